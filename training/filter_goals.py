"""What the filter's speed was meant to be, beside what was measured."""

from dataclasses import asdict, dataclass
from typing import Any

from training.bench_filter import BenchResult

STEP_MS = {("fastslam1", 1000): 0.4, ("fastslam2", 1000): 0.8, ("fastslam1", 100): 0.06, ("fastslam2", 100): 0.1}
FLAT_IN_N = {1000: 1.5, 100: 2.0}  # per number of particles
STATE_MS = 0.5
COMMON = {"landmarks": 300, "measurements": 15, "robots": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """One figure.

    Attributes:
        name: What was measured.
        value: The figure.
        unit: Of both numbers; empty for a ratio.
        limit: The most that the figure was meant to be; None where it is only stated.
    """

    name: str
    value: float
    unit: str
    limit: float | None

    @property
    def is_met(self) -> bool | None:
        """Whether the figure is within its limit; None without one."""
        return None if self.limit is None else self.value <= self.limit

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self) | {"is_met": self.is_met}


def goals_of(result: BenchResult) -> list[Goal]:
    """Return the figures for which a goal was set, as far as the result holds them."""
    goals: list[Goal] = []

    def add(name: str, value: float | None, limit: float | None, unit: str = "") -> None:
        if value is not None:
            goals.append(Goal(name=name, value=value, unit=unit, limit=limit))

    def median(**numbers: Any) -> float | None:
        row = result.find(**(COMMON | numbers))
        return None if row is None else row.timing.median_ms

    for (proposal, m), limit in STEP_MS.items():
        add(f"{proposal}, M={m}, N=300, B=15", median(proposal=proposal, particles=m), limit, "ms")
    for proposal in ("fastslam1", "fastslam2"):
        for m, limit in FLAT_IN_N.items():
            flat = _ratio(*(median(proposal=proposal, particles=m, landmarks=n) for n in (1000, 100)))
            add(f"{proposal}, M={m}: time at N=1000 over N=100", flat, limit)
        for few, many, n in ((100, 1000, 300), (1000, 10_000, 1000)):
            linear = _ratio(*(median(proposal=proposal, particles=m, landmarks=n) for m in (many, few)))
            add(f"{proposal}, N={n}: time at M={many} over M={few}", linear, many / few)
        for m in (100, 1000):
            for k in (2, 3):
                flat = _ratio(*(median(proposal=proposal, particles=m, robots=robots) for robots in (k, 1)))
                add(f"{proposal}, M={m}: time at K={k} over K=1, same B", flat, None)
    for name, timing in result.state.items():
        add(f"{name}, M=100, N=300", timing.median_ms, STATE_MS, "ms")
    return goals


def _ratio(numerator: float | None, denominator: float | None) -> float | None:
    return None if numerator is None or denominator is None else numerator / denominator
