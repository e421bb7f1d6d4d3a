"""`Belief`: what one robot believes after a tick, and `BeliefConfig`: what it assumes."""

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import MOST, BoolArray, FloatArray, IntArray, check_int
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap, TeamMapSummaries
from slam_backend.models.camera import StereoCamera
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from vslam_env.navigation import SeenGrid


def default_filter_options() -> FilterOptions:
    """Return the default filter: it assumes twice the camera noise of the default camera, and is rejuvenated in slices.

    Particle filters are over-confident. In the recorded readings of four office episodes of 220 s (seeds 100-103,
    three robots) the team's map error at the end was 0.41, 0.22, 0.42, 0.38 m with 1.5 times the true noise, 0.35,
    0.22, 0.39, 0.32 m with twice, and 0.54, 0.22, 0.43, 0.34 m with three times. That was without rejuvenation; what
    that does, and what it costs, is in docs/explanation/smoothing.md.
    """
    true = StereoCamera()
    return FilterOptions(
        camera=StereoCamera(sigma_px=2.0 * true.sigma_px, sigma_disparity_px=2.0 * true.sigma_disparity_px),
        rejuvenate_every=100,
        smoothing=SmoothingOptions(max_keys=90, further_keys=0, slice_steps=90, rigid_within=0.007),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BeliefConfig:
    """What the robots assume about their sensors, and how they align their maps.

    Attributes:
        filter: Options of each robot's FastSLAM, whose camera and motion hold the assumed noise; by default those of
            `default_filter_options`.
        alignment: When two maps are believed to fit together.
        attempts: When a pair of groups tries.
        merging: How their filters are merged, and when a merge is undone. By default robots merge on trial where they
            are not sure (`MergeOptions.min_sigmas_on_trial`): they are scored in the frames of their own starts.
        confirm_after: Landmarks measured fewer times than this are not yet part of a robot's map: what is seen but
            once may be a false point.
    """

    filter: FilterOptions = field(default_factory=default_filter_options)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    attempts: AttemptOptions = field(default_factory=AttemptOptions)
    merging: MergeOptions = field(default_factory=lambda: MergeOptions(min_sigmas_on_trial=5.0))
    confirm_after: int = 2

    def __post_init__(self) -> None:
        check_int("belief.confirm_after", self.confirm_after, 1, "Use 1 to count all landmarks.", MOST)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotHardware:
    """What each robot knows of its own hardware.

    Attributes:
        radius: Of its disc [m].
        ray_angles: (R,) float64 [rad], robot frame, ascending. Directions of the range finder's rays.
        scan_range: A ray that meets nothing reads this [m].
    """

    radius: float
    ray_angles: FloatArray
    scan_range: float


@dataclass(frozen=True, slots=True, eq=False)
class Teammate:
    """Another robot of the same group, in the own start frame.

    Attributes:
        robot: Its index.
        pose: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
    """

    robot: int
    pose: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        _freeze_arrays(self)

    @property
    def position_sigma(self) -> float:
        """One sigma of its position [m], averaged over directions."""
        return position_sigma(self.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Sixteen places to explore, in stable slots; see `CandidateSlots`.

    Attributes:
        goals: (16, 2) float64 [m], start frame; NaN in empty slots.
        headings: (16,) float64 [rad], start frame; NaN in empty slots.
        lengths: (16,) float64 [m]. Of the path to each at the last update.
        valid: (16,) bool.
        features: (16, 5) float32 [m], robot frame; see `CandidateSlots.features`.
    """

    goals: FloatArray
    headings: FloatArray
    lengths: FloatArray
    valid: BoolArray
    features: NDArray[np.float32]

    def __post_init__(self) -> None:
        _freeze_arrays(self)


@dataclass(frozen=True, eq=False)
class Belief:
    """What one robot believes after a tick; everything is in its own start frame, and nothing of it is the truth.

    Its arrays, those of its candidates and teammates included, are read-only copies.

    Attributes:
        robot: Its index.
        tick: Ticks since the reset.
        frame: Identity of the group's map frame: the index of the group's first robot.
        group: The robots that share the map, itself included, as far as it has been told.
        pose: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
        particles: (M, 3) float64 [m, m, rad]. The robot's pose in each particle.
        log_weights: (M,) float64, normalised.
        ess: Effective sample size, as a share of M.
        grid: The seen grid, read-only. It follows the robot: `copy()` it to keep it.
        candidates: Places to explore.
        teammates: The other robots of the group; those out of contact where they were when it was lost.
        start_from_group: (3,) float64 [m, m, rad]. Moves the group's map frame to the own start frame.
        group_map: The confirmed landmarks in the group's frame; `map` has it in the own start frame.
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
    grid: SeenGrid
    candidates: Candidates
    teammates: tuple[Teammate, ...]
    start_from_group: FloatArray
    group_map: LandmarkMap

    def __post_init__(self) -> None:
        _freeze_arrays(self)

    @cached_property
    def map(self) -> LandmarkMap:
        """The confirmed landmarks of the group's most probable particle."""
        return self.group_map.moved(self.start_from_group)


class BeliefBatch(NamedTuple):
    """The part of some robots' beliefs that observations show, gathered without copies: read it before the next step.

    Attributes:
        robots: (n,) int64. Their indices.
        points: Where they stand: their rows, and columns for all robots of the team up to the last one known.
        map_summaries: Of the confirmed landmarks in the map frames.
        cells: (n, 300, 300) uint8. Of the seen grids.
        features: (n, 16, 5) float32 [m], robot frames. Of the candidates; the reader's own.
    """

    robots: IntArray
    points: TeamPoses
    map_summaries: TeamMapSummaries
    cells: NDArray[np.uint8]
    features: NDArray[np.float32]

    @classmethod
    def of(cls, belief: Belief) -> "BeliefBatch":
        """Return what an observation shows of one belief."""
        known = {mate.robot: (mate.pose, mate.position_sigma) for mate in belief.teammates}
        known[belief.robot] = belief.pose, position_sigma(belief.covariance)
        points = TeamPoses(1, max(known) + 1)
        points.own[0], points.starts[0] = belief.pose, belief.start_from_group
        points.covariances[0], points.ess[0] = belief.covariance, belief.ess
        points.poses.fill(np.nan)
        points.sigmas.fill(np.nan)
        for robot, (pose, sigma) in known.items():
            points.poses[0, robot], points.sigmas[0, robot] = pose, sigma
        return cls(
            robots=np.array([belief.robot]),
            points=points,
            map_summaries=TeamMapSummaries.from_maps([belief.group_map.summary]),
            cells=belief.grid.cells[None],
            features=belief.candidates.features[None].copy(),
        )


def position_sigma(covariance: FloatArray) -> float:
    """Return one sigma of the position [m], averaged over directions, of a pose's covariance (3, 3) [m, m, rad]."""
    return math.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))


def _freeze_arrays(record: Any) -> None:
    """Replace the arrays of a frozen record by read-only copies: what a policy holds is not what the filters use."""
    for item in fields(record):
        value = getattr(record, item.name)
        if isinstance(value, np.ndarray):
            object.__setattr__(record, item.name, as_read_only(value.copy()))
