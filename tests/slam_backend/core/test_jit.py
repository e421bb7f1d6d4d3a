"""How kernels are compiled, kept, found again and warmed up; public names."""

import importlib.util
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
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
from slam_backend.core.compilation import MESSAGE, watch_compilation
from slam_backend.core.kernel_cache import CheckedFile
from slam_backend.warm_up import warm_up


def test_this_version_of_numba_can_leave_references_uncounted() -> None:
    """The option is numba's own: where it has gone, all works as before, but slower."""
    assert _jit.HAS_NRT_OPTION


@pytest.mark.parametrize("compiled", [_jit.in_place, _jit.inline, _jit.simd, _jit.simd_inline, _jit.simd_sum])
def test_kernels_that_work_in_place_can_make_no_array(compiled: Callable[[Any], Any]) -> None:
    """Its counter would be missing: numba refuses to compile them."""

    def makes_one(x: float) -> float:
        row = np.zeros(3)
        row[0] = x
        return float(row[0])

    with pytest.raises(NumbaError, match=r"zeros|NRT"):
        python_entry(compiled(makes_one))(1.0)


def test_kernels_that_count_may_call_those_that_do_not_and_the_other_way_round() -> None:
    """What is not counted by one is none of the other's business."""

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


def test_references_are_counted_everywhere_where_numba_does_not_know_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels then work as before, and may do more."""
    monkeypatch.setattr(_jit, "HAS_NRT_OPTION", False)

    def makes_one(x: float) -> float:
        return float(np.full(3, x).sum())

    assert _jit.in_place(makes_one)(2.0) == 6.0


def test_rooms_of_a_kernel_are_apart_and_stay_through_its_loops() -> None:
    """A loop does not take more room in each turn, and what it wrote last time is still there."""

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
def test_rooms_hold_numbers_of_any_type(dtype: Any) -> None:
    """They are laid out one behind the other, and wrap around as numbers of that type do."""

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


def test_the_size_of_a_room_is_a_constant() -> None:
    """The stack has no room of a size that compilation does not know."""

    def fill(size: int) -> float:
        return float(_jit.stack_array(size)[0])

    with pytest.raises(NumbaError):
        _jit.in_place(fill)(3)


def test_the_result_of_a_kernel_does_not_depend_on_which_kernel_asks_for_it_first() -> None:
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


def test_entries_of_two_processes_that_save_at_the_same_time_are_never_mixed_up(tmp_path: Any) -> None:
    """Whatever the order of their writes, an entry holds what was compiled for it, or is missing."""
    one, other = (CheckedFile(str(tmp_path), "kernel-1", "stamp") for _ in range(2))
    one._load_index = lambda: {}  # both have read the index before either wrote
    other._load_index = lambda: {}
    one.save("float64", "code of float64")
    other.save("int64", "code of int64")
    reader = CheckedFile(str(tmp_path), "kernel-1", "stamp")
    assert reader.load("int64") == "code of int64"
    assert reader.load("float64") in (None, "code of float64")
    assert CheckedFile(str(tmp_path), "kernel-1", "another stamp").load("int64") is None


def test_options_are_part_of_what_an_entry_of_the_cache_is_checked_for() -> None:
    """A kernel that is compiled in another way is not loaded from the entry of before."""

    def double(x: float) -> float:
        return 2.0 * x

    stamps = [kind(double)._cache._cache_file._source_stamp for kind in (_jit.jit, _jit.jit_fma, _jit.in_place)]
    stamps.append(_jit.device(_jit.jit(double))._cache._cache_file._source_stamp)
    assert all(stamps.count(stamp) == 1 for stamp in stamps)
    assert stamps[0] == _jit.jit(double)._cache._cache_file._source_stamp


KERNEL = """
from slam_backend.core.jit import jit

@jit
def kernel_of_a_test(x):
    return x + 1
