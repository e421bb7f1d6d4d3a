"""Records of the arrays and numbers that travel together from kernel to kernel.

P lanes are M particles, rounded up to whole blocks of `LANES`; B is the number of measurements of one robot's frame.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, Int32Array, IntArray


class MapArrays(NamedTuple):
    """Storage of the landmarks of all particles, see `particle_maps`.

    Attributes:
        values: (rows * 9 * P,) [m, m^2], map frame, each row [block][x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz][lane].
        counts: (rows, P). Number of matches of the landmark in the particle, its start included; 0: it lacks it.
        odds: (slots, P) log-odds of existence; (0, P) where existence is not kept.
        table: (6, slots), see `SlotRows`.
        maps: (maps, P). Ancestor maps; map 0 stands for the identity.
        users: (maps,). Number of slots read by each map.
        free_rows: (rows,). Stack of free rows.
        tops: (3,). Heights of the stacks of free rows and of free slots, and the id of the next landmark.
        descriptors: (slots, d).
        heads: (h, slots). Every (d / h)-th component of the descriptors, `FAR` where the slot is free.
    """

    values: FloatArray
    counts: Int32Array
    odds: FloatArray
    table: IntArray
    maps: Int32Array
    users: IntArray
    free_rows: IntArray
    tops: IntArray
    descriptors: Float32Array
    heads: Float32Array


class SlotRows(NamedTuple):
    """Rows of the table (6, slots) of a map's slots.

    Attributes:
        row_of: Row of each slot in the storage.
        map_of: Ancestor map by which it is to be read.
        ids: Stable id of the landmark, -1 = free slot.
        identities: The caller's identity of the landmark, -1 = none.
        last_seen: Step of the smoother in which the most probable particle last matched the landmark, 0 = never.
        free_slots: Stack of free slots.
    """

    row_of: int = 0
    map_of: int = 1
    ids: int = 2
    identities: int = 3
    last_seen: int = 4
    free_slots: int = 5


class WeightRows(NamedTuple):
    """Rows of the weights (4, P) of all particles.

    Attributes:
        log_weights: Log-weights since the last resampling, normalised.
        path_log_weights: Log-weights accumulated along the ancestral line (Eq. 12).
        weights: Weights after the last step, summing to 1.
        log_likelihood: Increments of a step.
    """

    log_weights: int = 0
    path_log_weights: int = 1
    weights: int = 2
    log_likelihood: int = 3


class RobotParts(NamedTuple):
    """Parts of the array (6, K, 3, P) of K robots in all particles, map frame [m, m, rad].

    Attributes:
        poses: Samples.
        starts: Start poses of the robots.
        means: Means x^ before sampling.
        biases: Means of the odometry biases, given the path [m/m, rad/m, rad/rad].
        covariances: First of the two parts that hold the covariances (K, 6, P) before sampling, upper triangles.
    """

    poses: int = 0
    starts: int = 1
    means: int = 2
    biases: int = 3
    covariances: int = 4


SLOT, WEIGHT, ROBOT = SlotRows(), WeightRows(), RobotParts()


class RobotArrays(NamedTuple):
    """K robots in all particles, and their estimates over all of them.

    Attributes:
        parts: (6, K, 3, P), see `RobotParts`.
        weights: (4, P), see `WeightRows`; read and written up to M.
        biases: (2, K, 3, 3) covariance of each robot's bias given its path; and, where N(x^, P^) was propagated, that
            of its pose (rows, robot axes) and bias.
        propagated_only: (K,) 1 where that was propagated since the last sighting, else 0.
        gauge: (3, 3) covariance of a motion of the whole map that particles do not show, or zeros.
        means, covariances: (K, 3), (K, 3, 3) each robot's pose over all particles.
    """

    parts: FloatArray
    weights: FloatArray
    biases: FloatArray
    propagated_only: IntArray
    gauge: FloatArray
    means: FloatArray
    covariances: FloatArray


class InputArrays(NamedTuple):
    """Input of a step.

    Attributes:
        rows: (K,) row of each robot in `table`; -1: it did nothing at all.
        table: (N, 6) int64, see `layout`: kind of motion, first and last row of the measurements among all n, whether
            these have covariances and names, and the number given. Exact poses are already in the particles.
        moves: (N, 3) odometry [m, m, rad] of those that moved.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        measurements: (n, 9) [m, m^2] points and, of the robots that have them, upper triangles of covariances,
            in the robots' axes: x ahead, y left, z up.
        descriptors: (n, d).
        names: (n,) the caller's names, of the robots that have them; or (0,).
    """

    rows: IntArray
    table: IntArray
    moves: FloatArray
    normals: FloatArray
    measurements: FloatArray
    descriptors: Float32Array
    names: IntArray


class StepResults(NamedTuple):
    """What became of the n measurements of a step.

    Attributes:
        found, distances: (n, P), see `Outcome`.
        associations: (2, n) slots of new landmarks, -1 = none; at the end as in `summarise`.
        noted: (K, 10) notes of the step for the run log, see `layout`.
        measured: (>= first + used, 10) measurements and their landmarks for the run log.
    """

    found: Int32Array
    distances: FloatArray
    associations: IntArray
    noted: FloatArray
    measured: FloatArray


class StepPart(NamedTuple):
    """Part of a step that one call of the kernel does.

    Attributes:
        low, high: Range of the robots to process; the step begins with the first robot.
        is_over: Whether these are the last robots, and the step is concluded.
        now: Number of the step; 0 if there is no smoother, which alone needs when landmarks were last seen.
        num_measured: Number of measurements that the run log holds already.
    """

    low: int
    high: int
    is_over: bool
    now: int
    num_measured: int


class MeasurementCounts(NamedTuple):
    """What became of the measurements of a step, according to the most probable particle.

    Attributes:
        long_unseen: Number of landmarks not seen for long that it matched.
        created: Number of measurements that started a landmark in any particle.
        new, matched, rejected: Numbers of those that it started, matched and rejected, unused ones included.
        nis: Mean of its squared distances, without what it predicted behind the camera, NaN if there is none.
    """

    long_unseen: int
    created: int
    new: int
    matched: int
    rejected: int
    nis: float


class StepSummary(NamedTuple):
    """Outcome of a step without the association of each measurement.

    Attributes:
        best: The most probable particle.
        long_unseen, created, new, matched, rejected, nis: See `MeasurementCounts`.
        ess: Effective sample size.
        needs_resampling: Whether the particles are to be resampled, now that something was measured.
    """

    best: int
    long_unseen: int
    created: int
    new: int
    matched: int
    rejected: int
    nis: float
    ess: float
    needs_resampling: bool


class Poses(NamedTuple):
    """One robot in all particles.

    Attributes:
        samples: (3, P) rows x, y, theta [m, m, rad], map frame.
        means: (3, P) means x^ before sampling.
        covariances: (6, P) upper triangles of the covariances P^ before sampling.
        biases: (3, P) means of the odometry bias, given the path [m/m, rad/m, rad/rad].
    """

    samples: FloatArray
    means: FloatArray
    covariances: FloatArray
    biases: FloatArray


class Motion(NamedTuple):
    """Motion of one robot in one step.

    Attributes:
        odometry: (3,) u [m, m, rad], previous robot frame.
        sigmas: (3,) standard deviations of u.
        normals: (M, 3) standard normal draws.
        exact: Whether the caller gave the pose, which no measurement then moves far.
        biased: Whether the bias of the odometry is estimated; all that follows is unused otherwise.
        jacobian: (3, 3) derivative J of u by the bias.
        spread: (6,) what the bias adds to the covariance of the predicted pose, robot axes, upper triangle.
        factor: (3, 3) lower Cholesky factor of the covariance of u given the pose before, bias included.
        gain: (3, 3) correction of the bias per deviation of the sampled pose, robot axes, or per normal draw.
        information: (6,) inverse of the covariance of the predicted pose, robot axes, upper triangle.
    """

    odometry: FloatArray
    sigmas: FloatArray
    normals: FloatArray
    exact: bool
    biased: bool
    jacobian: FloatArray
    spread: FloatArray
    factor: FloatArray
    gain: FloatArray
    information: FloatArray


class Frame(NamedTuple):
    """Measurements of one robot in one step.

    Attributes:
        points: (B, 3) [m] measured points relative to the camera centre, robot axes (x ahead is the depth).
        noises: (B, 6) [m^2] their covariances, robot axes, if `given`.
        given: Whether the covariances come with the measurements.
        camera: (7,) focal length, baseline, sigma of image coordinates, sigma of the disparity [px], mount (3) [m].
        descriptors: (B, d).
        identities: (B,) the caller's identities of landmarks, if `identified`; gates then rule out no match.
        identified: Whether identities decide instead of descriptors.
    """

    points: FloatArray
    noises: FloatArray
    given: bool
    camera: FloatArray
    descriptors: Float32Array
    identities: IntArray
    identified: bool


class Candidates(NamedTuple):
    """Landmarks that may have caused the measurements of a frame, nearest descriptor first.

    Attributes:
        starts: (B + 1,) where the candidates of each measurement begin among all C.
        slots: (C,) slots of the landmarks.
        descriptor_costs: (C,) squared distances e of descriptors [-], which `fastslam2` divides by their variance.
        owners: (C,) measurements.
        same: (C,) previous candidate of the same slot, -1 if there is none.
    """

    starts: IntArray
    slots: IntArray
    descriptor_costs: FloatArray
    owners: IntArray
    same: IntArray


class Space(NamedTuple):
    """Working space of one block of lanes.

    Attributes:
        work: (WORK_SIZE,) rows of the block, see `layout`.
        records: (C, CANDIDATE_ROWS * LANES) rows of each candidate.
        match: (B, LANES) candidate matched, or NO_MATCH or NEW_LANDMARK.
        mask: (LANES,) 1 where a lane takes part.
    """

    work: FloatArray
    records: FloatArray
    match: FloatArray
    mask: FloatArray


class Outcome(NamedTuple):
    """Results of one robot's frame.

    Attributes:
        found: (B, P) slots, new ones included, -1 = rejected.
        distances: (B, P) D of matches, NaN otherwise.
        new_slots: (B,) slot of the landmark that each measurement started in some particle, -1 = none.
        log_likelihood: (P,) log-likelihood of the step, added to.
    """

    found: Int32Array
    distances: FloatArray
    new_slots: IntArray
    log_likelihood: FloatArray


class LogColumns(NamedTuple):
    """Columns of `LogArrays`, with room for more rows and measurements."""

    steps: IntArray
    kinds: NDArray[np.int8]
    motions: FloatArray
    given: BoolArray
    starts: IntArray
    points: FloatArray
    ids: IntArray


class ViewBounds(NamedTuple):
    """Where landmarks are expected to be seen: bounds relative to a camera.

    Attributes:
        nearest: Least depth [m].
        side: Largest |lateral| / depth [-].
        rise: Largest |vertical| / depth [-].
        reach_squared: Largest squared distance [m^2].
    """

    nearest: float
    side: float
    rise: float
    reach_squared: float


class Viewpoint(NamedTuple):
    """Camera of one robot in all particles.

    Attributes:
        poses: (3, P) poses of the robot [m, m, rad], map frame.
        cosines, sines: (P,) of their headings.
        mount: (3,) place of the camera on the robot [m].
    """

    poses: FloatArray
    cosines: FloatArray
    sines: FloatArray
    mount: FloatArray
