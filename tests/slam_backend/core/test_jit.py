"""How kernels are compiled, kept, found again and warmed up; public names."""

import gc
import os
import subprocess
import sys
from collections.abc import Callable
from types import UnionType
from typing import Any, get_args, get_type_hints

import numba
import numpy as np
import pytest
from builders.kernels import python_entry
from numba.core.errors import NumbaError

import slam_backend
from slam_backend import FastSlam, FilterOptions, StepReport, TeamReport, TeamSlam
from slam_backend.core import jit as _jit
from slam_backend.core.compilation.messages import MESSAGE, watch_compilation
from slam_backend.warm_up import warm_up


def test_this_version_of_numba_can_leave_references_uncounted() -> None:
    """The option is internal to numba: without it all works, but slower."""
    assert _jit.HAS_NRT_OPTION


@pytest.mark.parametrize("compiled", [_jit.in_place, _jit.inline, _jit.simd, _jit.simd_inline])
def test_kernels_that_work_in_place_can_make_no_array(compiled: Callable[[Any], Any]) -> None:
    """Its counter would be missing: numba refuses to compile them."""

    def makes_one(x: float) -> float:
        row = np.zeros(3)
        row[0] = x
        return float(row[0])

    with pytest.raises(NumbaError, match=r"zeros|NRT"):
        python_entry(compiled(makes_one))(1.0)


def test_reference_counting_and_non_counting_kernels_may_call_each_other() -> None:
    """Reference counts of one kernel do not depend on the other."""

    def add_one(row: Any) -> None:
        for i in range(len(row)):
            row[i] += 1.0

    def total_of_new(size: int) -> float:
        row = np.zeros(size)
        in_place(row[1:])
        return float(row.sum())

    def twice(size: int, row: Any) -> None:
        row[:] = 2.0 * counted(size)

    in_place, counted = _jit.in_place(add_one), _jit.jit(total_of_new)
    row = np.zeros(2)
    _jit.in_place(twice)(5, row)
    assert row.tolist() == [8.0, 8.0]


