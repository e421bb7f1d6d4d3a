import gc
import math
import weakref
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, room, small_env, turning

from slam_backend.geometry import between, compose, inverse, transform_points
from vslam_env import World, vslam_v0
from vslam_env.actions import DISCRETE_COMMANDS, checked_actions
from vslam_env.navigation import FREE, OCCUPIED, cell_of
from vslam_env.simulation.episode import points_along

BARE = World("bare", [[0, 0, 9, 0], [9, 0, 9, 7], [9, 7, 0, 7], [0, 7, 0, 0]])


def test_all_agents_are_truncated_together() -> None:
    """After `max_cycles` steps, which may be assigned, all agents are truncated, none terminated, and gone."""
    env = small_env()
    env.max_cycles = 3
    env.reset(seed=0)
    for cycle in range(3):
        _, rewards, terminations, truncations, _ = env.step(turning(env.agents))
        assert terminations == {"robot_0": False, "robot_1": False}
        assert truncations == dict.fromkeys(env.possible_agents, cycle == 2)
        assert all(type(reward) is float for reward in rewards.values())
    assert env.agents == []


@pytest.mark.parametrize("ending", [{"max_cycles": 30}, {"stop_at_recall": 0.05}])
def test_maps_are_smoothed_when_an_episode_ends(ending: dict[str, Any]) -> None:
    """After the last step, maps and their scores are those that a rejuvenation gives, and no earlier ones are."""
    env, twin = small_env(**ending), small_env()
    for each in (env, twin):
        each.reset(seed=1, options={"start_poses": MEETING})
    while env.agents:
        actions = turning(env.agents)
        *_, infos = env.step(actions)
        twin.step(actions)
        own, other = (each.episode.belief.group_map(0).means for each in (env, twin))
        assert np.array_equal(own, other) == bool(env.agents)
    twin.episode.belief.rejuvenate()
    for robot, agent in enumerate(env.possible_agents):
        assert np.array_equal(env.episode.belief.group_map(robot).means, twin.episode.belief.group_map(robot).means)
        assert infos[agent]["map_error"] == twin.episode.team_metrics().map_errors[robot]


def test_filters_without_a_smoother_end_as_they_are() -> None:
    """Without rejuvenation the last step changes the beliefs as any other step does."""
    config = small_env().config.replace(belief={"filter": {"rejuvenate_every": None}})
    env, twin = (small_env(config=config, max_cycles=cycles) for cycles in (12, 40))
    for each in (env, twin):
        each.reset(seed=1)
        for _ in range(12):
            each.step(turning(each.agents))
    assert not env.agents
    assert twin.agents
    assert np.array_equal(env.episode.belief.group_map(0).means, twin.episode.belief.group_map(0).means)


def test_stop_at_recall_terminates_all_agents() -> None:
    """With `stop_at_recall` all agents terminate in the step in which the poorest map holds that share."""
    env = small_env(stop_at_recall=0.03, max_cycles=300)
    env.reset(seed=1)
    while env.agents:
        _, _, terminations, truncations, infos = env.step(turning(env.agents, 0.1, 0.6))
    assert terminations == {"robot_0": True, "robot_1": True}
    assert truncations == {"robot_0": False, "robot_1": False}
    assert min(info["map_recall"] for info in infos.values()) >= 0.03


@pytest.mark.parametrize(
    ("action", "command"),
    [((1, 1), (1.0, 1.5)), ((-1, -1), (-0.3, -1.5)), ((0, 0), (0, 0)), ((0.5, -0.2), (0.5, -0.3))],
)
def test_continuous_actions_are_scaled(action: Any, command: Any) -> None:
    """Actions in [-1, 1] are scaled to -0.3 .. 1 m/s and -1.5 .. 1.5 rad/s; zeros stand still."""
    for form in (action, np.array(action, np.float32), np.array(action, np.float64)):
        assert np.allclose(checked_actions({"robot_0": form}, ["robot_0"], "continuous"), [command])


def test_robots_execute_their_actions() -> None:
    """In free space a robot ends where its command leads; discrete actions are stay, ahead, left, right."""
    env = small_env(action_type="discrete", num_robots=1)
    for action, (speed, turn) in enumerate(DISCRETE_COMMANDS):
        env.reset(seed=0, options={"start_poses": [[3.0, 3.0, 0.5]]})
        env.step({"robot_0": action})
        moved = between([3.0, 3.0, 0.5], env.true_poses[0])
        assert np.allclose(moved, [0.1 * speed, 0.0, 0.1 * turn], atol=1e-9)


