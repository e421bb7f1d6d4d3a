import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest
from python_entry import python_entry

from slam_backend.core import jit as _jit
from slam_backend.core.compilation import MESSAGE, watch_compilation
from slam_backend.warm_up import warm_up

# What a process asks of the backend after it has warmed up; each line of output is a kernel compiled or loaded late.
VARIED_USE = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from slam_backend import FastSlam, Measurements, TeamSlam
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.attempts import AttemptOptions
from slam_backend.measurements import TeamMeasurements
from slam_backend.merge_options import MergeOptions
from slam_backend.metrics.maps import map_error
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.warm_up import warm_up
from simulated_team import SimulatedTeam

def versions():
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("slam_backend")]
    kernels = {id(v): v for module in modules for v in vars(module).values() if isinstance(v, Dispatcher)}
    return {(kernel.py_func.__qualname__, str(s)) for kernel in kernels.values() for s in kernel.signatures}

warm_up(everything=True)
before = versions()
assert before
rng = np.random.default_rng(0)
points = np.column_stack([rng.uniform(-2.0, 2.0, 30), rng.uniform(-1.0, 1.0, 30), rng.uniform(4.0, 7.0, 30)])
looks = np.linalg.qr(rng.normal(size=(64, 64)))[0][:30].astype(np.float32)
for proposal in ("fastslam1", "fastslam2"):
    for robots, particles, threshold in ((1, 5, 0.5), (3, 33, 1.0)):
        options = dict(one_to_one=robots > 1, existence=ExistenceModel() if robots > 1 else None)
        slam = FastSlam(robots, particles, proposal=proposal, resample_threshold=threshold, **options)
        for size in (1, 30, 0, 2):
            seen = rng.permutation(30)[:size]
            frame = Measurements(points[seen], looks[seen])
            given = Measurements(points[seen], looks[seen], np.tile(1e-3 * np.eye(3), (size, 1, 1)))
            slam.step([None] * robots, [frame] * robots)
            slam.step([np.array([0.0, 0.0, 0.02])] * robots, [given] * robots)
            slam.step([np.array([0.0, 0.0, -0.02])] * robots, [None] * robots)
            slam.step([None] * robots, [frame] * robots, [np.where(seen < 5, -1, seen)] * robots)
            slam.step([None] * robots, [frame] * robots, poses=[np.zeros(3)] * robots)
        columns = np.zeros((3, 2)).T  # neither contiguous nor to be written
        columns.setflags(write=False)
        slam.step([columns[0]] * robots, [frame] * robots, poses=[columns[1]] * robots)
        slam.set_state(slam.get_state())
        slam.map("mixture")
        slam.step([None] * robots, [frame] * robots)
slam = FastSlam(1, 40, resample_threshold=1.0, existence=ExistenceModel())
for size in (30, *(5 for _ in range(20))):
    slam.step([np.zeros(3)], [Measurements(points[:size], looks[:size])])
assert slam.num_landmarks < 30  # some are given up
team = TeamSlam(2, num_particles=7, attempts=AttemptOptions(every=1))
for size in (1, 3, 9, 30, 30, 30):
    team.step([None, None], [Measurements(points[:size], looks[:size])] * 2)
team.step(np.zeros((2, 3)), TeamMeasurements(np.tile(points, (2, 1)), np.tile(looks, (2, 1)), np.array([30, 60])))
assert len(team.groups) == 1
team.standpoints(), team.outlines()
slices = SmoothingOptions(slice_steps=20, rigid_within=0.01, max_keys=12, further_keys=4, fresh_keys=6)
for smoothing in (slices, SmoothingOptions()):
    simulation = SimulatedTeam(2, seed=100)
    smoothed = simulation.build(
        rejuvenate_every=20, smoothing=smoothing, attempts=AttemptOptions(every=5),
        merging=MergeOptions(watch_every=5, sure=0.0),
    )
    told = simulation.run(smoothed, 100)
    assert len(smoothed.groups) == 1
    assert any(report.rejuvenations for report in told if len(report.groups) == 1)
