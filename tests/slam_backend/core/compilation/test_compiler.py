"""Kernels are compiled in advance by several processes, into the cache that later processes read."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from numba import types

from slam_backend.core.compilation.compiler import (
    Task,
    compile_kernels,
    decode_signature,
    divide_tasks,
    encode_signature,
    find_kernel,
    missing_tasks,
    recorded_signatures,
)

ROOT = Path(__file__).parents[4]


class Row(NamedTuple):
    """Fields of a record."""

    left: Any
    right: Any


class Cell(NamedTuple):
    """A record with one field."""

    value: Any


def tuple_of(record: Any, *fields: types.Type) -> Any:
    """Return numba's type of a named tuple."""
    from_types: Any = types.BaseTuple.from_types
    return from_types(fields, record)


SMALL = "slam_backend.geometry._invert_rows"  # a kernel that calls few others
PROGRAM = """
import sys
from slam_backend.core.compilation.compiler import compile_kernels, missing_tasks, recorded_signatures
name = sys.argv[1]
wanted = {name: recorded_signatures("slam_backend")[name]}
counts = []
missing = len(missing_tasks(wanted))
compile_kernels(wanted, 2, lambda done, total, left: counts.append((done, total)))
print(missing, len(missing_tasks(wanted)), counts)
"""


def program(folder: Path, **variables: str) -> str:
    """Return what a process prints that compiles a small kernel in advance, with a cache of its own."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(ROOT)} | variables
    command = [sys.executable, "-c", PROGRAM, SMALL]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize(
    "signature",
    [
        (types.int64, types.float64, types.boolean),
        (types.Array(types.float32, 2, "C"), types.Array(types.int8, 1, "C", readonly=True)),
        (types.Array(types.boolean, 3, "F"), types.Array(types.uint64, 1, "A")),
        (tuple_of(Row, types.Array(types.float64, 2, "C"), types.int64), types.float64),
        (tuple_of(Row, types.int64, types.int64), tuple_of(Cell, types.int64)),
        (tuple_of(tuple, types.int64, types.float64), tuple_of(tuple, types.int64, types.int64)),
        (),
    ],
)
def test_signatures_survive_their_notation(signature: tuple[types.Type, ...]) -> None:
    """Decoding what was encoded gives the same types."""
    assert decode_signature(encode_signature(signature)) == signature


@pytest.mark.parametrize("package", ["slam_backend", "vslam_env"])
def test_recorded_kernels_exist(package: str) -> None:
    """Each recorded name is a kernel, and each signature can be read."""
    for name, signatures in recorded_signatures(package).items():
        assert find_kernel(name) is not None
        assert [encode_signature(decode_signature(words)) for words in signatures] == signatures


@pytest.mark.parametrize("workers", [1, 2, 3, 8])
def test_each_kernel_is_given_to_one_worker(workers: int) -> None:
    """All tasks are shared out once, and the workers' loads differ by no more than one task."""
    tasks = [Task(f"k{i}", "int64", {f"k{i}": 10 + i, "common": 5}) for i in range(20)]
    shares = divide_tasks(tasks, workers)
    assert sorted(task.name for share in shares for task in share) == sorted(task.name for task in tasks)
    loads = [5 + sum(10 + int(task.name[1:]) for task in share) for share in shares]
    assert len(shares) == workers
    assert max(loads) - min(loads) <= 30


def test_a_process_compiles_what_the_cache_lacks(tmp_path: Path) -> None:
    """After it nothing is missing; a second process has nothing to do, and tells nothing."""
    assert program(tmp_path) == "1 0 [(0, 1), (1, 1)]"
    assert program(tmp_path) == "0 0 []"


@pytest.mark.slow
@pytest.mark.nightly
def test_damaged_files_are_missing(tmp_path: Path) -> None:
    """A file that is truncated counts as not kept."""
    program(tmp_path)
    file = next(tmp_path.rglob("_invert_rows-*.nbc"))
    file.write_bytes(file.read_bytes()[:-3])
    assert program(tmp_path) == "1 0 [(0, 1), (1, 1)]"


EXPECTING = """
from slam_backend.core.compilation.compiler import decode_signature, expect, find_kernel, missing_tasks
from slam_backend.core.compilation.compiler import recorded_signatures, showing
from slam_backend.core.compilation.messages import watch_compilation
counts = []
names = ["slam_backend.geometry._invert_rows", "slam_backend.geometry._compose_rows"]
needed = {name: recorded_signatures("slam_backend")[name] for name in names}
expect(lambda: needed)
with watch_compilation(lambda name: None) as watch, showing(lambda done, total, left: counts.append((done, total))):
    find_kernel(names[0]).compile(decode_signature(needed[names[0]][0]))
print(len(watch.names), len(missing_tasks(needed)), counts)
"""


def test_the_first_kernel_that_is_missing_is_compiled_with_all_that_is_expected(tmp_path: Path) -> None:
    """Other processes compile both kernels, with their count, and this one loads the first; one core compiles one."""
    for cores, printed in ((2, "0 0 [(0, 2), (1, 2), (2, 2)]"), (1, "1 1 []")):
        cores_of = f"import os; os.sched_getaffinity = lambda pid: range({cores})"
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / str(cores)), "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", cores_of + EXPECTING]
        found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert found.stdout.strip() == printed


def test_without_a_compiler_nothing_is_missing(tmp_path: Path) -> None:
    """Where kernels are plain functions nothing is compiled."""
    assert program(tmp_path, NUMBA_DISABLE_JIT="1") == "0 0 []"


def test_bad_numbers_of_workers_are_refused() -> None:
    """They are named, before anything is compiled."""
    with pytest.raises(ValueError, match="workers: expected an int >= 1, got 0"):
        compile_kernels({}, 0)


def test_what_is_compiled_here_is_not_missing() -> None:
    """The kernels of this process come from a warm cache."""
    assert missing_tasks({SMALL: recorded_signatures("slam_backend")[SMALL]}) == []
