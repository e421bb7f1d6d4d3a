"""Predicted uncertainty of a robot's pose along the paths to its candidates, for planners that weigh localisation.

The covariance grows with the motion, as the filter's odometry model assumes, and shrinks by the landmarks of the own
map that come into view (extended Kalman filter without noise in the mean). Readings are idealised: every landmark in
view within `SIGHT` and not behind a wall is measured once every `STEP`.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from agents.goal_choice import SWITCH_RATIO, nearest_own_frontiers
from slam_backend.core.validation import FloatArray, IntArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import DistanceMap, cells_of, distance_map, sees

SIGHT, HALF_VIEW = 6.0, 0.46  # [m], [rad] range and half the angle of view
STEP = 1.5  # [m] between predicted measurements
ALONG, ACROSS, TURN = 0.05, 0.02, math.pi / 90.0  # [m/m], [m/m], [rad/m]: assumed noise of the odometry
RANGE_SIGMA, SIDE_SIGMA = 0.01, 0.01  # [1/m] times the squared range, [m/m] times the range
MOST_PREDICTED = 6  # nearest candidates whose poses are predicted
LEAST_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])  # [m^2, m^2, rad^2] of a step, so that covariances are invertible


def best_of_nearest(
    belief: Belief, held: int | None, values: Callable[[Belief, IntArray, FloatArray], FloatArray]
) -> int | None:  # fmt: skip
    """Return the slot of most value among the nearest frontiers, or None if there is none.

    Args:
        belief: Belief of the robot.
        held: Slot of the previous goal, the path to which counts half.
        values: Function from the belief, slots (n,) and lengths (n,) [m] of the paths to them to their values (n,).
    """
    slots = nearest_own_frontiers(belief, MOST_PREDICTED)
    lengths = np.where(slots == held, SWITCH_RATIO, 1.0) * belief.candidates.lengths[slots]
    return int(slots[np.argmax(values(belief, slots, lengths))]) if len(slots) else None


def predict_covariances(belief: Belief, slots: IntArray) -> list[FloatArray]:
    """Return the predicted covariances (n_i, 3, 3) of the pose on the way to each candidate, the last one at its goal.

    Args:
        belief: Belief of the robot.
        slots: (k,) int64. Slots of candidates. Without a known path the present covariance is returned.
    """
    ways, candidates = distance_map(belief.grid, belief.pose[:2]), belief.candidates
    paths = [ways.path_to(candidates.goals[slot]) for slot in slots]
    poses = [
        belief.pose[None] if path is None else _poses_along(path, float(candidates.headings[slot]))
        for slot, path in zip(slots, paths, strict=True)
    ]
    held = belief.map
    information = _information(np.concatenate(poses), ways, held.means[:, :2], held.covariances[:, :2, :2])
    # All paths advance together; shorter ones stay at their goals.
    longest = max(map(len, poses))
    all_poses = np.stack([np.vstack([ahead, np.repeat(ahead[-1:], longest - len(ahead), axis=0)]) for ahead in poses])
    gained = np.zeros((len(poses), longest, 3, 3))
    starts = np.cumsum([0, *map(len, poses)])
    for k, ahead in enumerate(poses):
        gained[k, : len(ahead)] = information[starts[k] : starts[k + 1]]
    before = np.concatenate([np.repeat(belief.pose[None, None], len(poses), axis=0), all_poses[:, :-1]], axis=1)
    jacobians, noise = _motions(before, all_poses)
    transposed = np.ascontiguousarray(jacobians.swapaxes(-1, -2))
    covariance = np.repeat(belief.covariance[None] + LEAST_COVARIANCE, len(poses), axis=0)
    together = np.empty((len(poses), longest, 3, 3))
    for step in range(longest):
        covariance = jacobians[:, step] @ covariance @ transposed[:, step] + noise[:, step]
        covariance = np.asarray(np.linalg.inv(np.linalg.inv(covariance) + gained[:, step]), dtype=np.float64)
        covariance = np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)), dtype=np.float64)
        together[:, step] = covariance
    return [together[k, : len(ahead)] for k, ahead in enumerate(poses)]


def _information(poses: FloatArray, ways: DistanceMap, landmarks: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the information (P, 3, 3) about poses (P, 3) from one measurement of each landmark in view.

    The jacobian is that of the offset from the robot to the landmark, rotated to the world's axes.
    """
    low, high = poses[:, :2].min(axis=0) - SIGHT, poses[:, :2].max(axis=0) + SIGHT
    near = ((low <= landmarks) & (landmarks <= high)).all(axis=1)
    landmarks, covariances = landmarks[near], covariances[near]
    gaps = landmarks[None] - poses[:, None, :2]
    bearings = np.arctan2(gaps[..., 1], gaps[..., 0]) - poses[:, None, 2]
    in_view = np.abs((bearings + math.pi) % (2.0 * math.pi) - math.pi) < HALF_VIEW
    in_view &= (gaps**2).sum(axis=-1) < SIGHT**2
    in_view = sees(ways, poses[:, :2], cells_of(ways, landmarks), SIGHT, among=in_view)
    pose, landmark = np.nonzero(in_view)
    offsets = gaps[pose, landmark]
    ranges = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 0.5)
    along = offsets / ranges[:, None]
    outer = along[:, :, None] * along[:, None, :]
    noise = (SIDE_SIGMA * ranges)[:, None, None] ** 2 * (np.eye(2) - outer) + covariances[landmark]
    noise = noise + (RANGE_SIGMA * ranges**2)[:, None, None] ** 2 * outer
    jacobians = np.zeros((len(pose), 2, 3))
    jacobians[:, 0, 0] = jacobians[:, 1, 1] = -1.0
    jacobians[:, 0, 2], jacobians[:, 1, 2] = offsets[:, 1], -offsets[:, 0]
    summed = np.zeros((len(poses), 3, 3))
    np.add.at(summed, pose, jacobians.transpose(0, 2, 1) @ np.linalg.solve(noise, jacobians))
    return summed