"""
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "one byte": lambda content: content[:1],
    "cut in the middle": lambda content: content[: len(content) // 2],
    "last byte gone": lambda content: content[:-1],
    "zeros": lambda content: bytes(len(content)),
    "noise": lambda content: np.random.default_rng(1).bytes(len(content)),
    "first byte": lambda content: bytes([content[0] ^ 1]) + content[1:],
    "a bit in the middle": lambda content: (
        content[: len(content) // 2] + bytes([content[len(content) // 2] ^ 8]) + content[len(content) // 2 + 1 :]
    ),
    "another pickle": lambda content: pickle.dumps("another"),
    "as numba alone writes it": lambda content: content[:-32],
}


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], tuple[Any, bool]]:
    """Call the kernel as a new process would; return its answer and whether it had to be compiled."""
    file = tmp_path / "module_of_a_test.py"
    file.write_text(KERNEL)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def call(x: Any) -> tuple[Any, bool]:
        spec = importlib.util.spec_from_file_location("module_of_a_test", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        with watch_compilation(lambda name: None) as watch:
            answer = module.kernel_of_a_test(x)
        return answer, watch._begin != 0.0

    return call


def _files(tmp_path: Path, kind: str) -> list[Path]:
    return sorted((tmp_path / "cache").rglob(f"*.{kind}"))


@pytest.mark.parametrize("kinds", [("nbi",), ("nbc",), ("nbi", "nbc")])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_written_again(
    damage: str, kinds: tuple[str, ...], play: Callable[[Any], tuple[Any, bool]], tmp_path: Path
) -> None:
    """Whatever happened to index and data, the kernel is right, is compiled once, and is in the cache afterwards."""
    assert play(1) == (2, True)
    assert play(1) == (2, False)
    for kind in kinds:
        (file,) = _files(tmp_path, kind)
        file.write_bytes(DAMAGES[damage](file.read_bytes()))
    assert play(1) == (2, True)
    assert play(1) == (2, False)
    assert {file.suffix for file in _files(tmp_path, "*")} == {".nbi", ".nbc"}


def test_nothing_of_a_damaged_file_is_run(play: Callable[[Any], tuple[Any, bool]], tmp_path: Path) -> None:
    """A pickle that would run code is not unpickled, as its check does not hold."""

    class Forged:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "run"),)

    play(1)
    for kind in ("nbi", "nbc"):
        (file,) = _files(tmp_path, kind)
        file.write_bytes(pickle.dumps(Forged()))
        assert play(1) == (2, True)
    assert not (tmp_path / "run").exists()


def test_data_of_another_signature_are_not_taken(play: Callable[[Any], tuple[Any, bool]], tmp_path: Path) -> None:
    """Data files that have changed places, as two processes at a time can leave them, are compiled again."""
    assert (play(1), play(0.5)) == ((2, True), (1.5, True))
    one, other = _files(tmp_path, "nbc")
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])
    assert (play(1), play(0.5)) == ((2, True), (1.5, True))
    assert (play(1), play(0.5)) == ((2, False), (1.5, False))


@pytest.mark.parametrize("what", ["caching.os.replace", "caching.FunctionCache.save_overload"])
def test_a_cache_that_takes_nothing_stops_nothing(
    what: str, play: Callable[[Any], tuple[Any, bool]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk, and where the folder takes no files any more, kernels are compiled and not kept."""

    def fail(*_: Any) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(f"numba.core.{what}", fail)
        assert play(1) == (2, True)
    assert not _files(tmp_path, "*")
    assert play(1) == (2, True)
    assert play(1) == (2, False)


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
slices = SmoothingOptions(slice_steps=20, rigid_within=0.01, max_keys=12, further_keys=4, recent_keys=6)
for smoothing in (slices, SmoothingOptions()):
    simulation = SimulatedTeam(2, seed=100)
    smoothed = simulation.build(
        rejuvenate_every=20, smoothing=smoothing, attempts=AttemptOptions(every=5),
        merging=MergeOptions(watch_every=5, min_sigmas=0.0),
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
    """A folder that is only read, and no home: kernels are compiled again in each process, with the same results."""
    usual = numba.njit

    def without_place(**options: Any) -> Any:
        def refuse(function: Callable[..., float]) -> Any:
            raise RuntimeError(f"cannot cache function {function.__name__!r}: no locator available")

        return refuse if options.get("cache") else usual(**options)

    monkeypatch.setattr(numba, "njit", without_place)

    def double(x: float) -> float:
        return 2.0 * x

    for kind in (_jit.jit, _jit.inline, _jit.simd, _jit.simd_inline):
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
            f"from slam_backend.core.jit import inline\n\n\n@inline\ndef answer(x):\n    return x + {number}\n"
        )
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from {name}.caller import ask; print(ask(0.0))"
        answers.append(float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout))
    assert answers == [1.0, 2.0]


def test_a_watch_hears_of_our_kernels_only() -> None:
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


def classes_of(hint: Any) -> set[type]:
    """Return the project's own classes that an annotation names."""
    if isinstance(hint, type) and not isinstance(hint, UnionType):
        return {hint} if hint.__module__.startswith("slam_backend.") else set()
    return set().union(*(classes_of(part) for part in get_args(hint)))


@pytest.mark.parametrize(
    "described",
    [FastSlam.__init__, FastSlam.step, FastSlam.rejuvenate, FilterOptions, StepReport, TeamSlam.__init__],
)
def test_what_a_filter_takes_and_tells_needs_no_inner_module(described: Any) -> None:
    """Whatever is to be built, or comes back, is a name of `slam_backend`."""
    found = set().union(*(classes_of(hint) for hint in get_type_hints(described).values()))
    assert found
    assert {kind.__name__ for kind in found} <= set(slam_backend.__all__)


def test_all_public_names_are_there() -> None:
    """Nothing is promised that is missing, and the list is in order."""
    assert all(hasattr(slam_backend, name) for name in slam_backend.__all__)
    assert slam_backend.__all__ == sorted(slam_backend.__all__)


def test_a_team_report_holds_reports_by_their_public_name() -> None:
    """What a team tells of rejuvenations is the class that the package names."""
    assert slam_backend.RejuvenationReport in classes_of(get_type_hints(TeamReport)["rejuvenations"])
