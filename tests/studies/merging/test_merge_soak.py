"""The soak test of merges runs, and reports the outcome of each merge."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from studies.merging import soak
from vslam_env.world import portable_source


def test_folders_are_replaced_by_their_floor_plans(tmp_path: Path) -> None:
    """Families keep their names; the plans of a folder are sorted by name."""
    for name in ("b.png", "a.png", "notes.txt"):
        (tmp_path / name).touch()
    config = soak.Config.from_mapping({"worlds": ("maze", str(tmp_path), "aisles"), "seeds": 1})
    plans = [portable_source(str(tmp_path / f"{name}.png")) for name in "ab"]
    assert [trial.world for trial in soak.trials(config)] == ["maze", *plans, "aisles"]


@pytest.mark.parametrize(("values", "match"), [
    ({"shift": 0.6}, "shift: expected metres, with --forced"),
    ({"forced": True, "worlds": ("aisles", "maze")}, r"worlds: expected aisles or random with --forced, got \['maze"),
])  # fmt: skip
def test_what_cannot_be_forced_is_refused(values: dict[str, Any], match: str) -> None:
    """Shifts are those of forced merges, which worlds of `vslam run` do not have."""
    with pytest.raises(ValueError, match=match):
        soak.Config(**values)


def test_a_forced_false_merge_is_undone() -> None:
    """Two robots merged by the wrong transform with the best fit count as a false merge that is correctly undone."""
    config = soak.Config(forced=True, cycles=120, seeds=1, seed=9000)
    (trial,) = soak.trials(config)
    row = asdict(trial) | soak.play(config, trial)
    (merge,) = row["merges"]
    assert merge["wrong_pairs"] > 0.9
    assert merge["uncertainty"] is None
    assert merge["undone_after"] is not None
    assert merge["later"] is None
    assert soak.is_false(merge)
    assert not soak.is_wrongly_undone(merge)
    assert not soak.counts(merge)
    assert (row["one_group"], row["put_off"]) == (False, 0)
    runs, errors = (table.lines(soak.unfold([row])) for table in soak.STUDY.tables)
    assert [runs[0][name].value for name in ("runs", "merges", "false", "undone", "wrongly")] == [1, 1, 1, 1, 0]
    assert [(line["when"], line["false"].value) for line in errors] == [("when made", 1), ("at the end", 1)]


def test_right_merges_that_are_undone_or_stay_are_counted() -> None:
    """A merge that was right when made and when undone is wrongly undone; a false one counts after 200 steps."""
    right, wrong = (0.1, 1.0), (0.2, 6.0)
    merge = {"wrong_pairs": 0.0, "unsmoothed": None, "later": None, "last": right, "made": right, "undone_after": 30}
    merges = [merge, merge | {"undone_after": None}, merge | {"last": wrong}]
    merges += [merge | {"made": wrong, "undone_after": after} for after in (199, 201, None)]
    row = {"world": "maze", "seed": 0, "one_group": True, "put_off": 3, "ate_m": 0.1, "merges": merges}
    (line, pooled) = soak.STUDY.tables[0].lines(soak.unfold([row]))
    assert [line[name].value for name in ("merges", "false", "after 200", "undone", "wrongly")] == [6, 3, 2, 4, 1]
    assert pooled == line | {"world": "all"}
    by_when = {line["when"]: line for line in soak.STUDY.tables[1].lines(soak.unfold([row]))}
    assert by_when["when made"]["false"].value == 3
    assert by_when["when made"]["RMS [m]"].value == pytest.approx((0.5 * (0.1**2 + 0.2**2)) ** 0.5)
