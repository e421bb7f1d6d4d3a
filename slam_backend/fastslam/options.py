"""Options of a `FastSlam`: one frozen, validated record."""

from dataclasses import astuple, dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import (
    MOST,
    FloatArray,
    argument_error,
    check_choice,
    check_float,
    check_int,
    check_kind,
    known_names,
)
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.models.camera import StereoCamera
from slam_backend.models.odometry import LARGEST_SIGMA, OdometryModel
from slam_backend.resampling import RESAMPLING
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.state import MAX_DESCRIPTOR

PROPOSALS = ("fastslam2", "fastslam1")
MAX_ROBOTS, MAX_PARTICLES = 1_000, 1_000_000  # beyond any memory
CALIBRATED_NOISE = 0.005  # [m]; chosen on simulated stereo runs, see docs/reference/smoother.md
REJUVENATE_EVERY = 50  # steps; 0.94 times the pose errors of every 100 in environments


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class FilterOptions:
    """Assumptions and decision rules of a `FastSlam`: its arguments without the number of robots and the seed.

    Attributes:
        num_particles: M.
        camera: Assumed camera and its noise.
        motion: Assumed noise of the odometry.
        proposal: "fastslam2": the measurements shape the sampled pose. "fastslam1": poses are sampled from the motion
            model alone and association follows Algorithm 1, with the corrections in `docs/reference/errata.md`.
        resampling: Scheme, a key of `slam_backend.resampling.RESAMPLING`.
        resample_threshold: ESS / M at or below which particles are resampled; 1 = at every step with a measurement.
        position_gate: D0, largest squared Mahalanobis distance of a match [-] (11.34: 99 % at 3 degrees of freedom).
        descriptor_gate: Square root of E0, largest L2 distance between matched descriptors [-].
        new_landmark_gate: Upper end of the dead zone: a measurement without a match is not new if any candidate, even
            one that is taken, has a squared Mahalanobis distance up to this (`fastslam2`) [-].
        new_landmark_radius: Distance from a similar landmark within which no measurement is new (`fastslam2`) [m].
        recovery_position: Position sigma of the prior for recovery (`fastslam2`) [m]. If a pose with this prior
            explains at least three measurements and most of those it can explain, but the particle's own pose does not,
            the particle is lost and re-localised from this prior, if three matches hold at the pose found. 0: no
            recovery.
        recovery_heading: Heading sigma of the prior for recovery [rad].
        descriptor_sigma: L2 distance between descriptors that costs a match as much as one sigma of position
            (`fastslam2`) [-].
        ambiguity_margin: Least difference of cost (squared Mahalanobis + log-determinant + descriptor) to the second
            best candidate; below it a measurement is ambiguous and rejected (`fastslam2`) [-].
        new_landmark_density: p0, density of measurements that match nothing [1/m^3].
        one_to_one: Match a landmark at most once in a frame; False: measurements choose independently, as in the paper.
        landmark_noise: Standard deviation q [m] along each axis of a landmark's random walk between two measurements:
            Sigma + q^2 I after each update, the first included. The variance then never falls below the fixed point of
            the Riccati recursion. 0: static landmarks. None: `CALIBRATED_NOISE` if particles are rejuvenated, where it
            keeps the covariances consistent in between, else 0: without a smoother the filter would only forget.
        existence: Detection model that updates the probability of existence of landmarks; particles delete improbable
            ones. None: landmarks are never deleted.
        rejuvenate_every: Steps after which particles are sampled from the smoother's posterior of whole paths; also at
            the first step after a merge, and sooner after a loop closure. None: never, as in the paper.
        smoothing: Options of the smoother.
    """

    num_particles: int = 100
    camera: StereoCamera = field(default_factory=StereoCamera)
    motion: OdometryModel = field(default_factory=OdometryModel)
    proposal: Literal["fastslam2", "fastslam1"] = "fastslam2"
    resampling: str = "systematic"
    resample_threshold: float = 0.5
    position_gate: float = 11.34
    descriptor_gate: float = 0.45
    new_landmark_gate: float = 25.0
    new_landmark_radius: float = 1.0
    recovery_position: float = 0.5
    recovery_heading: float = 0.1
    descriptor_sigma: float = 0.1
    ambiguity_margin: float = 6.0
    new_landmark_density: float = 0.01
    one_to_one: bool = True
    landmark_noise: float | None = None
    existence: ExistenceModel | None = None
    rejuvenate_every: int | None = REJUVENATE_EVERY
    smoothing: SmoothingOptions = field(default_factory=SmoothingOptions)

    def __post_init__(self) -> None:
        hint = "Use at least one particle; 100 is a good start."
        check_int("num_particles", self.num_particles, 1, hint, MAX_PARTICLES)
        for name, kind in (("camera", StereoCamera), ("motion", OdometryModel)):
            check_kind(name, getattr(self, name), kind)
        check_choice("proposal", self.proposal, PROPOSALS)
        check_choice("resampling", self.resampling, tuple(RESAMPLING))
        check_float("resample_threshold", self.resample_threshold, "Give a share of M.", at_least=0.0, at_most=1.0)
        for name in ("position_gate", "new_landmark_density"):
            check_float(name, getattr(self, name), "Give a positive number.", above=0.0)
        for name in ("descriptor_gate", "descriptor_sigma"):
            value = getattr(self, name)
            check_float(name, value, "Give a positive number.", at_least=1e-9, at_most=2.0 * MAX_DESCRIPTOR)
        check_float(
            "new_landmark_gate", self.new_landmark_gate, "It starts where the gate ends.", at_least=self.position_gate
        )
        check_float("new_landmark_radius", self.new_landmark_radius, "Use 0 to switch it off.", at_least=0.0)
        for name in ("recovery_position", "recovery_heading"):
            check_float(name, getattr(self, name), "Use 0 to switch it off.", at_least=0.0, at_most=LARGEST_SIGMA)
        if self.landmark_noise is not None:
            hint = "Use 0 for landmarks that stand still."
            check_float("landmark_noise", self.landmark_noise, hint, at_least=0.0, at_most=LARGEST_SIGMA)
        check_float(
            "ambiguity_margin", self.ambiguity_margin, "Use 0 to reject no ambiguous measurement.", at_least=0.0
        )
        existence: object = self.existence
        if not isinstance(existence, ExistenceModel | None):
            hint = "Build one: ExistenceModel()."
            raise argument_error("existence", "ExistenceModel or None", self.existence, hint)
        if self.existence is not None:
            self.existence.view(self.camera)  # raises if the view is empty
        if self.rejuvenate_every is not None:
            check_int("rejuvenate_every", self.rejuvenate_every, 1, "Give a number of steps, or None for never.", MOST)
        if not isinstance(self.smoothing, SmoothingOptions):
            raise argument_error("smoothing", "SmoothingOptions", self.smoothing, "Build them: SmoothingOptions().")
        if not isinstance(self.one_to_one, bool):
            raise argument_error("one_to_one", "a bool", self.one_to_one, "Say True or False.")

    @property
    def landmark_walk(self) -> float:
        """Variance [m^2] along each axis by which a landmark may move between two sightings."""
        if self.landmark_noise is None:
            return 0.0 if self.rejuvenate_every is None else CALIBRATED_NOISE**2
        return float(self.landmark_noise) ** 2


