"""Belief and scan become the arrays that PettingZoo hands to an agent: pure functions, and their spaces.

| key | shape | content, own estimated frames only | bounds |
|---|---|---|---|
| `pose` | (3,) | x, y [m], theta [rad], start frame | +-30, pi |
| `pose_std` | (3,) | one sigma of each [m, m, rad] | 30, pi |
| `map_stats` | (6,) | landmarks; mean and largest one sigma [m]; mean count; ESS / M; group size | `MAP_STATS_LIMIT` |
| `local_grid` | (3, 48, 48) uint8 | see `local_grid` | 0, 255 |
| `scan` | (R,) | ranges from right to left [m] | range of the scan |
| `candidates` | (16, 5) | see `CandidateSlots.features` [m] | +-90 |
| `teammates` | (7, 5) | x, y [m], cos and sin of the heading, robot frame; one sigma of the position [m] | +-90 |
| `teammates_mask` | (7,) int8 | which rows hold a robot of the same group | 0, 1 |
| `action_mask` | (17,) int8 | `goal` actions only: which actions are valid | 0, 1 |

Rows of `teammates` belong to the other robots by rising index, whatever the group; rows without a member are zeros. The
one sigma of a landmark is the root of its mean variance. Values beyond the bounds are clipped.
"""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from vslam_env.local_grid import CHANNELS, MARK, SIZE, local_grid
from vslam_env.navigation.candidate_slots import NUM_SLOTS
from vslam_env.robot_belief import Belief, Glimpse

MOST_TEAMMATES = 7
NUM_ACTIONS = 1 + NUM_SLOTS
POSE_LIMIT = np.array([30.0, 30.0, np.pi])
FAR = 90.0  # [m] more than the diagonal of the seen grid
MAP_STATS_LIMIT = np.array([10_000.0, 10.0, 10.0, 10_000.0, 1.0, 1.0 + MOST_TEAMMATES])

Observation = dict[str, NDArray[Any]]


def observe(belief: Belief, scan: FloatArray, goal_actions: bool) -> Observation:
    """Return a robot's observation.

    Args:
        belief: Of the robot.
        scan: (R,) float64 [m]. Its last scan.
        goal_actions: Whether actions are candidates, and are masked.

    Returns:
        Fresh arrays by name, as the table of this module says.
    """
    return observe_glimpse(Glimpse.of(belief), scan, goal_actions)


def observe_glimpse(glimpse: Glimpse, scan: FloatArray, goal_actions: bool) -> Observation:
    """Return what `observe` returns, from the part of the belief that it shows."""
    numbers, candidates = np.empty(12, np.float32), glimpse.features
    teammates, present = np.zeros((MOST_TEAMMATES, 5), np.float32), np.zeros(MOST_TEAMMATES, np.int8)
    _fill(
        glimpse.pose,
        glimpse.covariance,
        glimpse.outline.variances,
        glimpse.outline.counts,
        glimpse.ess,
        glimpse.group_size,
        glimpse.robot,
        glimpse.mates,
        glimpse.mate_poses,
        glimpse.mate_sigmas,
        numbers,
        candidates,
        teammates,
        present,
    )
    observation: Observation = {
        "pose": numbers[:3],
        "pose_std": numbers[3:6],
        "map_stats": numbers[6:],
        "local_grid": local_grid(glimpse),
        "scan": scan.astype(np.float32),
        "candidates": candidates,
        "teammates": teammates,
        "teammates_mask": present,
    }
    if goal_actions:
        observation["action_mask"] = action_mask(glimpse.valid)
    return observation


def action_mask(valid: NDArray[np.int8]) -> NDArray[np.int8]:
    """Return which `goal` actions are valid (17,) int8: staying always is, the others where `valid` (16,) says so."""
    mask = np.ones(NUM_ACTIONS, np.int8)
    mask[1:] = valid
    return mask


def flatten(observation: Observation) -> NDArray[np.float32]:
    """Return everything but the action mask as one float32 vector, in the order of the table; the grid as 0 and 1."""
    parts = [
        (value / np.float32(MARK) if name == "local_grid" else value).ravel()
        for name, value in observation.items()
        if name != "action_mask"
    ]
    return np.concatenate(parts).astype(np.float32)


