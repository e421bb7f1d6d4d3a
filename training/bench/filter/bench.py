"""Benchmark `vslam bench filter`: steps of filters with a full map, and compilation of all kernels."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import StepReport
from training.bench.config import FilterBenchConfig
from training.bench.filter.workload import LARGE_LOADS, FilterLoad, LoadStep, LoadWorld
from training.experiments.timing import describe_machine, run_named_trials, time_calls, timing_ms

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


def time_row(load: FilterLoad, steps: int) -> dict[str, Any]:
    """Fill a `FastSlam` and time `steps` steps.

    Returns:
        The load, its times, and: `right`, the share of the measurements that the most probable particle associates
        correctly; `landmarks_held`, its final number of landmarks; `ess`, the mean effective sample size over M
        before resampling; `resampled`, the share of steps with resampling; `nbytes`, the memory of the particles.
    """
    world = LoadWorld(load)
    slam, ids = filled_filter(world)
    course = list(world.course(WARM_UP + steps))
    seconds, reports = time_calls(lambda step: slam.step(step.odometry, step.frames), course, WARM_UP)
    return {
        **load.model_dump(), **timing_ms(seconds), "right": _share_right(course[WARM_UP:], reports, ids),
        "landmarks_held": slam.map_size, "ess": float(np.mean([report.ess for report in reports])) / load.particles,
        "resampled": float(np.mean([report.resampled for report in reports])), "nbytes": slam.nbytes,
        "bytes_per_landmark": slam.nbytes / (load.particles * load.landmarks),
    }  # fmt: skip


def time_state(load: FilterLoad) -> dict[str, Any]:
    """Time `get_state` and `set_state` of a filter after a number of steps."""
    world = LoadWorld(load)
    slam, _ = filled_filter(world)
    for step in world.course(WARM_UP):
        slam.step(step.odometry, step.frames)
    state = slam.get_state()
    taken, _ = time_calls(lambda _: len(slam.get_state()), range(STATE_CALLS), WARM_UP)  # each is freed before the next
    given, _ = time_calls(slam.set_state, [state] * STATE_CALLS, WARM_UP)
    return {"get_state": timing_ms(taken), "set_state": timing_ms(given)}


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


def time_compilation() -> dict[str, Any]:
    """Warm the backend up in two processes that share a new, empty cache.

    Returns:
        `"cold"` and `"cached"`, each with the times of import, compiler and whole warm-up [s], and the size of the
        cache in files and bytes.
    """
    with tempfile.TemporaryDirectory() as folder:
        cold, cached = _warm_up(folder), _warm_up(folder)
        sizes = [file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()]
    return {"cold": cold, "cached": cached, "cache_files": len(sizes), "cache_bytes": sum(sizes)}


def _warm_up(cache: str) -> dict[str, float]:
    """Warm up in a new process."""
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", WARM_UP_SCRIPT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    times: dict[str, float] = json.loads(done.stdout)
    return times


def run_bench(
    config: FilterBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Run all trials, or those until `should_stop`; there are `count_trials(config)`.

    Returns:
        `rows` in the order of the loads, the times of the `state`, of the `compilation` if requested; `machine`, and
        whether the benchmark is `complete`.
    """
    result: dict[str, Any] = {"machine": describe_machine(), "rows": [], "state": {}, "compilation": None}

    def time_load(load: FilterLoad) -> None:
        large = load.particles >= LARGE_LOADS[0]["particles"]
        result["rows"].append(time_row(load, min(config.steps, LARGE_STEPS) if large else config.steps))

    trials: list[tuple[str, Callable[[], object]]] = [
        (_name(load), partial(time_load, load)) for load in config.loads()
    ]
    trials.append(("get_state, set_state", lambda: result.update(state=time_state(STATE_LOAD))))
    if config.compile:
        trials.append(("compilation", lambda: result.update(compilation=time_compilation())))
    result["complete"] = run_named_trials(trials, on_trial, should_stop)
    return result


def count_trials(config: FilterBenchConfig) -> int:
    """Return the number of calls of `on_trial` by `run_bench`."""
    return 1 + len(config.loads()) + config.compile


def _name(load: FilterLoad) -> str:
    """Return the name of a load for the progress bar."""
    return f"{load.proposal} M={load.particles} N={load.landmarks} B={load.measurements} K={load.robots}"
