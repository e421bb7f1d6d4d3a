"""Planners that use revisit and rendezvous candidates, on candidates given by hand."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from agents.goal_choice import Planner
from agents.planners.next_best_view import PATH_SPREAD, NextBestView, decide, view_rates
from agents.planners.rendezvous import INTERVAL, Rendezvous
from tests.agents.test_policies import ROOM
from vslam_env import vslam_v0
from vslam_env.belief.team_belief import Belief, Teammate
from vslam_env.navigation import CandidateGains, CandidateKind

FRONTIER, REVISIT, MEETING = CandidateKind.FRONTIER, CandidateKind.REVISIT, CandidateKind.RENDEZVOUS
RNG = np.random.default_rng(0)


def _belief(
    slots: dict[int, tuple[CandidateKind, float, float]], mates: dict[int, float] | None = None, **changes: Any
) -> Belief:
    """Return a belief with candidates at (1, slot / 10) of given kind, path length and unseen wall.

    Args:
        slots: Kind, path length [m] and unseen wall [m] of each filled slot.
        mates: Path length of a teammate by slot; None: no teammate.
        changes: Fields of the belief, or of its candidates.
    """
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, num_particles=5, action_type="goal", max_cycles=100)
    env.reset(seed=0)
    given = env.belief("robot_0")
    size = len(given.candidates.valid)
    values: dict[str, Any] = {
        "goals": np.full((size, 2), np.nan), "headings": np.full(size, np.nan), "lengths": np.full(size, np.nan),
        "valid": np.zeros(size, np.bool_), "kinds": np.full(size, -1), "sizes": np.full(size, np.nan),
        "gains": CandidateGains(*np.zeros((4, size))), "own_goal": np.zeros(size, np.bool_),
        "teammate_lengths": np.full((size, 0 if mates is None else 1), np.inf),
        "teammate_goal": np.zeros(size, np.bool_), "features": given.candidates.features,
    }  # fmt: skip
    for slot, (kind, length, wall) in slots.items():
        values["goals"][slot], values["headings"][slot], values["valid"][slot] = (1.0, slot / 10), 0.0, True
        values["kinds"][slot], values["lengths"][slot], values["gains"].unseen_wall[slot] = kind, length, wall
    for slot, length in (mates or {}).items():
        values["teammate_lengths"][slot, 0] = length
    own = {field.name for field in fields(type(given.candidates))}
    values |= {name: value for name, value in changes.items() if name in own}
    known: dict[str, Any] = {name: getattr(given, name) for name in given.__dataclass_fields__}
    known |= {"candidates": type(given.candidates)(**values), "seconds_left": 60.0}
    if mates is not None:
        known["teammates"] = (Teammate(1, np.array([5.0, 0.0, 0.0]), np.eye(3), np.full(2, np.nan)),)
    return Belief(**known | {name: value for name, value in changes.items() if name not in own})


def test_frontiers_come_before_views_and_views_before_meetings() -> None:
    """Frontiers are explored first, then walls looked at, then the robot meets; with nothing left it stays."""
    slots = {3: (FRONTIER, 9.0, 0.0), 20: (REVISIT, 1.0, 3.0), 29: (MEETING, 0.5, 0.0)}
    for expected in (3, 20, 29, None):
        assert NextBestView().choose(_belief(slots), RNG) == expected
        slots.pop(expected or -1, None)


def test_robots_look_again_while_teammates_explore_what_is_left() -> None:
    """A frontier to which a teammate, 4 m away, is nearer comes after views; one that is near comes before them."""
    far, near = (FRONTIER, 9.0, 0.0), (FRONTIER, 1.0, 0.0)
    view = {20: (REVISIT, 1.0, 3.0)}
    assert NextBestView().choose(_belief({3: far, **view}, {}), RNG) == 20
    assert NextBestView().choose(_belief({3: near, **view}, {}), RNG) == 3
    assert NextBestView().choose(_belief({3: far}, {}), RNG) == 3


def test_views_are_worth_what_they_show_for_the_path() -> None:
    """The rate grows with the wall and falls with the path; the current goal counts more; other kinds have none."""
    slots = {16: (REVISIT, 2.0, 1.0), 17: (REVISIT, 2.0, 2.0), 18: (REVISIT, 9.0, 2.0), 0: (FRONTIER, 1.0, 5.0)}
    rates = view_rates(_belief(slots))
    assert rates[17] > rates[18] > 0.0
    assert rates[17] == pytest.approx(2.0 * rates[16])
    assert rates[0] == 0.0
    assert view_rates(_belief(slots), 16)[16] == pytest.approx(1.5 * rates[16])


def test_preferences_follow_the_choice() -> None:
    """Only candidates of the kind that is due are preferred, by their costs; the choice has the highest preference."""
    frontiers = {3: (FRONTIER, 4.0, 0.0), 5: (FRONTIER, 7.0, 0.0), 20: (REVISIT, 1.0, 3.0), 29: (MEETING, 0.5, 0.0)}
    slot, preferences = decide(_belief(frontiers), None)
    assert (slot, np.flatnonzero(np.isfinite(preferences)).tolist()) == (3, [4, 6])
    assert preferences[4] - preferences[6] == pytest.approx(3.0 / PATH_SPREAD)
    assert decide(_belief(frontiers), 5)[0] == 5  # kept, since its path counts half
    views = {20: (REVISIT, 2.0, 3.0), 21: (REVISIT, 2.0, 1.0), 29: (MEETING, 0.5, 0.0)}
    slot, preferences = decide(_belief(views), None)
    assert (slot, np.flatnonzero(np.isfinite(preferences)).tolist()) == (20, [21, 22])
    assert preferences[21] > preferences[22]
    slot, preferences = decide(_belief({29: (MEETING, 0.5, 0.0)}), None)
    assert (slot, np.flatnonzero(np.isfinite(preferences)).tolist()) == (29, [30])
    slot, preferences = decide(_belief({}), None)
    assert (slot, np.flatnonzero(np.isfinite(preferences)).tolist()) == (None, [0])


def test_views_are_left_to_teammates_and_to_time() -> None:
    """Views to which a teammate is nearer or drives are left to it if there are others; late ones are dropped."""
    slots = {16: (REVISIT, 4.0, 3.0), 17: (REVISIT, 4.0, 1.0)}
    assert NextBestView().choose(_belief(slots), RNG) == 16
    assert NextBestView().choose(_belief(slots, {16: 2.0, 17: 9.0}), RNG) == 17
    taken = np.arange(32) == 16
    assert NextBestView().choose(_belief(slots, {16: 9.0, 17: 9.0}, teammate_goal=taken), RNG) == 17
    assert NextBestView().choose(_belief(slots, {16: 2.0, 17: 3.0}), RNG) == 16
    assert NextBestView().choose(_belief(slots, seconds_left=3.0), RNG) is None


def test_meetings_interrupt_exploration_at_intervals() -> None:
    """A rendezvous is due at intervals, not if it is far; after a visit exploration goes on."""
    planner: Planner = Rendezvous()
    slots = {3: (FRONTIER, 2.0, 0.0), 29: (MEETING, 6.0, 0.0)}
    assert planner.choose(_belief(slots, tick=10), RNG) == 3
    assert planner.choose(_belief(slots, tick=INTERVAL), RNG) == 29
    there = {3: (FRONTIER, 2.0, 0.0), 29: (MEETING, 0.5, 0.0)}
    assert planner.choose(_belief(there, tick=INTERVAL + 60), RNG) == 29
    assert planner.choose(_belief(slots, tick=INTERVAL + 70), RNG) == 3
    far = {3: (FRONTIER, 2.0, 0.0), 29: (MEETING, 40.0, 0.0)}
    assert Rendezvous().choose(_belief(far, tick=INTERVAL), RNG) == 3
    assert Rendezvous().choose(_belief({29: (MEETING, 40.0, 0.0)}, tick=10), RNG) == 29
    assert Rendezvous().choose(_belief({}, tick=10), RNG) is None
