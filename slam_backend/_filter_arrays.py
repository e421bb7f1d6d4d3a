"""`FilterArrays`: where a filter's poses and weights lie, in as few arrays as can be, for kernels pay for each."""

import numpy as np

from slam_backend._kernels.layout import COVARIANCES, LOG_WEIGHTS, MEANS, PATH_LOG_WEIGHTS, POSES, STARTS, WEIGHTS
from slam_backend._map_store import aligned_zeros
from slam_backend.errors import FloatArray, Int32Array, IntArray


class FilterArrays:
    """What K robots and M particles of a filter hold without their maps, in P lanes; those beyond M mean nothing.

    All names but the attributes are views. Poses are in the map frame.

    Attributes:
        num_particles: M.
        _of_robots: (5, K, 3, P) float64. `_poses`, `_starts`, `_means`, and in the last two `_covariances`.
        _of_particles: (4, P) float64. `_log_weights`, `_path_log_weights`, `_weights`, and what a step adds to them.
        _blind: (K,) int64. 1 where N(x^, P^) was propagated since the last sighting, else 0.
        _frame: (3, 3) float64 [m, m, rad]. Covariance of a motion of the whole map that the particles do not show, as
            their frame was held when they were drawn anew; estimates have their share of it.
        _found, _distances: (n, P) int32, float64. Room for what is made of measurements within a step, see
            `update_fastslam2`.
    """

    def _make_arrays(self, num_robots: int, num_particles: int, padded: int) -> None:
        """Begin with all robots at the origin and equal weights."""
        self.num_particles = num_particles
        self._of_robots: FloatArray = aligned_zeros((5, num_robots, 3, padded), np.float64)
        self._of_particles: FloatArray = aligned_zeros((4, padded), np.float64)
        self._log_weights[:] = -np.log(num_particles)
        self._weights[:] = 1.0 / num_particles
        self._blind: IntArray = np.zeros(num_robots, np.int64)
        self._frame: FloatArray = np.zeros((3, 3))
        self._found: Int32Array = np.empty((0, padded), np.int32)
        self._distances: FloatArray = np.empty((0, padded))

    def _make_room_for(self, count: int) -> None:
        """Provide room for what is made of so many measurements, and more."""
        shape = 2 * count, self._found.shape[1]
        self._found, self._distances = np.empty(shape, np.int32), np.empty(shape)

    @property
    def num_robots(self) -> int:
        """K."""
        return int(self._of_robots.shape[1])

    @property
    def _poses(self) -> FloatArray:
        """(K, 3, P) [m, m, rad]. Of each robot (x_t^[m])."""
        return np.asarray(self._of_robots[POSES])

    @property
    def _starts(self) -> FloatArray:
        """(K, 3, P) likewise. Where each robot started; spreads at a merge."""
        return np.asarray(self._of_robots[STARTS])

    @property
    def _means(self) -> FloatArray:
        """(K, 3, P) likewise: with `_covariances` N(x^, P^) of each particle before sampling."""
        return np.asarray(self._of_robots[MEANS])

    @property
    def _covariances(self) -> FloatArray:
        """(K, 6, P) upper triangles."""
        return self._of_robots[COVARIANCES:].reshape(self.num_robots, 6, -1)

    @property
    def _log_weights(self) -> FloatArray:
        """(M,) since the last resampling, normalised."""
        return np.asarray(self._of_particles[LOG_WEIGHTS, : self.num_particles])

    @property
    def _path_log_weights(self) -> FloatArray:
        """(M,) accumulated along the ancestral line (Eq. 12)."""
        return np.asarray(self._of_particles[PATH_LOG_WEIGHTS, : self.num_particles])

    @property
    def _weights(self) -> FloatArray:
        """(M,) as the last step left them, summing to 1."""
        return np.asarray(self._of_particles[WEIGHTS, : self.num_particles])
