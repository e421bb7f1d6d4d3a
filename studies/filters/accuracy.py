"""Accuracy of filters on simulated stereo runs, between dead reckoning and two lower bounds of the error.

python -m studies.filters.accuracy --quick
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any, Literal

import numpy as np

from slam_backend.core.blas import single_threaded_blas
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from studies.bounds.online import ideal_online
from training.commands.study import run_program
from training.experiments.config import ONE_PARTICLE, ExperimentConfig, Positive, first_seed, option
from training.experiments.study import Chart, Column, Panel, ResultTable, Study
from training.stereo_runs.batch_problem import BatchProblem
from training.stereo_runs.runs import Preset, RunSpec, StereoRun, simulate_run
from training.stereo_runs.scores import REJUVENATE_EVERY, Answer, batch_of, follow, least_squares_answer, score

# ---------------------------------------------------------------------- trials

Method = Literal["dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2", "fastslam2+existence",
                 "fastslam2+rejuvenation"]  # fmt: skip
Association = Literal["known", "unknown"]
FILTER = "fastslam"  # beginning of the names of filters


class Config(ExperimentConfig):
    """All combinations of the lists, for each seed."""

    seeds: int = option(16, "Number of seeds.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    presets: tuple[Preset, ...] = option(("good",), "Noise presets: good, coarse, paper.")
    robots: tuple[Positive, ...] = option((1,), "Numbers of robots, which share a map.")
    particles: tuple[Positive, ...] = option(
        (10, 30, 100, 300, 1000), "Numbers of particles per filter.", hint=ONE_PARTICLE
    )
    associations: tuple[Association, ...] = option(("known",), "Data association: known or unknown.")
    lengths: tuple[float, ...] = option((100.0,), "Lengths of each robot's path [m].")
    methods: tuple[Method, ...] = option(
        ("dead_reckoning", "batch_ml", "ideal_online", "fastslam1", "fastslam2"),
        "Methods: dead_reckoning, batch_ml, ideal_online, fastslam1, fastslam2, fastslam2+existence, "
        "fastslam2+rejuvenation.",
        shown="all but the last two",
    )
    noise_factor: float = option(
        1.0, "Factor of the assumed measurement variance over the true one.", gt=0.0, hint="Use 1 for the true noise."
    )
    landmark_noise: float | None = option(
        None, "Standard deviation of the landmarks' random walk [m].", shown="0; 0.005 with rejuvenation", ge=0.0
    )

    def check(self) -> None:
        """Refuse combinations without a valid trial."""
        trials(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One method on one run."""

    preset: Preset  # Noise preset
    association: Association  # Methods without a filter always know it
    robots: int  # K
    length: float  # Path length of each robot [m]
    method: Method  # Name of the method
    particles: int | None  # M of a filter, None for other methods
    seed: int  # Seed of the run and of the filter

    def __post_init__(self) -> None:
        _ = self.spec  # validates the other fields

    @property
    def spec(self) -> RunSpec:
        """Simulated run."""
        return RunSpec(robots=self.robots, length=self.length, preset=self.preset, association=self.association)


def trials(config: Config) -> list[Trial]:
    """Return all trials, with trials of the same run in succession."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [
        Trial(
            preset=preset, association=association, robots=robots, length=length, method=method, particles=particles,
            seed=seed,
        )
        for seed, preset, association, robots, length, method in product(
            seeds, config.presets, config.associations, config.robots, config.lengths, config.methods
        )
        for particles in (config.particles if method.startswith(FILTER) else (None,))
    ]  # fmt: skip


@single_threaded_blas
def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run a trial; return the metrics of `score`, the name of its `condition`, and `seconds`."""
    begin = time.perf_counter()
    run = run_of(trial.spec, trial.seed)
    return {
        "condition": f"{trial.preset}, {trial.association}, K = {trial.robots}, {trial.length:g} m",
        **score(run, estimated(run, config, trial)), "seconds": time.perf_counter() - begin,
    }  # fmt: skip


