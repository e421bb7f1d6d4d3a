"""Predicted uncertainty of a robot's pose along the paths to its candidates, for planners that weigh localisation.

The covariance grows with the motion, as the filter's odometry model assumes, and shrinks by the landmarks of the own
map that come into view (extended Kalman filter without noise in the mean). Readings are idealised: every landmark in
view within `SIGHT` and not behind a wall is measured once per metre.
"""

import math
from collections.abc import Sequence

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import DistanceMap, cells_of, distance_map, sees

SIGHT, HALF_VIEW = 6.0, 0.46  # [m], [rad] range and half the angle of view
STEP = 1.0  # [m] between predicted measurements
ALONG, ACROSS, TURN = 0.05, 0.02, math.pi / 90.0  # [m/m], [m/m], [rad/m]: assumed noise of the odometry
RANGE_SIGMA, SIDE_SIGMA = 0.01, 0.01  # [1/m] times the squared range, [m/m] times the range
MOST_LANDMARKS = 60  # nearest to a viewpoint


class PosePredictor:
    """Predictor for one robot at one time.

    Args:
        belief: Belief of the robot.
    """

    def __init__(self, belief: Belief) -> None:
        self._belief = belief
        self._ways: DistanceMap = distance_map(belief.grid.cells, belief.pose[:2])
        held = belief.map
        self._landmarks, self._covariances = held.means[:, :2], held.covariances[:, :2, :2]
        self._cells: IntArray = cells_of(self._ways, self._landmarks)

    def along(self, slot: int) -> FloatArray:
        """Return the predicted covariances (n, 3, 3) of the pose on the way to a candidate, the last one at its goal.

        Args:
            slot: Slot of a candidate.
        """
        candidates = self._belief.candidates
        path = self._ways.path_to(candidates.goals[slot])
        if path is None:
            return self._belief.covariance[None].copy()
        poses = _poses_along(path, float(candidates.headings[slot]))
        covariance, found = self._belief.covariance.copy(), []
        visible = self._in_view(poses)
        before = self._belief.pose
        for pose, seen in zip(poses, visible, strict=True):
            covariance = _moved(covariance, before, pose)
            information = np.linalg.inv(covariance) + self._information(pose, np.flatnonzero(seen))
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
            covariance = np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)
            found.append(covariance)
            before = pose
        return np.array(found)

    def _in_view(self, poses: FloatArray) -> FloatArray:
        """Return which landmarks are in view from which poses, (n, N) bool."""
        gaps = self._landmarks[None] - poses[:, None, :2]
        bearings = np.arctan2(gaps[..., 1], gaps[..., 0]) - poses[:, None, 2]
        ahead = np.abs((bearings + math.pi) % (2.0 * math.pi) - math.pi) < HALF_VIEW
        near = np.linalg.norm(gaps, axis=-1) < SIGHT
        return np.asarray(ahead & near & sees(self._ways, poses[:, :2], self._cells, SIGHT))

    def _information(self, pose: FloatArray, seen: IntArray) -> FloatArray:
        """Return the information (3, 3) about a pose from one measurement of each of some landmarks."""
        gaps = self._landmarks[seen] - pose[:2]
        ranges = np.linalg.norm(gaps, axis=1)
        nearest = np.argsort(ranges, kind="stable")[:MOST_LANDMARKS]
        gaps, ranges, seen = gaps[nearest], np.maximum(ranges[nearest], 0.5), seen[nearest]
        # World frame: measured offset = landmark - position, turned by the heading's error
        jacobian = np.zeros((len(seen), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = -1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = gaps[:, 1], -gaps[:, 0]
        along = gaps / ranges[:, None]
        outer = along[:, :, None] * along[:, None, :]
        noise = (RANGE_SIGMA * ranges**2)[:, None, None] ** 2 * outer
        noise = noise + (SIDE_SIGMA * ranges)[:, None, None] ** 2 * (np.eye(2) - outer) + self._covariances[seen]
        solved = np.linalg.solve(noise, jacobian)
        return np.asarray(np.einsum("kij,kil->jl", jacobian, solved))


def d_optimality(covariances: FloatArray | Sequence[FloatArray]) -> FloatArray:
    """Return det(C)^(1/3) of covariances (..., 3, 3): the D-optimality criterion (Kiefer 1974; Carrillo 2012)."""
    return np.asarray(np.exp(np.linalg.slogdet(np.asarray(covariances))[1] / 3.0))


def _poses_along(path: FloatArray, final_heading: float) -> FloatArray:
    """Return poses (n, 3) about every `STEP` of a path (m, 2) [m], heading along it; the last one at the goal."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    count = max(1, math.ceil(lengths[-1] / STEP))
    at = np.linspace(0.0, lengths[-1], count + 1)[1:]
    points = np.column_stack([np.interp(at, lengths, path[:, axis]) for axis in (0, 1)])
    moves = np.diff(np.vstack([path[:1], points]), axis=0)
    headings = np.arctan2(moves[:, 1], moves[:, 0])
    return np.column_stack([np.vstack([points, points[-1:]]), [*headings, final_heading]])


def _moved(covariance: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) after a motion between two poses (3,)."""
    dx, dy = after[:2] - before[:2]
    distance = math.hypot(dx, dy)
    jacobian = np.eye(3)
    jacobian[0, 2], jacobian[1, 2] = -dy, dx
    c, s = (dx / distance, dy / distance) if distance > 0.0 else (1.0, 0.0)
    turned = np.array([[c, -s], [s, c]])
    noise = np.diag([1e-8, 1e-8, (TURN * distance) ** 2 + 1e-8])
    noise[:2, :2] += turned @ np.diag([(ALONG * distance) ** 2, (ACROSS * distance) ** 2]) @ turned.T
    return np.asarray(jacobian @ covariance @ jacobian.T + noise)
