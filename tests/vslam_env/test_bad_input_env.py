import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from small_env import MEETING, WALLS, small_env

from vslam_env import EnvConfig, ExplorationEnv, World, vslam_v0
from vslam_env.solo import SoloExplorationEnv
from vslam_env.world import Landmarks, load_floorplan, load_walls_json, save_walls_json

NARROW = World("narrow", [[0, 0, 9, 0], [9, 0, 9, 0.3], [9, 0.3, 0, 0.3], [0, 0.3, 0, 0]])
CLOSET = World("closet", [[0, 0, 2, 0], [2, 0, 2, 2], [2, 2, 0, 2], [0, 2, 0, 0]])


def _reset(**kwargs: Any) -> Callable[[], Any]:
    options = kwargs.pop("options", None)
    seed = kwargs.pop("seed", 0)
    return lambda: small_env(**kwargs).reset(seed=seed, options=options)


def _step(actions: Any, **kwargs: Any) -> Callable[[], Any]:
    def act() -> Any:
        env = small_env(**kwargs)
        env.reset(seed=0)
        return env.step(actions)

    return act


def _world_file(name: str, content: bytes) -> Callable[[], Any]:
    """Reset an environment whose world is a file of that content."""

    def act() -> Any:
        with TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            return small_env(world=path).reset(seed=0)

    return act


class _Nameless:
    weight = 1.0


def _blank_world(positions: Any) -> World:
    """The room with landmarks of its own at these places (n, 3), all on the first wall."""
    n = len(positions)
    looks = np.tile(np.eye(1, 64, dtype=np.float32), (n, 1))
    return World("blank", WALLS, Landmarks(positions, np.tile([0.0, 1.0], (n, 1)), np.zeros(n, np.int64), looks))


class _Returns:
    """A reward term that returns what it was made with."""

    def __init__(self, value: Any, name: Any = "given") -> None:
        self.value, self.name, self.weight = value, name, 1.0

    def __call__(self, before: Any, after: Any) -> Any:
        return self.value


class _Twice:
    name, weight = "twice", 1.0

    def __call__(self, before: Any, after: Any) -> Any:
        return np.array([1.0, np.nan])


CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "unknown world": (lambda: small_env(world="castle"), r"world.*expected.*'office'.*'castle'"),
    "world without a name": (lambda: small_env(world=""), r"world: expected one of 'office'.*, got ''"),
    "missing world file": (lambda: small_env(world="nowhere.png"), r"nowhere\.png"),
    "missing world in a config": (lambda: ExplorationEnv(EnvConfig(world="nowhere.json")), r"nowhere\.json"),
    "world of a wrong type": (lambda: small_env(world=3), "world: expected a name, a path, .*, got 3"),
    "function that makes no world": (_reset(world=lambda rng: 5), "world: expected a function that returns a World"),
    "function without an argument": (
        lambda: small_env(world=lambda: CLOSET),
        "world: expected a function of one argument, a random generator, got <function .*too many positional",
    ),
    "function of Python's own": (
        _reset(world=os.system),
        "world: expected a function of rng that returns a World, got <built-in function system>",
    ),
    "class as a function": (
        lambda: small_env(world=World),
        "world: expected a function of one argument, .*missing a required argument: 'walls'",
    ),
    "path too long": (lambda: small_env(world="x" * 5000), "world: expected .*, got 'xxx"),
    "path of a file too long": (
        lambda: small_env(world="x" * 5000 + ".json"),
        "world: expected a file, got 'xxx.*Check the path: File name too long",
    ),
    "robots fit, but on no cell": (
        _reset(world=World("box", [[0, 0, 0.5, 0], [0.5, 0, 0.5, 0.5], [0.5, 0.5, 0, 0.5], [0, 0.5, 0, 0]])),
        "a disc of radius 0.2 m fits anywhere in a 0.1 m cell, got no such cell in 'box'.* make rooms 0.7 m wide",
    ),
    "robots do not fit": (_reset(world=NARROW), "a disc of radius 0.2 m fits"),
    "starts do not fit": (_reset(world=CLOSET, num_robots=8), "num_robots: expected as many as can start 5 m apart"),
    "no robots": (lambda: small_env(num_robots=0), "num_robots: expected an int >= 1, got 0"),
    "too many robots": (lambda: small_env(num_robots=9), "num_robots: expected an int from 1 to 8, got 9"),
    "no particles": (lambda: small_env(num_particles=0), "num_particles: expected an int >= 1, got 0"),
    "robots as text": (lambda: small_env(num_robots="many"), "num_robots: expected a valid integer.*got 'many'"),
    "unknown sensor": (lambda: small_env(sensor="sonar"), "sensor: expected one of 'landmark', 'stereo', got 'sonar'"),
    "unknown action type": (lambda: small_env(action_type="jump"), "action_type: expected 'continuous', .*'jump'"),
    "unknown observations": (
        lambda: small_env(observation_type="image"),
        "observation_type: expected 'dict' or 'flat'",
    ),
    "unknown preset": (lambda: small_env(preset="brutal"), "preset: expected one of 'easy', 'standard', 'hard'"),
    "unknown render mode": (lambda: small_env(render_mode="ansi"), "render_mode: expected one of 'human', 'rgb_array'"),
    "no cycles": (lambda: small_env(max_cycles=0), "max_cycles: expected an int >= 1, got 0"),
    "no ticks": (lambda: small_env(decision_ticks=0), "decision_ticks: expected an int >= 1, got 0"),
    "too many particles": (
        lambda: small_env(num_particles=10**9),
        "num_particles: expected an int <= 1000000, got 1000000000",
    ),
    "too many rays": (
        lambda: small_env().config.replace(scan={"num_rays": 10**9}),
        r"scan\.num_rays: expected an int <= 100000, got 1000000000",
    ),
    "ticks without end": (
        lambda: small_env(decision_ticks=10**400),
        "decision_ticks: expected an int <= 1000000000, got 1000",
    ),
    "recall above one": (
        lambda: small_env(stop_at_recall=1.5),
        "stop_at_recall: expected a finite number > 0 and <= 1",
    ),
    "preset and config": (
        lambda: small_env(preset="easy", config=small_env().config),
        "preset: expected None beside a config",
    ),
    "config of a wrong type": (lambda: small_env(config=7), "config: expected an EnvConfig, a path or None, got 7"),
    "missing config": (
        lambda: small_env(config="nowhere.toml"),
        r"config: expected a readable TOML file.*nowhere\.toml",
    ),
    "config that is no TOML": (
        lambda: EnvConfig.from_toml_text("[x"),
        r"config: expected TOML, got '\[x'\. The reader says: ",
    ),
    "config of no text": (lambda: EnvConfig.from_toml_text(3), "config: expected TOML as text, got 3"),
    "config file with a NUL": (
        lambda: EnvConfig.from_toml("a\0.toml"),
        "config: expected a readable TOML file, got .*null",
    ),
    "cycles as text": (
        lambda: setattr(small_env(), "max_cycles", "x"),
        "max_cycles: expected an int >= 1, got 'x'",
    ),
    "no number of cycles": (
        lambda: setattr(small_env(), "max_cycles", None),
        "max_cycles: expected an int >= 1, got None",
    ),
    "recorder that records nothing": (
        lambda: setattr(small_env(), "recorder", 5),
        "recorder: expected a function or None, got 5",
    ),
    "unknown field": (lambda: small_env().config.replace(robots=2), "robots: expected a known field, got 2"),
    "unknown nested field": (
        lambda: small_env().config.replace(belief={"filter": {"particles": 5}}),
        r"belief\.filter\.particles: expected a known field, got 5",
    ),
    "unknown reward": (lambda: small_env(reward={"fame": 1.0}), "reward: expected one of 'map_error', .*got 'fame'"),
    "no weights": (lambda: small_env(reward={}), "reward: expected at least one term, got {}"),
    "no terms": (lambda: small_env(reward=[]), r"reward: expected at least one term, got \[\]"),
    "reward as text": (lambda: small_env(reward="map_error"), "reward: expected weights by name, or a list of terms"),
    "reward without a name": (
        lambda: small_env(reward=[_Nameless()]),
        "reward: expected terms with name, weight and a call",
    ),
    "repeated reward": (lambda: small_env(reward=[_Twice(), _Twice()]), "reward: expected terms with different names"),
    "reward that is NaN": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Twice()]),
        "reward term 'twice': expected 2 finite numbers",
    ),
    "reward of texts": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Returns(["a", "b"])]),
        "reward term 'given': expected 2 finite numbers, got \\['a', 'b'\\]",
    ),
    "reward of numbers as texts": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Returns(["1", "2"])]),
        "reward term 'given': expected 2 finite numbers, got \\['1', '2'\\]",
    ),
    "complex reward": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Returns([1j, np.complex128(1.0)])]),
        "reward term 'given': expected 2 finite numbers, got ",
    ),
    "reward beyond all numbers": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Returns([10**400, 0])]),
        "reward term 'given': expected 2 finite numbers, got \\[1000",
    ),
    "reward by name of a robot": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0]}, reward=[_Returns({"robot_0": 1.0})]),
        "reward term 'given': expected 2 finite numbers, got {'robot_0': 1.0}",
    ),
    "class of a reward": (lambda: small_env(reward=[_Twice]), "reward: expected terms, not their classes.*_Twice"),
    "reward named by a number": (
        lambda: small_env(reward=[_Returns(0.0, name=3)]),
        "reward: expected terms whose name is a text, got 3",
    ),
    "weight that is NaN": (lambda: small_env(reward={"map_error": float("nan")}), "reward.*map_error.*finite number"),
    "weight beyond all numbers": (
        lambda: small_env(reward={"map_error": 10**400}),
        "reward.*map_error.*: expected a finite number, got 1000",
    ),
    "negative seed": (_reset(seed=-1), "seed: expected an int >= 0, got -1"),
    "seed as text": (_reset(seed="x"), "seed: expected an int >= 0, got 'x'"),
    "options as list": (_reset(options=[1]), r"options: expected a dict or None, got \[1\]"),
    "world seed": (_reset(options={"world_seed": 1.5}), r"options\['world_seed'\]: expected an int >= 0, got 1.5"),
    "starts of a wrong shape": (
        _reset(options={"start_poses": [[1, 2, 3]]}),
        r"start_poses: expected an array of shape",
    ),
    "start that is NaN": (
        _reset(options={"start_poses": [[np.nan, 3, 0], [4, 4, 0]]}),
        "start_poses: expected finite numbers",
    ),
    "start that no number can be": (
        _reset(options={"start_poses": [[10**400, 3, 0], [4, 4, 0]]}),
        r"start_poses: expected an array of shape \(2, 3\), got",
    ),
    "start beyond all maps": (
        _reset(options={"start_poses": [[1e308, 3, 0], [4, 4, 0]]}),
        r"start_poses: expected numbers within \+-1e\+08, got 1e\+308",
    ),
    "starts as texts": (
        _reset(options={"start_poses": [["3", 3, 0], [4, 4, 0]]}),
        r"start_poses: expected an array of shape \(2, 3\) of real numbers, got \[\['3', 3, 0\]",
    ),
    "complex starts": (
        _reset(options={"start_poses": [[np.complex128(3), 3, 0], [4, 4, 0]]}),
        r"start_poses: expected an array of shape \(2, 3\) of real numbers, got an array of complex128",
    ),
    "start in a wall": (
        _reset(options={"start_poses": [[3, 3, 0], [0.1, 5, 0]]}),
        r"start_poses\[1\]: expected a place",
    ),
    "starts that overlap": (
        _reset(options={"start_poses": [MEETING[0], MEETING[0]]}),
        r"start_poses\[1\]: expected a place at least 0.4 m from the other robots",
    ),
    "actions as list": (_step([1, 2]), r"actions: expected a dict from agent to action, got \[1, 2\]"),
    "unknown agent": (
        _step({"robot_0": [0, 0], "robot_1": [0, 0], "robot_7": [0, 0]}),
        r"actions: expected actions of \['robot_0', 'robot_1'\], got 'robot_7'",
    ),
    "missing agent": (_step({"robot_0": [0, 0]}), "actions: expected an action of 'robot_1', got no 'robot_1'"),
    "action that is NaN": (
        _step({"robot_0": [0, np.nan], "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected two numbers in \[-1, 1\]",
    ),
    "action out of bounds": (
        _step({"robot_0": [0, 0], "robot_1": [2, 0]}),
        r"actions\['robot_1'\]: expected two numbers",
    ),
    "action of a wrong shape": (
        _step({"robot_0": [0, 0, 0], "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\), got shape \(3,\)",
    ),
    "action as text": (
        _step({"robot_0": "go", "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape",
    ),
    "action of texts": (
        _step({"robot_0": ["0.1", "0.2"], "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\) of real numbers",
    ),
    "complex action": (
        _step({"robot_0": np.zeros(2, complex), "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\) of real numbers",
    ),
    "action of things": (
        _step({"robot_0": np.array([0.1, "b"], dtype=object), "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\) of real numbers",
    ),
    "action of truth values": (
        _step({"robot_0": np.array([True, False]), "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\) of real numbers",
    ),
    "action of a number and a truth value": (
        _step({"robot_0": [True, 0.5], "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\) of real numbers, got \[True, 0.5\]",
    ),
    "masked action": (
        _step({"robot_0": np.ma.masked_equal([0.5, 0.1], 0.1), "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\), got a masked array with hidden entries",
    ),
    "action with an axis too many": (
        _step({"robot_0": np.zeros((2, 1)), "robot_1": [0, 0]}),
        r"actions\['robot_0'\]: expected an array of shape \(2,\), got shape \(2, 1\)",
    ),
    "discrete action out of range": (
        _step({"robot_0": 4, "robot_1": 0}, action_type="discrete"),
        r"actions\['robot_0'\]: expected an int from 0 to 3, got 4",
    ),
    "goal out of range": (
        _step({"robot_0": 0, "robot_1": -1}, action_type="goal"),
        r"actions\['robot_1'\]: expected an int from 0 to 16, got -1",
    ),
    "goal as float": (
        _step({"robot_0": 1.5, "robot_1": 0}, action_type="goal"),
        "expected an int from 0 to 16, got 1.5",
    ),
    "broken image": (_world_file("plan.png", b"no picture"), "world: expected an image that OpenCV can read"),
    "broken walls": (_world_file("plan.json", b"{"), "world: expected a JSON file, got a syntax error"),
    "broken map": (_world_file("map.yaml", b"image: [1, 2"), "world: expected a YAML file, got a syntax error"),
    "map without an image": (_world_file("map.yaml", b"resolution: 1"), "expected a mapping with the key 'image'"),
    "walls nested without end": (_world_file("plan.json", b"[" * 100_000), "world: expected a JSON file"),
    "walls as text": (
        _world_file("plan.json", b'{"walls": "all"}'),
        r"world\.walls: expected an array of shape \(n, 4\) of real numbers, got 'all'.* The file is .*plan\.json\.$",
    ),
    "walls of texts": (
        _world_file("plan.json", b'{"walls": [["0", 0, 9, 0]]}'),
        r"world\.walls: expected an array of shape \(n, 4\) of real numbers, got \[\['0', 0, 9, 0\]\]",
    ),
    "walls beyond all numbers": (
        _world_file("plan.json", b'{"walls": [[0, 0, 1' + b"0" * 400 + b", 0]]}"),
        r"world\.walls: expected an array of shape \(n, 4\), got \[\[0, 0, 1000",
    ),
    "walls beyond all maps": (
        _world_file("plan.json", b'{"walls": [[-1e308, 0, 1e308, 0]]}'),
        r"world\.walls: expected numbers within \+-1e\+08, got 1e\+308",
    ),
    "no landmarks": (_reset(world=_blank_world(np.zeros((0, 3)))), "world: expected landmarks that robots can see"),
    "landmarks out of sight": (
        _reset(world=_blank_world(np.array([[500.0, 0.0, 0.0]]))),
        "world: expected landmarks that robots can see, got no such landmark among 1 in 'blank'",
    ),
    "walls that enclose nothing": (
        _world_file("plan.json", b'{"walls": [[0, 0, 5, 0]]}'),
        "world: expected walls that enclose a space",
    ),
    "world seed below zero": (_reset(options={"world_seed": -1}), r"options\['world_seed'\]: expected an int >= 0"),
    "shared reward as text": (lambda: small_env(shared_reward="yes"), "shared_reward: expected .*, got 'yes'"),
    "split of one building": (lambda: small_env(world_split="train"), "world_split: expected None for a world"),
    "oracle as number": (lambda: small_env(oracle_pose=1), "oracle_pose: expected a valid boolean, got 1"),
    "landmarks too dense": (
        lambda: small_env().config.replace(landmarks={"density": -1.0}),
        "landmarks.density: expected a finite number > 0 and <= 10000, got -1",
    ),
    "descriptors without end": (
        lambda: small_env().config.replace(landmarks={"descriptor_size": 10**9}),
        "landmarks.descriptor_size: expected an int <= 10000, got 1000000000",
    ),
    "field that JSON cannot hold": (
        lambda: small_env().config.replace(num_robots=10**5000),
        "config: expected values that JSON can hold, got no such values",
    ),
    "floor plan at no path": (lambda: load_floorplan(None), "world: expected a path, got None"),
    "walls at no path": (lambda: load_walls_json(3), "world: expected a path, got 3"),
    "config at no path": (lambda: EnvConfig.from_toml(None), "config: expected a readable TOML file, got 'None'"),
    "walls to no path": (
        lambda: save_walls_json(CLOSET, None),
        "path: expected the path of a file, got None",
    ),
    "landmarks beyond all maps": (
        lambda: _blank_world(np.array([[1e308, 0.0, 0.0]])),
        r"landmarks\.positions: expected numbers within \+-1e\+08, got 1e\+308",
    ),
    "looks of endless length": (
        lambda: Landmarks([[0, 0, 0]], [[1, 0]], [0], [[1e30]]),
        r"landmarks\.descriptors: expected numbers within \+-1e\+06, got 1",
    ),
    "no state": (lambda: small_env().set_state([]), "state: expected what get_state returned, got a list"),
    "negative seed in a solo environment": (
        lambda: SoloExplorationEnv(world="fig5").reset(seed=-1),
        "seed: expected an int >= 0, got -1",
    ),
    "team in a solo environment": (lambda: SoloExplorationEnv(num_robots=2), "num_robots: expected 1, got 2"),
    "fewer starts than robots": (
        _reset(world=World("two", WALLS, start_poses=MEETING), num_robots=3),
        r"world\.start_poses: expected a row for each of 3 robots, got shape \(2, 3\)",
    ),
    "observations of a stranger": (
        lambda: small_env().observation_space("robot_7"),
        r"agent: expected one of \['robot_0', 'robot_1'\], got 'robot_7'",
    ),
    "actions of a stranger": (
        lambda: small_env().action_space("robot_7"),
        r"agent: expected one of \['robot_0', 'robot_1'\], got 'robot_7'",
    ),
    "belief of a stranger": (
        lambda: (env := small_env(), env.reset(seed=0), env.belief("robot_9")),
        r"agent: expected one of \['robot_0', 'robot_1'\], got 'robot_9'",
    ),
    "belief of an array": (
        lambda: (env := small_env(), env.reset(seed=0), env.belief(np.zeros(3))),
        r"agent: expected one of \['robot_0', 'robot_1'\], got array",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_refused_clearly(name: str) -> None:
    """Bad input raises one ValueError that names the argument, what was expected, what came, and a cure."""
    call, message = CASES[name]
    with pytest.raises(ValueError, match=message) as caught:
        call()
    text = str(caught.value)
    assert ": expected " in text
    assert ", got " in text
    assert text.rstrip().endswith((".", "?"))


@pytest.mark.parametrize("name", ["step", "state", "belief", "events", "readings", "scene", "true_poses", "render"])
def test_nothing_works_before_a_reset(name: str) -> None:
    """What needs an episode says so before the first reset."""
    env = small_env(render_mode="rgb_array")
    calls: dict[str, Callable[[], Any]] = {
        "step": lambda: env.step({}),
        "state": env.state,
        "belief": lambda: env.belief("robot_0"),
        "scene": env.scene,
        "render": env.render,
    }
    with pytest.raises(RuntimeError, match=rf"{name}: expected a running episode, got none\. Call reset\(\) first\."):
        calls.get(name, lambda: getattr(env, name))()


def test_no_step_after_the_end() -> None:
    """After the end of an episode a step says that it has ended."""
    env = small_env(max_cycles=1)
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    with pytest.raises(RuntimeError, match=r"step: expected a running episode, got one that has ended"):
        env.step({agent: np.zeros(2) for agent in env.possible_agents})


def test_refused_actions_move_nothing() -> None:
    """After a refused action the environment is as before."""
    env = small_env()
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match="expected two numbers"):
        env.step({"robot_0": [1, 0], "robot_1": [0, 9]})
    assert np.array_equal(env.state(), before)


@pytest.mark.parametrize(
    "refused",
    [
        {"seed": 2, "options": {"world_seed": -1}},
        {"seed": 2, "options": {"start_poses": [[-50.0, 0.0, 0.0]]}},
        {"options": {"start_poses": [[-50.0, 0.0, 0.0]]}},
        {"seed": -1},
        {"options": 5},
    ],
)
def test_a_refused_reset_changes_nothing(refused: dict[str, Any]) -> None:
    """The running episode goes on, and the next reset draws what it would have drawn."""
    shown = []
    for is_refused in (False, True):
        env = vslam_v0.parallel_env(num_robots=1, num_particles=5, world="fig5")
        env.reset(seed=0)
        if is_refused:
            with pytest.raises(ValueError, match="expected"):
                env.reset(**refused)
        assert env.agents == ["robot_0"]
        stepped = env.step({"robot_0": np.array([0.5, 0.5])})[0]["robot_0"]
        shown.append([stepped["scan"], env.reset()[0]["robot_0"]["scan"], env.true_poses])
    for one, other in zip(*shown, strict=True):
        np.testing.assert_array_equal(one, other)


def test_after_a_refused_first_reset_there_is_no_episode() -> None:
    """A reset that was refused before any other leaves nothing to step, and a good one works."""
    env = vslam_v0.parallel_env(num_robots=1, num_particles=5, world="fig5")
    with pytest.raises(ValueError, match="start_poses"):
        env.reset(seed=0, options={"start_poses": [[-50.0, 0.0, 0.0]]})
    assert env.agents == []
    env.reset(seed=0)
    assert env.agents == ["robot_0"]