map_error(team.map(0).means, rng.permutation(len(team.map(0))), np.asfortranarray(points))
for late in sorted(versions() - before):
    print(*late)
"""


def _kernel(module: str) -> Callable[[float], float]:
    """A kernel that claims to be of a module, with a part that it calls."""

    def part(x: float) -> float:
        return x + 1.0

    part.__module__ = module
    inner = numba.njit(part)

    def kernel(x: float) -> float:
        return inner(x) * 2.0  # type: ignore[no-any-return]

    kernel.__module__ = module
    return numba.njit(kernel)  # type: ignore[no-any-return]


@pytest.mark.slow
def test_nothing_is_compiled_after_the_warm_up() -> None:
    """However the backend is used afterwards, it needs no kernel that the warm-up has not made ready."""
    beside = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # where its simulated team is found
    done = subprocess.run([sys.executable, "-c", VARIED_USE], env=beside, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_a_second_warm_up_finds_everything_compiled() -> None:
    """What is compiled already takes no time."""
    warm_up(everything=True)
    assert warm_up(everything=True) == 0.0


def test_kernels_work_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that is only read, and no home: kernels are compiled in each process anew, with the same results."""
    usual = numba.njit

    def without_place(**options: Any) -> Any:
        def refuse(function: Callable[..., float]) -> Any:
            raise RuntimeError(f"cannot cache function {function.__name__!r}: no locator available")

        return refuse if options.get("cache") else usual(**options)

    monkeypatch.setattr(numba, "njit", without_place)

    def double(x: float) -> float:
        return 2.0 * x

    for kind in (_jit.jit, _jit.inlined, _jit.lanes, _jit.lanes_inlined):
        assert python_entry(kind(double))(4.0) == 8.0


@pytest.mark.parametrize("name", ["_kernels", "_other_kernels"])
def test_an_edit_of_a_kernel_is_noticed_by_kernels_of_its_folder_that_call_it(name: str, tmp_path: Path) -> None:
    """What is compiled into another module's kernel does not linger in the cache."""
    folder = tmp_path / name
    folder.mkdir()
    (folder / "caller.py").write_text(
        f"from slam_backend.core.jit import jit\n\nfrom {name}.callee import answer\n\n\n"
        "@jit\ndef ask(x):\n    return answer(x)\n"
    )
    answers = []
    for number in (1.0, 2.0):
        (folder / "callee.py").write_text(
            f"from slam_backend.core.jit import inlined\n\n\n@inlined\ndef answer(x):\n    return x + {number}\n"
        )
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from {name}.caller import ask; print(ask(0.0))"
        answers.append(float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout))
    assert answers == [1.0, 2.0]


def test_a_watch_hears_of_our_kernels_only() -> None:
    """A kernel of this project is told of once, with its parts; those of others never, nor what is already compiled."""
    told: list[str] = []
    kernel, foreign = _kernel("slam_backend.somewhere"), _kernel("somebody.else")
    with watch_compilation(told.append) as watch:
        assert (kernel(1.0), foreign(1.0)) == (4.0, 4.0)
        once = watch.seconds
        kernel(2.0)
    _kernel("slam_backend.after")(1.0)
    assert told == watch.names
    assert len(told) == 1
    assert told[0].startswith("slam_backend.somewhere.")
    assert once == watch.seconds > 0.0


def test_users_of_the_library_read_of_it_in_the_log() -> None:
    """The first compilation of a process is logged with level INFO, each one with DEBUG; nothing is printed."""
    code = """
import logging, numba, slam_backend
logging.basicConfig(format="%(levelname)s %(name)s %(message)s")
logging.getLogger("slam_backend").setLevel(logging.DEBUG)
for module in ("slam_backend.a", "slam_backend.b", "somebody.else"):
    def kernel(x): return x
    kernel.__module__ = module
    numba.njit(kernel)(1.0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    each = [f"DEBUG slam_backend Compiling slam_backend.{name}.kernel" for name in "ab"]
    assert (done.stdout, done.stderr.splitlines()) == ("", [f"INFO slam_backend {MESSAGE}", *each])
