"""Sequential test of a filter's consistency, with a bounded rate of false alarms.

Three signs of inconsistency are monitored, each by one or two yes-no questions about a frame:

- "nis": does the mean squared innovation of the frame lie beyond the 95 % bound of chi-square? The 99 % bound? At most
  about 5 and 1 % of the frames of a consistent filter do, even if the errors within a frame are fully correlated.
- "ess": is the effective sample size below a tenth of the particles?
- "rejected": of three measurements or more, are more than half neither matched nor new?

If the probability of a yes is at most p0 (5 %, and 1 % beyond the 99 % bound) given the past, the likelihood ratio L of
p1 > p0 against p0, multiplied over the frames, is a supermartingale: by Ville's inequality it ever exceeds 1/a with a
probability of at most a [1]. The test therefore needs no window, and the rate of false alarms holds for runs of any
length. The filter may fail late: a new product starts at every 25th frame, and all of them are summed with weights w
that add up to at most one,

    S_t = (S_{t-1} + w_t) L_t,     P(S_t >= 1/a for any t) <= a.

This is the recursion of Shiryaev and Roberts [2] with a prior over the frame at which the filter fails. Failures may be
weak and lasting or strong and short: for each sign S is averaged over its questions and two values of p1. A
conservative filter, for example one that assumes twice the true noise, shows no sign and raises no alarm.

A robot that is or was lost (`slam_backend.smoother.relocalisation`) is a warning of its own.

1. A. Ramdas, P. Gruenwald, V. Vovk, G. Shafer: Game-theoretic statistics and safe anytime-valid inference. Statistical
   Science 38(4), 2023.
2. M. Pollak: Optimal detection of a change in distribution. Annals of Statistics 13(1), 1985.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from slam_backend.fastslam.reports import Relocalisation
from slam_backend.state import Each, Flag, Float, Int, Record, Sizes, State

FALSE_ALARM_RATE = 0.01  # largest share of consistent filters that ever raise a warning, all signs together
NIS_BOUNDS = (7.81, 11.34)  # 95 and 99 % of chi-square with three degrees of freedom; conservative with two
LOW_ESS = 0.1  # share of the particles
LEAST_MEASURED = 3  # smallest frame that counts for "rejected"
SIGNS = ("nis", "ess", "rejected")
SIGN_OF = (0, 0, 1, 2)  # sign of each question
USUAL = (0.05, 0.01, 0.05, 0.05)  # p0 of each question
BETS = (0.1, 0.3)  # p1
# Likelihood ratios for each set of answers, whose bits are the questions.
FACTORS = tuple(
    tuple(
        p / usual if answers >> row & 1 else (1.0 - p) / (1.0 - usual) for row, usual in enumerate(USUAL) for p in BETS
    )
    for answers in range(1 << len(USUAL))
)
RENEWED = 25  # frames between two products
SHARE = 0.47  # the sum of 1 / (n ln^2 n) over n = 2, 3, ... is 2.11
WEIGHTS = tuple(SHARE / len(BETS) / SIGN_OF.count(sign) for sign in SIGN_OF for _ in BETS)
THRESHOLD = len(SIGNS) / FALSE_ALARM_RATE
HIGHEST = 1e6 * THRESHOLD  # limit of the evidence
CAUTIOUS = 1.0  # mean NIS below which covariances are at least twice too large, even in the plane
OVER_CONFIDENT = 4.0  # mean NIS, ideally 3, above which covariances are at least a quarter too small, even in space
VERDICTS = {  # words for a filter, with their conditions; the first one that holds applies
    "inconsistent": "a warning, other than of a lost robot",
    "perhaps lost": "a robot sees landmarks of another place of its map, and was not found since",
    "lost and found": "a robot was lost and found again",
    "unknown": "no measurement has matched a landmark",
    "over-confident": f"mean NIS above {OVER_CONFIDENT:g}",
    "cautious": f"mean NIS below {CAUTIOUS:g}",
    "consistent": f"mean NIS from {CAUTIOUS:g} to {OVER_CONFIDENT:g}",
}
SET_UP = "First check units, signs and time stamps (the filter's `diagnose()` names likely mistakes)"
ADVICE = {  # diagnosis and advice by sign
    "nis": (
        "the innovations exceed their predicted covariances, the filter is over-confident",
        f"{SET_UP}; then assume more odometry noise or measurement noise, lower rejuvenate_every, or use more"
        " particles.",
    ),
    "ess": (
        "less than a tenth of the particles carry all the weight",
        f"{SET_UP}; then use more particles, lower rejuvenate_every, or assume more measurement noise.",
    ),
    "rejected": (
        "most measurements match no landmark and start none",
        f"{SET_UP}; then assume more odometry noise.",
    ),
}


@dataclass(frozen=True, slots=True)
class ConsistencyWarning:
    """Sign that a filter is inconsistent.

    Attributes:
        sign: "nis", "ess" or "rejected".
        step: Step at which the evidence reached the threshold.
        share: Share of all frames that show the sign [-].
    """

    sign: str
    step: int
    share: float

    @property
    def text(self) -> str:
        """Diagnosis and advice."""
        diagnosis, advice = ADVICE[self.sign]
        return f"Inconsistent by step {self.step}: {diagnosis} ({self.share:.1%} of all frames). {advice}"


@dataclass(frozen=True, slots=True)
class LostWarning:
    """A robot that holds or held a wrong pose.

    Attributes:
        step: Step at which that was noticed.
        distance: Distance [m] between where it was believed to be and where older landmarks of its map are seen.
        num_landmarks: Number of landmarks that it had built a second time.
        found: Whether its pose and map were corrected; otherwise another place may look alike.
    """

    STATE = State(step=Int(), distance=Float(0.0), num_landmarks=Int(1), found=Flag())

    step: int
    distance: float
    num_landmarks: int
    found: bool

    @property
    def sign(self) -> str:
        """Name of the warning, "lost"."""
        return "lost"

    @property
    def text(self) -> str:
        """Diagnosis and advice."""
        what = "Lost, and found" if self.found else "Perhaps lost"
        return (
            f"{what} at step {self.step}: a robot saw {self.num_landmarks} landmarks again {self.distance:.1f} m from "
            "where they were held to be; "
            + ("its pose and map are corrected." if self.found else "or another place looks alike. Nothing is changed.")
            + " Check its odometry before: jumps, gaps, slipping wheels, or a robot that was carried."
        )


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of a filter so far.

    Attributes:
        frames: Number of frames with measurements.
        nis_mean: Mean over the frames of their mean squared innovation [-]; 3 is ideal, or 2 if all points lie in one
            plane, less is conservative. NaN if nothing was matched.
        nis_share: Share of the frames beyond the 95 % bound [-].
        ess_share: Share of the frames with an effective sample size below a tenth of the particles [-].
        rejected_share: Share of the frames with most measurements rejected [-].
        warnings: One warning for each sign with enough evidence, in the order of `SIGNS`, and one for each time that a
            robot was lost or seemed to be.
    """

    frames: int
    nis_mean: float
    nis_share: float
    ess_share: float
    rejected_share: float
    warnings: tuple[ConsistencyWarning | LostWarning, ...]

    @property
    def verdict(self) -> str:
        """Key of `VERDICTS`."""
        lost = [one for one in self.warnings if isinstance(one, LostWarning)]
        conditions = (
            any(one.sign != "lost" for one in self.warnings), any(not one.found for one in lost[-1:]), bool(lost),
            math.isnan(self.nis_mean), self.nis_mean > OVER_CONFIDENT, self.nis_mean < CAUTIOUS, True,
        )  # fmt: skip
        return next(word for word, holds in zip(VERDICTS, conditions, strict=True) if holds)

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields and the verdict as plain numbers and texts."""
        return {
            "verdict": self.verdict,
            "frames": self.frames,
            "nis_mean": self.nis_mean,
            "nis_share": self.nis_share,
            "ess_share": self.ess_share,
            "rejected_share": self.rejected_share,
            "warnings": [{"sign": one.sign, "step": one.step, "text": one.text} for one in self.warnings],
        }


class ConsistencyTest:
    """Running sums of the consistency test of one filter."""

    STATE = State(
        frames=Int(),
        begun=Int(),
        quiet=Int(0, RENEWED),
        nis=Float(0.0),
        matched=Int(),
        counts=Each(Int(), f"{len(SIGN_OF)}", list),
        evidence=Each(Float(0.0), f"{len(WEIGHTS)}", list),
        since=Each(Int(-1), f"{len(SIGNS)}", list),
        lost=Each(Record(LostWarning), kind=list),
    )
    __slots__ = ("_begun", "_counts", "_evidence", "_frames", "_lost", "_matched", "_nis", "_quiet", "_since")

    def __init__(self) -> None:
        self._frames = 0
        self._begun = 0  # frames before the start of the evidence
        self._quiet = 0  # last frames without a yes, not yet part of the evidence
        self._nis, self._matched = 0.0, 0  # sum of the frames' means, and number of frames with matches
        self._counts = [0] * len(SIGN_OF)
        self._evidence = [0.0] * len(WEIGHTS)
        self._since = [-1] * len(SIGNS)  # step of the warning, -1 = none
        self._lost: list[LostWarning] = []

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse a state whose evidence begins after its last frame."""
        if parts["begun"] > parts["frames"]:
            raise ValueError("evidence that begins later")

    def update(self, step: int, nis: float, ess: float, used: int, rejected: int) -> None:
        """Add a frame.

        Args:
            step: Number of the filter's step.
            nis: Mean squared innovation of the matches [-]; NaN without matches.
            ess: Effective sample size, as a share of the particles [-].
            used: Number of measurements, without those that the caller rejected.
            rejected: Number of these that were neither matched nor new.
        """
        if (self._frames - self._begun) % RENEWED == 0:
            self._restart()
        self._frames += 1
        if nis == nis:  # not NaN
            self._nis += nis
            self._matched += 1
        if nis > NIS_BOUNDS[0] or ess < LOW_ESS or 2 * rejected > used >= LEAST_MEASURED:
            answers = 4 * (ess < LOW_ESS) + 8 * (2 * rejected > used >= LEAST_MEASURED)
            self._test(answers + (nis > NIS_BOUNDS[0]) + 2 * (nis > NIS_BOUNDS[1]), step)
        else:
            self._quiet += 1

    def add_relocalisation(self, step: int, found: Relocalisation) -> None:
        """Add a robot that saw older landmarks elsewhere in a step of the filter; lasting suspicions count once."""
        if found.outcome == "found" or (found.outcome == "suspected" and all(one.found for one in self._lost[-1:])):
            self._lost.append(LostWarning(step, found.distance, found.num_landmarks, found.outcome == "found"))

    def _restart(self) -> None:
        """Start a new product, to detect a filter that fails from here on."""
        n = 2 + (self._frames - self._begun) // RENEWED
        begun = 1.0 / (n * math.log(n) ** 2)
        self._multiply(FACTORS[0], self._quiet)
        self._evidence = [old + begun * weight for old, weight in zip(self._evidence, WEIGHTS, strict=True)]
        self._quiet = 0

    def _test(self, answers: int, step: int) -> None:
        """Add a frame with a yes to the evidence and the counts, and compare the evidence with the threshold."""
        self._multiply(FACTORS[0], self._quiet)
        self._multiply(FACTORS[answers], 1)
        self._quiet = 0
        for row, sign in enumerate(SIGN_OF):
            if answers >> row & 1:
                self._counts[row] += 1
                if self._since[sign] < 0 and self._evidence_of(sign) >= THRESHOLD:
                    self._since[sign] = step

    def _multiply(self, factors: Sequence[float], times: int) -> None:
        """Multiply the evidence by the factors of `times` equal frames."""
        self._evidence = [
            min(old * factor**times, HIGHEST) for old, factor in zip(self._evidence, factors, strict=True)
        ]

    def _evidence_of(self, sign: int) -> float:
        """Return the evidence for a sign."""
        pairs = zip(self._evidence[::2], self._evidence[1::2], strict=True)
        return sum(one + two for of, (one, two) in zip(SIGN_OF, pairs, strict=True) if of == sign)

    def report(self) -> Consistency:
        """Return the consistency so far."""
        beyond, _, low, rejected = (count / max(self._frames, 1) for count in self._counts)
        shares = (beyond, low, rejected)
        warnings: tuple[ConsistencyWarning | LostWarning, ...] = tuple(
            ConsistencyWarning(sign, since, share)
            for sign, since, share in zip(SIGNS, self._since, shares, strict=True)
            if since >= 0
        )
        warnings += tuple(self._lost)
        nis_mean = self._nis / self._matched if self._matched else float("nan")
        return Consistency(self._frames, nis_mean, *shares, warnings)

    @classmethod
    def joined(cls, a: Self, b: Self) -> Self:
        """Return the test of the joint filter after a merge: shares and warnings of both, with fresh evidence."""
        joint = cls()
        joint._frames = joint._begun = a._frames + b._frames
        joint._nis, joint._matched = a._nis + b._nis, a._matched + b._matched
        joint._lost = sorted([*a._lost, *b._lost], key=lambda one: one.step)
        joint._counts = [one + other for one, other in zip(a._counts, b._counts, strict=True)]
        for sign, both in enumerate(zip(a._since, b._since, strict=True)):
            joint._since[sign] = min((since for since in both if since >= 0), default=-1)
        return joint
