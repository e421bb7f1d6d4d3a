"""The soak test of merges runs, and reports the outcome of each merge."""

import math
from pathlib import Path

from studies.merging import soak


def test_folders_are_replaced_by_their_floor_plans(tmp_path: Path) -> None:
    """Families keep their names; the plans of a folder are sorted by name."""
    for name in ("b.png", "a.png", "notes.txt"):
        (tmp_path / name).touch()
    assert soak.named_worlds(["maze", str(tmp_path)]) == ["maze", str(tmp_path / "a.png"), str(tmp_path / "b.png")]


def test_a_forced_false_merge_is_undone() -> None:
    """Two robots merged by the wrong transform with the best fit count as a false merge that is correctly undone."""
    merges, late, end = soak.play_aisles(9000, 120, soak.Setting(forced=True))
    (merge,) = merges
    assert merge.is_false
    assert merge.wrong_pairs > 0.9
    assert math.isnan(merge.doubt)
    assert merge.undone_after is not None
    assert merge.is_rightly_undone
    assert "correctly" in soak.describe_merge(merge)
    assert (end.seed, end.world, end.last_merge, late) == (9000, "aisles", None, [])
    assert len(end.groups) > 1
    summary = soak.summarise(merges, late, [end], 120)
    assert (summary["false_merges"], summary["false_merges_undone"], summary["wrongly_undone"]) == (1, 1, 0)
    assert summary["runs_in_one_group"] == 0
