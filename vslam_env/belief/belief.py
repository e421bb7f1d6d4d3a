"""Belief of one robot after a tick, and the configuration of beliefs."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, BoolArray, FloatArray, IntArray, check_int
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap, TeamMapSummaries
from slam_backend.models.camera import StereoCamera
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from vslam_env.belief.observation_keys import READ_CANDIDATES, READ_GLOBAL_GRIDS
from vslam_env.navigation import CANDIDATE_FEATURES, CandidateGains, CandidateKind, OccupancyGrid
from vslam_env.navigation.global_grids import GlobalGrids


def default_filter_options() -> FilterOptions:
    """Return the default filter options: assumptions for the default camera and odometry, with some reserve.

    Particle filters are over-confident: 1.5 times the camera noise gives the smallest pose errors in the mean
    (docs/lab/accuracy.md). The odometry is that of wheels: it hardly slips sideways, and its error of the turn grows
    with the distance, not with the turn; the prior of its biases is the true one. Position errors and maps are better
    with these values than with the defaults of `OdometryModel`, and the median NEES of poses is nearer to the ideal
    (docs/explanation/accuracy_limits.md).
    """
    true = StereoCamera()
    return FilterOptions(
        motion=OdometryModel(
            sigma_across=0.005, sigma_turn=0.005, floor_position=1e-4, floor_heading=1e-4,
            bias_scale=0.02, bias_heading=math.radians(0.5),
        ),
        camera=StereoCamera(sigma_px=1.5 * true.sigma_px, sigma_disparity_px=1.5 * true.sigma_disparity_px),
        smoothing=SmoothingOptions(max_keys=120, further_keys=0, incremental=True, rigid_within=0.007),
    )  # fmt: skip


def motion_without_smoother(motion: OdometryModel) -> OdometryModel:
    """Return the odometry noise to assume in filters that are not rejuvenated, given that of those that are.

    They keep as much slip and noise of turns and at rest as `OdometryModel()` has in proportion to `sigma_along`: less
    gains nothing without a smoother (docs/lab/accuracy.md), and has not been tried with rendered cameras.
    """
    plain = OdometryModel()
    scale = motion.sigma_along / plain.sigma_along
    return replace(
        motion, sigma_across=scale * plain.sigma_across, sigma_turn=plain.sigma_turn,
        floor_position=plain.floor_position, floor_heading=plain.floor_heading,
    )  # fmt: skip


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class BeliefConfig:
    """Configuration of beliefs: assumed noise, filters, map alignment and merging.

    Attributes:
        filter: Options of each FastSLAM filter; its camera and motion model hold the assumed noise.
        alignment: Criteria for accepting an alignment of two maps.
        attempts: Schedule of the merge attempts.
        merging: Options of merges and their rollback.
        confirm_after: Number of measurements after which a landmark belongs to a robot's map; a landmark measured only
            once may be a false point.
    """

    filter: FilterOptions = field(default_factory=default_filter_options)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    attempts: AttemptOptions = field(default_factory=AttemptOptions)
    merging: MergeOptions = field(default_factory=MergeOptions)
    confirm_after: int = 2

    def __post_init__(self) -> None:
        check_int("belief.confirm_after", self.confirm_after, 1, "Use 1 to count all landmarks.", MOST)


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotHardware:
    """Hardware parameters known to each robot.

    Attributes:
        radius: Radius of the robot's disc [m].
        ray_angles: (R,) float64 [rad], robot frame, ascending. Directions of the range finder's rays.
        scan_range: Range that a ray without a hit reads [m].
    """

    radius: float
    ray_angles: FloatArray
    scan_range: float


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Teammate:
    """Estimate of another robot of the same group, in the start frame of the believing robot.

    Attributes:
        robot: Index of the teammate.
        pose: (3,) float64 [m, m, rad]. Pose estimate.
        covariance: (3, 3) float64 [m, m, rad]. Covariance of the pose.
        goal: (2,) float64 [m]. Goal to which it drives, as it says; NaN: none, or not known.
    """

    robot: int
    pose: FloatArray
    covariance: FloatArray
    goal: FloatArray

    def __post_init__(self) -> None:
        _freeze_arrays(self)

    @property
    def position_sigma(self) -> float:
        """One sigma of the position [m], averaged over directions."""
        return position_sigma(self.covariance)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """C slots with places to go to, see `TeamCandidates`; renewed once a second, with `goal` actions at decisions.

    Attributes:
        goals: (C, 2) float64 [m], start frame. Goal positions; NaN in empty slots.
        headings: (C,) float64 [rad], start frame. Headings at the goals; NaN in empty slots.
        lengths: (C,) float64 [m]. Lengths of the paths to the goals at the last update; NaN in empty slots.
        valid: (C,) bool. True where a slot holds a candidate.
        kinds: (C,) int64. `CandidateKind` of each candidate; -1 in empty slots.
        sizes: (C,) float64 [m]. Length of a frontier; length of the walls seen again; 0 for
            rendezvous; NaN in empty slots.
        gains: Gains at each candidate.
        teammate_lengths: (C, T) float64 [m]. Lengths of the paths of the teammates, in the order of
            `Belief.teammates`, over the floor that this robot knows; inf: none known.
        own_goal: (C,) bool. True for the goal to which the robot drives.
        teammate_goal: (C,) bool. True within 1 m of the goal of a teammate.
        features: (C, F) float32, robot frame. Columns `CANDIDATE_FEATURES`.
    """

    goals: FloatArray
    headings: FloatArray
    lengths: FloatArray
    valid: BoolArray
    kinds: IntArray
    sizes: FloatArray
    gains: CandidateGains
    teammate_lengths: FloatArray
    own_goal: BoolArray
    teammate_goal: BoolArray
    features: NDArray[np.float32]

    def __post_init__(self) -> None:
        _freeze_arrays(self)

    def of_kind(self, kind: CandidateKind) -> IntArray:
        """Return the slots (n,) int64 that hold candidates of a kind, ascending."""
        return np.flatnonzero(self.kinds == kind)


@short_repr
@dataclass(frozen=True, eq=False)
class Belief:
    """Belief of one robot after a tick, in its own start frame and without ground truth.

    All arrays, including those of candidates and teammates, are read-only copies. In beliefs of an environment each
    attribute is made when it is first read, which must be before the next step; from then on it stays. Copies and
    pickles have all attributes.

    Attributes:
        robot: Index of the robot.
        tick: Ticks since the reset.
        frame: Identity of the group's map frame: the index of the group's first robot.
        group: Robots known to share the map, itself included.
        pose: (3,) float64 [m, m, rad]. Pose estimate.
        covariance: (3, 3) float64 [m, m, rad]. Covariance of the pose.
        particles: (M, 3) float64 [m, m, rad]. The robot's pose in each particle.
        log_weights: (M,) float64. Normalised logarithmic weights of the particles.
        ess: Effective sample size as a share of M.
        grid: Read-only view of the occupancy grid, updated in later ticks; use `copy()` to keep its content.
        candidates: Candidate places to explore. They are found from when they are first read on, or from the reset if
            the environment observes `candidates` or has `goal` actions.
        teammates: Other robots of the group; for those out of contact, the last estimate before contact was lost.
        looks: (S, S) uint8. Looks at walls by cell of the grid, see `TeamLooks`; a read-only view, as `grid.cells`.
        scan: (R,) float64 [m]. Last scan.
        seconds_left: Time until the episode is truncated [s]; inf if the belief is not used by an environment.
        start_from_group: (3,) float64 [m, m, rad]. Motion from the group's map frame to the own start frame.
        group_map: Confirmed landmarks in the group's map frame; see `map` for the own start frame.
    """

    robot: int
    tick: int
    frame: int
    group: tuple[int, ...]
    pose: FloatArray
    covariance: FloatArray
    particles: FloatArray
    log_weights: FloatArray
    ess: float
    grid: OccupancyGrid
    candidates: Candidates
    teammates: tuple[Teammate, ...]
    looks: NDArray[np.uint8]
    scan: FloatArray
    seconds_left: float
    start_from_group: FloatArray
    group_map: LandmarkMap

    def __post_init__(self) -> None:
        _freeze_arrays(self)

    @classmethod
    def on_demand(cls, make: Callable[[str], Any], **known: Any) -> Self:
        """Return a belief whose attributes are made by `make(name)` when they are read; `known` are made already."""
        self = object.__new__(cls)
        self.__dict__.update(known, _make=make)
        return self

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Make an attribute."""
            if name not in type(self).__dataclass_fields__ or "_make" not in self.__dict__:
                raise AttributeError(f"'Belief' has no attribute '{name}'")
            self.__dict__[name] = value = _frozen(self._make(name))
            return value

    def materialise(self) -> Self:
        """Make all attributes, so that they can also be read after the next step, and return the belief.

        Raises:
            RuntimeError: If an attribute is missing after the next step.
        """
        for item in fields(self):
            getattr(self, item.name)
        self.__dict__.pop("_make", None)
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self.materialise().__dict__

    @cached_property
    def map(self) -> LandmarkMap:
        """Confirmed landmarks of the best particle, in the own start frame."""
        return self.group_map.moved(self.start_from_group)


