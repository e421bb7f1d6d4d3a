"""Study of `vslam bench speed filter`: steps of filters with a full map, snapshots, compilation of all kernels."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import StepReport
from training.bench.speed.config import FilterSpeedConfig
from training.bench.speed.workload import LARGE_LOADS, FilterLoad, LoadStep, LoadWorld
from training.experiments.config import Proposal
from training.experiments.machine.timing import time_calls, timing_ms
from training.experiments.study import Chart, Column, Panel, ResultTable, Study, Words

LARGE_STEPS = 60
STATE_LOAD = FilterLoad(particles=100, landmarks=300, measurements=15)
SWEEPS = 3  # number of previous measurements of each landmark
WARM_UP = 30  # number of steps that are not counted
STATE_CALLS = 200
WARM_UP_SCRIPT = """
import json, time
begin = time.perf_counter()
from slam_backend import warm_up
ready = time.perf_counter()
compiling = warm_up(everything=True, workers=1)
print(json.dumps({"import_s": ready - begin, "compile_s": compiling, "warm_up_s": time.perf_counter() - ready}))
"""
STEP, SNAPSHOTS, KERNELS = "step", ("get_state", "set_state"), ("compiled", "cached")  # what is timed


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One timed call and the load of its filter, as in `FilterLoad`."""

    part: str  # `STEP`, one of `SNAPSHOTS`, or one of `KERNELS`
    proposal: Proposal
    particles: int
    landmarks: int
    measurements: int
    robots: int
    lookalikes: int
    seed: int

    @property
    def load(self) -> FilterLoad:
        """Load of the filter."""
        return FilterLoad(**{name: getattr(self, name) for name in FilterLoad.model_fields})


def trials(config: FilterSpeedConfig) -> list[Trial]:
    """Return all trials: steps row by row, snapshots, and compilation if requested."""
    others = [*SNAPSHOTS, *(KERNELS if config.compile else ())]
    rows = [(STEP, load) for load in config.loads()] + [(part, STATE_LOAD) for part in others]
    return [Trial(part=part, **load.model_dump()) for part, load in rows]


def play(config: FilterSpeedConfig, trial: Trial) -> dict[str, Any]:
    """Time a trial; see `time_row`, `time_snapshots` and `time_compilation`."""
    if trial.part in KERNELS:
        return time_compilation()[trial.part]
    if trial.part in SNAPSHOTS:
        return time_snapshots(trial.load, trial.part)
    is_large = trial.particles >= LARGE_LOADS[0]["particles"]
    return time_row(trial.load, min(config.steps, LARGE_STEPS) if is_large else config.steps)


def time_row(load: FilterLoad, steps: int) -> dict[str, Any]:
    """Fill a `FastSlam` and time `steps` steps.

    Returns:
        Times, and: `right`, the share of the measurements that the most probable particle associates
        correctly; `landmarks_held`, its final number of landmarks; `ess`, the mean effective sample size over M
        before resampling; `resampled`, the share of steps with resampling; `nbytes`, the memory of the particles.
    """
    world = LoadWorld(load)
    slam, ids = filled_filter(world)
    course = list(world.course(WARM_UP + steps))
    seconds, reports = time_calls(lambda step: slam.step(step.odometry, step.frames), course, WARM_UP)
    return {
        **timing_ms(seconds), "right": _share_right(course[WARM_UP:], reports, ids),
        "landmarks_held": slam.map_size, "ess": float(np.mean([report.ess for report in reports])) / load.particles,
        "resampled": float(np.mean([report.resampled for report in reports])), "nbytes": slam.nbytes,
        "bytes_per_landmark": slam.nbytes / (load.particles * load.landmarks),
    }  # fmt: skip


def time_snapshots(load: FilterLoad, part: str) -> dict[str, Any]:
    """Time `get_state` or `set_state` of a filter after a number of steps."""
    world = LoadWorld(load)
    slam, _ = filled_filter(world)
    for step in world.course(WARM_UP):
        slam.step(step.odometry, step.frames)
    if part == "get_state":
        return timing_ms(time_calls(lambda _: len(slam.get_state()), range(STATE_CALLS), WARM_UP)[0])
    return timing_ms(time_calls(slam.set_state, [slam.get_state()] * STATE_CALLS, WARM_UP)[0])