@pytest.mark.parametrize(
    "action",
    [
        np.array([0.5, -0.25]),
        np.array([0.5, -0.25], dtype=np.float16),
        np.array([0.5, -0.25], dtype=np.longdouble),
        np.array([0.5, -0.25], dtype=object),
        (0.5, -0.25),
    ],
)
def test_any_two_numbers_are_a_continuous_action(action: object) -> None:
    """The robots do the same for them as for the two numbers of the space."""
    env, same = small_env(), small_env()
    for one in (env, same):
        one.reset(seed=100)
    env.step(dict.fromkeys(env.agents, action))
    same.step(dict.fromkeys(same.agents, np.array([0.5, -0.25], dtype=np.float32)))
    np.testing.assert_array_equal(env.true_poses, same.true_poses)


def test_a_step_is_several_ticks() -> None:
    """With `decision_ticks` an action is held for so many ticks, and rewards are those of the ticks summed."""
    coarse, fine = small_env(decision_ticks=4), small_env()
    for env in (coarse, fine):
        env.reset(seed=3)
    action = turning(coarse.agents)
    total = dict.fromkeys(coarse.agents, 0.0)
    for _ in range(5):
        rewards = coarse.step(action)[1]
        for _ in range(4):
            for agent, reward in fine.step(action)[1].items():
                total[agent] += reward
        for agent, reward in rewards.items():
            total[agent] -= reward
    assert np.array_equal(coarse.true_poses, fine.true_poses)
    assert np.allclose(list(total.values()), 0.0, atol=1e-12)


def test_goals_are_reached() -> None:
    """A robot that always chooses one living candidate comes to it, on its own belief alone."""
    env = small_env(action_type="goal", num_robots=1)
    env.reset(seed=4)
    slot = int(np.flatnonzero(env.belief("robot_0").candidates.valid)[0])
    goal = env.belief("robot_0").candidates.goals[slot]
    nearest = math.inf
    for _ in range(12):
        if env.belief("robot_0").candidates.valid[slot]:
            goal = env.belief("robot_0").candidates.goals[slot]
        env.step({"robot_0": 1 + slot if env.belief("robot_0").candidates.valid[slot] else 0})
        nearest = min(nearest, float(np.linalg.norm(env.belief("robot_0").pose[:2] - goal)))
    assert nearest < 0.5


def test_masked_goals_act_as_staying() -> None:
    """A masked candidate moves nothing and counts as `invalid_action`; staying is no invalid action."""
    results = []
    for masked in (False, True):
        env = small_env(action_type="goal")
        env.reset(seed=3)
        empty = np.flatnonzero(~env.belief("robot_0").candidates.valid)
        assert len(empty)
        observations, *_, infos = env.step({"robot_0": 1 + int(empty[0]) if masked else 0, "robot_1": 0})
        assert infos["robot_0"]["invalid_action"] == masked
        assert infos["robot_1"]["invalid_action"] == 0
        results.append(observations["robot_0"])
    assert all(np.array_equal(results[0][name], results[1][name]) for name in results[0])


@pytest.mark.parametrize("make", [vslam_v0.parallel_env, vslam_v0.env])
def test_an_unknown_option_of_a_reset_causes_a_warning(make: Any) -> None:
    """Whatever the interface, it names the nearest known option and all of them; the episode begins."""
    env = make(world="fig5", num_robots=2, num_particles=5)
    says = r"ignores the option 'start_pose'\. Did you mean 'start_poses'\? Options are world_seed and start_poses\."
    with pytest.warns(UserWarning, match=says):
        env.reset(seed=0, options={"start_pose": MEETING, "world_seed": 3})
    assert len(env.agents) == 2


def test_reset_takes_the_first_frame() -> None:
    """After a reset robots have seen their first frame at the origin of their start frames; they stand as asked."""
    env = small_env()
    observations, infos = env.reset(seed=0, options={"start_poses": MEETING})
    assert np.allclose(env.true_start_poses, MEETING)
    assert np.array_equal(env.true_poses, env.true_start_poses)
    for robot, agent in enumerate(env.agents):
        assert np.abs(observations[agent]["pose"]).max() < 1e-6
        assert env.readings[robot].odometry is None
        assert len(env.readings[robot].measurements) > 0
        assert infos[agent]["distance"] == 0.0
        assert infos[agent]["group"] == robot


