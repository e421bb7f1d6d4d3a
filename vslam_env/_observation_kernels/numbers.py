"""The parts of observations that are no pictures, clipped to the bounds of their spaces."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place
from slam_backend.fastslam.relative_poses import COVARIANCE, ESS, OWN, SIGMAS

MOST_TEAMMATES = 7
POSE_LIMIT = np.array([30.0, 30.0, np.pi])
FAR = 90.0  # [m] more than the diagonal of the seen grid
MAP_STATS_LIMIT = np.array([10_000.0, 10.0, 10.0, 10_000.0, 1.0, 1.0 + MOST_TEAMMATES])


@device
@in_place
def _clip(value: float, low: float, high: float) -> np.float32:
    """Clip to bounds that are rounded as those of the space are."""
    return min(max(np.float32(value), np.float32(low)), np.float32(high))


@device
@in_place
def write_pose(belief: Any, pose: Any, sigmas: Any) -> None:
    """Write `pose` and `pose_std`, each (3,) float32, of a robot that believes this, see `Standpoints`."""
    for i in range(3):
        pose[i] = _clip(belief[OWN + i], -POSE_LIMIT[i], POSE_LIMIT[i])
        sigmas[i] = _clip(math.sqrt(belief[COVARIANCE + 4 * i]), 0.0, POSE_LIMIT[i])


@device
@in_place
def write_map_stats(places: Any, names: Any, belief: Any, group_size: int, stats: Any) -> None:
    """Write `map_stats` of a robot.

    Args:
        places, names: (m, 4), (m, 2) int64. Of its landmarks, see `OutlineRows`.
        belief: As in `write_pose`.
        group_size: Robots that share its map.
        stats: (6,) float32. Written to.
    """
    total = largest = 0.0
    times = 0
    for landmark in range(len(places)):
        sigma = math.sqrt(places[landmark, 3] / 3.0)
        total += sigma
        largest = max(largest, sigma)
        times += names[landmark, 0]
    held = max(len(places), 1)
    stats[0] = _clip(len(places), 0.0, MAP_STATS_LIMIT[0])
    stats[1] = _clip(total / held, 0.0, MAP_STATS_LIMIT[1])
    stats[2] = _clip(largest, 0.0, MAP_STATS_LIMIT[2])
    stats[3] = _clip(times / held, 0.0, MAP_STATS_LIMIT[3])
    stats[4] = _clip(belief[ESS], 0.0, MAP_STATS_LIMIT[4])
    stats[5] = _clip(group_size, 0.0, MAP_STATS_LIMIT[5])


@device
@in_place
def write_teammates(robot: int, poses: Any, belief: Any, teammates: Any, present: Any) -> int:
    """Write where a robot believes the others of its group to be; return how many these are.

    Args:
        robot: Its index.
        poses: (N, 3). Of all robots, start frame; NaN: it does not know.
        belief: As in `write_pose`.
        teammates: (7, 5) float32. Written to, as what follows.
        present: (7,) int8. `teammates_mask`.
    """
    teammates[:], present[:] = 0.0, 0
    x, y, theta = belief[OWN], belief[OWN + 1], belief[OWN + 2]
    c, s = math.cos(theta), math.sin(theta)
    known = 0
    for mate in range(len(poses)):
        if mate != robot and not np.isnan(poses[mate, 0]):
            known += 1
            to, place = teammates[mate - (mate > robot)], poses[mate]
            dx, dy, turn = place[0] - x, place[1] - y, place[2] - theta
            to[0], to[1] = _clip(c * dx + s * dy, -FAR, FAR), _clip(c * dy - s * dx, -FAR, FAR)
            to[2], to[3] = np.float32(math.cos(turn)), np.float32(math.sin(turn))
            to[4] = _clip(belief[SIGMAS + mate], -FAR, FAR)
            present[mate - (mate > robot)] = 1
    return known


@device
@in_place
def clip_candidates(features: Any) -> None:
    """Clip the features (16, 5) float32 of a robot's candidates."""
    for i in range(features.shape[0]):
        for j in range(features.shape[1]):
            features[i, j] = _clip(features[i, j], -FAR, FAR)