def packed_camera(camera: StereoCamera) -> FloatArray:
    """Return what kernels take of a camera, (7,) float64, see `Frame` of the kernels."""
    sigmas = camera.sigma_px, camera.sigma_disparity_px
    return np.array([camera.focal_px, camera.baseline, *sigmas, *camera.mount], np.float64)


NUMBERS = tuple(field.name for field in fields(FilterOptions) if field.type in ("float", "bool", float, bool))
DERIVED = (
    ("noise", np.float64, 6), ("bias_sigmas", np.float64, 3), ("camera", np.float64, 7),
    ("descriptor_gate_squared", np.float64), ("descriptor_variance", np.float64), ("log_density", np.float64),
    ("landmark_walk", np.float64), ("closure_after", np.float64), ("is_fastslam1", np.bool_),
)  # fmt: skip
KERNEL_OPTIONS = np.dtype((np.record, np.dtype([*((name, np.float64) for name in NUMBERS), *DERIVED], align=True)))


def kernel_options(options: FilterOptions) -> NDArray[Any]:
    """Return what kernels take of the options, (1,) `KERNEL_OPTIONS`: all numbers by their names, and what follows.

    These are noise of the odometry and sigmas of its bias, see `OdometryModel`; `packed_camera`; E0 and the variance of
    descriptors; log p0; the variance of a landmark's walk; and `SmoothingOptions.closure_after`.
    """
    packed: NDArray[Any] = np.zeros(1, KERNEL_OPTIONS)
    for name in NUMBERS:
        packed[name] = getattr(options, name)
    motion = astuple(options.motion)
    packed["noise"], packed["bias_sigmas"], packed["camera"] = motion[:6], motion[6:], packed_camera(options.camera)
    packed["descriptor_gate_squared"], packed["descriptor_variance"] = (
        options.descriptor_gate**2,
        options.descriptor_sigma**2,
    )
    packed["log_density"], packed["landmark_walk"] = np.log(options.new_landmark_density), options.landmark_walk
    packed["closure_after"] = options.smoothing.closure_after
    packed["is_fastslam1"] = options.proposal == "fastslam1"
    return packed


def robot_batches(num_robots: int, one_by_one: bool) -> tuple[tuple[int, int, bool], ...]:
    """Return for each kernel call of a step its first robot, the end of its robots, and whether it ends the step."""
    if one_by_one:
        return (*((robot, robot + 1, False) for robot in range(num_robots)), (num_robots, num_robots, True))
    return ((0, num_robots, True),)
