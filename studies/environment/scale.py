"""Cost and results over the size of the world and the number of robots: timed episodes.

python -m studies.environment.scale --quick
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from training.bench.exploration.config import ANY_SPLIT
from training.bench.exploration.players import parted
from training.bench.exploration.trials import CURVE_POINTS, TEAM, count_merges, first_steps, pose_errors, values_at
from training.commands.study import run_program
from training.episodes.config import RunConfig
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, Progress, run_episode
from training.experiments.config import ONE_PARTICLE, ExperimentConfig, NoisePreset, RobotCount, first_seed, option
from training.experiments.study import Chart, Column, Curves, Panel, ResultTable, Study
from vslam_env import save_state, warm_up
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv

DECISION_LIMIT = 10.0  # [s] longest time of a decision
LATE_SHARE = 0.25  # last part of an episode, in which maps are largest
SNAPSHOTS = 5  # repeated snapshots at the end, the median counts
SHARED = 15  # true landmarks that two maps share, so that they should be merged

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """All combinations of extents and numbers of robots, with one policy."""

    family: Literal["rooms", "office", "campus"] = option("rooms", "World family: rooms, office, or campus.")
    extents: tuple[Annotated[float, Field(gt=0.0)], ...] = option(
        (30.0, 60.0, 120.0, 200.0), "Widths of the worlds [m].", hint="Give metres."
    )
    robots: tuple[RobotCount, ...] = option((1, 3, 8), "Numbers of robots in a team.", hint="Use 1 to 8 robots.")
    policy: str = option("frontier", "Policy by name, path of a model, or MODULE:NAME; @team selects the central one.")
    duration: float = option(
        600.0, "Simulated time of an episode [s].", name="max_seconds", also="--duration", ge=1.0, hint="Give seconds."
    )
    particles: int = option(100, "Number of particles per filter.", ge=1, hint=ONE_PARTICLE)
    split: Literal["train", "validation", "test", "any"] = option(
        "validation", "Split of the worlds: train, validation, test, or any.", name="world_split"
    )
    preset: NoisePreset = option("standard", "Noise preset: easy, standard or hard.")
    seeds: int = option(2, "Number of episodes of each combination.", ge=1, hint="Use at least one episode.")
    seed: int = first_seed()

    def check(self) -> None:
        """Refuse a policy that does not exist."""
        parted(self.policy)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make the path of a model absolute, so that a configuration can be repeated from any folder."""
        from agents.registry import is_model

        found = dict(values)
        if "policy" in found and is_model(str(found["policy"])):
            found["policy"] = str(Path(found["policy"]).resolve())
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One timed episode."""

    family: str  # World family
    extent: float  # Width of the world [m]
    robots: int  # K
    seed: int  # Seed of the episode


def trials(config: Config) -> list[Trial]:
    """Return all trials, ordered by seed, then from small to large worlds as given."""
    combined = product(range(config.seed, config.seed + config.seeds), config.extents, config.robots)
    return [Trial(family=config.family, extent=e, robots=k, seed=seed) for seed, e, k in combined]


def environment(config: Config, trial: Trial) -> EnvConfig:
    """Return the environment of a trial."""
    player = parted(config.policy)
    shared: dict[str, Any] = {
        "world": f"{trial.family}:extent={trial.extent:g}", "robots": trial.robots, "policy": player.policy,
        "action_type": player.action_type, "particles": config.particles, "preset": config.preset, "seed": trial.seed,
    }  # fmt: skip
    found = RunConfig(**shared, max_seconds=config.duration).environment()
    return found.replace(world_split=None if config.split == ANY_SPLIT else config.split)


def checks(config: Config) -> Iterator[Callable[[], None]]:
    """Yield the first steps in a world of each extent, with the most robots."""
    for trial in {trial.extent: trial for trial in trials(config)}.values():
        yield partial(first_steps, environment(config, trial), parted(config.policy), trial.seed, DECISION_LIMIT)


class TimedEnv(ExplorationEnv):
    """Environment that keeps the processor time of each step [s]."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.seconds: list[float] = []

    def step(self, actions: Mapping[str, Any]) -> Any:
        """Execute the actions of all robots, see `ExplorationEnv.step`."""
        begin = time.process_time()
        results = super().step(actions)
        self.seconds.append(time.process_time() - begin)
        return results


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode and return its metrics.

    - Processor times of `env.step`, of all robots and all ticks of a decision: `steps_per_s`, the mean rate;
      `median_ms`, `late_ms`: median over the last quarter; `p99_ms`, `longest_ms`. Kernels are compiled before.
    - At the end: `get_state_ms`, `set_state_ms`; `snapshot_mb`, the size of the state as a file; `memory_mb`, that of
      the process, None where the system does not say; `reset_s`.
    - `coverage`, `mean_coverage`, `pose_error`, `landmarks` of a robot's map, and `TEAM`: means over the robots, as in
      `vslam bench exploration`; merges as in `count_merges`.
    - `sharing_pairs`: pairs of robots in one group, or whose maps share 15 true landmarks; `merged_pairs`: the former.
    - `curves`: `time_s`, and at these times `coverage`, `map_error`, `pose_error`, and `step_ms`, the median since the
      time before.

    Raises:
        PolicyError: If the policy fails.
    """
    _warm_up()
    first: list[float] = []
    ends: list[dict[str, Any]] = []

    def watch(progress: Progress) -> None:
        if progress.step == 0:
            first.append(time.process_time() - begin)
        elif not env.agents:
            ends.append(_snapshot_costs(env))

    with closing(TimedEnv(environment(config, trial))) as env:
        team = parted(config.policy).make(env, DECISION_LIMIT)
        begin = time.process_time()
        record = run_episode(env, team, trial.seed, watch)
    taken = 1e3 * np.array(env.seconds)
    late = taken[int((1.0 - LATE_SHARE) * len(taken)) :]
    scores = score_episode(record)["team"]
    errors = pose_errors(record)
    points = np.linspace(0.0, record.times[-1], CURVE_POINTS)
    marks = np.searchsorted(record.times, points + 1e-6, side="right") - 1  # steps taken until each time
    steps = [None, *(float(np.median(taken[a:b])) if b > a else None for a, b in pairwise(marks))]
    lines = {"coverage": record.coverage, "map_error": record.map_errors.mean(axis=0), "pose_error": errors}
    sharing, merged = sharing_pairs(record)
    return {
        "steps_per_s": float(1e3 * len(taken) / taken.sum()), "median_ms": float(np.median(taken)),
        "late_ms": float(np.median(late)), "p99_ms": float(np.quantile(taken, 0.99)), "longest_ms": float(taken.max()),
        "reset_s": first[0], **ends[0], "coverage": float(record.coverage[-1]),
        "mean_coverage": float(record.coverage.mean()), "pose_error": float(errors[-1]),
        "landmarks": float(np.mean([len(each) for each in record.maps])), **{name: scores[name] for name in TEAM},
        **count_merges(record.merges), "attempts": record.attempts, "one_group": len(record.groups) == 1,
        "sharing_pairs": sharing, "merged_pairs": merged,
        "curves": {"time_s": points}
        | {name: values_at(record.times, line, points) for name, line in lines.items()}
        | {"step_ms": steps},
    }  # fmt: skip


def sharing_pairs(record: EpisodeRecord) -> tuple[int, int]:
    """Return how many pairs of robots should share a map, and how many do.

    They should if they do, or if their maps contain `SHARED` common true landmarks.
    """
    together = {pair for group in record.groups for pair in combinations(sorted(group), 2)}
    known = [np.unique(claims[claims >= 0]) for claims in record.map_claims]
    sharing = [
        (a, b) in together or len(np.intersect1d(known[a], known[b], assume_unique=True)) >= SHARED
        for a, b in combinations(range(len(known)), 2)
    ]
    return sum(sharing), len(together)


def _snapshot_costs(env: ExplorationEnv) -> dict[str, Any]:
    """Return time and size of snapshots of an environment, and the memory of the process, see `play`."""
    taken, restored = [], []
    for _ in range(SNAPSHOTS):
        begin = time.process_time()
        state = env.get_state()
        middle = time.process_time()
        env.set_state(state)
        taken.append(middle - begin)
        restored.append(time.process_time() - middle)
    memory = memory_mb()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state"
        save_state(state, file)
        size = file.stat().st_size
    return {
        "get_state_ms": 1e3 * float(np.median(taken)), "set_state_ms": 1e3 * float(np.median(restored)),
        "snapshot_mb": size / 1e6, "memory_mb": memory,
    }  # fmt: skip


def memory_mb() -> Any:
    """Return the resident memory of this process [MB], or None where the system has no `/proc`."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@cache
