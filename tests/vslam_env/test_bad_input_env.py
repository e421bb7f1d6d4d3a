"""Input that makes no sense is refused by name, in one form, and leaves no trace."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.environments import ANGLES, MAX_RANGE, MEETING, WALLS, know, small_env
from builders.refusals import check_complete, check_option, refused

from slam_backend.models.camera import StereoCamera
from vslam_env import EnvConfig, ExplorationEnv, World, preset_config, vslam_v0
from vslam_env.belief.readings import Readings, TeamReadings
from vslam_env.belief.team_belief import BeliefConfig, TeamBelief
from vslam_env.navigation import (
    UNKNOWN,
    CandidateSlots,
    OccupancyGrid,
    TeamGrids,
    distance_map,
    find_frontiers,
    follow_path,
    plan_path,
    ray_directions,
)
from vslam_env.rendering import draw_frame
from vslam_env.sensors import LandmarkSensorConfig, ScanConfig
from vslam_env.sensors.stereo.cameras import ImagingConfig
from vslam_env.sensors.stereo.sensor import StereoSensorConfig
from vslam_env.sensors.stereo.textures import TextureConfig, draw_textures
from vslam_env.solo import SoloExplorationEnv
from vslam_env.world import (
    LandmarkConfig,
    Landmarks,
    OdometryNoise,
    Simulator,
    load_floorplan,
    load_walls_json,
    make_world,
    save_ros_map,
    save_walls_json,
)

NAN, INF, HUGE = np.nan, np.inf, 10**400  # the last is an int that no float can hold

# ---------------------------------------------------------------------- options

COUNT, SHARE, FROM_ZERO, CHORD = "1..1e9", "[0, 1]", "[0, inf)", "(0, 1.41421]"
SIGMA = "[0, 100]"
OPTIONS: dict[type[Any], tuple[str, dict[str, str | list[Any]]]] = {
    EnvConfig: ("", {
        "num_robots": "1..8", "decision_ticks": COUNT, "max_cycles": [0, True, "9", 2.0], "max_seconds": "(0, 1e8]",
        "stop_at_recall": "(0, 1]",
        "comm_range": FROM_ZERO, "comm_loss": SHARE, "comm_outage_seconds": [-1.0, 5.0, NAN],
        "robot_radius": "(0, 200]", "min_start_distance": FROM_ZERO,
        "map_error_cutoff": "[1e-6, 1e6]", "comm_line_of_sight": [1], "oracle_pose": ["yes", 1], "oracle_merge": [1],
        "oracle_floor": [1],
        "shared_start_view": [0.0], "shared_reward": ["yes"], "sensor": ["sonar"], "action_type": ["jump"],
        "observation_type": ["image"], "belief": [5], "stereo": [StereoCamera()], "world": [3], "reward": [1.0],
    }),
    LandmarkConfig: ("landmarks.", {
        "density": "(0, 10000]", "min_height": [-1e12, NAN], "max_height": "[-0.6, 1000]",
        "min_spacing": FROM_ZERO, "descriptor_size": "2..10000", "distinctness": CHORD, "repeated": SHARE,
    }),
    OdometryNoise: ("odometry.", dict.fromkeys(OdometryNoise.__slots__, SIGMA)),
    LandmarkSensorConfig: ("sensor.", {
        "max_measurements": "1..10000", "detection_probability": SHARE, "false_points": "[0, 10000]", "camera": [None],
        "descriptor_noise": "[0, 1e6]", "max_incidence": "(0, 1.5707]",
    }),
    ScanConfig: ("scan.", {
        "num_rays": "2..100000", "half_fov": "[0.001, 3.14159]", "max_range": "[0.001, 1e6]", "sigma": "[0, 1e6]",
    }),
    ImagingConfig: ("imaging.", dict.fromkeys(("noise", "gain_sigma", "eye_gain_sigma", "blur_px"), SIGMA) | {
        "parts": "1..1000",
    }),
    TextureConfig: ("textures.", {
        "texel": "[0.002, 0.1]", "floor": [-1e3, 1e3], "ceiling": "[-0.8, 99.1]", "polygons": "[0, 10000]",
        "posters": "[0, 10000]", "style": ["wallpaper"], "images": [3],
    }),
    StereoSensorConfig: ("stereo.", {
        "working_distance": [1e-300, 0.09, 1001.0, NAN, True, "0.5"],
        "max_incidence": "(0, 1.5707]", "tolerance": "(0, 1000]", "camera": [1],
        "front_end": [None],
    }),
    BeliefConfig: ("belief.", {"confirm_after": COUNT}),
}  # fmt: skip
ALL_OPTIONS = [(kind, name) for kind, (_, table) in OPTIONS.items() for name in table]


@pytest.mark.parametrize(("kind", "name"), ALL_OPTIONS, ids=[f"{kind.__name__}.{name}" for kind, name in ALL_OPTIONS])
def test_options_take_the_numbers_of_their_intervals_alone(kind: type[Any], name: str) -> None:
    """The ends of an interval are taken, and what lies outside, bools, texts and other kinds are refused by name."""
    called, table = OPTIONS[kind]
    check_option(kind, called, name, table[name], {})
    if kind is EnvConfig and name != "stereo":
        for bad in table[name] if isinstance(table[name], list) else ("many",):
            refused(lambda bad=bad: EnvConfig.from_dict({name: bad}), f"{name}: expected ")


@pytest.mark.parametrize("kind", OPTIONS, ids=lambda kind: kind.__name__)
def test_all_numbers_of_options_have_their_intervals(kind: type[Any]) -> None:
    """Whatever number a class of options has stands in the table."""
    check_complete(kind, OPTIONS[kind][1])


PARTS = {
    "belief.filter.num_particles": {"belief": {"filter": {"num_particles": 10.0}}},
    "camera.focal_px": {"belief": {"filter": {"camera": {"focal_px": 1e-300}}}},
    "motion.sigma_along": {"belief": {"filter": {"motion": {"sigma_along": 1e300}}}},
    "max_keys": {"belief": {"filter": {"smoothing": {"max_keys": 10**30}}}},
    "belief.confirm_after": {"belief": {"confirm_after": 2**63}},
    "landmarks.max_height": {"landmarks": {"max_height": 1e12}},
    "odometry.sigma_distance": {"odometry": {"sigma_distance": 1e300}},
    "sensor.false_points": {"landmark_sensor": {"false_points": 1e300}},
    "scan.max_range": {"scan": {"max_range": 1e300}},
    "stereo.camera": {"stereo": {"camera": {"width": 10**6, "height": 10**6}}},
    "textures.polygons": {"stereo": {"textures": {"polygons": 1e300}}},
    "imaging.parts": {"stereo": {"imaging": {"parts": 2**63}}},
    "corners.block": {"stereo": {"front_end": {"corners": {"block": 2**63}}}},
    "front_end.nearest": {"stereo": {"front_end": {"nearest": 0.01}}},
    "robots: expected a known field": {"robots": 2},
    "belief.filter.particles: expected a known field": {"belief": {"filter": {"particles": 5}}},
    "config: expected values that JSON can represent": {"num_robots": 10**5000},
}


def test_misspelt_names_get_the_nearest_one() -> None:
    """A field at any depth, a choice and a reward term are refused with the name that is probably meant."""
    for changes, meant in (
        ({"robot_radus": 0.1}, "robot_radius"), ({"belief": {"filter": {"num_particle": 5}}}, "num_particles"),
        ({"sensor": "sterio"}, "stereo"), ({"action_type": "goals"}, "goal"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=rf"Did you mean '{meant}'\?"):
            EnvConfig().replace(**changes)
    with pytest.raises(ValueError, match=r"got 'map_eror'\. Did you mean 'map_error'\?"):
        small_env(reward={"map_eror": 1.0})


@pytest.mark.parametrize("begins", PARTS)
def test_parts_of_a_configuration_are_checked_when_it_is_made(begins: str) -> None:
    """Not at a reset, nor in a step."""
    refused(lambda: EnvConfig().replace(**PARTS[begins]), begins)


@pytest.mark.parametrize("sensor", ["landmark", "stereo"])
def test_noise_under_which_filters_can_use_no_point_is_refused(sensor: str) -> None:
    """A filter whose camera makes covariances too flat for the points of the sensor is refused by name, at once."""
    for camera in ({"sigma_px": 1e-9}, {"sigma_disparity_px": 70.0}, {"baseline": 1e-6}, {"sigma_disparity_px": 1e5}):
        refused(
            partial(preset_config("standard", sensor).replace, belief={"filter": {"camera": camera}}),  # type: ignore[arg-type]
            "belief.filter.camera: expected noise that allows the use of points",
        )


# ---------------------------------------------------------------------- calls

CLOSET = World("closet", [[0, 0, 2, 0], [2, 0, 2, 2], [2, 2, 0, 2], [0, 2, 0, 0]])
NARROW = World("narrow", [[0, 0, 9, 0], [9, 0, 9, 0.3], [9, 0.3, 0, 0.3], [0, 0.3, 0, 0]])
BOX = World("box", [[0, 0, 0.5, 0], [0.5, 0, 0.5, 0.5], [0.5, 0.5, 0, 0.5], [0, 0.5, 0, 0]])
MARKS: dict[str, Any] = {
    "positions": [[1, 0, 0.2], [2, 0, -0.3]], "normals": [[0, 1], [0, 1]], "walls": [0, 0], "descriptors": np.eye(2, 7),
}  # fmt: skip
CELLS = OccupancyGrid().cells
POSE = (0.0, 0.0, 0.0)


class Term:
    """A reward term that returns what it was made with."""

    def __init__(self, value: Any = 0.0, name: Any = "given") -> None:
        self.value, self.name, self.weight = value, name, 1.0

    def __call__(self, before: Any, after: Any) -> Any:
        """Return the value."""
        return self.value


class Nameless:
    """No reward term."""

    weight = 1.0


def begin(**options: Any) -> Callable[[], Any]:
    """Return a call that makes an environment and begins an episode in it."""
    return lambda: small_env(**options).reset(seed=0)


def rewarded(value: Any) -> Callable[[], Any]:
    """Return a call that makes a step for which a term gives this reward."""

    def act() -> None:
        env = small_env(reward=[Term(value)])
        env.reset(seed=0)
        env.step(dict.fromkeys(env.agents, (0.0, 0.0)))

    return act


def marked(places: Any) -> World:
    """Return the room with landmarks at these places (n, 3), all on the first wall."""
    n = len(places)
    looks = np.tile(np.eye(1, 64, dtype=np.float32), (n, 1))
    return World("blank", WALLS, Landmarks(places, np.tile([0.0, 1.0], (n, 1)), np.zeros(n, np.int64), looks))


def asked(name: str, *arguments: Any) -> Callable[[], Any]:
    """Return a call of an environment in an episode."""

    def act() -> None:
        env = small_env()
        env.reset(seed=0)
        getattr(env, name)(*arguments)

    return act


def world(walls: Any, **more: Any) -> Callable[[], World]:
    """Return a call that makes a world."""
    return lambda: World("w", walls, **more)


CALLS: dict[str, list[Callable[[], Any]]] = {
    "world: expected": [
        partial(small_env, world=bad)
        for bad in (3, "castle", "", "x" * 5000, "x" * 5000 + ".json", "nowhere.json", "nowhere.png")
    ],
    "world: expected a function that returns a World": [begin(world=lambda rng: 5)],
    "world: expected a function of one argument": [begin(world=lambda: CLOSET), begin(world=World)],
    "world: expected a function of rng": [begin(world=os.system)],
    "world: expected one of 'office'": [partial(make_world, "ofice", np.random.default_rng(0))],
    "world: expected a name, a path, a World or a function": [partial(make_world, 7, np.random.default_rng(0))],
    "world: expected a file, got": [
        *(partial(make_world, name, np.random.default_rng(0)) for name in ("missing.png", "missing.json")),
        partial(load_floorplan, "x" * 5000 + ".png"),
    ],
    "world: expected the path of a file, got": [partial(load_floorplan, None), partial(load_walls_json, 3)],
    "metres_per_pixel: expected a finite number > 0": [partial(load_floorplan, "plan.png", metres_per_pixel=-1)],
    "path: expected": [
        *(partial(save_walls_json, CLOSET, to) for to in (None, Path("nowhere") / "copy.json")),
        *(partial(save_ros_map, OccupancyGrid(), to) for to in (None, "map.png")),
    ],
    "grid: expected": [partial(save_ros_map, OccupancyGrid(), "map.yaml")],
    "world: expected walls that enclose free space for a disc": [begin(world=BOX), begin(world=NARROW)],
    "num_robots: expected at most as many as fit 5 m apart": [begin(world=CLOSET, num_robots=8)],
    "world: expected landmarks that robots can see": [
        begin(world=marked(places)) for places in (np.zeros((0, 3)), np.array([[500.0, 0.0, 0.0]]))
    ],
    "world.start_poses: expected": [
        begin(world=World("two", WALLS, start_poses=MEETING), num_robots=3), world(WALLS, start_poses=[[1, 2]]),
    ],
    "world.walls: expected": [world(bad) for bad in ([], [[0, 0, 1]], [[0, 0, 1, NAN]], [[0, 0, 5000, 0]])],
    "world.walls[5]: expected a wall longer than 0.001 m": [world([*WALLS, [1, 1, 1, 1]])],
    "world.name: expected a string": [lambda: World(3, WALLS)],  # type: ignore[arg-type]
    "world.landmarks.walls: expected": [lambda: World("w", WALLS, Landmarks(**MARKS | {"walls": [0, 9]}))],
    "world.landmarks: expected": [lambda: World("w", WALLS, "many")],  # type: ignore[arg-type]
    "landmarks.normals: expected unit vectors": [lambda: Landmarks(**MARKS | {"normals": [[0, 1], [0, 2]]})],
    "landmarks.descriptors: expected": [
        lambda: Landmarks(**MARKS | {"descriptors": np.zeros((2, 7))}),
        lambda: Landmarks(**MARKS | {"descriptors": [[1e30]] * 2}),
    ],
    "landmarks.walls: expected": [lambda: Landmarks(**MARKS | {"walls": [0]})],
    "landmarks.positions: expected numbers within": [partial(marked, np.array([[1e308, 0.0, 0.0]]))],
    "num_particles: expected an int": [partial(small_env, num_particles=bad) for bad in (0, 10**9)],
    "preset: expected": [partial(small_env, preset="brutal"), partial(small_env, preset="easy", config=EnvConfig())],
    "render_mode: expected one of": [partial(small_env, render_mode="ansi")],
    "world_split: expected": [
        partial(small_env, world_split="test"), partial(vslam_v0.parallel_env, world_split="exam"),
    ],
    "observe_images: expected False": [
        partial(small_env, observe_images=True),
        partial(small_env, observe_images=True, sensor="stereo", observation_type="flat"),
    ],
    "textures.images: expected a folder": [
        lambda: draw_textures(WALLS, np.random.default_rng(1), TextureConfig(images="none"))
    ],
    "world: expected a file": [partial(ExplorationEnv, EnvConfig(world="nowhere.json"))],
    "config: expected an EnvConfig": [partial(small_env, config=7)],
    "config: expected a TOML file": [partial(small_env, config="nowhere.toml")],
    "config: expected the path of a file": [
        partial(EnvConfig.from_toml, "a\0.toml"), partial(EnvConfig.from_toml, None),
    ],
    "config: expected TOML as text": [partial(EnvConfig.from_toml_text, 3)],
    "config: expected a file in TOML, got a syntax error": [partial(EnvConfig.from_toml_text, "[x")],
    "max_cycles: expected an int >= 1": [
        partial(lambda bad: setattr(small_env(), "max_cycles", bad), bad) for bad in ("x", None)
    ],
    "max_seconds: expected None together with max_cycles": [
        partial(small_env, max_seconds=3.0), partial(EnvConfig, max_cycles=3, max_seconds=3.0),
        lambda: EnvConfig().replace(max_cycles=3, max_seconds=3.0),
    ],
    "recorder: expected a function or None": [lambda: setattr(small_env(), "recorder", 5)],
    "reward: expected": [
        partial(small_env, reward=bad)
        for bad in ([Nameless()], [Term], [Term(), Term()], [Term(name=3)], {}, [], "map_error", {"fame": 1.0})
    ],
    "reward['map_error']: expected a finite number": [
        partial(small_env, reward={"map_error": bad}) for bad in (NAN, HUGE)
    ],
    "reward term 'given': expected 2 finite numbers": [
        rewarded(bad) for bad in (
            np.array([1.0, NAN]), ["a", "b"], ["1", "2"], [1j, np.complex128(1.0)], [HUGE, 0], {"robot_0": 1.0},
        )
    ],
    "state: expected what get_state returned": [lambda: small_env().set_state([])],
    "agent: expected one of ['robot_0', 'robot_1']": [
        *(asked(name, "robot_7") for name in ("observation_space", "action_space", "belief")),
        asked("belief", np.zeros(3)),
    ],
    "num_robots: expected 1, got": [partial(SoloExplorationEnv, num_robots=2)],
    "seed: expected an int >= 0": [lambda: SoloExplorationEnv(world="fig5").reset(seed=-1)],
    "size: expected a pair": [partial(draw_frame, None, bad) for bad in ((960,), 960)],
    "size[0]: expected an int >= 160": [partial(draw_frame, None, (100, 720))],
    "size[1]: expected an int >= 120": [partial(draw_frame, None, (960, 7.5))],
    "cells: expected the grid, or its cells": [
        *(partial(plan_path, bad, (0, 0), (1, 1)) for bad in (CELLS[:7], CELLS.astype(float), [[1]])),
        lambda: CandidateSlots().update(CELLS[1:], POSE),
    ],
    "start_xy: expected": [
        partial(plan_path, CELLS, POSE, (1, 1)), partial(distance_map, CELLS, (INF, 0)),
        partial(find_frontiers, CELLS, (0, INF)),
    ],
    "goal_xy: expected finite numbers": [partial(plan_path, CELLS, (0, 0), (1, NAN))],
    "radius: expected a finite number >= 0.11": [partial(plan_path, CELLS, (0, 0), (1, 1), radius=-0.2)],
    "pose: expected": [
        *(partial(follow_path, bad, [[1, 1]]) for bad in ((0, 0), (0, 0, NAN))),
        *(partial(CandidateSlots().update, CELLS, bad) for bad in ((0, 0), (0, 0, NAN))),
    ],
    "path: expected an array of shape (n, 2)": [
        partial(follow_path, POSE, bad) for bad in (np.empty((0, 2)), [1.0, 2.0])
    ],
    "teammates: expected finite": [
        partial(CandidateSlots().update, CELLS, POSE, [1.0, 2.0]),
        partial(CandidateSlots().update, CELLS, POSE, [[NAN, 2.0]]),
    ],
    "ignored: expected finite numbers in an array": [partial(find_frontiers, CELLS, (0, 0), ignored=np.zeros(3, bool))],
    "angles: expected": [partial(ray_directions, bad) for bad in (ANGLES[::-1], ANGLES[:0], np.array([-1.6, 1.6]))],
}  # fmt: skip


@pytest.mark.parametrize("begins", CALLS)
def test_arguments_without_sense_are_refused_by_name(begins: str) -> None:
    """Bad input raises one ValueError that names the argument, what was expected, what came, and a cure."""
    for call in CALLS[begins]:
        refused(call, begins)


FILES: dict[str, list[tuple[str, bytes]]] = {
    "world: expected an image file": [("plan.png", b"no picture")],
    "world: expected a file in JSON": [("plan.json", b"{"), ("plan.json", b"[" * 100_000)],
    "world: expected a file in YAML, got a syntax error": [("map.yaml", b"image: [1, 2")],
    "world: expected a mapping with the key 'image'": [("map.yaml", b"resolution: 1"), ("map.yaml", b"[1, 2]")],
    "world.walls: expected": [
        ("plan.json", b'{"walls": ' + walls + b"}")
        for walls in (b'"all"', b'[["0", 0, 9, 0]]', b"[[0, 0, 1" + b"0" * 400 + b", 0]]", b"[[-1e308, 0, 1e308, 0]]")
    ],
    "world: expected walls that enclose free space": [("plan.json", b'{"walls": [[0, 0, 5, 0]]}')],
    "world: expected": [("plan.json", text) for text in (b"[1, 2]", b'{"wals": []}')],
    "world: expected no other keys in": [("plan.json", b'{"walls": [[0, 0, 5, 0]], "start_pose": [[1, 1, 0]]}')],
    "world: expected a folder with floor plans": [("nested/plan.txt", b"no plan")],
}


@pytest.mark.parametrize("begins", FILES)
def test_files_that_hold_no_world_are_refused(begins: str, tmp_path: Path) -> None:
    """The error says what the file should hold, before an episode begins."""
    for name, content in FILES[begins]:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        refused(begin(world=path.parent if "/" in name else path), begins)


# ---------------------------------------------------------------------- what is refused leaves no trace

REST = (0.0, 0.0)
ACTIONS: dict[str, dict[str, list[Any]]] = {
    "continuous": {
        "actions: expected": [[1, 2], {"robot_0": REST, "robot_1": REST, "robot_7": REST}, {"robot_0": REST}],
        "actions['robot_0']: expected": [
            {"robot_0": bad, "robot_1": (1.0, 0.0)} for bad in (
                [0, NAN], [2, 0], [0, 0, 0], "go", ["0.1", "0.2"], np.zeros(2, complex), np.array([0.1, "b"], object),
                np.array([True, False]), [True, 0.5], np.ma.masked_equal([0.5, 0.1], 0.1), np.zeros((2, 1)),
            )
        ],
        "actions['robot_1']: expected two numbers in [-1, 1]": [{"robot_0": [1, 0], "robot_1": [0, 9]}],
    },
    "discrete": {"actions['robot_0']: expected an int from 0 to 3": [{"robot_0": 4, "robot_1": 0}]},
    "goal": {"actions['robot_1']: expected an int from 0 to 32": [{"robot_0": 0, "robot_1": bad} for bad in (-1, 1.5)]},
}  # fmt: skip


@pytest.mark.parametrize("action_type", ACTIONS)
def test_refused_actions_move_nothing(action_type: str) -> None:
    """Neither robot moves, nor is anything drawn, and good actions do afterwards what they would have done."""
    env, untouched = (small_env(action_type=action_type) for _ in range(2))
    for one in (env, untouched):
        one.reset(seed=0)
    for begins, refusals in ACTIONS[action_type].items():
        for bad in refusals:
            refused(partial(env.step, bad), begins)
    np.testing.assert_array_equal(env.state(), untouched.state())
    good = dict.fromkeys(env.agents, np.array([0.5, 0.1]) if action_type == "continuous" else 1)
    assert_same(env.step(good)[0], untouched.step(good)[0])


STARTS = "start_poses"
RESETS: dict[str, list[dict[str, Any]]] = {
    "seed: expected an int >= 0": [{"seed": -1}, {"seed": "x"}],
    "options: expected a dict or None": [{"options": [1]}, {"options": 5}],
    "options['world_seed']: expected an int >= 0": [{"seed": 2, "options": {"world_seed": bad}} for bad in (1.5, -1)],
    f"{STARTS}: expected": [
        {"options": {"start_poses": bad}} for bad in (
            [[1, 2, 3]], *([[x, 3, 0], [4, 4, 0]] for x in (NAN, HUGE, 1e308, "3", np.complex128(3))),
        )
    ],
    f"{STARTS}[1]: expected a place": [
        {"options": {"start_poses": bad}} for bad in ([[3, 3, 0], [0.1, 5, 0]], [MEETING[0], MEETING[0]])
    ],
    f"{STARTS}[0]: expected a reachable": [{"seed": 2, "options": {"start_poses": [[-50.0, 0.0, 0.0], [4, 4, 0]]}}],
}  # fmt: skip


def test_a_refused_reset_changes_nothing() -> None:
    """The running episode continues, and the next reset draws what it would have drawn without the refusal."""
    env, untouched = small_env(), small_env()
    refused(partial(env.reset, seed=0, options={"start_poses": [[-50.0, 0.0, 0.0]] * 2}), STARTS)
    assert env.agents == []
    for one in (env, untouched):
        one.reset(seed=0)
    for begins, refusals in RESETS.items():
        for bad in refusals:
            refused(partial(env.reset, **bad), begins)
    actions = dict.fromkeys(env.agents, np.array([0.5, 0.5]))
    assert_same(env.step(actions)[0], untouched.step(actions)[0])
    assert_same(env.reset(), untouched.reset())
    np.testing.assert_array_equal(env.true_poses, untouched.true_poses)


COMMANDS: list[Any] = [
    [[1.0, 0.0]], "fast", [[NAN, 0.0], [0.0, 0.0]], np.array([[0.0, 0.0], [0.0, NAN]]),
    np.array([[0.0, INF], [0.0, 0.0]]), np.array([[0.0, 0.0], [-INF, 0.0]]), np.array([[1e300, 0.0], [0.0, 0.0]]),
    np.array([[0.0, 0.0], [0.0, -1e4]]), np.zeros((2, 2), complex),
]  # fmt: skip


def test_refused_commands_move_nothing() -> None:
    """Commands of the wrong shape, not finite or not real leave a simulator and an episode where they are."""
    simulator = Simulator(World("open", WALLS), MEETING)
    env, same = small_env(), small_env()
    for one in (env, same):
        one.reset(seed=100)
    for bad in COMMANDS:
        for call in (simulator.step, env.episode.advance):
            refused(partial(call, bad), "commands: expected ")
    np.testing.assert_array_equal(simulator.poses, MEETING)
    for one in (env, same):
        one.step(dict.fromkeys(one.agents, (0.5, 0.5)))
    np.testing.assert_array_equal(env.true_poses, same.true_poses)
    np.testing.assert_array_equal(env.belief("robot_0").pose, same.belief("robot_0").pose)


READINGS: list[tuple[str, Any]] = [
    ("odometry", np.zeros(2)), ("odometry", "ahead"), ("odometry", [0.0, NAN, 0.0]), ("measurements", None),
    ("scan", "far"), ("scan", np.ones(31)), ("bump", np.zeros(2, np.bool_)), ("pose", np.zeros(2)),
    ("contacts", np.ones(3, np.bool_)), ("contacts", None),
]  # fmt: skip


def test_refused_readings_leave_beliefs_as_they_are() -> None:
    """The error names the reading and its robot; beliefs go on as if they had never been given the wrong ones."""
    env = small_env(comm_loss=0.5, oracle_pose=True)
    record: list[tuple[Readings, ...]] = []
    env.recorder = record.append
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(3):
        env.step(dict.fromkeys(env.agents, (0.25, 0.4)))
    episode = env.episode
    whole, refusing = (TeamBelief(env.config.belief, 2, episode.belief_seed, episode.body) for _ in range(2))
    whole.step(record[0]), refusing.step(record[0])
    for readings in record[1:]:
        now, (first, second) = TeamReadings.stack(readings), readings
        for name, bad in READINGS:
            other = second._replace(**{name: bad})
            refused(partial(refusing.step, [first, other]), f"readings[1].{name}: expected ")
        odd = second._replace(contacts=np.ones(2, np.int64))
        refused(partial(refusing.step, [first, odd]), "contacts: expected a symmetric array of bools")
        for begins, other in (
            ("readings.scans: expected an array of shape (2, 32)", now._replace(scans=now.scans[:, 1:])),
            ("readings.bumps: expected an array of shape (2,)", now._replace(bumps=now.bumps[:1])),
            ("readings[0].contacts: expected an array of shape (1,)", [first]),
            ("readings: expected at least one", []),
        ):
            refused(partial(refusing.step, other), begins)
        whole.step(now), refusing.step(now)
        np.testing.assert_array_equal(refusing.poses, whole.poses)


RANGES = np.full(32, 2.0)
PAINTED: dict[str, list[Callable[[OccupancyGrid], Any]]] = {
    "pose: expected": [
        lambda grid: grid.update_from_scan((0.0, 0.0), RANGES, ANGLES), lambda grid: grid.clear_disc((INF, 0.0, 0.0)),
        lambda grid: grid.update_from_scan((NAN, 0.0, 0.0), RANGES, ANGLES),
    ],
    "ranges: expected an array of shape (n,)": [lambda grid: grid.update_from_scan(POSE, RANGES[:5], ANGLES)],
    "ranges: expected distances >= 0": [
        lambda grid: grid.update_from_scan(POSE, -RANGES, ANGLES),
        lambda grid: grid.update_from_scan(POSE, RANGES * NAN, ANGLES),
    ],
    "angles: expected ascending": [
        lambda grid: grid.update_from_scan(POSE, RANGES, ANGLES[::-1]),
        lambda grid: grid.update_from_scan(POSE, RANGES, ANGLES * 5),
        lambda grid: grid.update_from_scan(POSE, RANGES, ANGLES * NAN),
    ],
    "radius: expected a finite number > 0": [lambda grid: grid.clear_disc(POSE, radius=0.0)],
    "self_from_other: expected finite numbers": [lambda grid: grid.merge(OccupancyGrid(), (0.0, NAN, 0.0))],
    "state['known'].values: expected an array of int8": [lambda grid: know(grid, np.zeros((2, 3)))],
    "state['known']: expected parts that fit together, got '3 cells from 2148 on": [
        lambda grid: know(grid, np.zeros((2, 3), np.int8), (0, 2148))
    ],
}  # fmt: skip


def test_refused_scans_paint_nothing() -> None:
    """Not even what is good, beside a reading at no place or of negative ranges."""
    grid = OccupancyGrid()
    for begins, calls in PAINTED.items():
        for call in calls:
            refused(partial(call, grid), begins)
    assert not grid.cells.any()
    team, rays = TeamGrids(2), ray_directions(np.array([-0.1, 0.0, 0.1]))
    for name, pose, ranges in (
        ("pose", [0.0, NAN, 0.0], [1.0, 1.0, 1.0]),
        ("ranges", POSE, [1.0, -1.0, 1.0]), ("ranges", POSE, [1.0, NAN, 1.0]),
    ):  # fmt: skip
        poses, scans = np.full((2, 2, 3), NAN), np.array([np.ones(3), ranges])
        poses[0, 0], poses[1, 1] = 0.0, pose
        paint = partial(team.update, np.eye(2, dtype=np.int64), poses, scans, np.zeros(2, np.bool_))
        refused(partial(paint, rays, MAX_RANGE, 0.2), f"{name}: expected")
    assert all((grid.cells == UNKNOWN).all() for grid in team.grids)


# ---------------------------------------------------------------------- no episode


@pytest.mark.parametrize("name", ["step", "state", "belief", "events", "readings", "scene", "true_poses", "render"])
def test_nothing_works_before_a_reset(name: str) -> None:
    """What needs an episode says so before the first reset."""
    env = small_env(render_mode="rgb_array")
    arguments = {"step": [{}], "belief": ["robot_0"]}.get(name, [])
    refusal = rf"{name}: expected a running episode, got none\. Call reset\(\) first\."
    with pytest.raises(RuntimeError, match=refusal):
        getattr(env, name)(*arguments)


def test_no_step_after_the_end() -> None:
    """After the end of an episode a step says that it has ended."""
    env = small_env(max_cycles=1)
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    with pytest.raises(RuntimeError, match=r"step: expected a running episode, got one that has ended"):
        env.step({agent: np.zeros(2) for agent in env.possible_agents})
