import public_api


def test_public_names_and_signatures_are_the_recorded_ones() -> None:
    """A change of what others import is meant, recorded, and listed in the changelog, old -> new."""
    recorded = public_api.FILE.read_text(encoding="utf-8").splitlines()
    found = list(dict.fromkeys(public_api.public_api()))
    gone, new = set(recorded) - set(found), set(found) - set(recorded)
    cure = "Record them with `python tests/regression/public_api.py --record` and list old -> new in CHANGELOG.md."
    assert not gone | new, f"gone: {sorted(gone)}\nnew: {sorted(new)}\n{cure}"
