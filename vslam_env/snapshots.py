"""Snapshots of environments: version, validation and file format."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from slam_backend.core.validation import argument_error
from slam_backend.state import Child, Dict, Each, Int, Maybe, Options, Seed, Sizes, State, Text, built_options, refuse
from slam_backend.state.files import check_version, read_state, version_of, write_state
from vslam_env.config import EnvConfig
from vslam_env.reward import RewardTerm, is_named
from vslam_env.simulation.controllers import ActionExecutor
from vslam_env.simulation.episode import Episode
from vslam_env.simulation.scenario import Scenario
from vslam_env.world import WorldSource

MAGIC = b"vslam_env state "

EnvState = Mapping[str, Any]


class EnvParts:
    """Parts of the state of an environment."""

    STATE = State(
        version=Text(),
        config=Options(EnvConfig),
        objects=Dict(Text(), Text()),
        root=Maybe(Seed()),
        agents=Each(Text(), kind=list),
        cycle=Int(),
        episode=Maybe(Child(Episode)),
        executor=Child(ActionExecutor),
    )


def state_version() -> str:
    """Return the version of states: number of their format and package version; both must agree to continue."""
    return version_of(EnvParts)


def snapshot_objects(source: WorldSource, terms: Sequence[RewardTerm]) -> dict[str, str]:
    """Return the class names of the caller's own objects (world, reward terms), which states do not contain."""
    objects = {} if isinstance(source, (str, Path)) else {"world": type(source).__qualname__}
    return objects | {f"reward {term.name!r}": type(term).__qualname__ for term in terms if not is_named(term)}


def check_state(state: Any, config: EnvConfig, objects: Mapping[str, str]) -> Mapping[str, Any]:
    """Return a state if it fits an environment, or raise.

    Args:
        state: Value to check.
        config: Configuration of the environment.
        objects: Class names of the caller's own objects, see `snapshot_objects`.

    Raises:
        ValueError: If the value is not a state, or a state of another version or configuration.
    """
    found = _checked("state", state)
    custom = found["objects"]
    if not isinstance(custom, Mapping) or not all(type(name) is str for pair in custom.items() for name in pair):
        refuse("state['objects']", "class names of the caller's own objects", custom)
    if found["config"] != config:
        name, ours, theirs = _difference(config, found["config"])
        hint = "Restore into an environment of the same configuration."
        if custom and name in ("world", "reward"):
            hint = f"States do not contain your own objects: make the environment with the same {', '.join(custom)}."
        raise argument_error("state", f"one made with {name} = {_short(ours)}", theirs, hint)
    if custom != objects:
        named = [", ".join(f"{name} ({kind})" for name, kind in each.items()) for each in (objects, custom)]
        hint = "States do not contain these: make the environment with the same ones."
        raise argument_error("state", f"one made with {named[0] or 'no'} objects", f"'{named[1] or 'none'}'", hint)
    agents = found["agents"]
    if (
        type(agents) is not tuple
        or not all(type(agent) is str for agent in agents)
        or agents not in ((), tuple(config.agents))
    ):
        refuse("state['agents']", f"{tuple(config.agents)} or none", agents)
    if agents and found["episode"] is None:
        refuse("state['episode']", "a running episode", "none")
    return found


def state_sizes(config: EnvConfig, own: Scenario | None) -> Sizes:
    """Return the sizes that the checks of states need; `own` is a scenario that need not be rebuilt."""
    camera = config.stereo.camera
    return {
        "K": config.num_robots, "RAYS": config.scan.num_rays, "HEIGHT": camera.height, "WIDTH": camera.width,
        "CONFIG": config, "SCENARIO": own,
    }  # fmt: skip


def save_state(state: Mapping[str, Any], path: str | Path) -> None:
    """Write a state of `get_state` to a file; an interrupted write leaves no file or the old one.

    An existing file is replaced. The file contains only data and their SHA-256; loading it executes no code. Your own
    objects (worlds, reward terms) are not stored.

    Raises:
        ValueError: If it is not a state of this version, or the file cannot be written.
    """
    _checked("state", state)
    write_state(path, MAGIC, EnvParts, dict(state))


def load_state(path: str | Path) -> EnvState:
    """Read a state written by `save_state`.

    Raises:
        ValueError: If the file does not exist, contains no state, is damaged, or has another version.
    """
    return dict(_checked(str(path), read_state(path, MAGIC, EnvParts, "save_state")))


def _checked(name: str, state: Any) -> Mapping[str, Any]:
    """Return a state of this version, or raise; the version is checked first, since parts differ between versions."""
    expected, hint = "what get_state returned", "Pass it unchanged."
    if not isinstance(state, Mapping):
        raise argument_error(name, expected, f"a {type(state).__name__}", hint)
    if "version" in state:
        check_version(EnvParts, name, state["version"])
    for key in EnvParts.STATE.parts:
        if key not in state:
            raise argument_error(name, expected, f"a mapping without {key!r}", hint)
    if isinstance(state["config"], EnvConfig):
        return state
    return dict(state) | {"config": built_options(EnvConfig, f"{name}['config']", state["config"])}  # of a file


def _difference(ours: Any, theirs: Any, name: str = "") -> tuple[str, Any, Any]:
    """Return the first difference of two unequal configurations: dotted name of the field, and both values."""
    if not dataclasses.is_dataclass(ours) or type(ours) is not type(theirs):
        return name, ours, theirs
    pairs = ((f.name, getattr(ours, f.name), getattr(theirs, f.name)) for f in dataclasses.fields(ours))
    field, own, other = next(pair for pair in pairs if pair[1] != pair[2])
    return _difference(own, other, f"{name}.{field}" if name else field)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
