"""`NextBestView`: planner that explores first, and then looks again at walls and landmarks seen too rarely.

Ours; nearest to the greedy next-best-view planning of Gonzalez-Banos and Latombe, "Navigation strategies for exploring
indoor environments", IJRR 2002, and to the active revisits of Stachniss, Haehnel and Burgard, "Exploration with active
loop-closing for FastSLAM", IROS 2004. The map error counts landmarks measured too rarely as missing, so that looking
again pays; but maps must meet first, since each robot is scored by the map that it shares. So the time is divided:

1. A robot explores while there are frontiers to which no teammate has a shorter path, chosen by distance advantage
   (`agents.distance_advantage`): of the planners here its robots share their maps earliest. Views on the way are not
   taken: each costs a stop, and exploring takes longer by more than they show.
2. Otherwise it goes to views, worth what they show, walls [m] looked at too little and weak landmarks, for the path to
   them. Frontiers that are left to teammates come after that.
3. If nothing is left to see and robots are missing in the group, or a loop can be closed, the robot goes to the nearest
   rendezvous.

Places that cannot be reached in the time that is left are passed over, and those to which a teammate is nearer or
drives already are left to it. With continuous actions robots sweep their cameras on the way (`DrivingPolicy`), so that
walls beside the path have their looks without a stop.
"""

import numpy as np

from agents.distance_advantage import distance_advantage
from agents.targets import own_targets
from slam_backend.core.validation import BoolArray, FloatArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CandidateKind

LANDMARK_VALUE = 0.6  # [m] of unseen wall that a weak landmark is worth
STOP = 3.0  # [m] path that takes as long as the turn to a view and the look
PATH_POWER = 0.8  # exponent of the path's length: below 1, far views of much come before near views of little
HOLD = 1.5  # factor for the value of the current goal


class NextBestView:
    """Planner that explores, looks again and meets, in this order, within the time that is left."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._held: int | None = None

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to, or None if there is nothing left to see."""
        candidates = belief.candidates
        can_reach = candidates.valid & (candidates.lengths < belief.seconds_left)
        frontier, is_own = None, False
        if (can_reach & (candidates.kinds == CandidateKind.FRONTIER)).any():
            targets = own_targets(belief, self._held)
            assert targets is not None  # there is a frontier
            frontier = int(targets.slots[0, distance_advantage(targets, rng)[0]])
            is_own = bool((targets.lengths.argmin(axis=0) == 0).any())
        if not is_own:
            self._held = self._view(belief, can_reach)
        if is_own or self._held is None:
            self._held = frontier
        if self._held is None:
            is_meeting = can_reach & (candidates.kinds == CandidateKind.RENDEZVOUS)
            self._held = _best(1.0 / (1.0 + candidates.lengths), is_meeting)
        return self._held

    def _view(self, belief: Belief, can_reach: BoolArray) -> int | None:
        """Return the slot of the best view: of those left to this robot, of those no teammate goes to, or of all."""
        candidates, rates = belief.candidates, view_rates(belief, self._held)
        is_nearest = candidates.lengths <= candidates.teammate_lengths.min(axis=1, initial=np.inf)
        for allowed in (is_nearest & ~candidates.teammate_goal, ~candidates.teammate_goal, can_reach):
            best = _best(rates, can_reach & allowed)
            if best is not None:
                return best
        return None


def view_rates(belief: Belief, held: int | None = None) -> FloatArray:
    """Return what each revisit candidate shows for the path to it, (C,) float64; 0 for other kinds and empty slots.

    Args:
        belief: Belief of the robot.
        held: Slot of its previous goal.
    """
    candidates = belief.candidates
    values = candidates.gains.unseen_wall + LANDMARK_VALUE * candidates.gains.weak_landmarks
    if held is not None:
        values[held] *= HOLD
    is_view = candidates.kinds == CandidateKind.REVISIT
    lengths = np.where(is_view, candidates.lengths, 0.0)
    return np.asarray(np.where(is_view, values / (STOP + lengths) ** PATH_POWER, 0.0))


def _best(values: FloatArray, allowed: BoolArray) -> int | None:
    """Return the index of the largest value > 0 among the allowed ones, or None."""
    masked = np.where(allowed, values, 0.0)
    return int(masked.argmax()) if masked.max(initial=0.0) > 0.0 else None
