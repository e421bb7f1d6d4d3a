"""A damaged cache of kernels is no fault: what cannot be used is compiled and kept again."""

import importlib.util
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from slam_backend.core.compilation import watch_compilation

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
def test_damaged_files_are_written_anew(
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
