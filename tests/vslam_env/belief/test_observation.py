"""Observations: rebuilt from readings alone, and as their page says."""

import ast
import dataclasses
import inspect
import re
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, small_env, turning, wander

from agents.goal_network import NAMES
from slam_backend.geometry import between, inverse, transform_points
from vslam_env import EnvConfig, ExplorationEnv, preset_config, vslam_v0, vslam_v1
from vslam_env.belief.observation import flatten, observe
from vslam_env.belief.observation_keys import KEYS, MASK, SETS
from vslam_env.belief.readings import Readings, TeamReadings
from vslam_env.belief.team_belief import Belief, TeamBelief
from vslam_env.navigation import CELL, FREE, OCCUPIED, UNKNOWN, cell_of
from vslam_env.reward import TERMS


def _record(env: ExplorationEnv, steps: int) -> tuple[list[tuple[Readings, ...]], list[dict[str, Any]]]:
    """Run an episode in which the robots meet; return the readings of every tick and the observations of every step."""
    readings: list[tuple[Readings, ...]] = []
    env.recorder = readings.append
    observations = [env.reset(seed=5, options={"start_poses": MEETING})[0]]
    rng = np.random.default_rng(2)
    for k in range(steps):
        drive = turning(env.agents) if env.config.action_type == "continuous" and k < 120 else wander(env, rng)
        observations.append(env.step(drive)[0])
    return readings, observations


