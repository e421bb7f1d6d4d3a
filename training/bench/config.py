"""Configurations of benchmarks: trials, and the range of every value."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from training.bench.exploration.config import with_absolute_paths
from training.experiments.config import (
    ONE_PARTICLE,
    Descriptor,
    ExperimentConfig,
    NonNegative,
    Positive,
    first_seed,
    option,
    option_arguments,
    setting,
)
from training.experiments.policy_names import check_labels
from training.replay.config import MRCLAM, log_path

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.bench.accuracy.trials import Trial as AccuracyTrial
    from training.episodes.config import RunConfig
    from training.rl.config import TrainConfig
    from vslam_env.config import EnvConfig

Method = Literal["dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2", "fastslam2+existence",
                 "fastslam2+rejuvenation"]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeTrial:
    """One episode whose losses of accuracy are measured."""

    world: str  # Family or path
    robots: int  # K
    policy: str  # Name, path or `module:name`, optionally with `@` and the action type
    preset: str  # Noise preset of the environment
    max_range: float | None  # Range of the camera [m]; None: that of the preset
    baseline: float | None  # Baseline of the camera [m]; None: that of the preset
    measurements: int | None  # Largest number of measurements of a frame; None: that of the preset
    particles: int  # M
    seed: int  # Seed of the episode


STEREO_RUNS_ONLY = ("associations", "lengths", "methods", "noise_factor", "landmark_noise")
EPISODES_ONLY = ("split", "policies", "duration", "rejuvenate_every", "max_ranges", "baselines", "measurements")
STEREO_PRESETS, ENV_PRESETS = ("good", "coarse", "paper"), ("easy", "standard", "hard")


class AccuracyConfig(ExperimentConfig):
    """Accuracy benchmark: all combinations of the lists, for each seed.

    Without `worlds`, filters run on simulated stereo runs through an office. With `worlds`, robots explore them, and
    the losses between the information in their readings and the errors of their filters are measured.
    """

    seeds: int = option(16, "Number of seeds.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    worlds: tuple[str, ...] | None = option(
        None, "World families or paths to explore; without it, stereo runs through a simulated office."
    )
    presets: tuple[str, ...] | None = option(
        None, "Noise presets: good, coarse, paper; with --worlds easy, standard, hard.",
        shown="good; standard with --worlds",
    )  # fmt: skip
    robots: tuple[Positive, ...] = option((1,), "Numbers of robots; of stereo runs, they share a map.")
    particles: tuple[Positive, ...] | None = option(
        None, "Numbers of particles per filter.", hint=ONE_PARTICLE, shown="10,30,100,300,1000; 100 with --worlds"
    )
    split: Literal["train", "validation", "test", "any"] = option(
        "validation", "Split of the worlds in --worlds: train, validation, test, or any.", name="world_split"
    )
    policies: tuple[str, ...] = option(
        ("frontier",), "Policies of the robots in --worlds: name, path of a model, MODULE:NAME, or LABEL= and one of "
        "these; @discrete selects the action type.",
    )  # fmt: skip
    duration: float = option(
        120.0, "Simulated time of an episode in --worlds [s].", name="max_seconds", also="--duration", ge=1.0,
        hint="Give seconds.",
    )  # fmt: skip
    rejuvenate_every: int | None = option(
        None, "Ticks between rejuvenations of the particles in --worlds; 0: never.", shown="50", ge=0
    )
    max_ranges: tuple[Annotated[float, Field(gt=0.0)], ...] | None = option(
        None, "Ranges of the camera in --worlds [m].", shown="8", hint="Give metres."
    )
    baselines: tuple[Annotated[float, Field(gt=0.0)], ...] | None = option(
        None, "Baselines of the camera in --worlds [m].", shown="0.12", hint="Give metres."
    )
    measurements: tuple[Positive, ...] | None = option(
        None, "Largest numbers of measurements of a frame in --worlds.", shown="5"
    )
    associations: tuple[Literal["known", "unknown"], ...] = option(
        ("known",), "Data association of stereo runs: known or unknown."
    )
    lengths: tuple[float, ...] = option((100.0,), "Lengths of each robot's path in stereo runs [m].")
    methods: tuple[Method, ...] = option(
        ("dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2"),
        "Methods on stereo runs: dead_reckoning, batch_ml, ideal_online, fastslam1, fastslam2, fastslam2+existence, "
        "fastslam2+rejuvenation.",
        shown="all but the last two",
    )
    noise_factor: float = option(
        1.0, "Factor of the assumed measurement variance over the true one in stereo runs.", gt=0.0,
        hint="Use 1 for the true noise.",
    )  # fmt: skip
    landmark_noise: float | None = option(
        None, "Standard deviation of the landmarks' random walk [m] in stereo runs.",
        shown="0; 0.005 with rejuvenation", ge=0.0,
    )  # fmt: skip

    def check(self) -> None:
        """Refuse combinations without a valid trial, and options that have no effect."""
        from slam_backend.core.validation import argument_error, check_choice

        idle: tuple[str, ...] = EPISODES_ONLY
        hint = "Give --worlds, too."
        if self.worlds is not None:
            idle, hint = STEREO_RUNS_ONLY, "Omit --worlds."
        for name in idle:
            field = type(self).model_fields[name]
            if getattr(self, name) != field.default:
                about = option_arguments(field) or {}
                raise argument_error(
                    str(about["option"] or name), f"no value {'without' if self.worlds is None else 'with'} --worlds",
                    getattr(self, name), hint,
                )  # fmt: skip
        known = STEREO_PRESETS if self.worlds is None else ENV_PRESETS
        for preset in self.presets or ():
            check_choice("presets", preset, tuple(known))
        if self.worlds is None:
            self.trials()
            return
        from training.bench.exploration.players import BOUND, parted
        from vslam_env.world.registry import check_source

        check_labels(self.policies)
        for policy in self.policies:
            if parted(policy).role == BOUND:
                hint = "Bounds know the truth, which readings alone do not tell."
                raise argument_error("policy", "a policy of robots or of the team", policy, hint)
        for world in self.worlds:
            check_source(world)
        for trial in self.episodes()[: len(self.episodes()) // self.seeds]:
            self.environment(trial)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials can be repeated from any folder."""
        return with_absolute_paths(values)

    def trials(self) -> list["AccuracyTrial"]:
        """Return all trials on stereo runs, with trials of the same run in succession."""
        from training.bench.accuracy.trials import FILTERS, Trial

        seeds = range(self.seed, self.seed + self.seeds)
        return [
            Trial(
                preset=preset, association=association, robots=robots, length=length, method=method,  # type: ignore[arg-type]
                particles=particles, seed=seed, noise_factor=self.noise_factor, landmark_noise=self.landmark_noise,
            )
            for seed, preset, association, robots, length, method in product(
                seeds, self.presets or ("good",), self.associations, self.robots, self.lengths, self.methods
            )
            for particles in (self.particles or (10, 30, 100, 300, 1000) if method in FILTERS else (0,))
        ]  # fmt: skip

    def episodes(self) -> list[EpisodeTrial]:
        """Return all episodes, ordered by seed, then by combination."""
        combined = product(
            range(self.seed, self.seed + self.seeds), self.worlds or (), self.robots, self.policies,
            self.presets or ("standard",), self.max_ranges or (None,), self.baselines or (None,),
            self.measurements or (None,), self.particles or (100,),
        )  # fmt: skip
        return [
            EpisodeTrial(
                world=world, robots=robots, policy=policy, preset=preset, max_range=max_range, baseline=baseline,
                measurements=measurements, particles=particles, seed=seed,
            )
            for seed, world, robots, policy, preset, max_range, baseline, measurements, particles in combined
        ]  # fmt: skip

    def run(self, trial: EpisodeTrial) -> "RunConfig":
        """Return the configuration of an episode's run."""
        from training.bench.exploration.players import parted
        from training.episodes.config import RunConfig

        player = parted(trial.policy)
        return RunConfig(
            world=trial.world, robots=trial.robots, policy=player.policy,
            action_type=player.action_type,  # type: ignore[arg-type]
            particles=trial.particles, rejuvenate_every=self.rejuvenate_every,
            preset=trial.preset,  # type: ignore[arg-type]
            seed=trial.seed, max_seconds=self.duration,
        )  # fmt: skip

    def environment(self, trial: EpisodeTrial) -> "EnvConfig":
        """Return the environment of an episode; true and assumed camera have the same geometry."""
        from training.bench.exploration.players import world_split

        given = {"max_range": trial.max_range, "baseline": trial.baseline}
        camera = {name: value for name, value in given.items() if value is not None}
        sensor: dict[str, Any] = {"camera": camera}
        if trial.measurements is not None:
            sensor["max_measurements"] = trial.measurements
        return self.run(trial).environment().replace(
            world_split=world_split(self.split, trial.world), landmark_sensor=sensor,
            belief={"filter": {"camera": camera}},
        )  # fmt: skip