def d_optimality(covariances: FloatArray | Sequence[FloatArray]) -> FloatArray:
    """Return det(C)^(1/3) of covariances (..., 3, 3): the D-optimality criterion (Kiefer 1974; Carrillo 2012)."""
    return np.asarray(np.exp(np.linalg.slogdet(np.asarray(covariances))[1] / 3.0))


def _poses_along(path: FloatArray, final_heading: float) -> FloatArray:
    """Return poses (n, 3) about every `STEP` of a path (m, 2) [m], heading along it; the last one at the goal."""
    moves = np.diff(path, axis=0)
    lengths = np.zeros(len(path))
    np.sqrt((moves * moves).sum(axis=1)).cumsum(out=lengths[1:])
    count = max(1, math.ceil(lengths[-1] / STEP))
    at = np.linspace(0.0, lengths[-1], count + 1)
    points = np.empty((count + 1, 2))
    points[:, 0], points[:, 1] = np.interp(at, lengths, path[:, 0]), np.interp(at, lengths, path[:, 1])
    moves = np.diff(points, axis=0)
    poses = np.empty((count + 1, 3))
    poses[:-1, :2], poses[-1, :2] = points[1:], points[-1]
    poses[:-1, 2], poses[-1, 2] = np.arctan2(moves[:, 1], moves[:, 0]), final_heading
    return poses


def _motions(before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the jacobians (k, n, 3, 3) and the noise (k, n, 3, 3) of motions between poses (k, n, 3)."""
    moves = after[..., :2] - before[..., :2]
    distances = np.hypot(moves[..., 0], moves[..., 1])
    jacobians = np.broadcast_to(np.eye(3), (*distances.shape, 3, 3)).copy()
    jacobians[..., 0, 2], jacobians[..., 1, 2] = -moves[..., 1], moves[..., 0]
    outer = moves[..., :, None] * moves[..., None, :]  # squared distance along the motion
    across = distances[..., None, None] ** 2 * np.eye(2) - outer
    noise = np.broadcast_to(LEAST_COVARIANCE, (*distances.shape, 3, 3)).copy()
    noise[..., :2, :2] += ALONG**2 * outer + ACROSS**2 * across
    noise[..., 2, 2] += (TURN * distances) ** 2
    return jacobians, noise