@pytest.mark.parametrize(("action_type", "steps"), [("continuous", 300), ("goal", 30)])
def test_observations_are_rebuilt_from_readings_alone(action_type: str, steps: int) -> None:
    """300 ticks of observations, a merge among them, follow byte for byte from the readings, with no world present."""
    env = small_env(max_cycles=400, action_type=action_type)
    readings, recorded = _record(env, steps)
    assert any(event.kind == "merge" for event in env.events)
    ticks = env.config.ticks_per_step
    assert len(readings) == 1 + 300

    goal = action_type == "goal"
    episode = env.episode
    belief = TeamBelief(env.config.belief, 2, episode.belief_seed, episode.body, decision_ticks=ticks if goal else None)
    for tick, now in enumerate(readings):
        belief.step(now)
        if tick % ticks:
            continue
        belief.set_seconds_left(0.1 * (400 * ticks - tick))
        for robot, agent in enumerate(env.possible_agents):
            rebuilt = observe(belief.belief(robot), env.config.observed)
            expected = recorded[tick // ticks][agent]
            assert list(rebuilt) == list(expected)
            for name, value in rebuilt.items():
                assert value.tobytes() == expected[name].tobytes(), (tick, agent, name)


def test_readings_of_a_team_are_those_of_its_robots() -> None:
    """Readings that are taken apart and gathered again are what they were."""
    env = small_env(comm_loss=0.5, oracle_pose=True, oracle_association=True)
    readings, _ = _record(env, 3)
    for now in readings:
        again = TeamReadings.stack(now).per_robot()
        for one, other in zip(now, again, strict=True):
            for field, value, same in zip(Readings._fields, one, other, strict=True):
                np.testing.assert_array_equal(value, same, err_msg=field)


def test_every_part_of_an_observation_varies() -> None:
    """Over an episode with a merge each part of the observation carries information: none is constant."""
    _, observations = _record(small_env(max_cycles=400), 300)
    for name in observations[0]["robot_0"]:
        values = np.array([step["robot_0"][name] for step in observations]).reshape(len(observations), -1)
        changing = (values != values[0]).any(axis=0)
        if name in ("pose", "pose_std", "map_stats", "scan"):
            assert changing.all(), name
        assert changing.any(), name


def _plain_local_grid(belief: Belief) -> np.ndarray:
    """Return what `local_grid` returns, looked up cell by cell and landmark by landmark, without a compiled loop."""
    steps = (23.5 - np.arange(48)) * CELL
    ahead, left = np.meshgrid(steps, steps, indexing="ij")
    centres = transform_points(belief.pose, np.stack([ahead, left], axis=-1))
    size = len(belief.grid.cells)
    rows, cols = np.moveaxis(cell_of(centres, size), -1, 0)
    inside = (rows >= 0) & (rows < size) & (cols >= 0) & (cols < size)
    seen = np.where(inside, belief.grid.cells[np.where(inside, rows, 0), np.where(inside, cols, 0)], UNKNOWN)
    picture = np.zeros((3, 48, 48), np.uint8)
    picture[0], picture[1] = 255 * (seen == FREE), 255 * (seen == OCCUPIED)
    places = transform_points(inverse(belief.pose), belief.map.means[:, :2])
    for row, col in np.floor(24.0 - places / CELL).astype(int):
        if 0 <= row < 48 and 0 <= col < 48:
            picture[2, row, col] = 255
    return picture


def test_local_grid_agrees_with_a_plain_one() -> None:
    """Wherever the robot believes to be, at the rim of its grid and beyond as well."""
    env = small_env(max_cycles=60)
    env.reset(seed=2)
    rng = np.random.default_rng(3)
    for _ in range(60):
        env.step(wander(env, rng))
    belief = env.belief("robot_0")
    assert len(belief.map) > 3
    for spread in (2.0, 31.0):
        for _ in range(30):
            moved = dataclasses.replace(belief, pose=np.append(rng.uniform(-spread, spread, 2), rng.uniform(-3.0, 3.0)))
            picture, expected = observe(moved, ["local_grid"])["local_grid"], _plain_local_grid(moved)
            assert (picture != expected).mean() < 1e-3  # a centre on the border of two cells may fall to either side


def test_mask_is_what_the_belief_offers() -> None:
    """Staying is always valid, and action k + 1 exactly where slot k of the candidates is filled."""
    env = small_env(action_type="goal")
    observations, _ = env.reset(seed=3)
    for agent in env.agents:
        valid = env.belief(agent).candidates.valid
        assert observations[agent]["action_mask"].tolist() == [1, *valid.astype(int)]
        assert (observations[agent]["candidates"][~valid] == 0.0).all()


def test_flat_is_the_dict_in_order() -> None:
    """The flat observation is the named one, concatenated in the documented order, the mask apart."""
    named = small_env(action_type="goal").reset(seed=4)[0]["robot_0"]
    flat = small_env(action_type="goal", observation_type="flat").reset(seed=4)[0]["robot_0"]
    assert np.array_equal(flat["action_mask"], named["action_mask"])
    assert np.array_equal(flat["observation"], flatten(named))
    assert np.array_equal(flat["observation"][6:12], named["map_stats"])
    assert flat["observation"].shape == (3 + 3 + 6 + 3 * 48 * 48 + 32 + 32 * 17 + 35 + 7 + 5 + 1 + 3 * 48 * 48 + 3,)


def test_teammates_appear_with_the_merge() -> None:
    """Before a merge there is no teammate; after it the mate stands where it truly is, to within the errors of maps."""
    env = small_env(max_cycles=400)
    _, observations = _record(env, 300)
    merged = next(event.step for event in env.events if event.kind == "merge")
    assert not observations[merged - 1]["robot_0"]["teammates_mask"].any()
    last = observations[-1]
    for robot, other in ((0, 1), (1, 0)):
        seen = last[f"robot_{robot}"]
        assert seen["teammates_mask"].tolist() == [1, 0, 0, 0, 0, 0, 0]
        me, mate = env.true_poses[robot], env.true_poses[other]
        offset = mate[:2] - me[:2]
        c, s = np.cos(me[2]), np.sin(me[2])
        ahead, left = c * offset[0] + s * offset[1], c * offset[1] - s * offset[0]
        assert np.allclose(seen["teammates"][0, :2], [ahead, left], atol=0.5)


def test_numbers_follow_from_the_belief() -> None:
    """Pose, map figures, candidates and teammates are the belief's own, clipped and rounded to float32."""
    env = small_env(max_cycles=400)
    env.reset(seed=5, options={"start_poses": MEETING})
    for step in range(160):
        observations = env.step(turning(env.agents))[0]
        if step % 40:
            continue
        for agent in env.agents:
            belief, observation = env.belief(agent), observations[agent]
            landmarks = belief.map
            sigmas = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2) / 3.0)
            sizes = [len(landmarks), sigmas.mean(), sigmas.max(), landmarks.counts.mean()]
            np.testing.assert_array_equal(observation["pose"], belief.pose.astype(np.float32))
            np.testing.assert_allclose(observation["pose_std"], np.sqrt(np.diagonal(belief.covariance)), rtol=1e-6)
            np.testing.assert_allclose(observation["map_stats"], [*sizes, belief.ess, len(belief.group)], rtol=1e-6)
            np.testing.assert_allclose(observation["candidates"], belief.candidates.features, rtol=1e-6)
            rows = np.zeros((7, 5))
            for mate in belief.teammates:
                x, y, theta = between(belief.pose, mate.pose)
                sigma = np.sqrt(0.5 * np.trace(mate.covariance[:2, :2]))
                rows[mate.robot - (mate.robot > belief.robot)] = x, y, np.cos(theta), np.sin(theta), sigma
            np.testing.assert_allclose(observation["teammates"], rows, rtol=1e-5, atol=1e-6)
    assert len(env.belief("robot_0").teammates) == 1


PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "observations.md").read_text(encoding="utf-8")


def tables() -> dict[str, list[dict[str, str]]]:
    """Return the page's tables by the name of their first column: per row the cells by column, marks of code kept."""
    found: dict[str, list[dict[str, str]]] = {}
    lines = PAGE.splitlines()
    begins = [i for i in range(len(lines) - 1) if lines[i].startswith("|") and lines[i + 1].startswith("|---")]
    for begin in begins:
        columns = cells_of(lines[begin])
        rows = []
        for line in lines[begin + 2 :]:
            if not line.startswith("|"):
                break
            rows.append(dict(zip(columns, cells_of(line), strict=True)))
        name = columns[0].strip("`") + (" by preset" if "easy" in columns else "")
        assert name not in found, f"two tables begin with the column {name}"
        found[name] = rows
    return found


def cells_of(line: str) -> list[str]:
    """Return the cells of a table's line."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


TABLES = tables()


def by_name(table: str) -> dict[str, dict[str, str]]:
    """Return the rows of a table by what stands between the first marks of code in their first cells."""
    rows = TABLES[table]
    named = {next(iter(row.values())).split("`")[1]: row for row in rows}
    assert len(named) == len(rows)
    return named


def test_observations_are_as_the_page_says() -> None:
    """Names, shapes, dtypes and scalar ranges of the table are those of the spaces, in both directions."""
    rows = by_name("key")
    space: Any = small_env(action_type="goal").observation_space("robot_0")
    assert rows.keys() == space.spaces.keys()
    for name, row in rows.items():
        box = space[name]
        assert ast.literal_eval(row["shape"]) == box.shape, name
        assert np.dtype(row["dtype"]) == box.dtype, name
        if " to " in row["range"] and "," not in row["range"]:
            low, high = map(float, row["range"].split(" to "))
            assert (box.low == low).all(), name
            assert (box.high == high).all(), name


def test_the_flat_vector_is_as_long_as_the_page_says() -> None:
    """The page names the shape of the flat observation of all keys, and of those of drivers."""
    space = small_env(observation_type="flat").observation_space("robot_0")
    assert f"float32 vector, {space.shape} for all keys" in PAGE
    driver = small_env(observation_type="flat", observation_keys="driver").observation_space("robot_0")
    assert f'that of `"driver"` has {driver.shape}' in PAGE


def test_sets_are_as_the_page_says() -> None:
    """The page lists the keys of each set, and the default of each version; the shipped network reads none else."""
    rows = {name.strip('"'): row["keys"] for name, row in by_name("set").items()}
    assert rows.keys() == SETS.keys()
    driver, goal = (set(re.findall(r"`(\w+)`", rows[name])) for name in ("driver", "goal"))
    assert (driver, driver | goal) == (set(SETS["driver"]), set(SETS["goal"]))
    assert set(NAMES) <= {*SETS["goal"], MASK}
    assert SETS["all"] == KEYS
    for version in (vslam_v0, vslam_v1):
        for action_type in ("continuous", "discrete", "goal"):
            config = version.parallel_env(action_type=action_type).config
            expected = "all" if version is vslam_v0 else "goal" if action_type == "goal" else "driver"
            assert config.observation_keys == expected


def test_infos_are_as_the_page_says() -> None:
    """The table names each key of an info with its type, and no other."""
    rows = by_name("info")
    env = small_env(reward={"map_error": 1.0, "collisions": 0.5})
    for infos in (env.reset(seed=0)[1], env.step({agent: np.zeros(2) for agent in env.agents})[4]):
        types = {"reward/<term>" if key.startswith("reward/") else key: type(v) for key, v in infos["robot_0"].items()}
        assert {name: row["type"] for name, row in rows.items()} == {key: t.__name__ for key, t in types.items()}


def test_arguments_are_as_the_page_says() -> None:
    """The table names every argument of `parallel_env` in order, and what it is in the standard preset."""
    rows = by_name("argument")
    assert list(rows) == list(inspect.signature(vslam_v0.parallel_env).parameters)
    standard = EnvConfig()
    for name, row in rows.items():
        value = standard.belief.filter.num_particles if name == "num_particles" else getattr(standard, name, None)
        assert ast.literal_eval(row["standard"].strip("`")) == value, name


def test_fields_are_as_the_page_says() -> None:
    """Each field of the configuration stands on the page: as an argument, or in the table of those that are none."""
    rows = by_name("setting")
    arguments = inspect.signature(vslam_v0.parallel_env).parameters
    fields = [field.name for field in dataclasses.fields(EnvConfig) if field.name not in arguments]
    assert list(rows) == fields
    for name, row in rows.items():
        value, said = getattr(EnvConfig(), name), row["standard"].strip("`")
        assert said == (type(value).__name__ if dataclasses.is_dataclass(value) else repr(value)), name


@pytest.mark.parametrize("preset", ["easy", "standard", "hard"])
def test_presets_are_as_the_page_says(preset: str) -> None:
    """The numbers of the table are those of the presets, to three digits."""
    config = preset_config(preset)
    for name, row in by_name("field by preset").items():
        assert float(row[preset]) == pytest.approx(reduce(getattr, name.split("."), config), rel=5e-3), name


def test_reward_terms_and_actions_are_as_the_page_says() -> None:
    """The page names the terms that a reward can have, and the space of each type of action."""
    assert by_name("term").keys() == TERMS.keys()
    for name, row in by_name("action_type").items():
        assert repr(small_env(action_type=name).action_space("robot_0")).replace(".0", "") == row["space"].strip("`")


def test_options_are_as_the_page_says() -> None:
    """The options of a reset that the page names are those that its docstring names, and they are obeyed."""
    rows = by_name("option")
    documented = inspect.getdoc(small_env().reset)
    assert documented is not None
    assert all(f'`"{name}"`' in documented for name in rows)
    env = small_env()
    starts = np.array([[2.0, 2.0, 0.0], [8.0, 3.0, 1.0]])
    options = {"world_seed": 5, "start_poses": starts}
    assert options.keys() == rows.keys()
    env.reset(seed=1, options=options)
    looks = env.world.landmarks
    assert looks is not None
    np.testing.assert_allclose(env.true_start_poses, starts)
    env.reset(seed=2, options=options)
    again = env.world.landmarks
    assert again is not None
    np.testing.assert_array_equal(again.positions, looks.positions)
