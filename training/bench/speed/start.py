"""Study of `vslam bench speed start`: the time until a user can work, with empty caches and home, on two cores."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from training.bench.speed.config import Part, StartSpeedConfig
from training.experiments.study import Column, ResultTable, Row, Study
from training.experiments.tables import number

CORES = 2
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")
MANY_PARAMETERS = 10
SETTINGS = ("NUMBA_", "PYTHON", "XDG_", "MPL")  # what variables of the user begin with that change what is timed
DEMO = (
    "run", "--world", "office", "--robots", "3", "--policy", "next_best_view", "--action-type", "continuous",
    "--seed", "0",
)  # fmt: skip
# Programs print their figures on the last line.
KERNELS = "import vslam_env; print(vslam_env.warm_up(everything=True, workers={workers}))"
FIRST_STEPS = """
import time
begun = time.perf_counter()
from vslam_env import vslam_v1
env = vslam_v1.parallel_env()
env.reset(seed=0)
for _ in range(10):
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
print(time.perf_counter() - begun)
"""
FIRST_PICTURE = """
import os, sys, time
from slam_backend.core.compilation.messages import watch_compilation
from training.cli import app
from training.episodes.video import VideoWriter

def stop(writer, picture):
    print(f"\\n{time.time() - begun} {len(watch.names)}", flush=True)
    os._exit(0)

begun, VideoWriter.add = float(sys.argv.pop(1)), stop
with watch_compilation(lambda name: None) as watch:
    app()
"""
LIBRARIES = "numba, gymnasium, pettingzoo, pymunk"
IMPORT = "import time; begun = time.perf_counter(); import {modules}; print(time.perf_counter() - begun)"
COUNT = """
import inspect, numba, vslam_env
from slam_backend.core.compilation.compiler import find_kernel, recorded_signatures
found, todo = {}, [find_kernel(name) for name in recorded_signatures("slam_backend", "vslam_env")]
while todo:
    function = todo.pop().py_func
    if function not in found:
        found[function] = len(inspect.signature(function).parameters)
        named = [function.__globals__.get(name) for name in function.__code__.co_names]
        todo += [value for value in named if hasattr(value, "py_func")]
print(len(found), sum(number >= {many} for number in found.values()))
"""


@dataclass(frozen=True)
class Figure:
    """A figure of one part.

    Attributes:
        name: Name of what is measured.
        unit: Unit; empty for a count or a ratio.
        goal: Upper limit to reach; None: no limit.
    """

    name: str
    unit: str = "s"
    goal: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One figure of one run of a part."""

    part: Part
    figure: str  # Name of the figure
    run: int  # Number of the run


FIGURES: dict[Part, tuple[Figure, ...]] = {
    "demo": (Figure("make demo from a fresh clone, after installation"),),
    "kernels": (Figure("all kernels, one worker", goal=65.0), Figure("all kernels, two workers", goal=36.0)),
    "steps": (Figure("first reset and 10 steps of the default environment", goal=30.0),),
    "wheel": (
        Figure("with the kernels' wheel: first picture of vslam run", goal=15.0),
        Figure("with the kernels' wheel: cache misses until then", "", 0.0),
    ),
    "import": (
        Figure("import vslam_env"), Figure(f"import {LIBRARIES}"), Figure("the former over the latter", "", 1.5),
    ),
    "count": (Figure("kernels", "", 200.0), Figure(f"kernels with {MANY_PARAMETERS} or more parameters", "", 15.0)),
}  # fmt: skip


def trials(config: StartSpeedConfig) -> list[Trial]:
    """Return all trials, run by run."""
    wheel: tuple[Part, ...] = ("wheel",) if config.wheel is not None and "wheel" not in config.parts else ()
    return [
        Trial(part=part, figure=figure.name, run=run)
        for run in range(config.repeats)
        for part in (*config.parts, *wheel)
        for figure in FIGURES[part]
    ]


def play(config: StartSpeedConfig, trial: Trial) -> dict[str, Any]:
    """Time a part in processes of its own, once for all its figures; return the `value` of one."""
    values = measured(trial.part, trial.run, config.wheel)
    names = [figure.name for figure in FIGURES[trial.part]]
    return {"value": values[names.index(trial.figure)]}


@lru_cache(maxsize=1)
def measured(part: Part, run: int, wheel: str | None) -> tuple[float, ...]:
    """Return the values of all figures of a part in a run."""
    measure: dict[Part, Callable[[], tuple[float, ...]]] = {
        "demo": demo, "kernels": lambda: (*kernels(1), *kernels(2)), "steps": first_steps,
        "wheel": lambda: first_picture(Path(str(wheel))), "import": imports, "count": count,
    }  # fmt: skip
    with on_two_cores():
        return measure[part]()


# ---------------------------------------------------------------------- what is timed


