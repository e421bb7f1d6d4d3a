"""Least-squares problem of a run: whitened residuals of odometry and measurements, with their Jacobians.

The unknowns are the poses of each robot in its own path frame, the landmarks in the world frame, the path frames of
robots whose start is unknown, and, if modelled, an odometry bias per robot.
"""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, compose, rotation, wrap_angle
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from training.stereo_runs.runs import FALSE_POINT, StereoRun

START_SIGMAS = (10.0, 10.0, 1.0)  # [m, m, rad] prior of an unknown start about its initial value: hardly informative
NO_BIAS = (0.0, 0.0, 0.0)
NEAREST_SHARE = 0.5  # of the measured depth, below which a predicted depth has no pixel residual


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Unknowns at which residuals are evaluated."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], path frames
    landmarks: FloatArray  # (L, 3) float64 [m], world frame, in the order of `BatchProblem.names`
    bases: FloatArray | None = None  # (K, 3) float64 [m, m, rad], world frame. Path frames; None: all the world frame.
    # (K, 3) float64. Odometry biases: relative distance, turn per metre [rad/m] and per radian [rad/rad]; None: none.
    biases: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Whitened residuals of n measurements, standard normal at the true values."""

    residuals: FloatArray  # (n, 3) float64 [-]
    # (n, 3, 3) float64. Derivatives with respect to the pose (x, y, theta) of the measuring robot.
    by_pose: FloatArray
    by_landmark: FloatArray  # (n, 3, 3) float64. Derivatives with respect to the landmark.
    by_base: FloatArray  # (n, 3, 3) float64. Derivatives with respect to the path frame of the robot.


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """Whitened residuals of the odometry from each pose to the next."""

    residuals: FloatArray  # (K, T - 1, 3) float64 [-]
    by_first: FloatArray  # (K, T - 1, 3, 3) float64. Derivatives with respect to the earlier pose.
    by_second: FloatArray  # (K, T - 1, 3, 3) float64. Derivatives with respect to the later pose.
    by_bias: FloatArray  # (K, T - 1, 3, 3) float64. Derivatives with respect to the bias of the robot.


@dataclass(frozen=True, slots=True, eq=False)
class BatchProblem:
    """All readings of a run in flat arrays, with the landmark of each measurement."""

    starts: FloatArray  # (K, 3) float64 [m, m, rad], path frames, known exactly
    odometry: FloatArray  # (K, T - 1, 3) float64 [m, m, rad], each in the frame of the earlier pose
    odometry_covariances: FloatArray  # (K, T - 1, 3, 3) float64 [m, m, rad], positive definite
    camera: StereoCamera  # Camera and its noise
    points: FloatArray  # (n, 3) float64 [m], camera frame. Measurements, sorted by step, then robot.
    robots: IntArray  # (n,) int64. Robot of each measurement.
    steps: IntArray  # (n,) int64. Step of each measurement.
    landmarks: IntArray  # (n,) int64. Landmark of each measurement, as a row of `names`.
    names: IntArray  # (L,) int64. Landmark indices in the run, by first measurement.
    # (K, 3) float64 [m, m, rad], world frame. Path frames, or their initial values; None: all the world frame.
    bases: FloatArray | None = None
    loose: BoolArray | None = None  # (K,) bool. Whether a path frame is unknown; None: all are known.
    # Standard deviations of a robot's odometry bias, see `Estimate.biases`; 0: no such bias.
    bias_sigmas: tuple[float, float, float] = NO_BIAS
    whitening: FloatArray = field(init=False)  # (K, T - 1, 3, 3) float64. Inverse Cholesky factors of the covariances.

    def __post_init__(self) -> None:
        factors = np.linalg.cholesky(self.odometry_covariances)
        object.__setattr__(self, "whitening", np.linalg.inv(factors))

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
            odometry_covariances=diagonal([noise.motion.variances(own) for own in odometry]),
            camera=noise.camera, points=np.concatenate(points), robots=np.concatenate(robots),
            steps=np.concatenate(steps), landmarks=np.argsort(order)[rows], names=values[order],
        )  # fmt: skip

    @property
    def num_steps(self) -> int:
        """T."""
        return int(self.odometry.shape[1]) + 1

    @property
    def loose_robots(self) -> IntArray:
        """Robots whose path frame is unknown, ascending."""
        return np.flatnonzero(np.zeros(len(self.starts), dtype=np.bool_) if self.loose is None else self.loose)

    @property
    def biased(self) -> IntArray:
        """Modelled components of the odometry bias: 0 distance, 1 turn per metre, 2 turn per radian."""
        return np.flatnonzero(np.array(self.bias_sigmas) > 0.0)

    def dead_reckoning(self) -> Estimate:
        """Return paths from odometry only, with each landmark at the position of its first measurement."""
        paths = np.empty((len(self.starts), self.num_steps, 3))
        paths[:, 0] = self.starts
        for step in range(1, self.num_steps):
            paths[:, step] = compose(paths[:, step - 1], self.odometry[:, step - 1])
        return self.with_landmarks_at(paths)

    def with_landmarks_at(self, paths: FloatArray) -> Estimate:
        """Return an estimate with paths (K, T, 3), and each landmark at the middle one of its measured positions."""
        poses = paths[self.robots, self.steps]
        if self.bases is not None:
            poses = compose(self.bases[self.robots], poses)
        local = self.camera.robot_from_camera(self.points)
        planar = np.einsum("nij,nj->ni", rotation(poses[:, 2]), local[:, :2]) + poses[:, :2]
        order = np.argsort(self.landmarks, kind="stable")
        ends = np.cumsum(np.bincount(self.landmarks, minlength=len(self.names)))[:-1]
        seen = np.split(np.column_stack([planar, local[:, 2]])[order], ends) if len(order) else []
        middle = [own[np.argmin(((own - np.median(own, axis=0)) ** 2).sum(axis=1))] for own in seen]
        biases = np.zeros((len(paths), 3)) if len(self.biased) else None
        return Estimate(paths, np.array(middle).reshape(-1, 3), self.bases, biases)

    def sights(self, at: Estimate, metric: bool = False) -> Sights:
        """Return the residuals of all measurements.

        Args:
            metric: False: residual of the predicted (u, v, disparity), the exact noise model. True: residual of the
                predicted point, with its covariance at the measurement; less exact, but almost linear and defined
                behind the camera, so that the optimisation may start far away. Landmarks nearer than `NEAREST_SHARE` of
                the measured depth, as wrong associations have behind the camera, always have it.
        """
        own = at.paths[self.robots, self.steps]
        poses = own if at.bases is None else compose(at.bases[self.robots], own)
        turn = np.zeros((len(poses), 3, 3))
        turn[:, :2, :2], turn[:, 2, 2] = rotation(-poses[:, 2]), 1.0
        offset = at.landmarks[self.landmarks]
        offset[:, :2] -= poses[:, :2]
        local = np.einsum("nij,nj->ni", turn, offset)  # robot frame
        by_pose = np.zeros((len(poses), 3, 3))
        by_pose[:, :, :2] = -turn[:, :, :2]
        by_pose[:, 0, 2], by_pose[:, 1, 2] = local[:, 1], -local[:, 0]
        predicted = self.camera.camera_from_robot(local)
        scale = np.linalg.inv(np.linalg.cholesky(self.camera.covariance(self.points)))
        residuals = np.einsum("nij,nj->ni", scale, predicted - self.points)
        if not metric:
            front = predicted[:, 2] > NEAREST_SHARE * self.points[:, 2]
            seen, sigmas = predicted[front], np.array(3 * [self.camera.sigma_px])
            sigmas[2] = self.camera.sigma_disparity_px
            residuals[front] = (self.camera.project(seen) - self.camera.project(self.points[front])) / sigmas
            focal = self.camera.focal_px / seen[:, 2]
            by_pixel = np.zeros((len(seen), 3, 3))
            by_pixel[:, 0, 0] = by_pixel[:, 1, 1] = focal
            by_pixel[:, :, 2] = (
                -focal[:, None]
                / seen[:, 2, None]
                * np.column_stack([seen[:, :2], np.full(len(seen), self.camera.baseline)])
            )
            scale[front] = by_pixel / sigmas[:, None]
        scale = scale @ ROBOT_FROM_CAMERA.T
        by_pose = scale @ by_pose
        by_base = by_pose
        if at.bases is not None:  # chain rule through the world pose = base composed with the own pose
            bases = at.bases[self.robots]
            by_base = by_pose.copy()
            lever = poses[:, :2] - bases[:, :2]
            by_base[:, :, 2] += by_pose[:, :, 1] * lever[:, :1] - by_pose[:, :, 0] * lever[:, 1:]
            by_pose[:, :, :2] = by_pose[:, :, :2] @ rotation(bases[:, 2])
        return Sights(residuals, by_pose, scale @ turn, by_base)

    def moves(self, at: Estimate) -> Moves:
        """Return the residuals of all odometry: the expected reading of the motion between poses minus the reading.

        A bias (a, b, c) changes the reading of a motion of distance d and turn w as in `vslam_env.world.odometry`: the
        turn is e = b d + c w more, the translation (1 + a) times as long and turned by e / 2. d and w are those of the
        reading.
        """
        first, second = at.paths[:, :-1], at.paths[:, 1:]
        motion = between(first, second)
        by_second = np.zeros((*motion.shape, 3))
        by_second[..., :2, :2], by_second[..., 2, 2] = rotation(-first[..., 2]), 1.0
        by_first = -by_second
        by_first[..., 0, 2], by_first[..., 1, 2] = motion[..., 1], -motion[..., 0]
        by_bias = np.zeros((*motion.shape, 3))
        if at.biases is not None:
            by_bias[..., 2, 1] = np.hypot(self.odometry[..., 0], self.odometry[..., 1])
            by_bias[..., 2, 2] = self.odometry[..., 2]
            turn = np.einsum("kti,ki->kt", by_bias[..., 2, :], at.biases)
            turned = rotation(0.5 * turn)
            stretch = 1.0 + at.biases[:, 0, None, None]
            by_bias[..., :2, 0] = np.einsum("ktij,ktj->kti", turned, motion[..., :2])
            read = stretch * by_bias[..., :2, 0]
            by_bias[..., 0, 1:] = -0.5 * read[..., 1, None] * by_bias[..., 2, 1:]
            by_bias[..., 1, 1:] = 0.5 * read[..., 0, None] * by_bias[..., 2, 1:]
            motion = np.concatenate([read, (motion[..., 2] + turn)[..., None]], axis=-1)
            for by in (by_first, by_second):
                by[..., :2, :] = stretch[..., None] * (turned @ by[..., :2, :])
        residuals = motion - self.odometry
        residuals[..., 2] = wrap_angle(residuals[..., 2])
        white = self.whitening
        return Moves(
            np.einsum("ktij,ktj->kti", white, residuals), white @ by_first, white @ by_second, white @ by_bias
        )  # fmt: skip


def diagonal(variances: Any) -> FloatArray:
    """Return diagonal matrices (..., 3, 3) of variances (..., 3)."""
    values = np.asarray(variances)
    return values[..., None] * np.eye(values.shape[-1])
