"""`Targets`: frontiers that a group of robots divides among its members, as one robot or the whole group knows them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agents.goal_choice import SWITCH_RATIO
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import compose, inverse, transform_points
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import (
    CandidateKind,
    DistanceMap,
    cells_of,
    distance_map,
    lengths_between,
    rooms_of,
    sees,
)

MOST_TARGETS = 12  # per robot, nearest first: each costs a search of paths
SAME_TARGET = 1.0  # [m] frontiers of two robots nearer than this are the same
SIGHT = 8.0  # [m] assumed range of view
NO_PATH = 1e4  # [m] stands for the length of a path that a robot does not know


@short_repr
@dataclass(frozen=True, eq=False)
class Targets:
    """Frontiers and robots of one group; all places in the start frame of the first robot.

    Attributes:
        ways: Distance map over the floor that the first robot knows.
        positions: (K, 2) float64 [m]. Positions of the robots.
        places: (n, 2) float64 [m]. Goals of the frontiers.
        lengths: (K, n) float64 [m]. Lengths of the paths from the robots to the goals; `NO_PATH`: none is known.
            The length to a goal that a robot holds is halved, so that it is kept unless another is much better.
        slots: (K, n) int64. Slots of the frontiers among the candidates of each robot; -1: none.
        num_deciding: Number of robots, the first ones, whose targets are asked for; those of the others may be any.
    """

    ways: DistanceMap
    positions: FloatArray
    places: FloatArray
    lengths: FloatArray
    slots: IntArray
    num_deciding: int

    @cached_property
    def between(self) -> FloatArray:
        """(n, n) float64 [m]. Lengths of the paths between the goals, symmetric; `NO_PATH`: none is known."""
        lengths = np.minimum(lengths_between(self.ways, self.places, self.places), NO_PATH)
        both = np.minimum(lengths, lengths.T)  # a path may differ from its reverse by a few centimetres
        np.fill_diagonal(both, 0.0)
        return both

    @cached_property
    def seen_together(self) -> BoolArray:
        """(n, n) bool. Whether one goal is visible from the other within `SIGHT`."""
        return sees(self.ways, self.places, cells_of(self.ways, self.places), SIGHT)

    @cached_property
    def rooms(self) -> tuple[IntArray, IntArray]:
        """Rooms (K,) int64 of the robots and (n,) int64 of the goals, see `rooms_of`."""
        rooms = rooms_of(self.ways, np.concatenate([self.positions, self.places]))
        return rooms[: len(self.positions)], rooms[len(self.positions) :]

    def share(self, robot: int) -> IntArray:
        """Return the targets to which no other robot has a shorter path; if there are none, all that it can reach.

        Of robots with equal paths the one listed first has the target.
        """
        can_go = self.lengths[robot] < NO_PATH
        nearest = self.lengths.argmin(axis=0) == robot
        return np.flatnonzero(nearest & can_go) if (nearest & can_go).any() else np.flatnonzero(can_go)


def own_targets(belief: Belief, held: int | None) -> Targets | None:
    """Return the frontiers that a robot knows, with its teammates' paths over its own grid; None if there are none.

    Args:
        belief: Belief of the robot, which is listed first.
        held: Slot of its previous goal.
    """
    candidates = belief.candidates
    slots = _nearest(belief)
    if not len(slots):
        return None
    places = candidates.goals[slots]
    positions = np.array([belief.pose[:2], *(mate.pose[:2] for mate in belief.teammates)])
    ways = distance_map(belief.grid, belief.pose[:2])
    lengths = np.empty((len(positions), len(slots)))
    lengths[0] = candidates.lengths[slots]
    lengths[1:] = lengths_between(ways, positions[1:], places)
    straight = np.linalg.norm(places[None] - positions[:, None], axis=-1)
    lengths = np.where(np.isfinite(lengths), lengths, straight)  # a teammate whose place is known inaccurately
    if held is not None:
        lengths[0, slots == held] *= SWITCH_RATIO
    slots_of = np.full(lengths.shape, -1)
    slots_of[0] = slots
    return Targets(ways, positions, places, lengths, slots_of, 1)


def team_targets(beliefs: Sequence[Belief], held: Mapping[int, int | None]) -> Targets | None:
    """Return the frontiers of all robots of one group together; None if there are none.

    Args:
        beliefs: Beliefs of robots that share a map.
        held: Slot of the previous goal of each robot, by its index.
    """
    first = beliefs[0]
    places = np.empty((0, 2))
    entries: list[tuple[int, int, int, float]] = []  # robot, target, slot, length
    positions = []
    for row, belief in enumerate(beliefs):
        first_from_own = compose(first.start_from_group, inverse(belief.start_from_group))
        positions.append(transform_points(first_from_own, belief.pose[None, :2])[0])
        slots = _nearest(belief)
        goals = transform_points(first_from_own, belief.candidates.goals[slots])
        gaps = np.linalg.norm(places - goals[:, None], axis=-1)  # to the frontiers of the robots before
        for i, slot in enumerate(slots):
            target = int(gaps[i].argmin()) if gaps.shape[1] and gaps[i].min() < SAME_TARGET else len(places)
            if target == len(places):
                places = np.vstack([places, goals[i]])
            else:
                gaps[:, target] = np.inf  # a robot has at most one frontier for each target
            length = float(belief.candidates.lengths[slot])
            length *= SWITCH_RATIO if held.get(belief.robot) == slot else 1.0
            entries.append((row, target, int(slot), length))
    if not len(places):
        return None
    lengths = np.full((len(beliefs), len(places)), NO_PATH)
    slots_of = np.full(lengths.shape, -1)
    for row, target, slot, length in entries:
        lengths[row, target], slots_of[row, target] = length, slot
    ways = distance_map(first.grid, first.pose[:2])
    return Targets(ways, np.array(positions), places, lengths, slots_of, len(beliefs))


def _nearest(belief: Belief) -> IntArray:
    """Return the slots of a robot's nearest frontiers, at most `MOST_TARGETS`, in the order of their path lengths."""
    slots = belief.candidates.of_kind(CandidateKind.FRONTIER)
    return slots[np.argsort(belief.candidates.lengths[slots], kind="stable")][:MOST_TARGETS]
