"""Kernels are kept on disk, found again, and never taken from a file that is stale, damaged or anybody else's."""

import importlib.util
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.compiler import Compiler

from slam_backend.core import jit as _jit
from slam_backend.core.compilation import cache, shipped
from slam_backend.core.compilation.cache import KernelCache, cache_folder, is_private
from slam_backend.core.compilation.messages import watch_compilation
from slam_backend.core.compilation.stamp import stamp_of

ROOT = Path(__file__).parents[4]
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


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test is warned as a new process would be, and looks for folders again."""
    monkeypatch.setattr(shipped, "_warned", set())
    cache_folder.cache_clear()


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


def _files(tmp_path: Path) -> list[Path]:
    """Return the files of the kernel; others may be written meanwhile, since all kernels have one cache folder."""
    return sorted((tmp_path / "cache").rglob("kernel_of_a_test*"))


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_written_again(
    damage: str, play: Callable[[Any], tuple[Any, bool]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever happened to the file, the kernel is right, compiled once, and kept afterwards; one line says so."""
    assert play(1) == (2, True)
    assert play(1) == (2, False)
    (file,) = _files(tmp_path)
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    assert play(1) == (2, True)
    assert play(1) == (2, False)
    assert _files(tmp_path) == [file]
    assert [record.getMessage() for record in caplog.records] == [f"{file} is damaged: the kernel is compiled again."]


def test_nothing_of_a_damaged_file_is_run(play: Callable[[Any], tuple[Any, bool]], tmp_path: Path) -> None:
    """A pickle that would run code is not unpickled, as its check does not hold."""

    class Forged:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "run"),)

    play(1)
    (file,) = _files(tmp_path)
    file.write_bytes(pickle.dumps(Forged()))
    assert play(1) == (2, True)
    assert not (tmp_path / "run").exists()


def test_data_of_another_signature_are_not_taken(play: Callable[[Any], tuple[Any, bool]], tmp_path: Path) -> None:
    """Files that have changed places are compiled again."""
    assert (play(1), play(0.5)) == ((2, True), (1.5, True))
    one, other = _files(tmp_path)
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])
    assert (play(1), play(0.5)) == ((2, True), (1.5, True))
    assert (play(1), play(0.5)) == ((2, False), (1.5, False))