class MrclamPairsConfig(ExperimentConfig):
    """Pairwise alignment of the maps of an MR.CLAM log."""

    path: str = log_path(MRCLAM)
    durations: tuple[Annotated[float, Field(ge=0.0)], ...] = option(
        (100.0, 200.0, 400.0, 0.0), "Times at which maps are aligned [s]; 0: at the end.",
        hint="Give seconds; 0 means all.",
    )  # fmt: skip
    particles: int = option(100, "Number of particles per filter.", ge=1, hint="Use at least one particle.")


class StereoBenchConfig(ExperimentConfig):
    """Stereo benchmark. The height of images is three quarters of their width, with a constant field of view."""

    sizes: tuple[Annotated[int, Field(ge=64)], ...] = setting((320, 640), "Widths of the images [px].")
    landmarks: tuple[Positive, ...] = setting((50, 100, 200), "Numbers of landmarks per frame.")
    walls: tuple[Annotated[int, Field(ge=4)], ...] = setting((10, 40, 120), "Numbers of walls.")
    steps: int = option(100, "Number of timed pairs per row.", ge=1, hint="Use at least one pair.")
    views: int = option(
        60, "Number of rendered pairs per descriptor for the quality.", ge=1, hint="Use at least one pair."
    )
    descriptors: tuple[Descriptor, ...] = option(("usurf", "sift", "orb"), "Descriptors to compare.")


class TrainBenchConfig(ExperimentConfig):
    """Training benchmark; its environments are those of the preset `quick` of `vslam train`."""

    world: str = option("office", "World family or path.")
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    envs: int = option(16, "Number of parallel environments.", ge=1, hint="Use at least one environment.")
    workers: tuple[NonNegative, ...] = option(
        (0, 1, 2), "Numbers of worker processes, 0: this process.", hint="Use 0 for this process."
    )
    steps: int = option(40, "Number of timed steps per number of workers.", ge=2, hint="Use at least two steps.")
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")

    def check(self) -> None:
        """Refuse more workers than environments, and worlds that do not exist."""
        from slam_backend.core.validation import argument_error

        if (most := max(self.workers)) > self.envs:
            raise argument_error("workers", f"at most one per environment, {self.envs}", most, "Use fewer workers.")
        self.environment()

    def training(self) -> "TrainConfig":
        """Return the timed training."""
        from training.rl.config import TrainConfig

        return TrainConfig(world=self.world, robots=self.robots, envs=self.envs)

    def environment(self) -> "EnvConfig":
        """Return the configuration of the environments."""
        from training.rl.config import SPLIT_TRAIN

        return self.training().make_env_config(SPLIT_TRAIN)
