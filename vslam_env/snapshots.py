"""Snapshots of an environment: their version, their check, and their form on disk."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core import state_checks as check
from slam_backend.core.files import os_errors_as_argument_errors, write_file
from slam_backend.core.state_codec import ForeignObjectError, decode, encode, read_file, sequence_of
from slam_backend.core.validation import argument_error
from vslam_env.config import EnvConfig
from vslam_env.reward import RewardTerm, is_named
from vslam_env.simulation.episode import Episode
from vslam_env.simulation.scenario import Scenario
from vslam_env.state_checks import EpisodeCheck, check_drivers, check_standing
from vslam_env.state_kinds import ENV_KINDS
from vslam_env.world import WorldSource

STATE_FORMAT = 30  # raised when what a state holds changes; a state goes on bit by bit only with what made it
MAGIC = b"vslam_env state "
KEYS = ("version", "config", "objects", "root", "agents", "cycle", "episode", "drivers", "standing")

EnvState = dict[str, Any]


@cache
def state_version() -> str:
    """Return what a state is marked with: the number of its format and the version of the package."""
    try:
        package = version("vslam-env")
    except PackageNotFoundError:  # run from a source tree that was never installed
        package = "source"
    return f"{STATE_FORMAT}/{package}"


def snapshot_objects(source: WorldSource, terms: Sequence[RewardTerm]) -> dict[str, str]:
    """Return what of an environment are objects of the caller's, which no state holds: a word for each."""
    objects = {} if isinstance(source, (str, Path)) else {"world": type(source).__qualname__}
    return objects | {f"reward {term.name!r}": type(term).__qualname__ for term in terms if not is_named(term)}


def check_state(state: Any, config: EnvConfig, objects: Mapping[str, str]) -> Mapping[str, Any]:
    """Return a state if an environment of `config` can go on from it.

    Args:
        state: The value to check.
        config: Configuration of the environment.
        objects: Names of its parts that are objects of the caller's.

    Raises:
        ValueError: If it is no state, one of another version, or one of another configuration.
    """
    found = _checked("state", state)
    theirs_own = found["objects"]
    if not isinstance(theirs_own, dict) or not all(isinstance(name, str) for name in theirs_own):
        check.refuse("state['objects']", "a word for each object of the caller's", theirs_own)
    if found["config"] != config:
        name, ours, theirs = _difference(config, found["config"])
        cure = "Restore into an environment of the same configuration."
        if theirs_own and name in ("world", "reward"):
            cure = f"No state holds objects of your own: make the environment with the same {', '.join(theirs_own)}."
        raise argument_error("state", f"one made with {name} = {_short(ours)}", theirs, cure)
    if theirs_own != objects:
        named = [", ".join(f"{name} ({kind})" for name, kind in each.items()) for each in (objects, theirs_own)]
        cure = "No state holds these: make the environment with the same ones."
        raise argument_error("state", f"one made with {named[0] or 'no'} objects", f"'{named[1] or 'none'}'", cure)
    return found


def check_parts(
    state: Mapping[str, Any], config: EnvConfig, own: Episode | None
) -> tuple[np.random.SeedSequence | None, Scenario | None]:
    """Return the root of all seeds of a state that `check_state` passed, and its setting, if each part is whole.

    Args:
        state: Nothing of it is taken over yet.
        config: Configuration of the environment.
        own: The environment's running episode; None: there is none.

    Raises:
        ValueError: By name of the part that is wrong.
    """
    try:
        root = restored_sequence(state["root"])
    except Exception as error:  # whatever numpy says of what are no parts of one
        raise argument_error("state['root']", "a seed sequence", f"'{error}'", "Pass it unchanged.") from error
    check.instance("state['agents']", state["agents"], tuple)
    if state["agents"] not in ((), tuple(config.agents)):
        check.refuse("state['agents']", f"{tuple(config.agents)} or none", state["agents"])
    check.integer("state['cycle']", state["cycle"])
    if state["episode"] is None:
        if state["agents"]:
            check.refuse("state['episode']", "a running episode", "none")
        return root, None
    episode = EpisodeCheck(config, own)
    episode.check("state['episode']", state["episode"])
    check_standing("state['standing']", state["standing"], config.num_robots)
    check_drivers("state['drivers']", state["drivers"], config.num_robots)
    return root, episode.setting


def save_state(state: Mapping[str, Any], path: str | Path) -> None:
    """Write a state of `get_state` to a file; an interrupted write leaves no file, or the old one.

    A file of that name is replaced; what is there and no file is refused. The file holds data alone, with its SHA-256:
    loading it runs no code. Objects of your own (worlds, reward terms) are not stored.

    Raises:
        ValueError: If it is no state of this version, or the file cannot be written.
    """
    _checked("state", state)
    path = _checked_path(path)
    try:
        body = encode(dict(state), ENV_KINDS)
    except ForeignObjectError as error:
        cure = "Objects of your own are not stored: make the environment that loads with them."
        raise argument_error("state", "numbers, arrays and configurations of this package", str(error), cure) from error
    with os_errors_as_argument_errors(path, "path"):
        is_other = path.exists() and not path.is_file()
    if is_other:
        raise argument_error("path", "a file that can be written", Path(path), "There is something else, no file.")
    write_file(path, MAGIC + f"{state['version']}\n{_fingerprint(body)}\n".encode() + body)


def load_state(path: str | Path) -> EnvState:
    """Read a state that `save_state` wrote.

    Raises:
        ValueError: If there is no such file, it holds no state, a byte of it has changed, or it is of another version.
    """
    path = _checked_path(path)
    try:
        content = read_file(path)
    except OSError as error:
        raise argument_error("path", "the file of a state", Path(path), f"The system says: {error}.") from error
    head, _, body = content.partition(b"\n")
    if not head.startswith(MAGIC):
        raise argument_error("path", "the file of a state", Path(path), "Write one with save_state.")
    _check_version(str(path), head[len(MAGIC) :].decode(errors="replace"))  # before anything of it is read
    mark, _, body = body.partition(b"\n")
    if mark.decode(errors="replace") != _fingerprint(body):
        raise argument_error("path", "a whole file of a state", f"a damaged file {path}", "Save it again.")
    try:
        state = decode(body, ENV_KINDS)
    except ValueError as error:
        cure = f"Save it again; reading says: {error}."
        raise argument_error("path", "the file of a state that can be read here", Path(path), cure) from error
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
    return None if state is None else sequence_of(**state)


def _checked_path(path: Any) -> Path:
    """Return a path that can name a file."""
    if not isinstance(path, (str, PathLike)) or "\0" in str(path):
        raise argument_error("path", "the path of a file", path, "Give a text or a Path, without NUL characters.")
    return Path(path)


def _check_version(name: str, found: Any) -> None:
    if found != state_version():
        cure = "Go on with the version that made it; only the same one goes on bit by bit."
        raise argument_error(name, f"a state of version {state_version()!r}", found, cure)


def _checked(name: str, state: Any) -> Mapping[str, Any]:
    """Return a state of this version, or refuse it; another version's may have other parts, so that is said first."""
    expected, cure = "what get_state returned", "Pass it unchanged."
    if not isinstance(state, Mapping):
        raise argument_error(name, expected, f"a {type(state).__name__}", cure)
    if "version" in state:
        _check_version(name, state["version"])
    for key in KEYS:
        if key not in state:
            raise argument_error(name, expected, f"a mapping without {key!r}", cure)
    if not isinstance(state["config"], EnvConfig):
        raise argument_error(name, expected, f"a mapping whose config is a {type(state['config']).__name__}", cure)
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