def test_oracle_pose_is_the_true_pose() -> None:
    """With `oracle_pose` a robot's pose in its own start frame is exact, and its landmarks are still estimated."""
    env = small_env(oracle_pose=True)
    env.reset(seed=1)
    for _ in range(20):
        infos = env.step(turning(env.agents))[4]
    for robot, agent in enumerate(env.agents):
        true = between(env.true_start_poses[robot], env.true_poses[robot])
        assert np.allclose(env.belief(agent).pose, true, atol=1e-9)
        assert infos[agent]["pose_error"] < 1e-9
        assert infos[agent]["map_rmse"] > 1e-4


def test_oracle_association_makes_no_false_landmark() -> None:
    """With `oracle_association` no map holds a false landmark or a duplicate, however many false points there are."""
    config = small_env().config.replace(landmark_sensor={"false_points": 1.5}, oracle_association=True)
    env = small_env(config=config)
    env.reset(seed=1)
    for _ in range(30):
        infos = env.step(turning(env.agents))[4]
    assert all(info["map_precision"] == 1.0 for info in infos.values())


def test_oracle_merge_is_exact_and_alone() -> None:
    """With `oracle_merge` groups merge as soon as they share three landmarks, with the true transform, untried."""
    env = small_env(oracle_merge=True, max_cycles=200)
    env.reset(seed=5, options={"start_poses": MEETING})
    while env.agents and not env.events:
        env.step(turning(env.agents))
    (event,) = env.events
    assert event.kind == "merge"
    assert np.allclose(event.alignment.transform, between(*MEETING))
    infos = env.step(turning(env.possible_agents))[4] if env.agents else None
    assert infos is not None
    assert all(info["merges"] == 1 and info["group_size"] == 2 and info["group"] == 0 for info in infos.values())


def test_robots_that_know_the_floor_begin_with_it() -> None:
    """With `oracle_floor` all free floor is free and all walls are occupied in all grids; landmarks are not known."""
    env = small_env(oracle_floor=True)
    _, infos = env.reset(seed=1)
    episode = env.episode
    for robot, agent in enumerate(env.agents):
        frame, cells = inverse(env.true_start_poses[robot]), env.belief(agent).grid.cells
        for places, state in ((points_along(env.world.walls, 0.1), OCCUPIED), (episode.scenario.cells, FREE)):
            at = cell_of(transform_points(frame, places), len(cells))
            assert np.mean(cells[tuple(at.T)] == state) > 0.98  # but where a turned cell holds floor and a wall
        assert infos[agent]["map_recall"] < 0.3
    twin = small_env(oracle_floor=True)
    twin.set_state(env.get_state())
    np.testing.assert_array_equal(twin.belief("robot_0").grid.cells, env.belief("robot_0").grid.cells)


def test_an_oracle_merge_is_not_corrected_by_landmarks() -> None:
    """Maps of robots that know their poses lie in each other's start frames as truly as in their own."""
    env = small_env(oracle_merge=True, oracle_pose=True, oracle_association=True, max_cycles=200)
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(60):
        env.step(turning(env.agents))
    assert env.events
    assert np.allclose(env.episode.belief.team_poses.starts[1], inverse(between(*MEETING)), atol=1e-3)
    infos = env.step(turning(env.agents))[4]
    assert np.allclose(infos["robot_0"]["map_rmse"], infos["robot_1"]["map_rmse"], atol=1e-3)


def test_beliefs_are_in_the_own_start_frame() -> None:
    """Maps, particles and teammates lie where they truly are, laid at the own true start pose, also in groups."""
    env = small_env(oracle_merge=True, oracle_pose=True, oracle_association=True, max_cycles=200)
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(60):
        env.step(turning(env.agents))
    assert env.events
    landmarks = env.true_landmarks
    for robot, agent in enumerate(env.agents):
        belief, start = env.belief(agent), env.true_start_poses[robot]
        assert np.allclose(compose(start, belief.particles), env.true_poses[robot], atol=0.01)
        placed = belief.map.moved(start).means
        gaps = np.linalg.norm(placed[:, None] - landmarks[None], axis=-1).min(axis=1)
        assert np.median(gaps) < 0.05
        (mate,) = belief.teammates
        assert mate.robot == 1 - robot
        assert np.allclose(compose(start, mate.pose)[:2], env.true_poses[1 - robot, :2], atol=0.05)
        assert belief.frame == 0
        assert belief.group == (0, 1)