def _warm_up() -> None:
    """Load all kernels into this process, once."""
    warm_up(workers=1)


# ---------------------------------------------------------------------- results

STUDY = Study(
    name="scale",
    about="""Measure cost and results over the size of the world and the number of robots.

    Times of steps and snapshots, memory, coverage over time, errors of maps and poses, merges. Options in the plural
    take comma-separated values; all combinations are run. Times are processor times, so that other programs matter
    little. Episodes of a policy that fails are left out, with status 2 at the end. Ctrl-C finishes the current episode;
    the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    quick={"extents": (30.0, 60.0), "robots": (3,), "duration": 60.0, "seeds": 1},
    tables=(
        ResultTable(
            name="steps", title="Steps, processor time", by=("extent", "robots"),
            columns=(
                Column("steps_per_s", "steps/s", digits=1), Column("median_ms", "median [ms]", digits=1),
                Column("late_ms", "last quarter [ms]", digits=1), Column("p99_ms", "99 % [ms]", digits=0),
                Column("longest_ms", "longest [ms]", digits=0),
            ),
        ),
        ResultTable(
            name="snapshots", title="Snapshots and memory", by=("extent", "robots"),
            columns=(
                Column("get_state_ms", "get_state [ms]", digits=1), Column("set_state_ms", "set_state [ms]", digits=1),
                Column("snapshot_mb", "snapshot [MB]", digits=1), Column("memory_mb", "memory [MB]", digits=0),
                Column("reset_s", "reset [s]", digits=1),
            ),
        ),
        ResultTable(
            name="errors", title="Coverage and errors at the end", by=("extent", "robots"),
            columns=(
                Column("coverage", digits=1, interval=True), Column("pose_error", "pose [m]", digits=2, interval=True),
                Column("map_error", "E [m]", digits=2, interval=True), Column("map_rmse_m", "RMSE [m]", digits=2),
                Column("map_recall", digits=1), Column("landmarks", digits=0),
            ),
        ),
        ResultTable(
            name="merges", title="Merges", by=("extent", "robots"),
            columns=(
                Column("right_merges", "right", digits=1), Column("false_merges", "false", digits=1),
                Column("undone_merges", "undone", digits=1), Column("sharing_pairs", "pairs to merge", digits=1),
                Column("merged_pairs", "merged", digits=1), Column("attempts", digits=0),
            ),
        ),
    ),
    chart=Chart(
        x="extent", label="extent [m]", by="robots",
        panels=tuple(
            Panel(column=Column(name, heading))
            for name, heading in (
                ("longest_ms", "longest step [ms]"), ("get_state_ms", "get_state [ms]"),
                ("snapshot_mb", "snapshot [MB]"), ("pose_error", "pose error [m]"),
            )
        ),
    ),
    curves=Curves(
        by=("extent", "robots"),
        columns=(
            Column("coverage", digits=1), Column("map_error"), Column("pose_error"),
            Column("step_ms", "median step [ms]"),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
