"""Least-squares problem of a run: whitened residuals of odometry and measurements, with their Jacobians."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, compose, rotation, wrap_angle
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from training.bench.accuracy.runs import FALSE_POINT, StereoRun


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Paths and landmarks at which residuals are evaluated."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame
    landmarks: FloatArray  # (L, 3) float64 [m], world frame, in the order of `BatchProblem.names`


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Whitened residuals of n measurements, standard normal at the true values."""

    residuals: FloatArray  # (n, 3) float64 [-]
    # (n, 3, 3) float64. Derivatives with respect to the pose (x, y, theta) of the measuring robot.
    by_pose: FloatArray
    by_landmark: FloatArray  # (n, 3, 3) float64. Derivatives with respect to the landmark.
    in_front: bool  # Whether all landmarks are in front of their cameras


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """Whitened residuals of the odometry from each pose to the next."""

    residuals: FloatArray  # (K, T - 1, 3) float64 [-]
    by_first: FloatArray  # (K, T - 1, 3, 3) float64. Derivatives with respect to the earlier pose.
    by_second: FloatArray  # (K, T - 1, 3, 3) float64. Derivatives with respect to the later pose.


@dataclass(frozen=True, slots=True, eq=False)
class BatchProblem:
    """All readings of a run in flat arrays, with the true landmark of each measurement."""

    starts: FloatArray  # (K, 3) float64 [m, m, rad], world frame, known exactly
    odometry: FloatArray  # (K, T - 1, 3) float64 [m, m, rad], each in the frame of the earlier pose
    odometry_sigmas: FloatArray  # (K, T - 1, 3) float64 [m, m, rad]
    camera: StereoCamera  # Camera and its noise
    points: FloatArray  # (n, 3) float64 [m], camera frame. Measurements, sorted by step, then robot.
    robots: IntArray  # (n,) int64. Robot of each measurement.
    steps: IntArray  # (n,) int64. Step of each measurement.
    landmarks: IntArray  # (n,) int64. Landmark of each measurement, as a row of `names`.
    names: IntArray  # (L,) int64. Landmark indices in the run, by first measurement.

    @classmethod
    def of_run(cls, run: StereoRun) -> Self:
        """Collect the readings of a run with their true landmarks, without false points."""
        noise = run.spec.noise
        points, robots, steps, named = [], [], [], []
        for step, (frames, names) in enumerate(zip(run.frames, run.names, strict=True)):
            for robot, (frame, name) in enumerate(zip(frames, names, strict=True)):
                true = name != FALSE_POINT
                points.append(frame.points[true])
                named.append(name[true])
                robots.append(np.full(true.sum(), robot))
                steps.append(np.full(true.sum(), step))
        every = np.concatenate(named)
        values, firsts, rows = np.unique(every, return_index=True, return_inverse=True)
        order = np.argsort(firsts)
        odometry = run.odometry[1:].transpose(1, 0, 2).copy()
        return cls(
            starts=run.true_paths[:, 0], odometry=odometry,
            odometry_sigmas=np.array([[noise.motion.sigmas(u) for u in own] for own in odometry]).reshape(
                odometry.shape
            ),
            camera=noise.camera, points=np.concatenate(points), robots=np.concatenate(robots),
            steps=np.concatenate(steps), landmarks=np.argsort(order)[rows], names=values[order],
        )  # fmt: skip

    @property
    def num_steps(self) -> int:
        """T."""
        return int(self.odometry.shape[1]) + 1

    def dead_reckoning(self) -> Estimate:
        """Return paths from odometry only, with each landmark at the position of its first measurement."""
        paths = np.empty((len(self.starts), self.num_steps, 3))
        paths[:, 0] = self.starts
        for step in range(1, self.num_steps):
            paths[:, step] = compose(paths[:, step - 1], self.odometry[:, step - 1])
        _, first = np.unique(self.landmarks, return_index=True)
        poses = paths[self.robots[first], self.steps[first]]
        local = self.camera.robot_from_camera(self.points[first])
        planar = np.einsum("nij,nj->ni", rotation(poses[:, 2]), local[:, :2]) + poses[:, :2]
        return Estimate(paths, np.column_stack([planar, local[:, 2]]))

    def sights(self, at: Estimate, metric: bool = False) -> Sights:
        """Return the residuals of all measurements.

        Args:
            metric: False: residual of the predicted (u, v, disparity), the exact noise model. True: residual of the
                predicted point, with its covariance at the measurement; less exact, but almost linear and defined
                behind the camera, so that the optimisation may start far away.
        """
        poses = at.paths[self.robots, self.steps]
        turn = np.zeros((len(poses), 3, 3))
        turn[:, :2, :2], turn[:, 2, 2] = rotation(-poses[:, 2]), 1.0
        offset = at.landmarks[self.landmarks]
        offset[:, :2] -= poses[:, :2]
        local = np.einsum("nij,nj->ni", turn, offset)  # robot frame
        by_pose = np.zeros((len(poses), 3, 3))
        by_pose[:, :, :2] = -turn[:, :, :2]
        by_pose[:, 0, 2], by_pose[:, 1, 2] = local[:, 1], -local[:, 0]
        predicted = self.camera.camera_from_robot(local)
        depth = predicted[:, 2]
        if metric:
            factors = np.linalg.cholesky(self.camera.covariance(self.points))
            scale = np.linalg.inv(factors)
            residuals = np.einsum("nij,nj->ni", scale, predicted - self.points)
        else:
            sigmas = np.array([self.camera.sigma_px, self.camera.sigma_px, self.camera.sigma_disparity_px])
            residuals = (self.camera.project(predicted) - self.camera.project(self.points)) / sigmas
            focal = self.camera.focal_px / depth
            scale = np.zeros((len(poses), 3, 3))
            scale[:, 0, 0] = scale[:, 1, 1] = focal
            scale[:, :, 2] = (
                -focal[:, None]
                / depth[:, None]
                * np.column_stack([predicted[:, :2], np.full(len(depth), self.camera.baseline)])
            )
            scale /= sigmas[:, None]
        scale = scale @ ROBOT_FROM_CAMERA.T
        return Sights(residuals, scale @ by_pose, scale @ turn, bool((depth > 0.0).all()))

    def moves(self, at: Estimate) -> Moves:
        """Return the residuals of all odometry: the motion between poses minus the reading."""
        first, second = at.paths[:, :-1], at.paths[:, 1:]
        motion = between(first, second)
        residuals = motion - self.odometry
        residuals[..., 2] = wrap_angle(residuals[..., 2])
        by_second = np.zeros((*motion.shape, 3))
        by_second[..., :2, :2], by_second[..., 2, 2] = rotation(-first[..., 2]), 1.0
        by_first = -by_second
        by_first[..., 0, 2], by_first[..., 1, 2] = motion[..., 1], -motion[..., 0]
        sigmas = self.odometry_sigmas
        return Moves(residuals / sigmas, by_first / sigmas[..., None], by_second / sigmas[..., None])
