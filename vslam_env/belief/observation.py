"""Belief and scan become the arrays that PettingZoo hands to an agent: pure functions, and their spaces.

| key | shape | content, own estimated frames only | bounds |
|---|---|---|---|
| `pose` | (3,) | x, y [m], theta [rad], start frame | +-30, pi |
| `pose_std` | (3,) | one sigma of each [m, m, rad] | 30, pi |
| `map_stats` | (6,) | landmarks; mean and largest one sigma [m]; mean count; ESS / M; group size | `MAP_STATS_LIMIT` |
| `local_grid` | (3, 48, 48) uint8 | free, occupied, landmarks; cells of 0.2 m, ahead is up | 0, 255 |
| `scan` | (R,) | ranges from right to left [m] | range of the scan |
| `candidates` | (16, 5) | see `CandidateSlots.features` [m] | +-90 |
| `teammates` | (7, 5) | x, y [m], cos and sin of the heading, robot frame; one sigma of the position [m] | +-90 |
| `teammates_mask` | (7,) int8 | which rows hold a robot of the same group | 0, 1 |
| `action_mask` | (17,) int8 | `goal` actions only: which actions are valid | 0, 1 |

Rows of `teammates` belong to the other robots by rising index, whatever the group; rows without a member are zeros. The
one sigma of a landmark is the root of its mean variance. Values beyond the bounds are clipped.
"""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray
from vslam_env.belief._observation_kernels import (
    CHANNELS,
    GRID_ON,
    MAP_STATS_LIMIT,
    MAX_POSITION,
    MAX_TEAMMATES,
    POSE_LIMIT,
    SIZE,
    write_observations,
)
from vslam_env.belief.belief import Belief, BeliefBatch
from vslam_env.navigation.candidate_slots import FRONTIER_SIZE, NUM_FEATURES, NUM_SLOTS

NUM_ACTIONS = 1 + NUM_SLOTS

Observation = dict[str, NDArray[Any]]


def observe(belief: Belief, scan: FloatArray, goal_actions: bool) -> Observation:
    """Return a robot's observation.

    Args:
        belief: Belief of the robot.
        scan: (R,) float64 [m]. Its last scan.
        goal_actions: Whether actions are candidates, and are masked.

    Returns:
        Fresh arrays by name, as the table of this module says.
    """
    return observe_team(BeliefBatch.of(belief), scan[None], goal_actions)[0]


def observe_team(view: BeliefBatch, scans: FloatArray, goal_actions: bool) -> list[Observation]:
    """Return the observations of some robots.

    Args:
        view: What they show of the robots' beliefs.
        scans: (n, R) float64 [m]. The robots' last scans.
        goal_actions: Whether actions are candidates, and are masked.

    Returns:
        Per robot what `observe` returns, in memory that nothing else uses.
    """
    count, candidates = len(view.robots), view.features
    poses, deviations = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    stats, ranges = np.empty((count, 6), np.float32), np.empty(scans.shape, np.float32)
    teammates, present = np.empty((count, MAX_TEAMMATES, 5), np.float32), np.empty((count, MAX_TEAMMATES), np.int8)
    pictures = np.empty((count, len(CHANNELS), SIZE, SIZE), np.uint8)
    points, ((places, names), parts) = view.points, view.map_summaries
    arrays = poses, deviations, stats, pictures, ranges, candidates, teammates, present
    write_observations(view.robots, points.poses, points.beliefs, places, names, parts, view.cells, scans, arrays)
    observations: list[Observation] = []
    for i in range(count):  # by index: an array that is looped through ends with an error, and that costs microseconds
        observation: Observation = {
            "pose": poses[i],
            "pose_std": deviations[i],
            "map_stats": stats[i],
            "local_grid": pictures[i],
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
        (value / np.float32(GRID_ON) if name == "local_grid" else value).ravel()
        for name, value in observation.items()
        if name != "action_mask"
    ]
    return np.concatenate(parts).astype(np.float32)


def observation_space(num_rays: int, scan_range: float, goal_actions: bool, flat: bool) -> spaces.Space[Any]:
    """Return the space of the observations.

    Args:
        num_rays: R.
        scan_range: Range of the scan [m].
        goal_actions: Whether actions are masked.
        flat: One vector instead of named arrays. With masked actions it comes as `{"observation", "action_mask"}`.

    Returns:
        A `Dict`, or a `Box` if flat and without a mask.
    """
    named: dict[str, spaces.Space[Any]] = {
        "pose": _box(-POSE_LIMIT, POSE_LIMIT),
        "pose_std": _box(np.zeros(3), POSE_LIMIT),
        "map_stats": _box(np.zeros(6), MAP_STATS_LIMIT),
        "local_grid": spaces.Box(0, GRID_ON, (len(CHANNELS), SIZE, SIZE), np.uint8),
        "scan": _box(np.zeros(num_rays), np.full(num_rays, scan_range)),
        "candidates": _box(
            np.full((NUM_SLOTS, NUM_FEATURES), -MAX_POSITION), np.full((NUM_SLOTS, NUM_FEATURES), MAX_POSITION)
        ),
        "teammates": _box(np.full((MAX_TEAMMATES, 5), -MAX_POSITION), np.full((MAX_TEAMMATES, 5), MAX_POSITION)),
        "teammates_mask": spaces.Box(0, 1, (MAX_TEAMMATES,), np.int8),
    }
    mask = spaces.Box(0, 1, (NUM_ACTIONS,), np.int8)
    if not flat:
        return spaces.Dict(named | ({"action_mask": mask} if goal_actions else {}))
    lows = flatten({name: space.low for name, space in named.items() if isinstance(space, spaces.Box)})
    highs = flatten({name: space.high for name, space in named.items() if isinstance(space, spaces.Box)})
    vector = spaces.Box(lows, highs, dtype=np.float32)
    return spaces.Dict({"observation": vector, "action_mask": mask}) if goal_actions else vector


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
