"""The configurations of all benches: what each tries, and the range of every value."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from training.experiments.config import (
    ONE_PARTICLE,
    Descriptor,
    ExperimentConfig,
    NoisePreset,
    NonNegative,
    Positive,
    Proposal,
    RobotCount,
    Sensor,
    first_seed,
    option,
    setting,
)
from training.replay.config import MRCLAM, log_path

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from training.bench.accuracy.trials import Trial as AccuracyTrial
    from training.bench.alignment.trials import Trial as AlignmentTrial
    from training.bench.env.bench import EnvLoad
    from training.bench.filter.workload import FilterLoad
    from training.episodes.config import RunConfig
    from training.rl.config import TrainConfig
    from vslam_env.config import EnvConfig

Method = Literal["dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2", "fastslam2+existence",
                 "fastslam2+rejuvenation"]  # fmt: skip
AlignmentMethod = Literal["ransac", "svd", "icp", "impicp", "gnc", "clique"]
# (overlap, outliers): with 200 landmarks of each map, 20 true pairs leave room for 180 wrong ones, 200 for none.
GRID = (
    (1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.25, 0.0), (0.25, 0.5), (0.25, 0.75), (0.1, 0.0), (0.1, 0.5), (0.1, 0.8),
    (0.1, 0.9),
)  # fmt: skip
ORACLES = ("pose", "association", "merge")
NO_ORACLE, ALL_ORACLES = "none", "all"
ANY_SPLIT = "any"


class AccuracyConfig(ExperimentConfig):
    """The accuracy bench: each combination of the lists is tried on each seed."""

    seeds: int = option(16, "Number of seeds.", ge=1, hint="Run at least one seed.")
    seed: int = first_seed()
    presets: tuple[Literal["good", "coarse", "paper"], ...] = option(
        ("good",), "Noise: good, coarse or paper.", name="preset"
    )
    associations: tuple[Literal["known", "unknown"], ...] = option(
        ("known",), "Data association: known or unknown.", name="association"
    )
    robots: tuple[Positive, ...] = option((1,), "Numbers of robots that share a map.")
    lengths: tuple[float, ...] = option((100.0,), "Length of each robot's path [m].", name="length")
    methods: tuple[Method, ...] = option(
        ("dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2"),
        "dead_reckoning, batch_ml, ideal_online, fastslam1, fastslam2, fastslam2+existence, fastslam2+rejuvenation.",
        shown="all but the last two",
    )
    particles: tuple[Positive, ...] = option((10, 30, 100, 300, 1000), "Particles per filter.", hint=ONE_PARTICLE)
    noise_factor: float = option(
        1.0, "Factor by which filters scale the true variance of the measurements.", gt=0.0,
        hint="Use 1 for the noise as it is.",
    )  # fmt: skip
    landmark_noise: float | None = option(
        None, "Standard deviation of the landmarks' random walk [m].", shown="0, if rejuvenated 0.005", ge=0.0
    )

    def check(self) -> None:
        """Refuse combinations that no trial can be."""
        self.trials()

    def trials(self) -> list["AccuracyTrial"]:
        """Return all trials, those on the same run in a row."""
        from training.bench.accuracy.trials import FILTERS, Trial

        seeds = range(self.seed, self.seed + self.seeds)
        return [
            Trial(
                preset=preset, association=association, robots=robots, length=length, method=method,
                particles=particles, seed=seed, noise_factor=self.noise_factor, landmark_noise=self.landmark_noise,
            )
            for seed, preset, association, robots, length, method in product(
                seeds, self.presets, self.associations, self.robots, self.lengths, self.methods
            )
            for particles in (self.particles if method in FILTERS else (0,))
        ]  # fmt: skip


class AlignmentBenchConfig(ExperimentConfig):
    """The alignment bench: a grid of cells, and the hard sets U and I, whose trials are spread over their cases."""

    methods: tuple[AlignmentMethod, ...] = option(
        ("ransac", "svd", "icp", "impicp", "gnc", "clique"), "ransac, svd, icp, impicp, gnc, clique.", shown="all"
    )
    seeds: int = option(500, "Trials of each cell of the grid and method.", ge=1, hint="Try each cell at least once.")
    hard: int = option(1000, "Trials of each hard set and method.", ge=0, hint="Use 0 to leave the hard sets out.")
    seed: int = first_seed()

    def trials(self) -> list["AlignmentTrial"]:
        """Return all trials, those on the same maps in a row."""
        from training.bench.alignment.trials import Trial, cases

        grid = [
            Trial(kind="grid", case="", overlap=overlap, outliers=outliers, method=method, seed=self.seed + i)
            for (overlap, outliers), i, method in product(GRID, range(self.seeds), self.methods)
        ]
        kinds: tuple[Literal["U", "I"], ...] = ("U", "I")
        return grid + [
            Trial(
                kind=kind, case=cases(kind)[i % len(cases(kind))], overlap=0.0, outliers=0.0, method=method,
                seed=self.seed + i,
            )
            for kind, i, method in product(kinds, range(self.hard), self.methods)
        ]  # fmt: skip


class MrclamPairsConfig(ExperimentConfig):
    """Pairwise alignment of the maps of an MR.CLAM log."""

    path: str = log_path(MRCLAM)
    durations: tuple[Annotated[float, Field(ge=0.0)], ...] = option(
        (100.0, 200.0, 400.0, 0.0), "Seconds after which maps are aligned; 0: at the end.",
        hint="Give seconds; 0 means all.",
    )  # fmt: skip
    particles: int = option(100, "Particles of each robot's filter.", ge=1, hint="Use at least one particle.")


class EnvBenchConfig(ExperimentConfig):
    """The environment bench. One number at a time differs from the base, the first of each list."""

    robots: tuple[RobotCount, ...] = option(
        (3, 1, 2, 4, 6, 8), "Numbers of robots K, the base first.", hint="Use 1 to 8 robots."
    )
    particles: tuple[Positive, ...] = option((100, 30, 300, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    worlds: tuple[str, ...] = option(("office", "fig5", "maze", "hall", "loops"), "Families or paths of worlds.")
    modes: tuple[Literal["dict", "flat", "goal"], ...] = option(
        ("dict", "flat", "goal"), "Observations and actions: dict, flat, goal, which decides at every tick.",
        shown="all",
    )  # fmt: skip
    steps: int = option(600, "Timed steps per row.", ge=2, hint="Time a few steps.")
    plays: int = setting(5, "Repeats of a row's episode, for the times that other programs do not disturb.", ge=1)
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")
    peer: bool = option(True, "Time simple_spread of MPE2 in turn with the first row.")

    def loads(self) -> list["EnvLoad"]:
        """Return what is timed, row by row, the base first."""
        from training.bench.env.bench import EnvLoad

        base = EnvLoad(self.robots[0], self.particles[0], self.worlds[0], self.modes[0])
        rows = [base]
        rows += [base._replace(robots=robots) for robots in self.robots[1:]]
        rows += [base._replace(particles=particles) for particles in self.particles[1:]]
        rows += [base._replace(world=world) for world in self.worlds[1:]]
        return rows + [base._replace(mode=mode) for mode in self.modes[1:]]


@dataclass(frozen=True, slots=True)
class ExplorationTrial:
    """One policy in one episode: name, path or `module:name`, perhaps with `@` and the type of action."""

    policy: str
    world: str
    robots: int
    oracle: str
    seed: int


class ExplorationBenchConfig(ExperimentConfig):
    """The exploration bench. Worlds, numbers of robots and oracles are combined; policies meet in each."""

    policies: tuple[str, ...] = option(
        ("frontier", "random_goals", "random_walk"),
        "Names, models' paths, MODULE:NAME of your own; NAME@discrete chooses the type of action. The others are "
        "compared with the first.",
    )
    worlds: tuple[str, ...] = option(("office", "maze", "loops", "hall"), "Families or paths of worlds.")
    split: Literal["train", "validation", "test", "any"] = option(
        "validation", "train, validation or test worlds, or any."
    )
    robots: tuple[RobotCount, ...] = option((3,), "Numbers of robots that explore together.", hint="Use 1 to 8 robots.")
    oracles: tuple[Literal["none", "pose", "association", "merge", "all"], ...] = option(
        (NO_ORACLE, ALL_ORACLES), "What robots know from the truth: none, pose, association, merge, all."
    )
    duration: float = option(120.0, "Seconds of an episode.", ge=1.0, hint="Give seconds.")
    particles: int = option(100, "Particles per filter.", ge=1, hint=ONE_PARTICLE)
    rejuvenate_every: int | None = option(
        None, "Ticks between rejuvenations of the particles; 0: never.", shown="100", ge=0
    )
    preset: NoisePreset = option("standard", "easy, standard or hard noise.")
    sensor: Sensor = option("landmark", "landmark, or stereo: rendered images.")
    seeds: int = option(10, "Episodes of each policy.", ge=1, hint="Play one episode or more.")
    seed: int = first_seed()

    def check(self) -> None:
        """Refuse policies and worlds that are not there."""
        from training.bench.exploration.trials import parted

        for policy in self.policies:
            parted(policy)
        for robots, world in product(self.robots, self.worlds):
            self.environment(ExplorationTrial(self.policies[0], world, robots, self.oracles[0], self.seed))

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials repeat from anywhere."""
        from agents.registry import is_model
        from vslam_env.world import WORLD_FAMILIES

        found = dict(values)
        if isinstance(found.get("worlds"), list | tuple):
            found["worlds"] = [w if w in WORLD_FAMILIES else str(Path(str(w)).resolve()) for w in found["worlds"]]
        if isinstance(found.get("policies"), list | tuple):
            found["policies"] = [str(Path(p).resolve()) if is_model(p) else p for p in found["policies"]]
        return found

    def trials(self) -> list[ExplorationTrial]:
        """Return all trials: seed by seed, and in a seed combination by combination."""
        seeds = range(self.seed, self.seed + self.seeds)
        combined = product(seeds, self.worlds, self.robots, self.oracles, self.policies)
        return [ExplorationTrial(policy, world, k, oracle, seed) for seed, world, k, oracle, policy in combined]

    def run(self, trial: ExplorationTrial) -> "RunConfig":
        """Return the trial as a run."""
        from training.bench.exploration.trials import parted
        from training.episodes.config import RunConfig

        policy, action_type = parted(trial.policy)
        shared: dict[str, Any] = {
            "world": trial.world, "robots": trial.robots, "policy": policy, "action_type": action_type,
            "particles": self.particles, "rejuvenate_every": self.rejuvenate_every, "preset": self.preset,
            "sensor": self.sensor, "seed": trial.seed,
        }  # fmt: skip
        return RunConfig(**shared, max_cycles=max(1, round(self.duration / RunConfig(**shared).step_s)))

    def environment(self, trial: ExplorationTrial) -> "EnvConfig":
        """Return the environment of a trial: of all policies with one seed in one combination the same world."""
        from vslam_env.world import is_single_layout

        split = None if self.split == ANY_SPLIT or is_single_layout(trial.world) else self.split
        oracles = {f"oracle_{name}": trial.oracle in (name, ALL_ORACLES) for name in ORACLES}
        return self.run(trial).environment().replace(world_split=split, **oracles)