def test_a_cache_that_takes_nothing_stops_nothing(
    play: Callable[[Any], tuple[Any, bool]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """On a full disk kernels are compiled and not kept; one line says so."""

    def fail(*_: Any) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(cache.os, "replace", fail)
        assert (play(1), play(0.5)) == ((2, True), (1.5, True))
    told = "Compiled kernels are not kept (No space left on device): each process compiles them."
    assert [record.getMessage() for record in caplog.records] == [told]
    assert not [file for file in (tmp_path / "cache").rglob("*") if file.is_file()]
    assert play(1) == (2, True)
    assert play(1) == (2, False)


def test_kernels_work_where_no_cache_can_be_written(
    play: Callable[[Any], tuple[Any, bool]], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A folder that is only read, and no home: kernels are compiled again in each process, with the same results."""
    monkeypatch.setattr(cache, "cache_folder", lambda *_: None)
    assert (play(1), play(1)) == ((2, True), (2, True))
    told = "Compiled kernels are not kept (no folder can be written): each process compiles them."
    assert [record.getMessage() for record in caplog.records] == [told]


def test_kernels_of_sources_that_are_only_read_are_kept_in_the_users_own_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is made for the user alone."""
    monkeypatch.setattr(cache, "_user_cache", lambda: str(tmp_path / "home"))
    (tmp_path / "sources").touch()  # a folder in it cannot be made
    folder = cache_folder(tmp_path / "sources")
    assert folder is not None
    assert folder.is_relative_to(tmp_path / "home")
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="modes of files are those of POSIX")
def test_folders_to_which_others_may_write_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What is kept there would be run; another folder is taken, and one line says so."""
    monkeypatch.setattr(cache, "_user_cache", lambda: str(tmp_path / "home"))
    folder = cache_folder(tmp_path, str(tmp_path / "cache"))
    assert folder is not None
    folder.chmod(0o777)
    cache_folder.cache_clear()
    assert cache_folder(tmp_path, str(tmp_path / "cache")) == tmp_path / "__pycache__"
    (record,) = caplog.records
    told = f"Kernels are not kept in {folder}: it belongs to another user, or others may write to it."
    assert record.getMessage() == told


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="modes of files are those of POSIX")
def test_files_to_which_others_may_write_are_not_read(
    play: Callable[[Any], tuple[Any, bool]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They are written again, for the user alone."""
    play(1)
    (file,) = _files(tmp_path)
    file.chmod(0o666)
    assert play(1) == (2, True)
    assert play(1) == (2, False)
    assert file.stat().st_mode & 0o777 == 0o600
    told = f"{file} is not read: it belongs to another user, or others may write to it."
    assert [record.getMessage() for record in caplog.records] == [told]


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="modes of files are those of POSIX")
@pytest.mark.parametrize(
    ("user", "mode", "is_own", "expected"),
    [
        (0, 0o700, False, True), (0, 0o755, False, True), (0, 0o775, False, False), (0, 0o775, True, True),
        (0, 0o777, True, False), (1, 0o700, True, False),
    ],
)  # fmt: skip
def test_who_may_write_to_a_folder(user: int, mode: int, is_own: bool, expected: bool) -> None:
    """The user alone, and a group that has no other member."""
    status = os.stat_result((mode, 0, 0, 0, os.geteuid() + user, 7, 0, 0, 0, 0))
    assert is_private(status, lambda group, owner: is_own and (group, owner) == (7, os.geteuid())) is expected


@pytest.mark.slow
@pytest.mark.nightly
def test_files_of_older_sources_are_removed(tmp_path: Path) -> None:
    """An edited kernel leaves one file, as do other signatures."""
    for number in (1, 1, 2):
        _run_edited(tmp_path, number)
    assert len(list((tmp_path / "cache").rglob("ask-*.nbc"))) == 1


# ---------------------------------------------------------------------- stamps


def test_options_are_part_of_what_a_kernel_is_compiled_from() -> None:
    """A kernel that is compiled in another way is not loaded from the entry of before."""

    def double(x: float) -> float:
        return 2.0 * x

    stamps = [_stamp(kind(double)) for kind in (_jit.jit, _jit.jit_fma, _jit.in_place)]
    stamps.append(_stamp(_jit.device(_jit.jit(double))))
    assert all(stamps.count(stamp) == 1 for stamp in stamps)
    assert stamps[0] == _stamp(_jit.jit(double))
    own: Any = _jit.device(_jit.jit(double))
    own._compiler.pipeline_class = Compiler
    assert _stamp(own) not in stamps


def _stamp(kernel: Any) -> str:
    return stamp_of(kernel)


CALLER = """
from slam_backend.core.jit import jit
{first}

@jit
def ask(x):
    return {body}
"""
MIDDLE = """
from slam_backend.core.jit import device, jit
from callee_of_a_test import answer

@device
@jit
def through(x):
    return answer(x)
"""
CALLEE = """
from slam_backend.core.jit import inline

NUMBER = {number}

@inline
def answer(x):
    return x + NUMBER
"""
ASK = "import sys; sys.path.insert(0, sys.argv[1]); from caller_of_a_test import ask; print(ask(0.0))"


def _run_edited(folder: Path, number: float, first: str = "", body: str = "through(x)") -> float:
    """Return what a new process answers with a callee that is edited."""
    first = first or "from middle_of_a_test import through"
    (folder / "caller_of_a_test.py").write_text(CALLER.format(first=first, body=body))
    (folder / "middle_of_a_test.py").write_text(MIDDLE)
    (folder / "callee_of_a_test.py").write_text(CALLEE.format(number=number))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1"}  # sources change within a second
    command = [sys.executable, "-c", ASK, str(folder)]
    return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("first", "body"),
    [
        ("from middle_of_a_test import through", "through(x)"),
        ("from callee_of_a_test import answer", "answer(x)"),
        ("from callee_of_a_test import NUMBER", "x + NUMBER"),
        ("import callee_of_a_test as callee", "callee.answer(x)"),
        ("from callee_of_a_test import NUMBER\nROW = (0.0, NUMBER)", "x + ROW[1]"),
    ],
    ids=["callee of a callee", "callee", "constant", "callee of a module", "constant in a tuple"],
)
def test_an_edit_of_whatever_a_kernel_reaches_is_noticed(first: str, body: str, tmp_path: Path) -> None:
    """A callee, in whatever module, and a constant are compiled into a kernel; neither lingers in the cache."""
    assert [_run_edited(tmp_path, number, first, body) for number in (1.0, 2.0, 1.0)] == [1.0, 2.0, 1.0]


