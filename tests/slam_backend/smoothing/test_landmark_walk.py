"""What a rejuvenation leaves of the landmarks' random walk."""

import numpy as np

from slam_backend.fastslam.filter import FastSlam
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements

NOISE = 0.05  # [m]


def rejuvenated_map(landmark_noise: float) -> LandmarkMap:
    """Return the map just after the particles of a robot that drives past six landmarks were drawn anew."""
    rng = np.random.default_rng(3)
    landmarks = np.column_stack([rng.uniform(-1.0, 1.0, 6), rng.uniform(-0.5, 0.5, 6), rng.uniform(3.0, 5.0, 6)])
    slam = FastSlam(num_particles=5, rejuvenate_every=6, landmark_noise=landmark_noise)
    for step in range(6):
        points = landmarks - [0.0, 0.0, 0.2 * step]
        move = None if step == 0 else np.array([0.2, 0.0, 0.0])
        report = slam.step([move], [Measurements(points, np.eye(6))], identities=[np.arange(6)])
    assert report.rejuvenation is not None
    assert report.rejuvenation.reason == ""
    return slam.map()


def test_landmarks_may_walk_after_a_rejuvenation_as_after_a_sighting() -> None:
    """To the smoother they stand still; what it leaves is widened by the variance of one walk along each axis."""
    still, walking = rejuvenated_map(0.0), rejuvenated_map(NOISE)
    wider = walking.covariances - still.covariances
    np.testing.assert_allclose(wider, np.tile(NOISE**2 * np.eye(3), (6, 1, 1)), atol=0.02 * NOISE**2)
