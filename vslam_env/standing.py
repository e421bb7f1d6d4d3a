"""`Standing`: how the team stands at one moment, as the simulator knows it."""

from typing import NamedTuple

from slam_backend.errors import FloatArray, IntArray

NUM_FIGURES = 10
FOUND, DISTANCES = 8, 9  # rows of figures; those before them are scores, see `vslam_env.scoring.score_team`


class Standing(NamedTuple):
    """How the team stands.

    Attributes:
        figures: (10, K) float64. What the properties return, row by row in their order.
        collisions: (K,) int64. Ticks since the reset in which each robot was kept from moving as commanded. Never
            written to, so that standings share it.
        bytes_sent: (K,) int64. Since the reset.
        coverage: Share of the free floor that the team has seen.
        merges: Since the reset.
        time: Since the reset [s].
    """

    figures: FloatArray
    collisions: IntArray
    bytes_sent: IntArray
    coverage: float
    merges: int
    time: float

    @property
    def map_errors(self) -> FloatArray:
        """(K,) float64 [m]. E of each robot's map."""
        row: FloatArray = self.figures[0]
        return row

    @property
    def map_rmses(self) -> FloatArray:
        """(K,) float64 [m]. Of the landmarks that each holds; the cutoff of the map error where it holds none."""
        row: FloatArray = self.figures[1]
        return row

    @property
    def map_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds, wherever it has them."""
        row: FloatArray = self.figures[2]
        return row

    @property
    def map_precisions(self) -> FloatArray:
        """(K,) float64. Share of the landmarks in each map that are matched; of duplicates one is."""
        row: FloatArray = self.figures[3]
        return row

    @property
    def placed_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds closer than 0.5 m to where they are."""
        row: FloatArray = self.figures[4]
        return row

    @property
    def pose_errors(self) -> FloatArray:
        """(K,) float64 [m]."""
        row: FloatArray = self.figures[5]
        return row

    @property
    def heading_errors(self) -> FloatArray:
        """(K,) float64 [rad], at least 0."""
        row: FloatArray = self.figures[6]
        return row

    @property
    def pose_sigmas(self) -> FloatArray:
        """(K,) float64 [m]. One sigma of the position in its own start frame, as each believes."""
        row: FloatArray = self.figures[7]
        return row

    @property
    def found(self) -> FloatArray:
        """(K,) float64. Share of the free floor that each was nearest to when the team first saw it."""
        row: FloatArray = self.figures[FOUND]
        return row

    @property
    def distances(self) -> FloatArray:
        """(K,) float64 [m]. Way that each has gone since the reset."""
        row: FloatArray = self.figures[DISTANCES]
        return row