def test_an_edit_of_something_else_recompiles_nothing(tmp_path: Path) -> None:
    """Lines that move, comments, and other functions of the same file do not change a stamp."""
    source = "from slam_backend.core.jit import jit\n\n@jit\ndef kernel(x):\n    return x + 1\n"
    edited = source.replace("\n\n", "\n# A comment\nOTHER = 3\n\n\n") + "\ndef other(x):\n    return x\n"
    stamps = []
    for text in (source, edited, source.replace("+ 1", "+ 2")):
        scope: dict[str, Any] = {}
        exec(compile(text, "kernel_of_a_test.py", "exec"), scope)
        stamps.append(_stamp(scope["kernel"]))
    assert stamps[0] == stamps[1] != stamps[2]


RECORD = """
from typing import NamedTuple

from slam_backend.core.jit import jit

class Record(NamedTuple):
    {fields}

@jit
def taken(record):
    return record.x - record.y

@jit
def made(x, y):
    return Record(x=x, y=y).x
"""


def test_other_fields_of_a_record_are_noticed() -> None:
    """A kernel reads fields by their place: a record whose fields of one type are swapped is another argument."""
    names, stamps = [], []
    for fields in ("x: float\n    y: float", "y: float\n    x: float"):
        scope: dict[str, Any] = {"__name__": "module_of_a_test"}
        exec(compile(RECORD.format(fields=fields), "module_of_a_test.py", "exec"), scope)
        signature = (numba.typeof(scope["Record"](1.0, 2.0)),)
        names.append(KernelCache(scope["taken"]).file_name(signature, ("triple", "processor", "")))
        stamps.append(_stamp(scope["made"]))
    assert names[0] != names[1]
    assert stamps[0] != stamps[1]


def test_a_stamp_tells_apart_what_looks_alike() -> None:
    """Equal numbers of other types, and arrays of other values, give other machine code."""
    values = [1, 1.0, True, np.float32(1), np.float64(1), np.array([1.0, 2.0]), np.array([1.0, 3.0]), (1, 2), [1, 2]]
    stamps = set()
    for value in values:
        scope = {"jit": _jit.jit, "VALUE": value}
        exec("@jit\ndef kernel(x):\n    return x + VALUE", scope)
        stamps.add(_stamp(scope["kernel"]))
    assert len(stamps) == len(values)


def test_a_kernel_that_names_what_no_stamp_can_cover_is_refused() -> None:
    """Its value could change unnoticed."""
    scope: dict[str, Any] = {"jit": _jit.jit, "VALUE": {}}
    exec("@jit\ndef kernel(x):\n    return VALUE", scope)
    with pytest.raises(TypeError, match="constant of a kernel: expected a number, text, array or tuple, got dict"):
        stamp_of(scope["kernel"])


def test_without_a_compiler_kernels_run_as_plain_python() -> None:
    """Everything works, slowly, with the same results within rounding; one line says so."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    code = "import numpy as np, slam_backend as s; f = s.FastSlam(num_particles=3); "
    code += "m = s.Measurements(np.eye(3) + 2.0, np.eye(3, 64, dtype=np.float32)); "
    code += "[f.step([(0.0, 0.0, 0.1)], [m]) for _ in range(3)]; print(*f.map().means.ravel())"
    outputs = []
    for variables in ({}, {"NUMBA_DISABLE_JIT": "1"}):
        command = [sys.executable, "-W", "error", "-c", code]
        done = subprocess.run(command, env=environment | variables, capture_output=True, text=True, check=True)
        outputs.append(np.array(done.stdout.split(), dtype=float))
    assert done.stderr == "NUMBA_DISABLE_JIT is set: kernels run as plain Python, some hundred times as slow.\n"
    assert len(outputs[0]) == 9
    np.testing.assert_allclose(*outputs, rtol=1e-9)


def test_without_a_compiler_nothing_is_warmed_up_and_all_paths_run_without_warnings() -> None:
    """Numbers of numpy warn of overflow and of division by zero, which compiled kernels allow."""
    code = "import vslam_env; assert vslam_env.warm_up(everything=True) == 0.0; "
    code += "from vslam_env._warm_up import _run_all_paths; _run_all_paths({'existence', 'planners'})"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-W", "error", "-c", code], env=environment, check=True)
