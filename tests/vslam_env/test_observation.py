import dataclasses
from typing import Any

import numpy as np
import pytest
from small_env import MEETING, small_env, turning, wander

from slam_backend.geometry import between, inverse, transform_points
from vslam_env import ExplorationEnv
from vslam_env.belief.observation import flatten, observe
from vslam_env.belief.readings import Readings, TeamReadings
from vslam_env.belief.team_belief import Belief, TeamBelief
from vslam_env.navigation import CELL, FREE, GRID_SIZE, OCCUPIED, UNKNOWN, cell_of

KEYS = ["pose", "pose_std", "map_stats", "local_grid", "scan", "candidates", "teammates", "teammates_mask"]


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
        for robot, agent in enumerate(env.possible_agents):
            rebuilt = observe(belief.belief(robot), now[robot].scan, goal)
            expected = recorded[tick // ticks][agent]
            assert list(rebuilt) == list(expected)
            for name, value in rebuilt.items():
                assert value.tobytes() == expected[name].tobytes(), (tick, agent, name)


def test_scans_and_bumps_of_another_length_are_refused_before_anything_changes() -> None:
    """Beliefs that refused readings go on with right ones as if they had never been given the wrong ones."""
    env = small_env()
    readings, _ = _record(env, 3)
    episode = env.episode
    whole, refusing = (TeamBelief(env.config.belief, 2, episode.belief_seed, episode.body) for _ in range(2))
    for now in map(TeamReadings.gathered, readings):
        short = now._replace(scans=now.scans[:, 1:])
        with pytest.raises(ValueError, match=r"readings.scans: .* shape \(2, 32\), got shape \(2, 31\)"):
            refusing.step(short)
        with pytest.raises(ValueError, match=r"readings.scans: .* shape \(2, 32\), got shape \(1, 32\)"):
            refusing.step(now.of_each()[:1])
        with pytest.raises(ValueError, match=r"readings: expected those of each robot"):
            refusing.step([])
        with pytest.raises(ValueError, match=r"readings.bumps: expected an array of shape \(2,\), got shape \(1,\)"):
            refusing.step(now._replace(bumps=now.bumps[:1]))
        whole.step(now), refusing.step(now)
        np.testing.assert_array_equal(refusing.poses, whole.poses)


def test_readings_of_a_team_are_those_of_its_robots() -> None:
    """Readings that are taken apart and gathered again are what they were; what does not fit together is refused."""
    env = small_env(comm_loss=0.5, oracle_pose=True, oracle_association=True)
    readings, _ = _record(env, 3)
    for now in readings:
        again = TeamReadings.gathered(now).of_each()
        for one, other in zip(now, again, strict=True):
            for field, value, same in zip(Readings._fields, one, other, strict=True):
                np.testing.assert_array_equal(value, same, err_msg=field)
    first, second = readings[-1]
    with pytest.raises(ValueError, match=r"readings\[1\].scan: .* shape \(32,\), got shape \(31,\)"):
        TeamReadings.gathered([first, second._replace(scan=second.scan[1:])])
    with pytest.raises(ValueError, match=r"readings\[0\].heard: expected an array, got None"):
        TeamReadings.gathered([first._replace(heard=None), second])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("odometry", np.zeros(2), r"readings\[1\]\.odometry: expected an array of shape \(3,\), got shape \(2,\)"),
        (
            "odometry",
            "ahead",
            r"readings\[1\]\.odometry: expected an array of shape \(3,\) of real numbers",
        ),
        ("odometry", [0.0, np.nan, 0.0], r"readings\[1\]\.odometry: expected finite numbers, got NaN"),
        ("measurements", None, r"readings\[1\]\.measurements: expected an array, got None"),
        ("scan", "far", r"readings\[1\]\.scan: expected an array of shape \(32,\) of real numbers, got 'far'"),
        ("bump", np.zeros(2, np.bool_), r"readings\[1\]\.bump: expected an array of shape \(\), got shape \(2,\)"),
        ("pose", np.zeros(2), r"readings\[1\]\.pose: expected an array of shape \(3,\), got shape \(2,\)"),
        ("heard", np.ones(3, np.bool_), r"readings\[1\]\.heard: expected an array of shape \(2,\), got shape \(3,\)"),
        ("heard", np.ones(2, np.int64), r"contacts: expected a symmetric array of bools, got"),
    ],
)
def test_readings_that_make_no_sense_are_refused(name: str, value: Any, message: str) -> None:
    """The error names the reading and its robot, and the beliefs are as before."""
    env = small_env(comm_loss=0.5, oracle_pose=True)
    readings, _ = _record(env, 2)
    episode = env.episode
    whole, refusing = (TeamBelief(env.config.belief, 2, episode.belief_seed, episode.body) for _ in range(2))
    whole.step(readings[0]), refusing.step(readings[0])
    first, second = readings[1]
    with pytest.raises(ValueError, match=message):
        refusing.step([first, second._replace(**{name: value})])
    whole.step(readings[1]), refusing.step(readings[1])
    np.testing.assert_array_equal(refusing.poses, whole.poses)