def estimated(run: StereoRun, config: Config, trial: Trial) -> Answer:
    """Return the answer of the method of a trial; least squares know the true data associations."""
    if trial.method.startswith(FILTER):
        return follow(run, build_filter(run, config, trial))
    if trial.method == "dead_reckoning":
        return Answer(BatchProblem.of_run(run).dead_reckoning().paths)
    problem, batch = batch_of(run)
    if trial.method == "batch_ml":
        return least_squares_answer(problem, batch.paths, batch.path_covariances, batch.landmarks)
    online = ideal_online(problem, batch)
    return least_squares_answer(problem, online.paths, online.covariances, online.landmarks)


def build_filter(run: StereoRun, config: Config, trial: Trial) -> FastSlam:
    """Return a new filter: "+existence" with the default existence model, "+rejuvenation" with regular smoothing."""
    proposal, _, extra = trial.method.partition("+")
    camera, factor = run.spec.noise.camera, float(np.sqrt(config.noise_factor))
    options: dict[str, Any] = {"landmark_noise": config.landmark_noise}
    options["camera"] = replace(
        camera, sigma_px=factor * camera.sigma_px, sigma_disparity_px=factor * camera.sigma_disparity_px
    )
    if extra == "existence":
        options["existence"] = ExistenceModel(frame_limit=run.spec.measurements // run.spec.robots)
    elif extra == "rejuvenation":
        options["rejuvenate_every"] = REJUVENATE_EVERY
    return run.build_filter(trial.particles or 0, proposal, trial.seed, **options)  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def run_of(spec: RunSpec, seed: int) -> StereoRun:
    """Simulate a run once for consecutive trials."""
    return simulate_run(spec, seed)


# ---------------------------------------------------------------------- results

POSE = Column("pose_rms_m", "pose [m]", interval=True)
MAP = Column("map_rmse_m", "map [m]", interval=True)
ANEES = Column("anees", "ANEES", digits=1, interval=True)


def table(name: str, title: str, *columns: Column) -> ResultTable:
    """Return a table with a line for each condition, method and number of particles, where its columns have values."""
    return ResultTable(
        name=name, title=title, by=("condition", "method", "particles"), columns=columns,
        words={
            "condition": ("noise, association, robots, path", str),
            "particles": ("M", lambda value: "" if value is None else str(value)),
        },
        where=lambda row: any(row[column.name] is not None for column in columns),
    )  # fmt: skip


def shares(*columns: tuple[str, str, int]) -> Sequence[Column]:
    """Return columns of means in per cent: name, heading, digits."""
    return [Column(name, heading, digits=digits, factor=100.0) for name, heading, digits in columns]


STUDY = Study(
    name="accuracy",
    about="""Measure filter accuracy on simulated stereo runs against lower bounds of the error.

    Compared with dead reckoning, batch maximum likelihood and the ideal online estimate. Options that accept several
    values take them comma-separated; all combinations are run. Ctrl-C finishes the current trial and summarises the
    finished ones; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    quick={"seeds": 2, "particles": (30,)},
    tables=(
        table(
            "paths", "Paths: RMS over robots and steps", POSE, Column("pose_rms_m", "median [m]", "median"),
            Column("pose_rms_m", "worst [m]", "worst"), Column("pose_aligned_rms_m", "aligned [m]"),
            Column("heading_rms_deg", "heading [°]", digits=2),
        ),
        table(
            "maps", "Maps", MAP, Column("map_aligned_rmse_m", "aligned [m]"),
            *shares(
                ("map_recall", "recall [%]", 1), ("map_precision", "precision [%]", 1),
                ("confirmed_precision", "if seen twice [%]", 1),
            ),
        ),
        table(
            "consistency", "Consistency", ANEES, Column("nees_mean", "NEES mean", digits=1),
            Column("nees_median", "median", digits=1), Column("nis", "NIS", digits=2),
            *shares(("ess_share", "ESS/M [%]", 1)),
        ),
        table(
            "matches", "Matches and time",
            *shares(
                ("wrong_match_share", "wrong matches [%]", 2), ("held_back_share", "neither matched nor new [%]", 2)
            ),
            Column("step_ms", "step [ms]", "median", digits=2),
            Column("rejuvenation_ms", "rejuvenation [ms]", "median", digits=1),
            *shares(("refused_share", "refused [%]", 1)),
        ),
    ),
    chart=Chart(
        x="particles", label="particles M", by="method", rows="condition", log=True,
        panels=(Panel(column=POSE, log=True), Panel(column=MAP, log=True), Panel(column=ANEES, log=True, guide=1.0)),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