def test_references_are_counted_if_numba_lacks_the_option(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels then give the same results, and may allocate arrays."""
    monkeypatch.setattr(_jit, "HAS_NRT_OPTION", False)

    def makes_one(x: float) -> float:
        return float(np.full(3, x).sum())

    assert _jit.in_place(makes_one)(2.0) == 6.0


def test_stack_arrays_of_a_kernel_are_distinct_and_persist_through_loops() -> None:
    """A loop allocates its array once, and keeps its content between iterations."""

    def fill(out: Any) -> None:
        one, other = _jit.stack_array(5), _jit.stack_array(3)
        for turn in range(4):
            if turn == 0:
                one[:] = 0.0
            other[:] = float(turn)
            for i in range(len(one)):
                one[i] += other[i % len(other)] + 10.0 * i
        for i in range(5):
            out[i] = one[i]

    out = np.empty(5)
    _jit.in_place(fill)(out)
    assert out.tolist() == [6.0 + 40.0 * i for i in range(5)]


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64, np.float32, np.float64])
def test_stack_arrays_hold_numbers_of_any_type(dtype: Any) -> None:
    """Elements are contiguous, and overflow as numbers of their type do."""

    def fill(out: Any) -> None:
        row = _jit.stack_array_of(7, dtype)
        for i in range(len(row)):
            row[i] = out[i]
        for i in range(len(row)):
            out[i] = row[len(row) - 1 - i] + row[i]

    out = np.arange(7).astype(dtype) * dtype(40)
    expected = out + out[::-1]
    _jit.in_place(fill)(out)
    assert out.tolist() == expected.tolist()


def test_the_size_of_a_stack_array_is_a_constant() -> None:
    """A size that is unknown when the kernel is compiled is refused."""

    def fill(size: int) -> float:
        return float(_jit.stack_array(size)[0])

    with pytest.raises(NumbaError):
        _jit.in_place(fill)(3)


def test_the_result_of_a_kernel_does_not_depend_on_its_first_caller() -> None:
    """A division by zero raises in a strict kernel, even if a lane kernel, where it gives inf, called it first."""

    def quotient(x: float, y: float) -> float:
        return x / y

    for decorated in (_jit.jit, _jit.in_place):
        strict = decorated(quotient)

        assert _called_first_by_a_lane_kernel(strict)
        with pytest.raises(ZeroDivisionError):
            strict(1.0, 0.0)


def _called_first_by_a_lane_kernel(strict: Any) -> bool:
    def lane(x: float) -> float:
        return strict(x, 2.0) * x

    return bool(_jit.simd(lane)(3.0) == 4.5)


def test_a_device_kernel_refuses_a_call_from_python_and_serves_other_kernels() -> None:
    """It has no wrapper for Python, without which a call would end the process."""

    def double(x: float) -> float:
        return 2.0 * x

    def outer(x: float) -> float:
        return kernel(x) + 1.0

    kernel = _jit.device(_jit.in_place(double))
    assert _jit.in_place(outer)(3.0) == 7.0
    with pytest.raises(TypeError, match=r"double can be called by kernels only: remove @device"):
        kernel(3.0)


# What a process asks of the backend after it has warmed up; each line of output is a kernel compiled or loaded late.
VARIED_USE = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from slam_backend import FastSlam, Measurements, TeamSlam
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.models.measurements import TeamMeasurements
from slam_backend.team.options import MergeOptions
from slam_backend.maps.alignment import align_maps
from slam_backend.metrics.maps import map_error
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.warm_up import warm_up
from builders.teams import SimulatedTeam

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
        slam = FastSlam(robots, num_particles=particles, proposal=proposal, resample_threshold=threshold, **options)
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
slam = FastSlam(1, num_particles=40, resample_threshold=1.0, existence=ExistenceModel())
for size in (30, *(5 for _ in range(20))):
    slam.step([np.zeros(3)], [Measurements(points[:size], looks[:size])])
assert slam.num_landmarks < 30  # some are given up
team = TeamSlam(2, num_particles=7, attempts=AttemptOptions(every=1))
for size in (1, 3, 9, 30, 30, 30):
    team.step([None, None], [Measurements(points[:size], looks[:size])] * 2)
team.step(np.zeros((2, 3)), TeamMeasurements(np.tile(points, (2, 1)), np.tile(looks, (2, 1)), np.array([30, 60])))
assert len(team.groups) == 1
team.team_poses(), team.map_summaries()
slices = SmoothingOptions(incremental=True, rigid_within=0.01, max_keys=12, further_keys=4, recent_keys=6)
for smoothing in (slices, SmoothingOptions()):
    simulation = SimulatedTeam(2, seed=100)
    smoothed = simulation.build(
        rejuvenate_every=20, smoothing=smoothing, attempts=AttemptOptions(every=5),
        merging=MergeOptions(watch_every=5, min_sigmas=0.0),
    )
    told = simulation.run(smoothed, 100)
    assert len(smoothed.groups) == 1
    assert any(report.rejuvenations for report in told if len(report.groups) == 1)
align_maps(team.map(0), team.map(1))
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
    with watch_compilation(lambda name: None) as watch:
        seconds = warm_up(everything=True)
    assert (watch.names, seconds) == ([], 0.0)


def test_collections_after_a_warm_up_search_only_what_is_new() -> None:
    """The objects of the kernels are left out; cycles made later are found."""
    warm_up()
    assert gc.get_freeze_count() > 10_000
    assert len(gc.get_objects()) < 1000
    cycle: list[Any] = []
    cycle.append(cycle)
    name = id(cycle)
    del cycle
    assert gc.collect() > 0
    assert all(id(found) != name for found in gc.get_objects())


def test_compilation_progress_reports_only_kernels_of_this_project() -> None:
    """A kernel of this project is announced once, with its parts; those of others, and what is compiled, are not."""
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


COMPILING = """
import numba, slam_backend
for module in ("slam_backend.a", "slam_backend.b", "somebody.else"):
    def kernel(x): return x
    kernel.__module__ = module
    numba.njit(kernel)(1.0)
"""


def test_compilations_are_logged() -> None:
    """The first compilation of a process is logged with level INFO, each one with DEBUG; nothing is printed."""
    code = (
        """
import logging
logging.basicConfig(format="%(levelname)s %(name)s %(message)s")
logging.getLogger("slam_backend").setLevel(logging.DEBUG)
"""
        + COMPILING
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    each = [f"DEBUG slam_backend Compiling slam_backend.{name}.kernel" for name in "ab"]
    assert (done.stdout, done.stderr.splitlines()) == ("", [f"INFO slam_backend {MESSAGE}", *each])


def test_a_program_that_configured_no_logging_prints_why_it_waits() -> None:
    """One line on stderr says so; where the first compilation is ahead of time, too."""
    for code in (COMPILING, "from slam_backend.core.compilation.messages import announce; announce()\n" + COMPILING):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert (done.stdout, done.stderr.splitlines()) == ("", [MESSAGE])


def classes_of(hint: Any) -> set[type]:
    """Return the project's own classes that an annotation names."""
    if isinstance(hint, type) and not isinstance(hint, UnionType):
        return {hint} if hint.__module__.startswith("slam_backend.") else set()
    return set().union(*(classes_of(part) for part in get_args(hint)))


@pytest.mark.parametrize(
    "described",
    [FastSlam.from_options, FastSlam.step, FastSlam.rejuvenate, FilterOptions, StepReport, TeamSlam.__init__],
)
def test_arguments_and_results_of_a_filter_are_public_names(described: Any) -> None:
    """Every argument and result type is a name of `slam_backend`."""
    found = set().union(*(classes_of(hint) for hint in get_type_hints(described).values()))
    assert found
    assert {kind.__name__ for kind in found} <= set(slam_backend.__all__)


def test_all_public_names_exist_in_order() -> None:
    """Each name in `__all__` exists, and the list is sorted."""
    assert all(hasattr(slam_backend, name) for name in slam_backend.__all__)
    assert slam_backend.__all__ == sorted(slam_backend.__all__)


def test_a_team_report_holds_the_public_rejuvenation_report() -> None:
    """The rejuvenations of a team report are of the class that the package exports."""
    assert slam_backend.RejuvenationReport in classes_of(get_type_hints(TeamReport)["rejuvenations"])