@pytest.mark.parametrize("observation_type", ["dict", "flat"])
@pytest.mark.parametrize("action_type", ["continuous", "discrete", "goal"])
def test_observations_are_inside_their_spaces(action_type: str, observation_type: str) -> None:
    """Every observation is in its space, dtype included, from the reset on."""
    env = small_env(action_type=action_type, observation_type=observation_type, num_robots=3, max_cycles=25)
    observations, _ = env.reset(seed=1)
    rng = np.random.default_rng(0)
    while env.agents:
        for agent, observation in observations.items():
            assert env.observation_space(agent).contains(observation)
        observations = env.step(wander(env, rng))[0]


def test_keys_shapes_and_types() -> None:
    """Observations have the documented names, shapes and types, and a mask exactly where actions are goals."""
    observation = small_env(action_type="goal").reset(seed=1)[0]["robot_1"]
    assert list(observation) == [*KEYS, "action_mask"]
    shapes = {name: value.shape for name, value in observation.items()}
    assert shapes == {
        "pose": (3,),
        "pose_std": (3,),
        "map_stats": (6,),
        "local_grid": (3, 48, 48),
        "scan": (32,),
        "candidates": (16, 5),
        "teammates": (7, 5),
        "teammates_mask": (7,),
        "action_mask": (17,),
    }
    types = {"local_grid": np.uint8, "teammates_mask": np.int8, "action_mask": np.int8}
    assert all(value.dtype == types.get(name, np.float32) for name, value in observation.items())
    assert list(small_env().reset(seed=1)[0]["robot_1"]) == KEYS


def test_consecutive_observations_share_no_memory() -> None:
    """What an agent does to an observation changes neither the next one nor what the robot believes."""
    env = small_env(action_type="goal")
    before, _ = env.reset(seed=3)
    after = env.step(dict.fromkeys(env.agents, 0))[0]
    for agent in before:
        for name in before[agent]:
            for other in after.values():
                assert not np.shares_memory(before[agent][name], other[name])
    pose, scan = env.belief("robot_0").pose.copy(), env.readings[0].scan.copy()
    for value in after["robot_0"].values():
        value[:] = 1
    assert np.array_equal(env.belief("robot_0").pose, pose)
    assert np.array_equal(env.readings[0].scan, scan)


def test_every_kind_of_element_varies() -> None:
    """Over an episode with a merge each part of the observation carries information: none is constant."""
    _, observations = _record(small_env(max_cycles=400), 300)
    for name in KEYS:
        values = np.array([step["robot_0"][name] for step in observations]).reshape(len(observations), -1)
        changing = (values != values[0]).any(axis=0)
        if name in ("pose", "pose_std", "map_stats", "scan"):
            assert changing.all(), name
        assert changing.any(), name


def test_local_grid_is_ego_centred() -> None:
    """A wall ahead is above the middle of the local grid; turning by 90 degrees to the right moves it to the left."""
    env = small_env(num_robots=1)
    observations, _ = env.reset(seed=0, options={"start_poses": [[8.0, 3.0, 0.0]]})  # 3 m from the wall on the right
    occupied = observations["robot_0"]["local_grid"][1]
    rows = np.flatnonzero(occupied[:, 23:25].any(axis=1))
    assert len(rows)
    assert np.abs(rows - (23.5 - 3.0 / 0.2)).min() <= 1.5
    assert (rows < 24).all()

    for _ in range(11):  # a quarter turn in 1.1 s, at no more than 1.5 rad/s
        observations = env.step({"robot_0": np.array([0.0, -(np.pi / 2 / 1.1) / 1.5])})[0]
    occupied = observations["robot_0"]["local_grid"][1]
    columns = np.flatnonzero(occupied[23:25, :24].any(axis=0))
    assert len(columns)
    assert np.abs(columns - (23.5 - 3.0 / 0.2)).min() <= 2.0


def _plain_local_grid(belief: Belief) -> np.ndarray:
    """Return what `local_grid` returns, looked up cell by cell and landmark by landmark, without a compiled loop."""
    steps = (23.5 - np.arange(48)) * CELL
    ahead, left = np.meshgrid(steps, steps, indexing="ij")
    centres = transform_points(belief.pose, np.stack([ahead, left], axis=-1))
    rows, cols = np.moveaxis(cell_of(centres), -1, 0)
    inside = (rows >= 0) & (rows < GRID_SIZE) & (cols >= 0) & (cols < GRID_SIZE)
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
            picture, expected = observe(moved, env.readings[0].scan, False)["local_grid"], _plain_local_grid(moved)
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
    assert flat["observation"].shape == (3 + 3 + 6 + 3 * 48 * 48 + 32 + 80 + 35 + 7,)


def test_teammates_appear_with_the_merge() -> None:
    """Before a merge nobody is there; after it the teammate stands where it truly is, to within the maps' errors."""
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
