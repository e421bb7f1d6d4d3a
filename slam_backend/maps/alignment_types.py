"""Options and results of map alignment, and the reasons for which it refuses."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

import numpy as np

from slam_backend.core.read_only import as_read_only
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
from slam_backend.fastslam.reports import MergeEvent

Reason = Literal[
    "", "too few candidates", "too many candidates", "too few inliers", "ambiguous", "mirrored", "poorly spread",
    "too uncertain",
]  # fmt: skip
REASONS: tuple[Reason, ...] = (
    "too few candidates",
    "too many candidates",  # by geometry alone
    "too few inliers",
    "ambiguous",
    "mirrored",  # the mirror image fits better, and no robot sees one
    "poorly spread",
    "too uncertain",
)
HINTS: dict[str, str] = {  # what helps, by the reason of a refusal
    "too few candidates": "The maps hold too few landmarks that look alike: let robots see more of the same places.",
    "too many candidates": "Compare maps by appearance, or compare smaller ones.",
    "too few inliers": "Few landmarks lie alike in both maps: they share little, or one is bent. Let robots see more of"
    " the same places, set `rejuvenate_every`, or raise `AlignmentOptions.position_floor` for rough maps.",
    "ambiguous": "The shared landmarks fit at several places: let robots see more of what is there only once.",
    "mirrored": "The mirror image fits better: check the sign of the measured coordinates.",
    "poorly spread": "The shared landmarks stand too close together: let robots see more of the same places.",
    "too uncertain": "The way of a robot to what the maps share is too uncertain: close loops or set"
    " `rejuvenate_every`; or accept it, by a lower `MergeOptions.min_sigmas_on_trial` where paths leave it open, by a"
    " higher"
    " `AlignmentOptions.max_sigma_position` or `max_sigma_heading` where landmarks do.",
}
BOUNDS = ("translation", "rotation", "one match", "paths", "repeat")  # that a refusal as "too uncertain" may miss
DISTINCT_TRANSLATION = 0.5  # [m]; beyond these two an alignment counts as another one, and as a false one
DISTINCT_ROTATION = math.radians(5.0)
LARGEST = 1e9  # of gates and distances; their squares are far from infinite
MAX_SIMILAR = 10_000  # as many pairs as geometry alone may make
FEWEST_INLIERS = 3  # two matches fit any motion between them: only a third is evidence


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentOptions:
    """When two landmarks look alike, when they lie together, and when an alignment is believed.

    Attributes:
        appearance: Whether only landmarks that look alike may be the same. False: any two of the same height may, where
            all look the same; two maps then have at most 10,000 such pairs.
        descriptor_gate: Largest L2 distance between matched descriptors [-].
        descriptor_ratio: A match stands out if it is closer than this times the best landmark of another place [-].
        max_similar: Landmarks that have up to so many look-alikes within the gate in the other map may be any of them;
            with more they must stand out. 0: all must.
        same_place: Landmarks of one map within this distance may be duplicates, and do not compete [m].
        position_gate: Largest squared Mahalanobis residual of an inlier [-]; 11.34 is 99 % of 3 degrees of freedom.
        position_floor: Standard deviation added to the residuals, because filters' maps are over-confident [m].
        min_inliers: Fewer inliers are refused; at least 3.
        max_ratio: Refused when the `ratio` of an `Alignment` exceeds this [-].
        min_spread: Refused when the inliers extend over less than this along their main axis [m].
        max_sigma_position: Refused when the translation is less certain than this in any direction [m].
        max_sigma_heading: Refused when the rotation is less certain than this [rad].
        success_probability: That a random search meets the best alignment, and each rival that would make it
            ambiguous [-].
        max_samples: Bound on the minimal samples of that search, whatever the probability.
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
            raise argument_error("options.appearance", "a bool", self.appearance, "Say True or False.")
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
        check_int("options.look_alikes", self.max_similar, 0, "Use 0 to demand that all stand out.", MAX_SIMILAR)
        check_int("options.min_inliers", self.min_inliers, FEWEST_INLIERS, "Two fit any motion: demand more.", MOST)
        check_int("options.max_samples", self.max_samples, 1, "Allow at least one sample.", MOST)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The motion from map b to map a, p_a = R(theta) p_b + t, or a refusal.

    Attributes:
        success: Whether the alignment is believed.
        reason: Empty on success, else one of `REASONS`.
        tx: Translation [m], frame a; NaN when refused.
        ty: Likewise.
        theta: Rotation [rad] in [-pi, pi); NaN when refused.
        covariance: (3, 3) float64 [m, m, rad] of (tx, ty, theta); NaN when refused.
        inliers: (k, 2) int64 rows (index in map a, index in map b), one-to-one; none when refused.
        ratio: How near the best alignment that differs (by more than 0.5 m or 5 degrees) comes to this one: its own
            inliers, over this one's own or half of this one's if those are more; own are those that the other has not.
            0 if there was none.
        missed: Of a refusal as "too uncertain" the bound that is missed most, one of `BOUNDS`: the standard deviation
            of the translation or of the rotation, the shift by leaving one match out; in a team also the spread that
            the robots' paths leave open, or the change since the last trial; else empty.
        excess: The missed figure over its bound, above 1 [-]; NaN where none is missed.
    """

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
            raise argument_error("reason", expected, self.reason, "Name why it was refused.")
        cure = "A successful alignment has a finite motion and covariance."
        pose = check_array("tx, ty, theta", (self.tx, self.ty, self.theta), (3,), cure, finite=self.success)
        for name, value in zip(("tx", "ty", "theta"), pose, strict=True):
            object.__setattr__(self, name, float(value))
        covariance = check_array("covariance", self.covariance, (3, 3), cure, finite=self.success)
        inliers = check_array("inliers", self.inliers, (None, 2), "Give rows (a, b).", dtype=np.int64)
        for name, array in (("covariance", covariance), ("inliers", inliers)):
            object.__setattr__(self, name, as_read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return Alignment, tuple(getattr(self, field.name) for field in fields(self))

    @property
    def transform(self) -> FloatArray:
        """The motion (3,) = a_from_b [m, m, rad]; NaN when refused."""
        return np.array([self.tx, self.ty, self.theta])

    @classmethod
    def refused(cls, reason: Reason, ratio: float = 0.0, missed: str = "", excess: float = math.nan) -> Self:
        """Return a refusal: NaN motion and covariance, no inliers."""
        nan, none = math.nan, np.empty((0, 2), np.int64)
        return cls(False, reason, nan, nan, nan, np.full((3, 3), nan), none, ratio, missed, excess)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairAttempts:
    """The attempts of one pair of groups to align their maps.

    Attributes:
        robots_a: The one group, as it was then.
        robots_b: The other group.
        attempts: How many there were.
        refusals: Refused attempts by reason, one of `REASONS` each, in that order.
        last_reason: Reason of the last refusal; empty if there was none.
        last_step: Step of the last refusal; None if there was none.
        missed: Bound that the last refusal missed, see `Alignment.missed`.
        excess: Figure of that bound over the bound, see `Alignment.excess`.
    """

    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    attempts: int
    refusals: Mapping[str, int]
    last_reason: str
    last_step: int | None
    missed: str
    excess: float


def count_attempts(events: Iterable[MergeEvent]) -> tuple[PairAttempts, ...]:
    """Return what came of the attempts of each pair of groups, in order of their first attempts.

    Args:
        events: All events of a team, in order; merges and undos do not count.
    """
    tried: dict[tuple[tuple[int, ...], tuple[int, ...]], list[MergeEvent]] = {}
    for event in events:
        if event.kind == "attempt":
            tried.setdefault((event.robots_a, event.robots_b), []).append(event)
    return tuple(_of_pair(own) for own in tried.values())


def refusals_of(events: Iterable[MergeEvent], robot: int) -> dict[str, float]:
    """Return how many attempts a robot's groups made, and how many were refused for each reason.

    Args:
        events: All events of a team.
        robot: Index of the robot.

    Returns:
        `attempts`, and for each of `REASONS` a key such as `refused_too_uncertain`.
    """
    own = [event for event in events if event.kind == "attempt" and robot in event.robots_a + event.robots_b]
    counts = Counter(event.alignment.reason for event in own)
    named = {f"refused_{reason.replace(' ', '_')}": float(counts[reason]) for reason in REASONS}
    return {"attempts": float(len(own))} | named


def _of_pair(events: list[MergeEvent]) -> PairAttempts:
    """Return the attempts of one pair, at least one."""
    refused = [event for event in events if not event.alignment.success]
    counts = Counter(event.alignment.reason for event in refused)
    last = refused[-1] if refused else None
    return PairAttempts(
        robots_a=events[0].robots_a,
        robots_b=events[0].robots_b,
        attempts=len(events),
        refusals={reason: counts[reason] for reason in REASONS if counts[reason]},
        last_reason=last.alignment.reason if last else "",
        last_step=last.step if last else None,
        missed=last.alignment.missed if last else "",
        excess=last.alignment.excess if last else float("nan"),
    )
