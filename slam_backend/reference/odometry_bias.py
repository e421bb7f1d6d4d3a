"""Odometry bias of one robot given its path, a Gaussian whose covariance is the same in all particles."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import wrap_angle
from slam_backend.reference.pose_gaussian import GaussianPose, lower_root, turn_about_vertical

LARGEST_INNOVATION = 30.0  # squared Mahalanobis distance of a pose that still corrects the bias


@dataclass
class OdometryBias:
    """Covariance of a robot's odometry bias b, and what it adds to a motion u - J b - n.

    Attributes:
        covariance: (3, 3) P of the bias [m/m, rad/m, rad/rad].
        cross: (3, 3) covariance X of the pose (rows, axes of the robot) and the bias; zeros if the pose was sampled.
        jacobian: (3, 3) J of the last motion.
        spread: (3, 3) what the bias adds to the covariance of the predicted pose, axes of the robot after the motion.
        root: (3, 3) lower factor of the covariance of the motion, J P J^T + diag(sigmas^2).
        gain: (3, 3) correction of the bias per deviation of the sampled pose, or per standard normal draw.
    """

    covariance: FloatArray
    cross: FloatArray
    jacobian: FloatArray
    spread: FloatArray
    root: FloatArray
    gain: FloatArray

    @classmethod
    def prior(cls, covariance: FloatArray) -> "OdometryBias":
        """Return the bias before any motion."""
        return cls(covariance.copy(), *(np.zeros((3, 3)) for _ in range(5)))

    def move(self, odometry: FloatArray, jacobian: FloatArray, sigmas: FloatArray) -> None:
        """Predict over a motion (3,) with its derivative J (3, 3) by the bias and standard deviations (3,)."""
        carried = np.array([[1.0, 0.0, -odometry[1]], [0.0, 1.0, odometry[0]], [0.0, 0.0, 1.0]]) @ self.cross
        own = jacobian @ self.covariance @ jacobian.T
        back = turn_about_vertical(-odometry[2])
        self.jacobian, self.root = jacobian, lower_root(own + np.diag(sigmas**2))
        self.spread = back @ (own - carried @ jacobian.T - jacobian @ carried.T) @ back.T
        self.cross = back @ (carried - jacobian @ self.covariance)

    def learn_from_pose(self, predicted: GaussianPose) -> FloatArray:
        """Set the gain for poses sampled about a prediction; return the information (3, 3) of it, robot axes."""
        turn = turn_about_vertical(predicted.mean[2])
        information = np.linalg.pinv(turn.T @ predicted.covariance @ turn)
        self.gain = self.cross.T @ information
        self.covariance = self.covariance - self.gain @ self.cross
        self.cross = np.zeros((3, 3))
        return np.asarray(information)

    def learn_from_draws(self) -> None:
        """Set the gain for motions that are drawn."""
        self.gain = -(np.linalg.pinv(self.root) @ self.jacobian @ self.covariance).T
        self.covariance = self.covariance - self.gain @ self.gain.T
        self.cross = np.zeros((3, 3))

    def correction(self, predicted: GaussianPose, pose: FloatArray, information: FloatArray) -> FloatArray:
        """Return what a sampled pose (3,) adds to the mean of the bias; zeros if it is far from the prediction."""
        off = pose - predicted.mean
        off[2] = wrap_angle(off[2])
        off = turn_about_vertical(-predicted.mean[2]) @ off
        return self.gain @ off if off @ information @ off <= LARGEST_INNOVATION else np.zeros(3)