def demo() -> tuple[float]:
    """Return how long the demo takes, from its call to the finished run folder [s]."""
    with fresh_place() as place:
        begun = time.perf_counter()
        place.run("-m", "training", *DEMO)
        return (time.perf_counter() - begun,)


def kernels(workers: int) -> tuple[float]:
    """Return how long all kernels take to compile [s]."""
    with fresh_place() as place:
        return place.figures(KERNELS.format(workers=workers))[:1]  # type: ignore[return-value]


def first_steps() -> tuple[float, ...]:
    """Return how long the first steps of the default environment take, imports included [s]."""
    with fresh_place() as place:
        return place.figures(FIRST_STEPS)


def first_picture(wheel: Path) -> tuple[float, ...]:
    """Return when the demo draws its first picture with shipped kernels [s], and how many it had to compile."""
    with fresh_place() as place:
        site = place.home / "site"
        install = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site), str(wheel))
        subprocess.run([sys.executable, *install], check=True)
        place.search.append(str(site))
        place.run("-m", "compileall", "-q", str(place.sources))  # as an installation does
        return place.figures(FIRST_PICTURE, str(time.time()), *DEMO)


def imports() -> tuple[float, float, float]:
    """Return how long the package and its libraries alone take to import [s], and the ratio; files are cached."""
    with fresh_place() as place:
        place.run("-m", "compileall", "-q", str(place.sources))  # as an installation does
        both = [IMPORT.format(modules=modules) for modules in ("vslam_env", LIBRARIES)]
        times = [[place.figures(program)[0] for program in both] for _ in range(6)][1:]
    ours, theirs = (float(x) for x in np.median(times, axis=0))
    return ours, theirs, ours / theirs


def count() -> tuple[float, ...]:
    """Return how many kernels there are, and how many have many parameters."""
    with fresh_place() as place:
        return place.figures(COUNT.replace("{many}", str(MANY_PARAMETERS)))


# ---------------------------------------------------------------------- where it runs


@dataclass
class Place:
    """A copy of the sources without caches, and an empty home."""

    home: Path
    sources: Path
    search: list[str]

    def run(self, *arguments: str) -> str:
        """Run Python here and return what it prints.

        Raises:
            RuntimeError: If it fails.
        """
        kept = {name: value for name, value in os.environ.items() if not name.startswith(SETTINGS)}
        here = {"HOME": str(self.home), "PYTHONPATH": os.pathsep.join(self.search)}
        done = subprocess.run(
            [sys.executable, *arguments], cwd=self.home, env=kept | here, capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(f"{arguments[:2]} failed:\n{done.stderr}")
        return done.stdout

    def figures(self, program: str, *arguments: str) -> tuple[float, ...]:
        """Run a program and return the numbers on the last line that it prints."""
        return tuple(float(word) for word in self.run("-c", program, *arguments).splitlines()[-1].split())


@contextmanager
def fresh_place() -> Iterator[Place]:
    """Copy the sources to a new folder, without caches, beside an empty home."""
    root = Path(__file__).parents[3]
    with TemporaryDirectory() as folder:
        home, sources = Path(folder, "home"), Path(folder, "sources")
        home.mkdir()
        for package in PACKAGES:
            shutil.copytree(root / package, sources / package, ignore=shutil.ignore_patterns("__pycache__"))
        yield Place(home, sources, [str(sources)])


@contextmanager
def on_two_cores() -> Iterator[None]:
    """Let this process, and those that it starts, use two cores, where the system can say so."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:CORES])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# ---------------------------------------------------------------------- results


def _figure(rows: Sequence[Row]) -> Figure:
    """Return the figure of a line."""
    return next(figure for figure in FIGURES[rows[0]["part"]] if figure.name == rows[0]["figure"])


def _shown(statistic: Callable[[Sequence[float]], Any], rows: Sequence[Row]) -> str:
    """Return a statistic of the values with its unit."""
    values = [row["value"] for row in rows]
    digits = 0 if all(float(value).is_integer() for value in values) else 2
    return f"{number(float(statistic(values)), digits)} {_figure(rows).unit}".rstrip()


def _goal(rows: Sequence[Row]) -> str:
    figure = _figure(rows)
    return "" if figure.goal is None else f"{figure.goal:g} {figure.unit}".rstrip()


STUDY = Study(
    name="start",
    config=StartSpeedConfig,
    trial=Trial,
    trials=trials,
    play=play,
    timed=True,
    tables=(
        ResultTable(
            name="start", title=f"Start-up with empty caches and home, {CORES} cores", by=("part", "figure"),
            columns=(
                Column("median", statistic=partial(_shown, np.median)), Column("least", statistic=partial(_shown, min)),
                Column("most", statistic=partial(_shown, max)), Column("runs", statistic=len, digits=0),
                Column("goal", statistic=_goal),
            ),
        ),
    ),
)  # fmt: skip
