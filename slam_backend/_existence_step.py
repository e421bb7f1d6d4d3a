"""What a filter does for the existence of landmarks: after each robot's frame it weighs those around the robot."""

import numpy as np
from numpy.typing import NDArray

from slam_backend import _existence_kernels as kernels
from slam_backend._particle_maps import ParticleMaps
from slam_backend.camera import StereoCamera
from slam_backend.errors import FloatArray, IntArray
from slam_backend.existence import ExistenceModel


class ExistenceStep:
    """An existence model together with the camera that sees the landmarks.

    Args:
        model: How likely landmarks are seen, and when they are given up.
        camera: The filter's.
    """

    def __init__(self, model: ExistenceModel, camera: StereoCamera) -> None:
        self._model = model
        self._view = model.view(camera)
        self._mount = np.array(camera.mount)
        self._bounds = (model.log_odds_floor, model.log_odds_cap)
        self._near = 2.0 * float(np.sqrt(self._view.reach_squared))

    def weigh(
        self, maps: ParticleMaps, poses: FloatArray, best: int, found: NDArray[np.int32], new_slots: IntArray
    ) -> IntArray:
        """Update the log-odds after one robot's frame, which may be empty; particles drop what is too improbable.

        Args:
            maps: Changed; the landmarks that the frame started begin at the prior.
            poses: (3, P) the robot's sampled poses [m, m, rad], map frame.
            best: The most probable particle before the step: what it has around the robot is looked at.
            found: (n, P) slot to which each particle gave each measurement of the frame, -1 = none.
            new_slots: (n,) slot of the landmark that each measurement started, -1 = none.

        Returns:
            Slots that no particle holds any more. They are to be released once nobody asks for their ids.
        """
        maps.start_odds(new_slots)
        view = self._view
        seen_from = (poses, np.cos(poses[2]), np.sin(poses[2]), self._mount)
        slots = kernels.landmarks_told_of(
            maps.ids, maps.row_of, maps.map_of, maps.maps, maps.blocks, maps.counts, maps.num_particles, best,
            *seen_from, self._near, view.nearest, view.side, view.reach_squared, found, new_slots,
        )  # fmt: skip
        if not len(slots):
            return slots
        maps.refresh(slots)
        pose = np.ascontiguousarray(poses[:, best])
        store = (maps.row_of, maps.blocks, maps.counts)
        expected = kernels.count_expected(slots, *store, best, pose, self._mount, *view)
        return kernels.weigh_existence(
            slots, kernels.mark_seen(slots, len(maps.ids), found), maps.odds, *store,
            *seen_from, *view, *self._model.increments(expected), *self._bounds,
        )  # fmt: skip