def observation_space(num_rays: int, scan_range: float, goal_actions: bool, flat: bool) -> spaces.Space[Any]:
    """Return the space of the observations.

    Args:
        num_rays: R.
        scan_range: [m].
        goal_actions: Whether actions are masked.
        flat: One vector instead of named arrays. With masked actions it comes as `{"observation", "action_mask"}`.

    Returns:
        A `Dict`, or a `Box` if flat and without a mask.
    """
    named: dict[str, spaces.Space[Any]] = {
        "pose": _box(-POSE_LIMIT, POSE_LIMIT),
        "pose_std": _box(np.zeros(3), POSE_LIMIT),
        "map_stats": _box(np.zeros(6), MAP_STATS_LIMIT),
        "local_grid": spaces.Box(0, MARK, (len(CHANNELS), SIZE, SIZE), np.uint8),
        "scan": _box(np.zeros(num_rays), np.full(num_rays, scan_range)),
        "candidates": _box(np.full((NUM_SLOTS, 5), -FAR), np.full((NUM_SLOTS, 5), FAR)),
        "teammates": _box(np.full((MOST_TEAMMATES, 5), -FAR), np.full((MOST_TEAMMATES, 5), FAR)),
        "teammates_mask": spaces.Box(0, 1, (MOST_TEAMMATES,), np.int8),
    }
    mask = spaces.Box(0, 1, (NUM_ACTIONS,), np.int8)
    if not flat:
        return spaces.Dict(named | ({"action_mask": mask} if goal_actions else {}))
    lows = flatten({name: space.low for name, space in named.items() if isinstance(space, spaces.Box)})
    highs = flatten({name: space.high for name, space in named.items() if isinstance(space, spaces.Box)})
    vector = spaces.Box(lows, highs, dtype=np.float32)
    return spaces.Dict({"observation": vector, "action_mask": mask}) if goal_actions else vector


@jit
def _clip(value: float, low: float, high: float) -> Any:
    """Clip to bounds that are rounded as those of the space are."""
    return min(max(np.float32(value), np.float32(low)), np.float32(high))


@jit
def _fill(
    pose: Any,
    covariance: Any,
    variances: Any,
    counts: Any,
    ess: float,
    group_size: int,
    robot: int,
    mates: Any,
    mate_poses: Any,
    mate_sigmas: Any,
    numbers: Any,
    candidates: Any,
    teammates: Any,
    present: Any,
) -> None:
    """Write the parts of an observation that are neither a picture nor a scan.

    Args:
        pose: As in `Glimpse`, like all up to `mate_sigmas`.
        covariance: The same.
        variances: (N,) float64 [m^2]. Traces of the landmarks' covariances.
        counts: (N,) int64.
        ess: The same.
        group_size: The same.
        robot: The same.
        mates: The same.
        mate_poses: The same.
        mate_sigmas: The same.
        numbers: (12,) float32: `pose`, `pose_std`, `map_stats`. Written to, as all that follow.
        candidates: (16, 5) float32, as they are without bounds.
        teammates: (7, 5) float32, zeros before.
        present: (7,) int8, zeros before.
    """
    for i in range(3):
        numbers[i] = _clip(pose[i], -POSE_LIMIT[i], POSE_LIMIT[i])
        numbers[3 + i] = _clip(math.sqrt(covariance[i, i]), 0.0, POSE_LIMIT[i])
    mean = largest = seen = 0.0
    for k in range(len(counts)):
        sigma = math.sqrt(variances[k] / 3.0)
        mean += sigma / len(counts)
        largest = max(largest, sigma)
        seen += counts[k] / len(counts)
    numbers[6] = _clip(len(counts), 0.0, MAP_STATS_LIMIT[0])
    numbers[7] = _clip(mean, 0.0, MAP_STATS_LIMIT[1])
    numbers[8] = _clip(largest, 0.0, MAP_STATS_LIMIT[2])
    numbers[9] = _clip(seen, 0.0, MAP_STATS_LIMIT[3])
    numbers[10] = _clip(ess, 0.0, MAP_STATS_LIMIT[4])
    numbers[11] = _clip(group_size, 0.0, MAP_STATS_LIMIT[5])
    for i in range(len(candidates)):
        for j in range(5):
            candidates[i, j] = _clip(candidates[i, j], -FAR, FAR)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for m in range(len(mates)):
        row = mates[m] - (mates[m] > robot)
        dx, dy = mate_poses[m, 0] - pose[0], mate_poses[m, 1] - pose[1]
        turn = mate_poses[m, 2] - pose[2]
        teammates[row, 0], teammates[row, 1] = _clip(c * dx + s * dy, -FAR, FAR), _clip(c * dy - s * dx, -FAR, FAR)
        teammates[row, 2], teammates[row, 3] = np.float32(math.cos(turn)), np.float32(math.sin(turn))
        teammates[row, 4] = _clip(mate_sigmas[m], -FAR, FAR)
        present[row] = 1


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
