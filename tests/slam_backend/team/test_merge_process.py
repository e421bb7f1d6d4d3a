"""A merge goes through the phases of its table."""

import re
from typing import Any

import numpy as np
import pytest
from builders.teams import SimulatedTeam, links

from slam_backend.team import merge
from slam_backend.team.branches import Branch
from slam_backend.team.merge import Attempt, MergeProcess, Smoothing, Trial, Undoing, Watched
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions


def table() -> list[str]:
    """Return the lines of the table of phases."""
    return re.findall(r"^ *(\|.*\|)$", MergeProcess.__doc__ or "", re.MULTILINE)


def transitions() -> set[tuple[str, str]]:
    """Return each phase with each of the phases that may follow."""
    found, phase = set(), ""
    for line in table()[2:]:
        first, _, _, following = (cell.strip() for cell in line[1:-1].split("|"))
        phase = first or phase
        found |= {(phase, part.split()[0].rstrip(",")) for part in following.split(";") if part.strip()}
    return found


def _often_refuted(number: int, trunk: Branch, *_: Any) -> bool:
    """Return whether a merge can be undone now, and the step is one of some."""
    monitors = trunk.monitors[trunk.merge_numbers.index(number) :]
    return all(each.both_sides_connected(trunk.active_robots) for each in monitors) and monitors[0].steps % 41 > 35


def test_merges_change_phases_as_the_table_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Teams with false merges, lost contacts and a caller that merges make most transitions, and no others."""
    made: set[tuple[str, str]] = set()
    for kind in (Attempt, Smoothing, Trial, Watched, Undoing):

        def noted(self: Any, team: Any, advance: Any = kind.advance) -> Any:
            phase = advance(self, team)
            made.update({(self.name, phase.name)} - {(self.name, self.name)})
            return phase

        monkeypatch.setattr(kind, "advance", noted)
    monkeypatch.setattr(merge, "is_refuted", _often_refuted)
    merging = MergeOptions(watch_every=2, blocked_steps=5, watch_steps=60)
    for seed, every in ((0, None), (1, 20), (2, 20)):
        rng, simulation = np.random.default_rng(seed), SimulatedTeam(4, 200 + seed)
        team = simulation.build(
            num_particles=9, attempts=AttemptOptions(every=5), merging=merging, rejuvenate_every=every
        )
        for _ in range(45):
            pairs = [(a, b) for a in range(4) for b in range(a) if rng.random() < 0.5]
            simulation.run(team, 8, links(4, *pairs))
    assert made <= transitions()
    assert {("attempt", "smoothing"), ("attempt", "trial"), ("smoothing", "trial"), ("trial", "watched")} <= made
    assert {("watched", "undoing"), ("undoing", "undone")} <= made