@short_repr
class BeliefBatch(NamedTuple):
    """Observable part of n robots' beliefs, without copies: valid until the next step.

    What no key reads is left out: the global grids are then not drawn, and there are no candidates.

    Attributes:
        robots: (n,) int64. Indices of the robots.
        team_poses: Poses, with one row per robot and columns for the team up to the last known robot.
        map_summaries: Summaries of the confirmed landmarks in the map frames.
        cells: (n, S, S) uint8. Cells of the occupancy grids.
        global_grids: Pictures of all that was seen.
        features: (n, C, F) float32, robot frames. Features of the candidates; a new array.
        scans: (n, R) float64 [m]. Last scans.
        seconds_left: Time until the episode is truncated [s].
    """

    robots: IntArray
    team_poses: TeamPoses
    map_summaries: TeamMapSummaries
    cells: NDArray[np.uint8]
    global_grids: GlobalGrids
    features: NDArray[np.float32]
    scans: FloatArray
    seconds_left: float

    @classmethod
    def of(cls, belief: Belief, keys: Collection[str]) -> "BeliefBatch":
        """Return the batch of a single belief, with what these keys of observations read."""
        known = {mate.robot: (mate.pose, mate.position_sigma) for mate in belief.teammates}
        known[belief.robot] = belief.pose, position_sigma(belief.covariance)
        team_poses = TeamPoses(1, max(known) + 1)
        team_poses.own[0], team_poses.starts[0] = belief.pose, belief.start_from_group
        team_poses.covariances[0], team_poses.ess[0] = belief.covariance, belief.ess
        team_poses.poses.fill(np.nan)
        team_poses.sigmas.fill(np.nan)
        for robot, (pose, sigma) in known.items():
            team_poses.poses[0, robot], team_poses.sigmas[0, robot] = pose, sigma
        draws, describes = not READ_GLOBAL_GRIDS.isdisjoint(keys), not READ_CANDIDATES.isdisjoint(keys)
        features = belief.candidates.features if describes else NO_FEATURES
        return cls(
            robots=np.array([belief.robot]),
            team_poses=team_poses,
            map_summaries=TeamMapSummaries.from_maps([belief.group_map.summary]),
            cells=belief.grid.cells[None],
            global_grids=GlobalGrids.of(belief.grid, belief.looks) if draws else GlobalGrids(1),
            features=features[None].copy(),
            scans=belief.scan[None],
            seconds_left=belief.seconds_left,
        )


NO_FEATURES = np.empty((0, len(CANDIDATE_FEATURES)), np.float32)


def position_sigma(covariance: FloatArray) -> float:
    """Return one sigma of the position [m], averaged over directions, for the covariance (3, 3) of a pose."""
    return math.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))


def _freeze_arrays(record: Any) -> None:
    """Replace the arrays of a frozen record by read-only copies, which policies cannot share with the filters."""
    for item in fields(record):
        object.__setattr__(record, item.name, _frozen(getattr(record, item.name)))


def _frozen(value: Any) -> Any:
    """Return a value with read-only copies of its arrays."""
    if isinstance(value, np.ndarray):
        return as_read_only(value.copy())
    return CandidateGains(*map(_frozen, value)) if isinstance(value, CandidateGains) else value
