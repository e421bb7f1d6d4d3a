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

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.errors import FloatArray
from slam_backend.geometry import between
from vslam_env.belief import Belief
from vslam_env.local_grid import CHANNELS, MARK, SIZE, local_grid
from vslam_env.navigation.frontiers import NUM_SLOTS

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
    observation: Observation = {
        "pose": _clipped(belief.pose, -POSE_LIMIT, POSE_LIMIT),
        "pose_std": _clipped(np.sqrt(np.diagonal(belief.covariance)), 0.0, POSE_LIMIT),
        "map_stats": _clipped(_map_stats(belief), 0.0, MAP_STATS_LIMIT),
        "local_grid": local_grid(belief),
        "scan": scan.astype(np.float32),
        "candidates": _clipped(belief.candidates.features, -FAR, FAR),
        **_teammates(belief),
    }
    if goal_actions:
        observation["action_mask"] = action_mask(belief)
    return observation


def action_mask(belief: Belief) -> NDArray[np.int8]:
    """Return which `goal` actions are valid (17,) int8: staying always is, the others if their slot is filled."""
    return np.concatenate([[True], belief.candidates.valid]).astype(np.int8)


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


def _map_stats(belief: Belief) -> FloatArray:
    landmarks = belief.group_map
    if not len(landmarks):
        return np.array([0.0, 0.0, 0.0, 0.0, belief.ess, len(belief.group)])
    sigmas = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2) / 3.0)
    counts = landmarks.counts.mean()
    return np.array([len(landmarks), sigmas.mean(), sigmas.max(), counts, belief.ess, len(belief.group)])


def _teammates(belief: Belief) -> Observation:
    rows = np.zeros((MOST_TEAMMATES, 5))
    mask = np.zeros(MOST_TEAMMATES, np.int8)
    for mate in belief.teammates:
        row = mate.robot - (mate.robot > belief.robot)
        x, y, theta = between(belief.pose, mate.pose).tolist()
        sigma = np.sqrt(0.5 * (mate.covariance[0, 0] + mate.covariance[1, 1]))
        rows[row] = x, y, np.cos(theta), np.sin(theta), sigma
        mask[row] = 1
    return {"teammates": _clipped(rows, -FAR, FAR), "teammates_mask": mask}


def _clipped(values: Any, low: Any, high: Any) -> NDArray[np.float32]:
    """Return a fresh float32 array within bounds, which are rounded as those of the space are."""
    return np.asarray(np.clip(np.asarray(values, np.float32), np.float32(low), np.float32(high)))


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