def test_beliefs_are_frozen() -> None:
    """A policy can change neither a belief nor the grid behind it; their arrays are those of test_reproducibility."""
    env = small_env()
    env.reset(seed=0)
    belief = env.belief("robot_0")
    with pytest.raises(AttributeError, match="cannot assign to field"):
        belief.pose = np.zeros(3)  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        belief.grid.cells[0, 0] = 1
    with pytest.raises(RuntimeError, match="read-only view"):
        belief.grid.clear_disc(np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        belief.map.means[0, 0] = 1.0


def test_grids_are_joined_at_a_merge() -> None:
    """At a merge each robot's grid gains what the other has seen, in its own frame; later scans go to both."""
    env = small_env(oracle_merge=True, max_cycles=200)
    env.reset(seed=5, options={"start_poses": MEETING})
    known = [0, 0]
    while not env.events:
        known = [int(np.count_nonzero(env.belief(agent).grid.cells)) for agent in env.agents]
        env.step(turning(env.agents))
    joint = [int(np.count_nonzero(env.belief(agent).grid.cells)) for agent in env.agents]
    assert min(joint) > max(known)
    assert abs(joint[0] - joint[1]) < 0.1 * joint[0]
    for _ in range(20):
        env.step(turning(env.agents))
    later = [int(np.count_nonzero(env.belief(agent).grid.cells)) for agent in env.agents]
    assert min(later) > min(joint)
    assert abs(later[0] - later[1]) < 0.1 * later[0]


def test_collisions_and_distance() -> None:
    """A robot that drives into a wall reads its bumps; its distance ends at the wall."""
    env = small_env(num_robots=1, world=BARE)
    env.reset(seed=1, options={"start_poses": [[8.0, 3.0, 0.0]]})
    for _ in range(20):
        infos = env.step({"robot_0": np.array([1.0, 0.0])})[4]
    assert 10 <= infos["robot_0"]["collisions"] <= 13
    assert abs(infos["robot_0"]["distance"] - 0.8) < 0.03
    assert env.readings[0].bump


def test_state_holds_the_truth() -> None:
    """The state is a float32 vector in its space that begins with the true pose."""
    env = small_env()
    env.reset(seed=1)
    env.step(turning(env.agents))
    state = env.state()
    assert env.state_space.contains(state)
    x, y, theta = env.true_poses[0]
    assert np.allclose(state[:4], [x, y, np.cos(theta), np.sin(theta)], atol=1e-5)
    x, y, _ = env.true_poses[1]
    assert np.allclose(state[12:14], [x, y], atol=1e-5)


def test_rendering_depends_on_mode_and_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing without a mode; without a screen `human` warns once and goes on; with a (dummy) one it shows frames."""
    pytest.importorskip("pygame")
    assert small_env().render() is None
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    env, seen = (small_env(render_mode="human") for _ in range(2))
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="render_mode='human' shows nothing"):
        env.step(turning(env.agents))
    assert env.render() is None
    env.close()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    seen.reset(seed=1)
    assert seen.render() is None
    seen.close()


def test_scene_shows_the_truth_and_the_estimates() -> None:
    """A scene has the true walls and poses, and estimates laid at the true starts, near the truth."""
    env = small_env()
    env.reset(seed=1)
    for _ in range(12):
        env.step(turning(env.agents))
    scene = env.scene()
    assert scene.tick == 12
    assert np.array_equal(scene.walls, room().walls)
    for robot, view in enumerate(scene.robots):
        assert np.array_equal(view.true_pose, env.true_poses[robot])
        assert view.true_path.shape == view.estimated_path.shape == (13, 2)
        assert np.linalg.norm(view.estimated_pose[:2] - view.true_pose[:2]) < 0.2
        assert view.particles.shape == (20, 3)
        assert len(view.sight_lines) <= 5
        assert view.group == robot


def test_a_dropped_environment_is_freed_at_once() -> None:
    """Nothing keeps a dropped environment, its filters and its grids, alive until the garbage collector comes."""
    env = small_env()
    env.recorder = lambda readings: None
    env.reset(seed=1)
    env.step(turning(env.agents))
    twin = env.clone()
    kept = [weakref.ref(part) for part in (env, env.episode, env.episode.belief, twin.episode)]
    gc.disable()
    try:
        del env, twin
        assert [part() for part in kept] == [None] * 4
    finally:
        gc.enable()
