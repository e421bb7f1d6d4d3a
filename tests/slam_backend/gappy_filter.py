"""Filters that have resampled, and one whose particles differ in what they hold."""

import numpy as np

from slam_backend import FastSlam, Measurements


def filter_after_some_steps(num_particles: int, seed: int) -> tuple[FastSlam, np.ndarray, np.ndarray]:
    """Return a filter that has resampled at twelve steps, and points (14, 3) and looks (14, 14) of its world."""
    rng = np.random.default_rng(seed)
    slam = FastSlam(num_particles=num_particles, seed=seed, resample_threshold=1.0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, 14), rng.uniform(-1.0, 1.0, 14), rng.uniform(2.0, 6.0, 14)])
    looks = np.linalg.qr(rng.standard_normal((14, 14)))[0].astype(np.float32)
    for step in range(12):
        seen = rng.choice(14 if step > 4 else 8, 5, replace=False)
        noisy = points[seen] + rng.normal(0.0, 0.02, (5, 3))
        slam.step([np.array([0.0, 0.0, 0.001])], [Measurements(noisy, looks[seen])])
    return slam, points, looks


def filter_with_gaps(num_particles: int, seed: int) -> FastSlam:
    """Return a filter whose particles have resampled at different times, and do not all hold the same landmarks."""
    slam, _, _ = filter_after_some_steps(num_particles, seed)
    slots = slam.state.maps.used_slots()
    slam.state.maps.refresh(slots[::2])
    slam.state.maps.counts[slam.state.maps.row_of[slots[::2]], 1::3] = 0
    return slam
