"""Random environments: each case is one line that can be pasted, and that is all there is to it."""

import dataclasses
import hashlib
import re
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from builders.comparison import digest
from builders.environments import room, wander

from vslam_env import EnvConfig, ExplorationEnv, World, preset_config
from vslam_env.config import ACTION_TYPES
from vslam_env.presets import NOISE_PRESETS
from vslam_env.world import load_floorplan

REFUSAL = r"[\w.\[\]'{}, ]+: expected .*, got .*\. .*\."
PERCEIVED = ("measurements", "odometry[", "pose", "readings")  # what the simulator draws is never the caller's fault
WORLDS = ("office", "maze", "loops", "hall", "fig5", "room", "plan")
# What these cost is bounded here: the configuration accepts more, and memory and patience end before.
DEAREST = {
    "num_particles": 60, "merged_particles": 60, "decision_ticks": 12,
    "num_rays": 100, "density": 5.0, "descriptor_size": 100, "max_measurements": 50, "false_points": 20.0,
    "width": 200, "height": 150, "most": 300, "block": 15, "spacing": 30, "border": 40, "cell": 100, "iterations": 20,
    "parts": 4, "polygons": 20.0, "posters": 2.0, "max_samples": 20_000, "max_keys": 200, "further_keys": 50,
    "recent_keys": 100, "max_iterations": 30, "steps_per_key": 100, "landmarks_per_key": 20,
}  # fmt: skip
CHEAPEST = {"texel": 0.02, "min_spacing": 0.02}
OPTIONAL_INTS = ("decision_ticks", "merged_particles", "rejuvenate_every", "frame_limit")
EXTREMES = (0.0, 5e-324, 1e-300, 1e-100, 1e-30, 1e-12, 1e-9, 1e-6, 1e6, 1e9, 1e12, 1e30, 1e100, 1e300, 1.7e308)
WHOLE_EXTREMES = (0, 1, 2, 3, 10**6, 2**31, 2**63, 10**30)


@dataclasses.dataclass(frozen=True)
class Case:
    """One environment, and how it is driven: `changes` as `EnvConfig.replace` takes them, a world's name or sides."""

    seed: int
    preset: str
    sensor: str
    world: Any
    changes: dict[str, Any]
    steps: int


def drawn(seed: int) -> Case:
    """Draw a case: a preset, what kind of environment, and some numbers that are moved, a few of them to extremes."""
    rng = np.random.default_rng(seed)
    sensor = "stereo" if rng.random() < 0.12 else "landmark"
    preset = str(rng.choice(NOISE_PRESETS))
    world: Any = str(rng.choice(WORLDS)) if rng.random() < 0.5 else tuple(rng.uniform(2.0, 60.0, 2).tolist())
    if rng.random() < 0.1:
        world = tuple((10.0 ** rng.uniform(-0.5, 2.3, 2)).tolist())
    if sensor == "stereo":  # textures of large buildings take seconds
        world = str(rng.choice(["room", "plan"])) if rng.random() < 0.4 else tuple(rng.uniform(2.0, 12.0, 2).tolist())
    robots = int(rng.integers(1, 9)) if rng.random() < 0.7 else int(rng.integers(1, 4))
    changes: dict[str, Any] = {
        "num_robots": min(robots, 2) if sensor == "stereo" else robots,
        "action_type": str(rng.choice(ACTION_TYPES)),
        "observation_type": str(rng.choice(["dict", "flat"])),
        "max_cycles": int(rng.integers(3, 40)),
        "belief": {"filter": {"num_particles": int(rng.integers(1, 40))}},
    }
    for name in (
        "oracle_pose",
        "oracle_association",
        "oracle_merge",
        "oracle_floor",
        "comm_line_of_sight",
        "shared_start_view",
    ):
        if rng.random() < 0.2:
            changes[name] = True
    if sensor == "stereo" and changes["observation_type"] == "dict":
        changes["observe_images"] = bool(rng.random() < 0.5)
    if rng.random() < 0.5:
        changes["min_start_distance"] = float(rng.uniform(0.5, 3.0))
        changes["shared_start_view"] = True
    config = _bare(preset, sensor)
    for path, changed in _moved(config, rng):
        _put(changes, path, changed)
    steps = int(rng.integers(2, 8)) if sensor == "stereo" else int(rng.integers(3, 40))
    return Case(seed, preset, sensor, world, changes, steps)


@cache
def _bare(preset: str, sensor: str) -> EnvConfig:
    return preset_config(preset, sensor)


def _moved(config: EnvConfig, rng: np.random.Generator) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield numbers and choices of the configuration that are moved, by path."""
    belief = ("belief", "filter")
    if rng.random() < 0.2:
        yield (*belief, "existence"), {}
    if rng.random() < 0.3:
        yield (*belief, "proposal"), "fastslam1"
    if rng.random() < 0.3:
        yield (*belief, "resampling"), str(rng.choice(["systematic", "stratified", "multinomial", "residual"]))
    if rng.random() < 0.4:
        yield (*belief, "rejuvenate_every"), int(rng.integers(1, 12))
    if rng.random() < 0.2:
        yield ("belief", "alignment", "appearance"), False
    if rng.random() < 0.3:
        yield ("belief", "alignment", "min_inliers"), 3
        yield ("belief", "attempts", "every"), int(rng.integers(1, 6))
        yield ("belief", "alignment", "max_sigma_position"), 5.0
        yield ("belief", "alignment", "max_sigma_heading"), 1.0
        yield ("belief", "merging", "min_sigmas"), 0.0
    numbers = list(_numbers(config))
    wild = rng.random() < 0.6
    for _ in range(int(rng.integers(0, 6))):
        path, value = numbers[int(rng.integers(len(numbers)))]
        yield path, _number(path[-1], value, wild and rng.random() < 0.5, rng)


def _numbers(part: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield path and value of each number of a configuration, those included that are None unless asked for."""
    for field in dataclasses.fields(part):
        value, here = getattr(part, field.name), (*path, field.name)
        if field.name in ("num_robots", "max_cycles", "existence", "images", "world_split"):
            continue
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, here)
        elif value is None or (isinstance(value, (int, float, tuple)) and not isinstance(value, bool)):
            yield here, value


