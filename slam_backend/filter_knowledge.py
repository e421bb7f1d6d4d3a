"""What a filter knows: poses, particles, maps, logs. `FastSlam` adds what changes them."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._best_map import best_map, slots_held, write_outline
from slam_backend._filter_state import FilterState
from slam_backend._mixtures import map_mixture
from slam_backend.consistency import Consistency
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_choice
from slam_backend.geometry import between
from slam_backend.landmark_map import LandmarkMap, MapOutline, OutlineRows
from slam_backend.reports import PoseEstimate
from slam_backend.run_log import RobotLog
from slam_backend.standpoints import Standpoints, members_of

NO_WEIGHTS = np.empty(0)  # nobody asks for them where all particles start at the same place


class FilterKnowledge(FilterState):
    """All that can be asked of a filter; what names a robot raises a ValueError if there is none of that index."""

    @property
    def num_landmarks(self) -> int:
        """Landmarks that at least one particle holds."""
        return int(np.count_nonzero(self._maps.ids >= 0))

    @property
    def map_size(self) -> int:
        """Landmarks that the most probable particle holds: the length of `map()`."""
        slots = np.flatnonzero(self._maps.ids >= 0)
        return int(np.count_nonzero(self._maps.of_particle(self.best_particle, slots)[1]))

    @property
    def map_room(self) -> int:
        """Landmarks for which there is room: no particle holds more."""
        return int(self._maps.table.shape[1])

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self._maps.descriptors.shape[1])

    @property
    def consistency(self) -> Consistency:
        """Whether the filter errs as little as it claims, as far as its frames tell, and what to try if not."""
        return self._consistency.report()

    def log(self, robot: int = 0) -> RobotLog:
        """Return what the robot did and measured so far: odometry, points, and the landmarks they were taken for."""
        return self._logs[self._check_robot(robot)].copy()

    @property
    def nbytes(self) -> int:
        """Memory that the particles hold [bytes]: mostly (72 + 4) per particle and landmark."""
        arrays = (self._poses, self._starts, self._means, self._covariances, self._log_weights, self._path_log_weights)
        return self._maps.nbytes + sum(array.nbytes for array in arrays)

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1. A copy."""
        return np.asarray(np.exp(self._log_weights))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] over all particles, map frame. Copies.

        They are those of the mixture of N(x^, P^) before sampling, which scatters less than the samples.
        """
        return self._estimates.of(self._check_robot(robot))

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return a robot's poses (M, 3) [m, m, rad], map frame, and the normalised log-weights (M,). Copies."""
        return self._columns(self._poses[self._check_robot(robot)]), self._log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return (3,) [m, m, rad] where the robot started, map frame, by the most probable particle. A copy."""
        return np.array(self._starts[self._check_robot(robot), :, self.best_particle])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] in its own start frame. Copies.

        Each particle's pose is seen from where the robot started in that particle, so that what the filter does not
        know of the start, after a merge, does not blur it.
        """
        index, every = self._check_robot(robot), tuple(range(self.num_robots))
        points = Standpoints(len(every))
        self._stand(every, every, 1.0, points)
        return PoseEstimate(points.own[index].copy(), points.covariances[index].copy())

    def _stand(self, names: tuple[int, ...], live: tuple[int, ...], ess: float, points: Standpoints) -> None:
        """Write where the robots stand, which the team calls by these names, of those that are live; `ess` as it is."""
        weights = NO_WEIGHTS if self._from_origin else np.exp(self._log_weights)
        _kernels.stand(
            self._of_robots, weights, self._best, self._from_origin, *self._estimates,
            members_of(names, live), ess, points.poses, points.beliefs,
        )  # fmt: skip

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3) [m, m, rad], each seen from where it started in that particle."""
        starts = self._columns(self._starts[self._check_robot(robot)])
        return between(starts, self._columns(self._poses[robot]))

    def _columns(self, rows: FloatArray) -> FloatArray:
        """Return (M, c) of padded rows (c, P). A copy."""
        return rows[:, : self.num_particles].T.copy()

    def map(self, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the map [m, m^2] in the map frame, landmarks by ascending id. A copy.

        Args:
            estimate: "best": means and conditional covariances of the most probable particle (Eq. 12). "mixture":
                mean and covariance over all particles that hold the landmark, path uncertainty included,
                sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T) (Sec. 3.2, see `docs/errata.md`); the landmarks are
                those of the most probable particle.
            min_count: Landmarks that the most probable particle measured fewer times are left out.

        Raises:
            ValueError: If `estimate` is neither.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        best = self.best_particle
        if estimate == "best":
            return LandmarkMap._trusted(*best_map(self._maps, best, min_count))
        return LandmarkMap._trusted(*map_mixture(self._maps, best, self._log_weights, self._frame, min_count))

    def looks(self) -> NDArray[np.float32]:
        """Return the descriptors (n, d) of the landmarks of `map()`. A copy."""
        return np.asarray(self._maps.descriptors[slots_held(self._maps, self.best_particle, 1)])

    def outline(self, min_count: int = 1) -> MapOutline:
        """Return the outline of `map(min_count=min_count)`, much faster. Fresh arrays."""
        rows = OutlineRows.unwritten(self.map_room)
        return rows.part(0, write_outline(self._maps, self._best, min_count, rows, 0))

    def existence(self) -> tuple[IntArray, FloatArray]:
        """Return the ids (n,) of the landmarks of `map()`, ascending, and the probability (n,) that each exists.

        Raises:
            ValueError: If the filter was built without `existence`.
        """
        if self._existence is None:
            cure = "Build the filter with existence=ExistenceModel()."
            raise bad_argument("existence", "a filter that keeps it", "one that does not", cure)
        slots = self._maps.used_slots()
        slots = slots[self._maps.of_particle(self.best_particle, slots)[1] > 0]
        return self._maps.ids[slots], 1.0 / (1.0 + np.exp(-self._maps.odds_of_particle(self.best_particle, slots)))

    def _dense(self) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        """Return ids (n,), means (n, 3, M) [m], covariances (n, 6, M) [m^2] and counts (n, M), 0 where one lacks it."""
        slots = self._maps.used_slots()
        values, counts = self._maps.dense(slots)
        return self._maps.ids[slots], values[:, :3], values[:, 3:], counts.astype(np.int64)

    def _check_robot(self, robot: int) -> int:
        """Return the index of a robot that there is."""
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)
