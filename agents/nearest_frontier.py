"""`NearestFrontier`: drives to the nearest place to explore that no teammate is nearer to."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import centre_of, distance_map, follow_path, plan_path

SWITCH_RATIO = 0.5  # leave a goal for one whose path is less than this share of the way that is left
REPLAN_TICKS = 10
FAR_SHARE = 0.3  # patrols lead to one of the farthest places
ARRIVED = 0.5  # [m]
MAX_SPEED, MAX_TURN = 1.0, 1.5  # [m/s], [rad/s] where continuous actions are 1
NO_WAY = np.iinfo(np.int32).max  # in `DistanceMap.cost`
STAY, AHEAD, LEFT, RIGHT = 0, 1, 2, 3  # discrete actions
TURN_FIRST = 0.5  # [rad/s] a discrete action turns if the pursuit asks for at least this


def choose_slot(belief: Belief, held: int | None = None) -> int | None:
    """Return the slot of the nearest candidate by path length, or None if there is none.

    Candidates that a teammate is nearer to, even as the crow flies, are left to it unless there are no others.

    Args:
        belief: Of the robot.
        held: The slot chosen before; it is kept unless the candidate is gone or another is much nearer.
    """
    candidates = belief.candidates
    slots = np.flatnonzero(candidates.valid)
    if not len(slots):
        return None
    mates = np.array([mate.pose[:2] for mate in belief.teammates]).reshape(-1, 2)
    gaps = np.linalg.norm(candidates.goals[slots, None] - mates[None], axis=-1)
    own = slots[(gaps >= candidates.lengths[slots, None]).all(axis=1)]
    choices = own if len(own) else slots
    nearest = int(choices[np.argmin(candidates.lengths[choices])])
    if held is not None and held in choices:
        turns_off = candidates.lengths[nearest] < SWITCH_RATIO * candidates.lengths[held]
        return nearest if turns_off else held
    return nearest


class NearestFrontierGoals:
    """The policy for `goal` actions; stays where nothing is left to explore."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._held: int | None = None

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 1 + the slot of the chosen candidate, or 0."""
        self._held = choose_slot(belief, self._held)
        return 0 if self._held is None else 1 + self._held


class NearestFrontier:
    """The policy for `continuous` and `discrete` actions: plans on the robot's own grid and drives along.

    Where nothing is left to explore it patrols to far places, so that groups meet whose maps could not be aligned yet.

    Args:
        discrete: Whether actions are `discrete` ones; else `continuous` ones.
    """

    def __init__(self, discrete: bool = False) -> None:
        self._discrete = discrete
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._held: int | None = None
        self._patrol: FloatArray | None = None
        self._path: FloatArray | None = None
        self._heading: float | None = None
        self._age = REPLAN_TICKS

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int | NDArray[np.float32]:
        """Return the action that drives towards the chosen place."""
        self._age += 1
        if self._path is None or self._age >= REPLAN_TICKS:
            self._plan(belief, rng)
        if self._path is None:
            speed, turn = 0.0, MAX_TURN  # looks around until floor to drive on is seen
        else:
            speed, turn = follow_path(belief.pose, self._path, MAX_SPEED, MAX_TURN, self._heading)
        if self._discrete:
            if abs(turn) >= TURN_FIRST or (speed == 0.0 and turn != 0.0):
                return LEFT if turn > 0.0 else RIGHT
            return AHEAD if speed > 0.0 else STAY
        return np.array([speed / MAX_SPEED, turn / MAX_TURN], dtype=np.float32)

    def _plan(self, belief: Belief, rng: np.random.Generator) -> None:
        """Choose where to go, and a path to it."""
        self._age = 0
        self._held = choose_slot(belief, self._held)
        if self._held is not None:
            goal, self._heading = belief.candidates.goals[self._held], float(belief.candidates.headings[self._held])
        else:
            here = belief.pose[:2]
            if self._patrol is None or np.linalg.norm(self._patrol - here) < ARRIVED:
                self._patrol = patrol_goal(belief, rng)
            goal, self._heading = self._patrol, None
        self._path = plan_path(belief.grid.cells, belief.pose[:2], goal)
        if self._path is None:
            self._patrol = None
        elif self._held is None:
            self._patrol = self._path[-1]  # as near as one gets to a place beside which a wall has come to be seen


def patrol_goal(belief: Belief, rng: np.random.Generator) -> FloatArray:
    """Draw one of the farthest places (2,) [m], start frame, that the robot can reach over floor it has seen.

    Where it can reach nothing it is the robot's own place.
    """
    ways = distance_map(belief.grid.cells, belief.pose[:2])
    rows, cols = np.nonzero(ways.cost < NO_WAY)
    if not len(rows):
        return np.array(belief.pose[:2])
    costs = ways.cost[rows, cols]
    place = int(rng.choice(np.flatnonzero(costs >= np.quantile(costs, 1.0 - FAR_SHARE))))
    return centre_of(np.array([rows[place], cols[place]]) + ways.corner)
