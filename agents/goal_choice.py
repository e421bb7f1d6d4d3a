"""Policies that choose among candidates: for `goal` actions, or driving to the chosen one themselves.

A planner decides by its `choose` only; `GoalPolicy` turns its choice into an action, and `DrivingPolicy` drives to what
any policy for `goal` actions chooses.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.policy import Policy, keys_of
from slam_backend.core.validation import FloatArray, IntArray
from vslam_env.belief.team_belief import Belief, Candidates
from vslam_env.navigation import CandidateKind, distance_map
from vslam_env.navigation.driver import Driver
from vslam_env.navigation.planning import MAX_SPEED, MAX_TURN

SWITCH_RATIO = 0.5  # switch goals if the path is shorter than this share of the remaining path
REPLAN_TICKS = 10
FAR_SHARE = 0.3  # share of the reachable cells, farthest first, from which patrol goals are drawn
ARRIVED = 0.5  # [m]
UNREACHABLE = np.iinfo(np.int32).max  # unreachable, in `DistanceMap.cost`
STAY, AHEAD, LEFT, RIGHT = 0, 1, 2, 3  # discrete actions
SWEEP = 0.6  # [rad] to each side: walls of a corridor are seen within 60 degrees of incidence only if the camera turns
SWEEP_TICKS = 8  # on each side: the time to turn there at full rate
TURN_FIRST = 0.5  # [rad/s] desired turn rate from which a discrete action turns


class Planner(Protocol):
    """Choice among the candidates of one robot. Each robot needs a planner of its own."""

    def reset(self) -> None:
        """Clear the state of the last episode."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot of the candidate to go to, or None to stay."""


class GoalHolder:
    """Planner that remembers the slot that it chose last."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._held: int | None = None


class GoalPolicy:
    """Policy for `goal` actions that goes where a planner chooses, and stays where it chooses nothing.

    Args:
        planner: Planner of this robot.
    """

    observation_keys = ()

    def __init__(self, planner: Planner) -> None:
        self._planner = planner

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._planner.reset()

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 1 + the slot of the chosen candidate, or 0."""
        slot = self._planner.choose(belief, rng)
        return 0 if slot is None else 1 + slot


class DrivingPolicy:
    """Policy for `continuous` and `discrete` actions that plans on the robot's grid and follows the path to its goal.

    If nothing is chosen, the robot patrols to far places, so that groups whose maps are not aligned yet meet.

    Args:
        chooser: Policy of this robot for `goal` actions, asked once a second.
        discrete: Whether actions are `discrete`; otherwise they are `continuous`.
        sweeps: Whether the robot sweeps its camera from side to side on the way, with `continuous` actions: the walls
            beside a path are too oblique to be measured by a camera that looks along it.
    """

    def __init__(self, chooser: Policy, discrete: bool = False, sweeps: bool = False) -> None:
        self._chooser, self._discrete, self._sweeps = chooser, discrete, sweeps and not discrete
        self.observation_keys = keys_of(chooser)
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._chooser.reset()
        self._patrol: FloatArray | None = None
        self._driver = Driver()
        self._age = REPLAN_TICKS

    @property
    def goal(self) -> FloatArray | None:
        """(2,) float64 [m]. Place to which the robot drives, start frame; None: there is none."""
        path = self._driver.path
        return None if path is None else path[-1]

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int | NDArray[np.float32]:
        """Return the action that drives towards the goal."""
        self._age += 1
        if self._driver.path is None or self._age >= REPLAN_TICKS:
            self._plan(observation, belief, rng)
        if self._driver.path is None:
            speed, turn = 0.0, MAX_TURN  # turn on the spot until free floor is seen
        else:
            aside = 0.0
            if self._sweeps:
                aside = SWEEP if belief.tick % (2 * SWEEP_TICKS) < SWEEP_TICKS else -SWEEP
            speed, turn = self._driver.command(belief.pose, belief.grid, aside=aside)
        if self._discrete:
            if abs(turn) >= TURN_FIRST or (speed == 0.0 and turn != 0.0):
                return LEFT if turn > 0.0 else RIGHT
            return AHEAD if speed > 0.0 else STAY
        return np.array([speed / MAX_SPEED, turn / MAX_TURN], dtype=np.float32)

    def _plan(self, observation: Any, belief: Belief, rng: np.random.Generator) -> None:
        """Choose a goal and a path to it."""
        self._age = 0
        action = self._chooser.act(observation, belief, rng)
        slot = action - 1
        goal: tuple[FloatArray, float | None] | None
        if action > 0:
            goal = belief.candidates.goals[slot], float(belief.candidates.headings[slot])
        else:
            here = belief.pose[:2]
            if self._patrol is None or np.linalg.norm(self._patrol - here) < ARRIVED:
                self._patrol = patrol_goal(belief, rng)
            goal = None if self._patrol is None else (self._patrol, None)
        self._driver.set_goal(goal, belief.pose, belief.grid)
        if self._driver.path is None:
            self._patrol = None
        elif action == 0:
            self._patrol = self.goal  # the nearest reachable point, if a wall was discovered at the goal


def own_share(belief: Belief, slots: IntArray) -> IntArray:
    """Return those of the slots to which no teammate is nearer, in a straight line; all of them if there are none."""
    candidates = belief.candidates
    positions = np.array([mate.pose[:2] for mate in belief.teammates]).reshape(-1, 2)
    gaps = np.linalg.norm(candidates.goals[slots, None] - positions[None], axis=-1)
    nearer = slots[(gaps >= candidates.lengths[slots, None]).all(axis=1)]
    return nearer if len(nearer) else slots


def nearest_own_frontiers(belief: Belief, most: int) -> IntArray:
    """Return the slots of the nearest frontiers, at most `most`, of those to which no teammate is nearer."""
    candidates = belief.candidates
    slots = own_share(belief, candidates.of_kind(CandidateKind.FRONTIER))
    return slots[np.argsort(candidates.lengths[slots], kind="stable")][:most]


def nearest_slot(candidates: Candidates, slots: IntArray, held: int | None) -> int | None:
    """Return the slot with the shortest path, or None if there are no slots.

    Args:
        candidates: Candidates of the robot.
        slots: (n,) int64. Slots to choose from.
        held: Slot of the previous goal; it is kept unless it is not among the slots or another is much nearer.
    """
    if not len(slots):
        return None
    nearest = int(slots[np.argmin(candidates.lengths[slots])])
    if held is not None and held in slots:
        turns_off = candidates.lengths[nearest] < SWITCH_RATIO * candidates.lengths[held]
        return nearest if turns_off else held
    return nearest


def patrol_goal(belief: Belief, rng: np.random.Generator) -> FloatArray | None:
    """Draw one of the farthest points (2,) [m], start frame, that the robot can reach over known floor.

    If nothing is reachable, return None.
    """
    ways = distance_map(belief.grid, belief.pose[:2])
    rows, cols = np.nonzero(ways.cost < UNREACHABLE)
    if not len(rows):
        return None
    costs = ways.cost[rows, cols]
    place = int(rng.choice(np.flatnonzero(costs >= np.quantile(costs, 1.0 - FAR_SHARE))))
    return ways.centre_of([rows[place], cols[place]])
