"""Configurations of the speed benchmarks, and the range of every value."""

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from training.experiments.config import (
    ONE_PARTICLE,
    ExperimentConfig,
    Positive,
    Proposal,
    RobotCount,
    option,
    setting,
)

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.bench.speed.workload import FilterLoad

Part = Literal["demo", "kernels", "steps", "wheel", "import", "count"]
Mode = Literal["driver", "poses", "odometry", "identities", "association", "merging", "all", "flat", "goal"]


class EnvSpeedConfig(ExperimentConfig):
    """Environment benchmark. Each row changes one number of the base, which has the first entry of each list."""

    robots: tuple[RobotCount, ...] = option(
        (3, 1, 2, 4, 6, 8), "Numbers of robots K, starting with the base.", hint="Use 1 to 8 robots."
    )
    particles: tuple[Positive, ...] = option((100, 30, 300, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    worlds: tuple[str, ...] = option(("office", "fig5", "maze", "hall", "loops"), "World families or paths.")
    modes: tuple[Mode, ...] = option(
        get_args(Mode), "Parts in the loop, from known poses to goal actions.", shown="all"
    )
    steps: int = option(1000, "Number of steps of an episode.", ge=2, hint="Use at least two steps.")
    plays: int = setting(5, "Number of repeats of each episode, to reduce the influence of other load.", ge=1)
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")
    peer: bool = option(True, "Time simple_spread of MPE2 interleaved with the first row.")


class FilterSpeedConfig(ExperimentConfig):
    """Filter benchmark; rows are all combinations of the given numbers."""

    particles: tuple[Positive, ...] = option((100, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    landmarks: tuple[int, ...] = option((100, 300, 1000), "Numbers of landmarks N in the map of each particle.")
    measurements: tuple[int, ...] = option((5, 15), "Numbers of measurements B per step, of all robots together.")
    robots: tuple[Positive, ...] = option((1, 2, 3), "Numbers of robots K.", hint="Use 1 to 8 robots.")
    proposals: tuple[Proposal, ...] = ("fastslam1", "fastslam2")
    lookalikes: int = option(
        1, "Number of landmarks that share one descriptor.", name="look_alikes", ge=1,
        hint="Use 1 for distinct descriptors.",
    )  # fmt: skip
    steps: int = option(300, "Number of timed steps per row.", ge=1, hint="Use at least one step.")
    large: bool = option(False, "Include 10,000 particles with 300 and 1,000 landmarks.")
    compile: bool = option(False, "Include the compilation time of all kernels with an empty cache.")

    def check(self) -> None:
        """Refuse combinations that cannot be timed."""
        self.loads()

    def loads(self) -> list["FilterLoad"]:
        """Return the timed loads, row by row."""
        from training.bench.speed.workload import LARGE_LOADS, FilterLoad

        numbers = product(self.proposals, self.particles, self.landmarks, self.measurements, self.robots)
        rows = [
            FilterLoad(
                proposal=p, particles=m, landmarks=n, measurements=b, robots=k, lookalikes=self.lookalikes,
                seed=self.seed,
            )
            for p, m, n, b, k in numbers
        ]  # fmt: skip
        if not self.large:
            return rows
        return rows + [
            FilterLoad(**load, proposal=p, lookalikes=self.lookalikes, seed=self.seed)
            for p, load in product(self.proposals, LARGE_LOADS)
        ]


class BatchedSpeedConfig(ExperimentConfig):
    """Benchmark of batched teams beside processes of the environment; all drive at random."""

    batches: tuple[Positive, ...] = option((1024,), "Numbers of environments of a batch.")
    beside: int = option(
        16, "Number of processes of the environment to compare with; 0: none.", ge=0, hint="Use 0 for none."
    )
    world: str = option("office", "World family or path.")
    robots: int = option(3, "Number of robots K, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    rows: int = option(
        384, "Number of landmarks for which the belief of a team has room.", ge=16, hint="Use 16 rows or more."
    )
    decision_ticks: Positive = option(10, "Ticks of 0.1 s per step.")
    steps: Positive = option(60, "Number of steps of an episode.")
    plays: Positive = option(2, "Number of episodes of each environment of a batch.")
    num_worlds: Positive = option(64, "Largest number of worlds of a batch.")
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")


class StartSpeedConfig(ExperimentConfig):
    """The start-up bench: what a user waits for at first."""

    parts: tuple[Part, ...] = option(
        ("demo", "kernels", "steps", "import", "count"), "Parts to time: demo, kernels, steps, wheel, import, count."
    )
    repeats: int = option(3, "Runs of each part.", ge=1, hint="Time at least one run.")
    wheel: str | None = option(None, "Wheel of kernels, which adds the part wheel.", shown="none", is_path=True)
    seed: int = setting(0, "Seed; the bench draws nothing.", ge=0)

    def check(self) -> None:
        """Refuse a wheel that is not there."""
        from slam_backend.core.validation import argument_error

        if ("wheel" in self.parts or self.wheel is not None) and not (self.wheel and Path(self.wheel).is_file()):
            expected = "the wheel that `make kernels-wheel` writes"
            raise argument_error("wheel", expected, self.wheel, "Or leave the part wheel out.")
