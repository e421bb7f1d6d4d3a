"""Snapshots of an environment: their version, their check, and their form on disk."""

import dataclasses
import hashlib
import pickle
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from os import PathLike, replace
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np

from slam_backend.errors import bad_argument
from vslam_env.config import EnvConfig

STATE_FORMAT = 27  # raised when what a state holds changes; a state goes on bit by bit only with what made it
MAGIC = b"vslam_env state "
KEYS = ("version", "config", "root", "agents", "cycle", "episode", "drivers", "standing")

EnvState = dict[str, Any]


@cache
def state_version() -> str:
    """Return what a state is marked with: the number of its format and the version of the package."""
    try:
        package = version("vslam-env")
    except PackageNotFoundError:  # run from a source tree that was never installed
        package = "source"
    return f"{STATE_FORMAT}/{package}"


def check_state(state: Any, config: EnvConfig) -> Mapping[str, Any]:
    """Return a state if an environment of `config` can go on from it.

    Raises:
        ValueError: If it is no state, one of another version, or one of another configuration.
    """
    found = _checked("state", state)
    if found["config"] != config:
        name, ours, theirs = _difference(config, found["config"])
        cure = "Restore into an environment of the same configuration."
        raise bad_argument("state", f"one made with {name} = {_short(ours)}", theirs, cure)
    return found


def save_state(state: Mapping[str, Any], path: str | Path) -> None:
    """Write a state of `get_state` to a file; an interrupted write leaves no file, or the old one.

    A file of that name is replaced; what is there and no file is refused. The file is a pickle, marked and with its
    SHA-256: like any pickle, load it only from where you would run code from.

    Raises:
        ValueError: If it is no state of this version, or the file cannot be written.
    """
    _checked("state", state)
    path = _checked_path(path)
    try:
        if path.exists() and not path.is_file():
            raise bad_argument("path", "a file that can be written", str(path), "There is something else, no file.")
        part = path.with_name(f"{path.name}.{token_hex(8)}.part")
        with part.open("xb") as file:  # readable to whom the process lets read, which temporary files are not
            try:
                body = pickle.dumps(dict(state), protocol=5)
                file.write(MAGIC + f"{state['version']}\n{_fingerprint(body)}\n".encode() + body)
                file.close()
                replace(part, path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise bad_argument("path", "a file that can be written", str(path), f"The system says: {error}.") from error


def load_state(path: str | Path) -> EnvState:
    """Read a state that `save_state` wrote.

    Raises:
        ValueError: If there is no such file, it holds no state, a byte of it has changed, or it is of another version.
    """
    path = _checked_path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise bad_argument("path", "the file of a state", str(path), f"The system says: {error}.") from error
    head, _, body = content.partition(b"\n")
    if not head.startswith(MAGIC):
        raise bad_argument("path", "the file of a state", str(path), "Write one with save_state.")
    _check_version(str(path), head[len(MAGIC) :].decode(errors="replace"))  # before anything of it is unpickled
    mark, _, body = body.partition(b"\n")
    if mark.decode(errors="replace") != _fingerprint(body):
        raise bad_argument("path", "a whole file of a state", f"a damaged file {path}", "Save it again.")
    try:
        state = pickle.loads(body)
    except Exception as error:
        cure = f"Read it where it was written; reading says: {error}."
        raise bad_argument("path", "the file of a state that can be read here", str(path), cure) from error
    return dict(_checked(str(path), state))


def _fingerprint(body: bytes) -> str:
    return hashlib.sha256(body).hexdigest()


def sequence_state(sequence: np.random.SeedSequence | None) -> dict[str, Any] | None:
    """Return what a seed sequence is made of, its count of children included."""
    if sequence is None:
        return None
    names = ("entropy", "spawn_key", "pool_size", "n_children_spawned")
    return {name: getattr(sequence, name) for name in names}


def restored_sequence(state: Mapping[str, Any] | None) -> np.random.SeedSequence | None:
    """Return the seed sequence that `sequence_state` described."""
    return None if state is None else np.random.SeedSequence(**state)


def _checked_path(path: Any) -> Path:
    """Return a path that can name a file."""
    if not isinstance(path, (str, PathLike)) or "\0" in str(path):
        raise bad_argument("path", "the path of a file", path, "Give a text or a Path, without NUL characters.")
    return Path(path)


def _check_version(name: str, found: Any) -> None:
    if found != state_version():
        cure = "Go on with the version that made it; only the same one goes on bit by bit."
        raise bad_argument(name, f"a state of version {state_version()!r}", found, cure)


def _checked(name: str, state: Any) -> Mapping[str, Any]:
    """Return a state of this version, or refuse it; another version's may have other parts, so that is said first."""
    expected, cure = "what get_state returned", "Pass it unchanged."
    if not isinstance(state, Mapping):
        raise bad_argument(name, expected, f"a {type(state).__name__}", cure)
    if "version" in state:
        _check_version(name, state["version"])
    for key in KEYS:
        if key not in state:
            raise bad_argument(name, expected, f"a mapping without {key!r}", cure)
    if not isinstance(state["config"], EnvConfig):
        raise bad_argument(name, expected, f"a mapping whose config is a {type(state['config']).__name__}", cure)
    return state


def _difference(ours: Any, theirs: Any, name: str = "") -> tuple[str, Any, Any]:
    """Return where two unequal configurations differ first: the field, through nested parts, and both values."""
    if not dataclasses.is_dataclass(ours) or type(ours) is not type(theirs):
        return name, ours, theirs
    pairs = ((f.name, getattr(ours, f.name), getattr(theirs, f.name)) for f in dataclasses.fields(ours))
    field, own, other = next(pair for pair in pairs if pair[1] != pair[2])
    return _difference(own, other, f"{name}.{field}" if name else field)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
