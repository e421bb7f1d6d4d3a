"""Kernels are compiled by other processes while a program compiles and runs what it calls first."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from slam_backend.core.compilation import ahead, compiler
from slam_backend.core.compilation.cache import cache_folder

ROOT = Path(__file__).parents[4]
# Expects two kernels, does something when the first is compiled, and calls the second; prints what it has compiled.
PROGRAM = """
import os, signal, sys, time
from slam_backend.core.compilation import ahead
from slam_backend.core.compilation.compiler import decode_signature, find_kernel, missing_tasks, recorded_signatures
from slam_backend.core.compilation.messages import watch_compilation
ahead.available_cores = lambda: int(sys.argv[1])
names = ["slam_backend.smoother.reassociation.find_only", "slam_backend.geometry._invert_rows"]
needed = {name: recorded_signatures("slam_backend")[name] for name in names}
ahead.expect(lambda: needed)
with watch_compilation(lambda name: None) as watch:
    for name in names:
        find_kernel(name).compile(decode_signature(needed[name][0]))
        if name == names[0]:
            exec(sys.argv[2])
print([name.rpartition(".")[2] for name in watch.names], len(missing_tasks(needed)))
"""
BOTH, FIRST, NONE = "['find_only', '_invert_rows'] 0", "['find_only'] 0", "[] 0"


def start(folder: Path, act: str = "pass", cores: int = 2, place: Path | None = None) -> "subprocess.Popen[str]":
    """Start the program with a cache of its own, from a file in a folder `place`, or as a command."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PROGRAM, str(cores), act]
    if place is not None:
        (place / "program.py").write_text(PROGRAM, encoding="utf-8")
        command[1:3] = [str(place / "program.py")]
    elsewhere = None if place is None else place / "elsewhere"
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, cwd=elsewhere)


def printed(folder: Path, act: str = "pass", cores: int = 2) -> str:
    """Return what the program prints."""
    process = start(folder, act, cores)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    return output.strip()


def test_a_kernel_that_a_worker_has_begun_is_waited_for(tmp_path: Path) -> None:
    """The program compiles one kernel, and finds the other in the cache; later none does anything."""
    assert printed(tmp_path) == FIRST
    assert printed(tmp_path, "assert ahead._helpers is None") == NONE


def test_workers_import_what_the_program_imports(tmp_path: Path) -> None:
    """Another `slam_backend` in the current folder, which the program does not import, is not imported by workers."""
    other = tmp_path / "elsewhere" / "slam_backend"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise ImportError\n", encoding="utf-8")
    program = start(tmp_path / "cache", place=tmp_path)
    assert program.communicate(timeout=300)[0].strip() == FIRST


def test_a_killed_worker_is_not_waited_for(tmp_path: Path) -> None:
    """The program compiles what the worker has not finished."""
    assert printed(tmp_path, "[worker.kill() for worker in ahead._helpers._workers]") in (BOTH, FIRST)


def test_on_one_core_no_worker_is_started(tmp_path: Path) -> None:
    """The program compiles both kernels itself."""
    assert printed(tmp_path, cores=1) == BOTH


def test_while_another_process_fills_the_cache_no_worker_is_started(tmp_path: Path) -> None:
    """The program compiles both kernels itself, and does not wait for the other process."""
    folder = cache_folder(Path(compiler.__file__).parent, str(tmp_path))
    assert folder is not None
    with FileLock(folder / compiler.LOCK):
        assert printed(tmp_path) == BOTH


def test_workers_compile_what_is_called_soon_first(tmp_path: Path) -> None:
    """Kernels that are called later come last, within both parts the longest first."""
    sizes = {"now.short": 1, "later.long": 9, "now.long": 5, "later.short": 2}
    tasks = [compiler.Task(name, "float64", {name: size}) for name, size in sizes.items()]
    helpers = ahead.Helpers(tasks, ("later.",), 0, FileLock(tmp_path / "lock"))
    assert [helpers._next_line().split()[0] for _ in tasks] == ["now.long", "now.short", "later.long", "later.short"]
    assert helpers._next_line() == ""


def test_a_waiting_program_compiles_what_it_will_call_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the awaited kernel is done, the longest first; kernels that are called later are left to workers."""
    names = ["now.awaited", "now.long", "now.short", "now.left", "later.long"]
    tasks = [compiler.Task(name, "float64", {name: 9 - place}) for place, name in enumerate(names)]
    helpers = ahead.Helpers(tasks, ("later.",), 0, FileLock(tmp_path / "lock"))
    awaited, compiled = helpers._next_line(), []

    def compile_lines(lines: Iterator[str], report: Any) -> None:
        compiled.append(next(lines).split()[0])
        if len(compiled) == 2:
            helpers._begun.discard(awaited)

    monkeypatch.setattr(ahead, "compile_lines", compile_lines)
    assert helpers.wait_for(awaited, helps=True)
    assert compiled == ["now.long", "now.short"]
    assert [helpers._next_line().split()[0] for _ in range(2)] == ["now.left", "later.long"]
    assert not helpers.wait_for("unknown float64", helps=True)


def test_first_steps_call_no_kernel_that_comes_last() -> None:
    """What environments expect to call later is not called before the first slice of smoothing; such kernels exist."""
    code = """
from slam_backend.core.compilation.compiler import compiled_signatures, recorded_signatures
from vslam_env import vslam_v0
from vslam_env.environment import LATER
env = vslam_v0.parallel_env()
env.reset(seed=0)
for _ in range(7):
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
called = [name for package in ("slam_backend", "vslam_env") for name in compiled_signatures(package)]
recorded = recorded_signatures("slam_backend", "vslam_env")
print(len(called) > 20, [name for name in called if name.startswith(LATER)])
print([start for start in LATER if not any(name.startswith(start) for name in recorded)])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["True []", "[]"], done.stderr


def test_a_warm_up_waits_for_no_worker() -> None:
    """It compiles with processes of its own; what is expected within it starts none."""
    ahead.expect(dict)
    with ahead.set_aside():
        assert ahead._needed is None
        ahead.expect(dict)
        assert ahead._needed is None


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_workers_end_with_a_killed_program(tmp_path: Path) -> None:
    """No process goes on compiling."""
    act = "print(*(worker.pid for worker in ahead._helpers._workers), flush=True); time.sleep(600)"
    program = start(tmp_path, act)
    assert program.stdout is not None
    worker = int(program.stdout.readline())
    os.kill(program.pid, signal.SIGKILL)
    program.wait()
    program.stdout.close()
    end = time.monotonic() + 60.0
    while time.monotonic() < end and Path(f"/proc/{worker}").exists():
        time.sleep(0.1)
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