def _number(name: str, value: Any, extreme: bool, rng: np.random.Generator) -> Any:
    """Return another number in place of one: a few times as large or small, or extreme."""
    if isinstance(value, tuple):
        return [_number(name, one, extreme, rng) for one in value]
    whole = isinstance(value, int) or (value is None and name in OPTIONAL_INTS)
    if extreme:
        chosen = rng.choice(np.array(WHOLE_EXTREMES if whole else EXTREMES, dtype=object))
        sign = 1 if whole or rng.random() < 0.9 else -1
        moved = sign * (int(chosen) if whole else float(chosen))
    else:
        start = value if value else (5 if whole else float(rng.choice([0.01, 0.3, 5.0])))
        factor = 10.0 ** rng.uniform(-1.3, 1.3)
        moved = max(1, round(start * factor)) if whole else start * factor
    moved = min(moved, DEAREST.get(name, moved))
    return max(moved, CHEAPEST.get(name, moved))


def _put(changes: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    for name in path[:-1]:
        changes = changes.setdefault(name, {})
    changes[path[-1]] = value


def _plan(_: np.random.Generator) -> World:
    """Return the world of a floor plan with two rooms and a door between them."""
    image = np.pad(np.full((80, 120), 255, np.uint8), 5)
    image[5:50, 60:63] = 0
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plan.png"
        assert cv2.imwrite(str(path), image)
        return load_floorplan(path, metres_per_pixel=0.1)


def environment(case: Case) -> ExplorationEnv | None:
    """Make the environment of a case; None if it is refused, as documented."""
    source = case.world
    if source == "room":
        source = room()
    elif source == "plan":
        source = _plan
    elif not isinstance(source, str):
        x, y = source
        source = World("room", [[0, 0, x, 0], [x, 0, x, y], [x, y, 0, y], [0, y, 0, 0]])
    try:
        config = _bare(case.preset, case.sensor).replace(**case.changes)
        return ExplorationEnv(config, world=source)
    except ValueError as error:
        return _documented(error)


def _documented(error: ValueError) -> None:
    """Raise a refusal again unless it has the project's form, and names what the caller gave."""
    if not re.fullmatch(REFUSAL, str(error), re.DOTALL) or str(error).startswith(PERCEIVED):
        raise error


def played(case: Case) -> str | None:
    """Play a case and check all that comes out; return a digest of it, or None if it is refused before the first step.

    Raises:
        AssertionError: If something is NaN or outside its space, or anything at all is raised in a step.
    """
    env = environment(case)
    if env is None:
        return None
    said = hashlib.sha256()
    try:
        observations, infos = env.reset(seed=case.seed)
    except ValueError as error:
        return _documented(error)
    rng = np.random.default_rng(case.seed)
    _check(env, observations, infos)
    digest([observations, infos], said)
    for _ in range(case.steps):
        if not env.agents:
            break
        observations, rewards, terminated, truncated, infos = env.step(wander(env, rng))
        _check(env, observations, infos)
        assert all(np.isfinite(reward) for reward in rewards.values()), rewards
        digest([observations, rewards, terminated, truncated, infos, env.state()], said)
    return said.hexdigest()


def _check(env: ExplorationEnv, observations: dict[str, Any], infos: dict[str, Any]) -> None:
    """Check what an environment says."""
    for agent in env.possible_agents:
        space, shown = env.observation_space(agent), observations[agent]
        if not space.contains(shown):
            names = [name for name in shown if not space[name].contains(shown[name])] if isinstance(shown, dict) else []
            raise AssertionError(f"{agent}: outside its space {names}")
        assert infos[agent].keys() == infos["robot_0"].keys()
        for name, figure in infos[agent].items():
            assert type(figure) in (int, float), f"{agent}: {name} is a {type(figure).__name__}"
            assert np.isfinite(figure), f"{agent}: {name} is {figure}"
        belief = env.belief(agent)
        for name in ("pose", "covariance", "particles", "log_weights", "ess", "start_from_group"):
            assert np.isfinite(getattr(belief, name)).all(), f"{agent}: belief.{name} is not finite"
        assert np.isfinite(belief.map.means).all(), f"{agent}: means of the map are not finite"
        assert np.isfinite(belief.map.covariances).all(), f"{agent}: covariances of the map are not finite"
        variances = np.einsum("nii->ni", belief.map.covariances)
        assert (variances >= 0.0).all(), f"{agent}: a negative variance in the map"
    assert np.isfinite(env.state()).all(), "state is not finite"


def check(case: Case) -> bool:
    """Check a case twice; return whether it was played at all.

    Raises:
        AssertionError: With the case in one line that can be pasted, `check(Case(...))`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            first = played(case)
            assert played(case) == first, "other bytes when it is repeated"
    except Exception as error:
        raise AssertionError(f"check({case!r})\n{type(error).__name__}: {error}") from error
    return first is not None
