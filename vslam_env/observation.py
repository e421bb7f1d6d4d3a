"""Belief and scan become the arrays that PettingZoo hands to an agent: pure functions, and their spaces.

| key | shape | content, own estimated frames only | bounds |
|---|---|---|---|
| `pose` | (3,) | x, y [m], theta [rad], start frame | +-30, pi |
| `pose_std` | (3,) | one sigma of each [m, m, rad] | 30, pi |
| `map_stats` | (6,) | landmarks; mean and largest one sigma [m]; mean count; ESS / M; group size | `MAP_STATS_LIMIT` |
| `local_grid` | (3, 48, 48) uint8 | see `local_grids` | 0, 255 |
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
from vslam_env.local_grid import CHANNELS, MARK, SIZE, local_grids
from vslam_env.navigation.candidate_slots import FRONTIER_SIZE, NUM_FEATURES, NUM_SLOTS
from vslam_env.robot_belief import Belief, View

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
    return observed(View.of(belief), scan[None], goal_actions)[0]


def observed(view: View, scans: FloatArray, goal_actions: bool) -> list[Observation]:
    """Return the observations of some robots.

    Args:
        view: What they show of the robots' beliefs.
        scans: (n, R) float64 [m]. The robots' last scans.
        goal_actions: Whether actions are candidates, and are masked.

    Returns:
        Per robot what `observe` returns, in memory that nothing else uses.
    """
    count, candidates = len(view.robots), view.features
    numbers, ranges = np.empty((count, 12), np.float32), np.empty(scans.shape, np.float32)
    teammates, present = np.empty((count, MOST_TEAMMATES, 5), np.float32), np.empty((count, MOST_TEAMMATES), np.int8)
    points, (rows, parts) = view.points, view.outlines
    _fill(
        view.robots, points.poses, points.sigmas, points.own, points.covariances, points.ess,
        rows.variances, rows.counts, parts, scans, numbers, ranges, candidates, teammates, present,
    )  # fmt: skip
    grids = local_grids(view)
    observations: list[Observation] = []
    for i in range(count):  # by index: an array that is looped through ends with an error, and that costs microseconds
        observation: Observation = {
            "pose": numbers[i, :3],
            "pose_std": numbers[i, 3:6],
            "map_stats": numbers[i, 6:],
            "local_grid": grids[i],
            "scan": ranges[i],
            "candidates": candidates[i],
            "teammates": teammates[i],
            "teammates_mask": present[i],
        }
        if goal_actions:
            observation["action_mask"] = action_mask(candidates[i])
        observations.append(observation)
    return observations


def action_mask(candidates: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return which `goal` actions are valid (17,) int8: staying always is, the others where there is a candidate."""
    mask = np.ones(NUM_ACTIONS, np.int8)
    mask[1:] = candidates[:, FRONTIER_SIZE] > 0.0
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
        "candidates": _box(np.full((NUM_SLOTS, NUM_FEATURES), -FAR), np.full((NUM_SLOTS, NUM_FEATURES), FAR)),
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
    robots: Any, poses: Any, sigmas: Any, own: Any, covariances: Any, ess: Any, variances: Any, counts: Any, parts: Any,
    scans: Any, numbers: Any, ranges: Any, candidates: Any, teammates: Any, present: Any,
) -> None:  # fmt: skip
    """Write the parts of observations that are no pictures.

    Args:
        robots: As in `View`.
        poses, sigmas, own, covariances, ess: Of its points.
        variances, counts, parts: (N,) float64 [m^2], (N,) int64, (n, 2) int64. Of its outlines.
        scans: (n, R) float64 [m].
        numbers: (n, 12) float32: `pose`, `pose_std`, `map_stats`. Written to, as all that follow.
        ranges: (n, R) float32: `scan`.
        candidates: (n, 16, 5) float32, as they are without bounds.
        teammates: (n, 7, 5) float32.
        present: (n, 7) int8: `teammates_mask`.
    """
    ranges[:], teammates[:], present[:] = scans, 0.0, 0
    for k in range(len(robots)):
        row, pose = numbers[k], own[k]
        for i in range(3):
            row[i] = _clip(pose[i], -POSE_LIMIT[i], POSE_LIMIT[i])
            row[3 + i] = _clip(math.sqrt(covariances[k, i, i]), 0.0, POSE_LIMIT[i])
        first, last = parts[k]
        total = largest = 0.0
        times = 0
        for landmark in range(first, last):
            sigma = math.sqrt(variances[landmark] / 3.0)
            total += sigma
            largest = max(largest, sigma)
            times += counts[landmark]
        held = max(last - first, 1)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        group_size = 1
        for mate in range(poses.shape[1]):
            if mate != robots[k] and not np.isnan(poses[k, mate, 0]):
                group_size += 1
                to, place = teammates[k, mate - (mate > robots[k])], poses[k, mate]
                dx, dy, turn = place[0] - pose[0], place[1] - pose[1], place[2] - pose[2]
                to[0], to[1] = _clip(c * dx + s * dy, -FAR, FAR), _clip(c * dy - s * dx, -FAR, FAR)
                to[2], to[3] = np.float32(math.cos(turn)), np.float32(math.sin(turn))
                to[4] = _clip(sigmas[k, mate], -FAR, FAR)
                present[k, mate - (mate > robots[k])] = 1
        row[6] = _clip(last - first, 0.0, MAP_STATS_LIMIT[0])
        row[7] = _clip(total / held, 0.0, MAP_STATS_LIMIT[1])
        row[8] = _clip(largest, 0.0, MAP_STATS_LIMIT[2])
        row[9] = _clip(times / held, 0.0, MAP_STATS_LIMIT[3])
        row[10] = _clip(ess[k], 0.0, MAP_STATS_LIMIT[4])
        row[11] = _clip(group_size, 0.0, MAP_STATS_LIMIT[5])
        for i in range(candidates.shape[1]):
            for j in range(candidates.shape[2]):
                candidates[k, i, j] = _clip(candidates[k, i, j], -FAR, FAR)


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