class FilterBenchConfig(ExperimentConfig):
    """The filter bench; rows are all combinations of the numbers given."""

    particles: tuple[Positive, ...] = option((100, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    landmarks: tuple[int, ...] = option((100, 300, 1000), "Numbers of landmarks N, in the maps of all particles.")
    measurements: tuple[int, ...] = option((5, 15), "Numbers of measurements B, of all robots together.")
    robots: tuple[Positive, ...] = option((1, 2, 3), "Numbers of robots K.", hint="Use 1 to 8 robots.")
    proposals: tuple[Proposal, ...] = ("fastslam1", "fastslam2")
    lookalikes: int = option(
        1, "Number of landmarks that share one descriptor.", ge=1, hint="Use 1 for landmarks that all look different."
    )
    steps: int = option(300, "Timed steps per row.", ge=1, hint="Time at least one step.")
    large: bool = option(False, "Also 10,000 particles with 300 and 1,000 landmarks.")
    compile: bool = option(False, "Also time the compilation of all kernels into an empty cache.")

    def check(self) -> None:
        """Refuse combinations that cannot be timed."""
        self.loads()

    def loads(self) -> list["FilterLoad"]:
        """Return what is timed, row by row."""
        from training.bench.filter.workload import LARGE_LOADS, FilterLoad

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


class StereoBenchConfig(ExperimentConfig):
    """The stereo bench. Images are three quarters as high as wide, with the same field of view."""

    sizes: tuple[Annotated[int, Field(ge=64)], ...] = setting((320, 640), "Widths of the images [px].")
    landmarks: tuple[Positive, ...] = setting((50, 100, 200), "Numbers of landmarks in a frame.")
    walls: tuple[Annotated[int, Field(ge=4)], ...] = setting((10, 40, 120), "Numbers of walls.")
    steps: int = option(100, "Timed pairs per row.", ge=1, hint="Time at least one pair.")
    views: int = option(60, "Rendered pairs per descriptor for quality.", ge=1, hint="Look at least once.")
    descriptors: tuple[Descriptor, ...] = option(("usurf", "sift", "orb"), "Descriptors to compare.")


class TrainBenchConfig(ExperimentConfig):
    """The training bench; the environments are those of `vslam train`'s preset `quick`."""

    world: str = option("office", "A family or a path.")
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    envs: int = option(16, "Environments side by side.", ge=1, hint="Use at least one environment.")
    workers: tuple[NonNegative, ...] = option((0, 1, 2), "Numbers of processes, 0: this one.", hint="Use 0 for none.")
    steps: int = option(40, "Steps timed per number of workers.", ge=2, hint="Time a few steps.")
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")

    def check(self) -> None:
        """Refuse more workers than environments, and worlds that are not there."""
        from slam_backend.core.validation import argument_error

        if (most := max(self.workers)) > self.envs:
            raise argument_error("workers", f"at most one per environment, {self.envs}", most, "Use fewer.")
        self.environment()

    def training(self) -> "TrainConfig":
        """Return the training that is timed."""
        from training.rl.config import TrainConfig

        return TrainConfig(world=self.world, robots=self.robots, envs=self.envs)

    def environment(self) -> "EnvConfig":
        """Return the environments' configuration."""
        from training.rl.config import SPLIT_TRAIN

        return self.training().make_env_config(SPLIT_TRAIN)
