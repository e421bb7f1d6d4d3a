"""The compiled inner loops of the filter: one robot's frame, for all particles.

`step` takes the robots in turn; `fastslam1` or `fastslam2` processes one robot's frame. Their parts are in folders:
`motion`, `measurement`, `association`, `update` (landmark EKF, existence) and `particles` (weights, resampling, storage
of landmarks, estimates).

Particles are taken in blocks of `LANES`, and every loop over the lanes of a block is plain arithmetic on rows of one
flat workspace, which the compiler turns into vector instructions; decisions become masks. A row is addressed as
`work[ROW + i]`, lane i, with ROW a multiple of LANES known at compile time.

Landmarks lie in `values[row, block, c, lane]` (flattened) with c = (x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz) in the map
frame, and `counts[row, particle]` says how often the particle saw it (0: it does not hold it). Resampling does not move
them: see `fastslam/particle_maps.py`, which says what `row_of`, `map_of` and `maps` are. Everything is expressed in the
map frame, where the derivative of a measured point with respect to the landmark is the identity (the robot only yaws).

The measurement model (Eqs. 5-7). A landmark mu lies at e = mu - p from the camera centre p. A point v measured in the
camera, turned into map axes, gives the innovation r = k (R v - e) with k = Z_predicted / Z_measured. This is the EKF in
(u, v, disparity): the innovation and its covariance are those of the image coordinates, mapped to metres at the
predicted point, and the density of the image coordinates is that of r times Z_predicted^4 (times a constant of the
camera). Where the caller gives covariances, k = 1 and there is no such factor.

The pose. x = x0 + C xi with xi ~ N(0, I) before the frame: nothing is inverted, so a motion without noise needs no
special case. With A = (dr/dx) C and S = Sigma + R, a match adds A^T S^-1 A to the information matrix of xi
(rows `INFO..`) and A^T S^-1 r to the gradient (`GRAD..`). A gate takes S + A P A^T, with P the covariance of xi
(`COV_XI..`). The turn into map axes is by (`COS`, `SIN`); R above is that turn, R in S the measurement noise.
"""

from slam_backend.fastslam._kernels.inputs import extent, read_team
from slam_backend.fastslam._kernels.layout import (
    EXACT_POSE,
    FAR,
    LANES,
    MIN_DEPTH,
    MOVED,
    NO_READING,
    NUM_MEASURED,
    NUM_NOTED,
    REJECTED,
    STATIONARY,
)
from slam_backend.fastslam._kernels.particles.map_storage import map_summary, release
from slam_backend.fastslam._kernels.particles.pose_estimates import add_gauge_covariance, mixture, write_team_poses
from slam_backend.fastslam._kernels.particles.resampling import apply_resampling, resample
from slam_backend.fastslam._kernels.records import MapArrays
from slam_backend.fastslam._kernels.step import step_robots, write_sigmas
from slam_backend.fastslam._kernels.update.landmark_ekf import RELINEARISE_UP_TO

__all__ = [
    "EXACT_POSE",
    "FAR",
    "LANES",
    "MIN_DEPTH",
    "MOVED",
    "NO_READING",
    "NUM_MEASURED",
    "NUM_NOTED",
    "REJECTED",
    "RELINEARISE_UP_TO",
    "STATIONARY",
    "MapArrays",
    "add_gauge_covariance",
    "apply_resampling",
    "extent",
    "map_summary",
    "mixture",
    "read_team",
    "release",
    "resample",
    "step_robots",
    "write_sigmas",
    "write_team_poses",
]  # fmt: skip
