"""Options, results and refusal reasons of map alignment."""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import (
    MOST,
    FloatArray,
    IntArray,
    argument_error,
    check_array,
    check_float,
    check_int,
    known_names,
)
from slam_backend.state import FLOAT64, INT64, Array, Flag, Float, State, Text

Reason = Literal[
    "", "too few candidates", "too many candidates", "too few inliers", "ambiguous", "mirrored", "poorly spread",
    "too uncertain",
]  # fmt: skip
REASONS: tuple[Reason, ...] = (
    "too few candidates",
    "too many candidates",  # without appearance
    "too few inliers",
    "ambiguous",
    "mirrored",  # the mirror image fits better, which is physically impossible
    "poorly spread",
    "too uncertain",
)
HINTS: dict[str, str] = {  # hints by refusal reason
    "too few candidates": "The maps have too few similar landmarks: let robots see more of the same places.",
    "too many candidates": "Compare maps by appearance, or compare smaller ones.",
    "too few inliers": "Few landmarks agree in both maps: the overlap is small, or one map is distorted. Let robots see"
    " more of the same places, set `rejuvenate_every`, or raise `AlignmentOptions.position_floor` for inaccurate maps.",
    "ambiguous": "The shared landmarks fit at several places: let robots see more distinctive places.",
    "mirrored": "The mirror image fits better: check the sign of the measured coordinates.",
    "poorly spread": "The shared landmarks are too close together: let robots see more of the same places.",
    "too uncertain": "The path of a robot to the shared landmarks is too uncertain: close loops or set"
    " `rejuvenate_every`; or accept it, with a lower `MergeOptions.min_sigmas` if the paths are uncertain, or"
    " a higher `AlignmentOptions.max_sigma_position` or `max_sigma_heading` if the landmarks are.",
}
BOUNDS = ("translation", "rotation", "one match", "paths")  # possible bounds of a "too uncertain" refusal
DISTINCT_TRANSLATION = 0.5  # [m]; alignments beyond these two limits count as different, and as false
DISTINCT_ROTATION = math.radians(5.0)
LARGEST = 1e9  # limit of gates and distances; their squares do not overflow
MAX_SIMILAR = 10_000  # same limit as for pairs without appearance
FEWEST_INLIERS = 3  # a motion can be made to fit any two matches: only a third is evidence


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentOptions:
    """Gates of candidates and inliers, and refusal limits of an alignment.

    Attributes:
        appearance: Whether candidates need similar descriptors. False: any two landmarks of the same height are
            candidates, for maps without distinctive descriptors; two maps then have at most 10,000 such pairs.
        descriptor_gate: Largest L2 distance between matched descriptors [-].
        descriptor_ratio: Largest descriptor distance of a distinctive match over that to any other place [-].
        max_similar: Largest number of similar landmarks in the other map for which all pairs are candidates; landmarks
            with more need a distinctive match. 0: all do.
        same_place: Distance within which landmarks of one map may be duplicates and do not compete [m].
        position_gate: Largest squared Mahalanobis residual of an inlier [-]; 11.34 is 99 % of 3 degrees of freedom.
        position_floor: Standard deviation added to the residuals, because filters' maps are over-confident [m].
        min_inliers: Minimum number of inliers, at least 3.
        max_ratio: Largest `ratio` of an `Alignment` [-].
        min_spread: Minimum extent of the inliers along their main axis [m].
        max_sigma_position: Largest standard deviation of the translation in any direction [m].
        max_sigma_heading: Largest standard deviation of the rotation [rad].
        success_probability: Probability that a random search finds the best alignment, and each rival that would make
            it ambiguous [-].
        max_samples: Maximum number of minimal samples of that search.
    """

    appearance: bool = True
    descriptor_gate: float = 0.45
    descriptor_ratio: float = 0.8
    max_similar: int = 6
    same_place: float = 1.0
    position_gate: float = 11.34
    position_floor: float = 0.1
    min_inliers: int = 8
    max_ratio: float = 0.6
    min_spread: float = 2.0
    max_sigma_position: float = 0.17
    max_sigma_heading: float = 0.025
    success_probability: float = 0.999
    max_samples: int = 20_000

    def __post_init__(self) -> None:
        if not isinstance(self.appearance, bool):
            raise argument_error("options.appearance", "a bool", self.appearance, "Give True or False.")
        above = ("descriptor_gate", "position_gate", "position_floor", "max_sigma_position", "max_sigma_heading")
        for name in above:
            check_float(f"options.{name}", getattr(self, name), "Give a positive number.", above=0.0, at_most=LARGEST)
        for name in ("descriptor_ratio", "max_ratio"):
            check_float(f"options.{name}", getattr(self, name), "Give a share.", above=0.0, at_most=1.0)
        for name in ("same_place", "min_spread"):
            check_float(
                f"options.{name}", getattr(self, name), "Give a distance in metres.", at_least=0.0, at_most=LARGEST
            )
        probability = self.success_probability
        check_float("options.success_probability", probability, "Use e.g. 0.999.", above=0.0, at_most=1.0 - 1e-12)
        check_int("options.max_similar", self.max_similar, 0, "Use 0 to require distinctive matches.", MAX_SIMILAR)
        check_int("options.min_inliers", self.min_inliers, FEWEST_INLIERS, "A motion fits any two: require more.", MOST)
        check_int("options.max_samples", self.max_samples, 1, "Allow at least one sample.", MOST)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The motion from map b to map a, p_a = R(theta) p_b + t, or a refusal.

    Attributes:
        success: Whether the alignment is accepted.
        reason: Empty on success, else one of `REASONS`.
        tx: Translation along x [m], frame a; NaN when refused.
        ty: Translation along y [m], frame a; NaN when refused.
        theta: Rotation [rad] in [-pi, pi); NaN when refused.
        covariance: (3, 3) float64 [m, m, rad] of (tx, ty, theta); NaN when refused.
        inliers: (k, 2) int64 rows (index in map a, index in map b), one-to-one; none when refused.
        ratio: Support of the best different alignment (by more than 0.5 m or 5 degrees) relative to this one: its
            exclusive inliers over the exclusive inliers of this one, or over half of all inliers if that is more. 0 if
            there is no other.
        missed: Bound that a "too uncertain" refusal exceeds most, one of `BOUNDS`: standard deviation of the
            translation or of the rotation, shift by leaving one match out; in a team also the uncertainty of the
            robots' paths, or the change since the last trial. Else empty.
        excess: Value of the missed bound over its limit, above 1 [-]; NaN if none is missed.
    """

    STATE = State(
        success=Flag(),
        reason=Text(("", *REASONS)),
        tx=Float(nan=True),
        ty=Float(nan=True),
        theta=Float(nan=True),
        covariance=Array(FLOAT64, "3 3", nan=True),
        inliers=Array(INT64, "inliers 2"),
        ratio=Float(0.0),
        missed=Text(("", *BOUNDS)),
        excess=Float(0.0, math.inf, nan=True),
    )
    success: bool
    reason: str
    tx: float
    ty: float
    theta: float
    covariance: FloatArray
    inliers: IntArray
    ratio: float
    missed: str = ""
    excess: float = math.nan

    def __post_init__(self) -> None:
        if self.reason not in (REASONS if not self.success else ("",)):
            expected = "'' on success, else one of " + ", ".join(REASONS)
            raise argument_error("reason", expected, self.reason, "Give the reason of the refusal.")
        hint = "A successful alignment has a finite motion and covariance."
        pose = check_array("tx, ty, theta", (self.tx, self.ty, self.theta), (3,), hint, finite=self.success)
        for name, value in zip(("tx", "ty", "theta"), pose, strict=True):
            object.__setattr__(self, name, float(value))
        covariance = check_array("covariance", self.covariance, (3, 3), hint, finite=self.success)
        inliers = check_array("inliers", self.inliers, (None, 2), "Give rows (a, b).", dtype=np.int64)
        for name, array in (("covariance", covariance), ("inliers", inliers)):
            object.__setattr__(self, name, as_read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled alignments read-only."""
        return Alignment, tuple(getattr(self, field.name) for field in fields(self))

    @property
    def transform(self) -> FloatArray:
        """Motion (3,) a_from_b [m, m, rad]; NaN when refused."""
        return np.array([self.tx, self.ty, self.theta])

    @classmethod
    def refused(cls, reason: Reason, ratio: float = 0.0, missed: str = "", excess: float = math.nan) -> Self:
        """Return a refusal: NaN motion and covariance, no inliers."""
        nan, none = math.nan, np.empty((0, 2), np.int64)
        return cls(False, reason, nan, nan, nan, np.full((3, 3), nan), none, ratio, missed, excess)


def is_distinct(motion: FloatArray) -> bool:
    """Return whether two alignments count as different, given the motion (3,) [m, m, rad] from one to the other."""
    x, y, turn = motion
    return bool(np.hypot(x, y) > DISTINCT_TRANSLATION or abs(turn) > DISTINCT_ROTATION)