def filled_filter(world: LoadWorld) -> tuple[FastSlam, IntArray]:
    """Return a filter whose particles contain all landmarks, and the landmark ids in the filter (N,)."""
    load = world.load
    chosen = {field.name: getattr(load.options, field.name) for field in fields(FilterOptions)}
    slam = FastSlam(load.robots, **chosen, seed=load.seed, initial_poses=world.starts)
    ids = np.full(load.landmarks, -1)
    for step in world.mapping(SWEEPS):
        created = slam.step(step.odometry, step.frames, step.names).created[0]
        ids[step.names[0][created >= 0]] = created[created >= 0]
    return slam, ids


def _share_right(course: list[LoadStep], reports: list[StepReport], ids: IntArray) -> float:
    """Return the share of all measurements with a correct association."""
    found = np.concatenate([np.concatenate(report.associations) for report in reports])
    true = np.concatenate([np.concatenate(step.names) for step in course])
    return float(np.mean(found == ids[true]))


@cache
def time_compilation() -> dict[str, dict[str, Any]]:
    """Warm the backend up in two processes that share a new, empty cache.

    Returns:
        Times by the names in `KERNELS`: of import, compiler and whole warm-up [s], and the size of the cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        cold, cached = _warm_up(folder), _warm_up(folder)
        sizes = [file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()]
    size = {"cache_files": len(sizes), "cache_bytes": sum(sizes)}
    return dict(zip(KERNELS, (cold | size, cached | size), strict=True))


def _warm_up(cache: str) -> dict[str, float]:
    """Warm up in a new process."""
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", WARM_UP_SCRIPT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    times: dict[str, float] = json.loads(done.stdout)
    return times


WORDS: Words = {"particles": ("M", str), "landmarks": ("N", str), "measurements": ("B", str), "robots": ("K", str)}
MEDIAN = Column("median_ms", "median [ms]")
SPREAD = Column("low_ms", "10 % [ms]"), Column("high_ms", "90 % [ms]"), Column("min_ms", "least [ms]")


def _is(*parts: str) -> Any:
    return lambda row: row["part"] in parts


STUDY = Study(
    name="filter",
    config=FilterSpeedConfig,
    trial=Trial,
    trials=trials,
    play=play,
    timed=True,
    tables=(
        ResultTable(
            name="steps", title="A step", by=("proposal", "particles", "landmarks", "measurements", "robots"),
            each=("proposal",), words=WORDS, where=_is(STEP),
            note="Unknown association, resampling at every step, one thread. right: share of correctly associated "
            "measurements; memory: per particle and landmark.",
            columns=(
                MEDIAN, *SPREAD, Column("right", "right [%]", digits=0, factor=100.0),
                Column("bytes_per_landmark", "memory [bytes]", digits=0),
            ),
        ),
        ResultTable(
            name="snapshots", title="Snapshots", by=("part", "particles", "landmarks"), words=WORDS,
            where=_is(*SNAPSHOTS), columns=(MEDIAN, *SPREAD),
        ),
        ResultTable(
            name="kernels", title="All kernels, in a new process", by=("part",), where=_is(*KERNELS),
            columns=(
                Column("import_s", digits=1), Column("compile_s", "compiler [s]", digits=0),
                Column("warm_up_s", "ready after [s]", digits=1),
                Column("cache_bytes", "cache [MB]", digits=1, factor=1e-6),
            ),
        ),
    ),
    chart=Chart(
        x="landmarks", label="landmarks in the map, N", by="particles", rows="proposal", log=True,
        title=lambda proposal: f"{proposal}, mean over B and K", where=_is(STEP),
        panels=(Panel(column=MEDIAN, log=True), Panel(column=Column("high_ms", "90 % [ms]"), log=True)),
    ),
)  # fmt: skip
