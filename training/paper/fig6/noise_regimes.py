"""The conditions under which the paper's Fig. 6 is drawn: its own kind of noise, and what it leaves out."""

from dataclasses import dataclass
from typing import Any, Literal

from training.bench.accuracy.runs import RunSpec
from training.bench.accuracy.trials import REJUVENATE_EVERY

Proposal = Literal["fastslam1", "fastslam2", "fastslam2+rejuvenation", "batch_ml"]

BOUND: Proposal = "batch_ml"  # no filter: maximum likelihood over the whole run, told all names; it has no particles

FEW = (10, 100, 1000)  # particles, beside the paper's eleven numbers
# Algorithm 1, l. 10: drawn at random in proportion to the weights, at every step. fastslam2 keeps the defaults, and
# "+rejuvenation" draws all particles anew from smoothed paths every so many steps.
FILTER_OPTIONS: dict[Proposal, dict[str, Any]] = {
    "fastslam1": {"resample_threshold": 1.0, "resampling": "multinomial"},
    "fastslam2": {},
    "fastslam2+rejuvenation": {"rejuvenate_every": REJUVENATE_EVERY},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Regime:
    """Noise, looks of the landmarks, and the filters that are tried. Association is always unknown.

    Attributes:
        title: For tables and figures.
        preset: Of the noise, a key of `stereo_runs.PRESETS`.
        looks: Fields of `RunSpec` that say how landmarks are confused.
        proposals: Of the filters; with `BOUND`, what nothing can beat stands beside them.
        few: Whether the numbers of particles in `FEW` are enough.
    """

    title: str
    preset: str
    looks: dict[str, Any]
    proposals: tuple[Proposal, ...]
    few: bool

    def spec(self, robots: int, length: float, measurements: int = 15) -> RunSpec:
        """Return the run of K robots, each driving `length` [m]; all together measure at most B landmarks in a step."""
        return RunSpec(
            preset=self.preset, association="unknown", robots=robots, length=length, measurements=measurements,
            **self.looks,
        )  # fmt: skip


# Sec. 5 speaks neither of look-alikes nor of false points.
DISTINCT = {"look_alikes": 1, "outliers": 0.0, "wrong_descriptors": 0.0}
REGIMES = {
    "paper": Regime(
        title="as in the paper", preset="paper", looks=DISTINCT, proposals=("fastslam1",), few=False
    ),
    "look_alikes": Regime(
        title="with look-alikes and false points", preset="paper", looks={}, proposals=("fastslam1",),
        few=True,
    ),
    "good": Regime(
        title="good stereo", preset="good", looks=DISTINCT,
        proposals=("fastslam1", "fastslam2", "fastslam2+rejuvenation", BOUND), few=True,
    ),
}  # fmt: skip
