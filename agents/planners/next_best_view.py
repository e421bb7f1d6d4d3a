"""`NextBestView`: planner that explores first, and then looks again at walls seen too rarely.

Ours; nearest to the greedy next-best-view planning of Gonzalez-Banos and Latombe, "Navigation strategies for exploring
indoor environments", IJRR 2002, and to the active revisits of Stachniss, Haehnel and Burgard, "Exploration with active
loop-closing for FastSLAM", IROS 2004. The map error counts landmarks measured too rarely as missing, so that looking
again pays; but maps must meet first, since each robot is scored by the map that it shares. So the time is divided:

1. A robot explores while there are frontiers to which no teammate has a shorter path, chosen by distance advantage
   (`agents.planners.distance_advantage`): of the planners here its robots share their maps earliest. Views on the way
   are not taken: each costs a stop, and exploring takes longer by more than they show.
2. Otherwise it goes to views, worth what they show, walls [m] looked at too little, for the path to them. Frontiers
   that are left to teammates come after that. Landmarks measured too rarely are no reason to go: most are false points.
3. If nothing is left to see and robots are missing in the group, or a loop can be closed, the robot goes to the nearest
   rendezvous.

Places that cannot be reached in the time that is left are passed over, and those to which a teammate is nearer or
drives already are left to it. With continuous actions robots sweep their cameras on the way (`DrivingPolicy`), so that
walls beside the path have their looks without a stop.
"""

import numpy as np

from agents.goal_choice import GoalHolder
from agents.planners.common.targets import own_targets
from agents.planners.distance_advantage import advantage_costs
from slam_backend.core.validation import BoolArray, FloatArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CandidateKind

STOP = 3.0  # [m] path that takes as long as the turn to a view and the look
PATH_POWER = 0.8  # exponent of the path's length: below 1, far views of much come before near views of little
HOLD = 1.5  # factor for the value of the current goal
PATH_SPREAD = 2.0  # [m] by which one frontier must cost more than another to be e times less preferred
VIEW_SHARPNESS = 4.0  # power of the rates of views that gives preferences


class NextBestView(GoalHolder):
    """Planner that explores, looks again and meets, in this order, within the time that is left."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to, or None if there is nothing left to see."""
        self._held, _ = decide(belief, self._held)
        return self._held


def decide(belief: Belief, held: int | None) -> tuple[int | None, FloatArray]:
    """Return the slot to go to, and how much each action is preferred.

    Args:
        belief: Belief of the robot.
        held: Slot of its previous goal.

    Returns:
        The slot, or None to stay; and (1 + C,) float64 logarithms of preferences, for staying and for the slots, up to
        a constant: -inf for actions that are not considered. The slot has the highest one.
    """
    candidates = belief.candidates
    can_reach = candidates.valid & (candidates.lengths < belief.seconds_left)
    preferences = np.full(1 + len(can_reach), -np.inf)
    frontiers, costs, is_own = np.empty(0, np.int64), np.empty(0), False
    if (can_reach & (candidates.kinds == CandidateKind.FRONTIER)).any():
        targets = own_targets(belief, held)
        assert targets is not None  # there is a frontier
        share, costs = advantage_costs(targets, 0)
        frontiers = targets.slots[0, share]
        is_own = bool((targets.lengths.argmin(axis=0) == 0).any())
    if not is_own:
        rates, allowed = view_rates(belief, held), _left_views(belief, can_reach)
        values = np.where(allowed, rates, 0.0)
        if (slot := _best(values)) is not None:
            preferences[1:] = VIEW_SHARPNESS * np.log(values, out=np.full(len(values), -np.inf), where=values > 0.0)
            return slot, preferences
    if len(frontiers):
        preferences[1 + frontiers] = -costs / PATH_SPREAD
        return int(frontiers[np.argmin(costs)]), preferences
    meetings = np.where(
        can_reach & (candidates.kinds == CandidateKind.RENDEZVOUS), 1.0 / (1.0 + candidates.lengths), 0.0
    )
    slot = _best(meetings)
    if slot is None:
        preferences[0] = 0.0
    else:
        is_meeting = meetings > 0.0
        preferences[1:][is_meeting] = -candidates.lengths[is_meeting] / PATH_SPREAD
    return slot, preferences


def _left_views(belief: Belief, can_reach: BoolArray) -> BoolArray:
    """Return the views (C,) left to this robot; if there are none, those no teammate goes to, or else all."""
    candidates = belief.candidates
    is_view = can_reach & (view_rates(belief) > 0.0)
    is_nearest = candidates.lengths <= candidates.teammate_lengths.min(axis=1, initial=np.inf)
    for allowed in (is_nearest & ~candidates.teammate_goal, ~candidates.teammate_goal):
        if (is_view & allowed).any():
            return is_view & allowed
    return is_view


def view_rates(belief: Belief, held: int | None = None) -> FloatArray:
    """Return what each revisit candidate shows for the path to it, (C,) float64; 0 for other kinds and empty slots.

    Args:
        belief: Belief of the robot.
        held: Slot of its previous goal.
    """
    candidates = belief.candidates
    values = candidates.gains.unseen_wall.copy()
    if held is not None:
        values[held] *= HOLD
    is_view = candidates.kinds == CandidateKind.REVISIT
    lengths = np.where(is_view, candidates.lengths, 0.0)
    return np.asarray(np.where(is_view, values / (STOP + lengths) ** PATH_POWER, 0.0))


def _best(values: FloatArray) -> int | None:
    """Return the index of the largest value > 0, or None."""
    return int(values.argmax()) if values.max(initial=0.0) > 0.0 else None
