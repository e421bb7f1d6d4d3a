"""`ConsistencyTest`: whether a filter errs as little as it claims, with a stated rate of false alarms.

Three signs are watched, each by one or two questions that a frame answers with yes or no:

- "nis": does the mean squared innovation of the frame lie beyond the 95 % bound of chi-square? The 99 % bound? However
  much the measurements of a frame err together, their mean does so in no more than some 5 and 1 % of the frames of an
  honest filter.
- "ess": do less than a tenth of the particles carry the weight?
- "rejected": of three measurements or more, do more than half match nothing and begin nothing?

Where the probability of a yes is at most p0 (5 %, and 1 % beyond the 99 % bound) whatever came before, the likelihood
ratio L of p1 > p0 against p0, multiplied over the frames, is a supermartingale: by Ville's inequality it ever exceeds
1/a with a probability of at most a [1]. So there is no window, and the rate of false alarms holds for runs of any
length. The filter may fail late: at every 25th frame a new product begins, and all of them add up under weights w whose
sum is at most one,

    S_t = (S_{t-1} + w_t) L_t,     P(S_t >= 1/a for any t) <= a.

That is the recursion of Shiryaev and Roberts [2] with a prior for the frame at which the filter fails. Filters fail a
little all the time, or much for a while: for each sign the mean S over its questions and two p1 is taken. Filters that
claim too little, as those which assume twice the true noise, show no sign: that does no harm.

1. A. Ramdas, P. Gruenwald, V. Vovk, G. Shafer: Game-theoretic statistics and safe anytime-valid inference. Statistical
   Science 38(4), 2023.
2. M. Pollak: Optimal detection of a change in distribution. Annals of Statistics 13(1), 1985.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

FALSE_ALARM_RATE = 0.01  # at most this share of honest filters is ever warned of, all signs together
NIS_BOUNDS = (7.81, 11.34)  # 95 and 99 % of chi-square with three degrees of freedom; with two it is more
LOW_ESS = 0.1  # of the particles
LEAST_MEASURED = 3  # measurements of a frame of which most may be rejected
SIGNS = ("nis", "ess", "rejected")
SIGN_OF = (0, 0, 1, 2)  # of each question
USUAL = (0.05, 0.01, 0.05, 0.05)  # p0 of each
BETS = (0.1, 0.3)  # p1
# By which evidence changes, for each set of answers, whose bits are the questions.
FACTORS = tuple(
    tuple(
        p / usual if answers >> row & 1 else (1.0 - p) / (1.0 - usual) for row, usual in enumerate(USUAL) for p in BETS
    )
    for answers in range(1 << len(USUAL))
)
RENEWED = 25  # frames
SHARE = 0.47  # the sum of 1 / (n ln^2 n) over n = 2, 3, ... is 2.11
WEIGHTS = tuple(SHARE / len(BETS) / SIGN_OF.count(sign) for sign in SIGN_OF for _ in BETS)
THRESHOLD = len(SIGNS) / FALSE_ALARM_RATE
HIGHEST = 1e6 * THRESHOLD  # of the evidence: what is certain need not grow
SUMS, LISTS = ("frames", "begun", "quiet", "nis", "matched"), ("counts", "evidence", "since")
CURES = {
    "nis": "measurements lie farther from where the filter expects them than it allows for: it is too sure of itself. "
    "Assume more odometry noise, or more measurement noise, or set rejuvenate_every, or use more particles",
    "ess": "less than a tenth of the particles carry all the weight. Use more particles, or set rejuvenate_every, or "
    "assume more measurement noise",
    "rejected": "most measurements match nothing. Assume more odometry noise, or check time stamps and units",
}


@dataclass(frozen=True, slots=True)
class ConsistencyWarning:
    """A sign that a filter is not consistent.

    Attributes:
        sign: "nis", "ess" or "rejected".
        step: In which the evidence sufficed.
        share: Share of all frames that show the sign [-].
    """

    sign: str
    step: int
    share: float

    @property
    def text(self) -> str:
        """What is wrong, and what to try."""
        return f"By step {self.step} it is clear that {CURES[self.sign]} ({self.share:.1%} of all frames show it)."


@dataclass(frozen=True, slots=True)
class Consistency:
    """What is known so far of whether a filter errs as little as it claims.

    Attributes:
        frames: In which something was measured.
        nis_mean: Mean over the frames of their mean squared innovation [-]; 3 is honest, or 2 where all is in one
            plane, less is cautious. NaN if nothing was matched.
        nis_share: Share of the frames beyond the 95 % bound [-].
        ess_share: Share of the frames with an effective sample size below a tenth of the particles [-].
        rejected_share: Share of the frames of which most measurements were rejected [-].
        warnings: One for each sign with enough evidence, in the order of `SIGNS`.
    """

    frames: int
    nis_mean: float
    nis_share: float
    ess_share: float
    rejected_share: float
    warnings: tuple[ConsistencyWarning, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain numbers and texts."""
        return {
            "frames": self.frames,
            "nis_mean": self.nis_mean,
            "nis_share": self.nis_share,
            "ess_share": self.ess_share,
            "rejected_share": self.rejected_share,
            "warnings": [{"sign": one.sign, "step": one.step, "text": one.text} for one in self.warnings],
        }


class ConsistencyTest:
    """The running sums of one filter."""

    __slots__ = ("_begun", "_counts", "_evidence", "_frames", "_matched", "_nis", "_quiet", "_since")

    def __init__(self) -> None:
        self._frames = 0
        self._begun = 0  # frames before the evidence began
        self._quiet = 0  # frames without a yes that the evidence does not hold yet
        self._nis, self._matched = 0.0, 0  # sum of the frames' means, and number of frames with matches
        self._counts = [0] * len(SIGN_OF)
        self._evidence = [0.0] * len(WEIGHTS)
        self._since = [-1] * len(SIGNS)  # step of the warning

    def update(self, step: int, nis: float, ess: float, used: int, rejected: int) -> None:
        """Take note of a frame.

        Args:
            step: Number of the filter's step.
            nis: Mean squared innovation of what was matched [-]; NaN if nothing was.
            ess: Effective sample size, as a share of the particles [-].
            used: Measurements, without those that the caller rejected.
            rejected: How many of these neither matched nor began a landmark.
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

    def _restart(self) -> None:
        """Let a filter that fails from here on be found, too."""
        n = 2 + (self._frames - self._begun) // RENEWED
        begun = 1.0 / (n * math.log(n) ** 2)
        self._multiply(FACTORS[0], self._quiet)
        self._evidence = [old + begun * weight for old, weight in zip(self._evidence, WEIGHTS, strict=True)]
        self._quiet = 0

    def _test(self, answers: int, step: int) -> None:
        """Weigh a frame that answers yes to a question, count it, and see whether the evidence is enough."""
        self._multiply(FACTORS[0], self._quiet)
        self._multiply(FACTORS[answers], 1)
        self._quiet = 0
        for row, sign in enumerate(SIGN_OF):
            if answers >> row & 1:
                self._counts[row] += 1
                if self._since[sign] < 0 and self._evidence_of(sign) >= THRESHOLD:
                    self._since[sign] = step

    def _multiply(self, factors: Sequence[float], times: int) -> None:
        """Change the evidence by so many frames of one kind."""
        self._evidence = [
            min(old * factor**times, HIGHEST) for old, factor in zip(self._evidence, factors, strict=True)
        ]

    def _evidence_of(self, sign: int) -> float:
        """Return the evidence of a sign."""
        pairs = zip(self._evidence[::2], self._evidence[1::2], strict=True)
        return sum(one + two for of, (one, two) in zip(SIGN_OF, pairs, strict=True) if of == sign)

    def report(self) -> Consistency:
        """Return what is known so far."""
        beyond, _, low, rejected = (count / max(self._frames, 1) for count in self._counts)
        shares = (beyond, low, rejected)
        told = tuple(
            ConsistencyWarning(sign, since, share)
            for sign, since, share in zip(SIGNS, self._since, shares, strict=True)
            if since >= 0
        )
        nis_mean = self._nis / self._matched if self._matched else float("nan")
        return Consistency(self._frames, nis_mean, *shares, told)

    @classmethod
    def joined(cls, a: Self, b: Self) -> Self:
        """Return the test of the joint filter after a merge: shares and warnings of both, and evidence that begins."""
        joint = cls()
        joint._frames = joint._begun = a._frames + b._frames
        joint._nis, joint._matched = a._nis + b._nis, a._matched + b._matched
        joint._counts = [one + other for one, other in zip(a._counts, b._counts, strict=True)]
        for sign, both in enumerate(zip(a._since, b._since, strict=True)):
            joint._since[sign] = min((since for since in both if since >= 0), default=-1)
        return joint

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the test goes on."""
        sums = {name: getattr(self, f"_{name}") for name in SUMS}
        return sums | {name: tuple(getattr(self, f"_{name}")) for name in LISTS}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the one that gave `state`."""
        for name in SUMS:
            setattr(self, f"_{name}", state[name])
        for name in LISTS:
            setattr(self, f"_{name}", list(state[name]))
