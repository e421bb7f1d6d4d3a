"""Built-in and custom policies."""

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.environments import know

from agents import POLICIES, make_policy
from agents.goal_choice import DrivingPolicy, GoalPolicy, patrol_goal
from agents.planners.nearest_frontier import NearestFrontier, choose_slot
from agents.plugins import is_plugin
from agents.registry import action_types
from slam_backend.geometry import compose
from vslam_env import NUM_CANDIDATES, CandidateKind, ExplorationEnv, World, vslam_v0
from vslam_env.belief.team_belief import Belief, Teammate
from vslam_env.navigation import OccupancyGrid, cell_of, plan_path

ROOM = World("room", [[0, 0, 11, 0], [11, 0, 11, 9], [11, 9, 0, 9], [0, 9, 0, 0], [5, 0, 5, 5]])
MATCHES = [(name, action_type) for name, known in POLICIES.items() for action_type in known]


def _env(action_type: str, **kwargs: Any) -> ExplorationEnv:
    options: dict[str, Any] = {"world": ROOM, "num_robots": 2, "num_particles": 20, "max_cycles": 30}
    return vslam_v0.parallel_env(action_type=action_type, **options | kwargs)


def _run(env: ExplorationEnv, name: str, seed: int) -> tuple[list[Any], float]:
    """Return all actions of an episode and the coverage at its end."""
    policies = {agent: make_policy(name, env.config.action_type) for agent in env.possible_agents}
    rng = np.random.default_rng(seed)
    observations, infos = env.reset(seed=seed)
    log = []
    while env.agents:
        actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        for agent, action in actions.items():
            assert env.action_space(agent).contains(action)
        log.append(actions)
        observations, _, _, _, infos = env.step(actions)
        assert not any(info["invalid_action"] for info in infos.values())
    return log, infos["robot_0"]["coverage"]


@pytest.mark.parametrize(("name", "action_type"), MATCHES)
def test_policies_act_within_the_rules(name: str, action_type: str) -> None:
    """Actions of every policy are in the space and valid, and the same seed gives the same actions."""
    first, _ = _run(_env(action_type), name, 3)
    second, _ = _run(_env(action_type), name, 3)
    for one, other in zip(first, second, strict=True):
        assert all(np.array_equal(one[agent], other[agent]) for agent in one)


@pytest.mark.slow
@pytest.mark.parametrize(("action_type", "cycles"), [("continuous", 500), ("discrete", 500), ("goal", 50)])
def test_the_frontier_policy_explores(action_type: str, cycles: int) -> None:
    """In 50 s two robots see nearly all of a room of 11 x 9 m."""
    _, coverage = _run(_env(action_type, max_cycles=cycles), "frontier", 1)
    assert coverage > 0.93


def test_a_swept_camera_maps_the_walls_of_a_corridor() -> None:
    """On one drive along a corridor 2.4 m wide the map has more landmarks if the camera is swept, in the same time."""
    corridor = World("corridor", [[0, 0, 24, 0], [24, 0, 24, 2.4], [24, 2.4, 0, 2.4], [0, 2.4, 0, 0]])
    recall, coverage = {}, {}
    for sweeps in (False, True):
        env = _env("continuous", world=corridor, num_robots=1, max_cycles=230)
        policy, rng = DrivingPolicy(GoalPolicy(NearestFrontier()), sweeps=sweeps), np.random.default_rng(0)
        observations, infos = env.reset(seed=0, options={"start_poses": [[1.0, 1.2, 0.0]]})
        while env.agents:
            action = policy.act(observations["robot_0"], env.belief("robot_0"), rng)
            observations, _, _, _, infos = env.step({"robot_0": action})
        recall[sweeps], coverage[sweeps] = infos["robot_0"]["map_recall"], infos["robot_0"]["coverage"]
    assert recall[True] > recall[False] + 0.1
    assert coverage[True] > coverage[False] - 0.05


def _belief(env: ExplorationEnv, **changes: Any) -> Belief:
    belief = env.belief("robot_0")
    fields = {name: getattr(belief, name) for name in belief.__dataclass_fields__}
    return Belief(**fields | changes)


def _candidates(env: ExplorationEnv, goals: dict[int, tuple[float, float, float]]) -> Any:
    """Return candidates with a goal (x, y) and a path length in some slots."""
    given = env.belief("robot_0").candidates
    count = NUM_CANDIDATES
    places, lengths, valid = np.full((count, 2), np.nan), np.zeros(count), np.zeros(count, np.bool_)
    for slot, (x, y, length) in goals.items():
        places[slot], lengths[slot], valid[slot] = (x, y), length, True
    kinds = np.where(valid, CandidateKind.FRONTIER, CandidateKind.NONE)
    return dataclasses.replace(given, goals=places, headings=np.zeros(count), lengths=lengths, valid=valid, kinds=kinds)


def test_the_nearest_slot_is_chosen_and_kept() -> None:
    """The shortest path wins; a chosen slot is kept unless it is gone or another path is less than half as long."""
    env = _env("goal")
    env.reset(seed=0)
    both = _belief(env, candidates=_candidates(env, {2: (1.0, 0.0, 4.0), 9: (0.0, 2.0, 3.0)}))
    assert choose_slot(both) == 9
    assert choose_slot(both, held=2) == 2
    assert choose_slot(both, held=5) == 9
    close = _belief(env, candidates=_candidates(env, {2: (1.0, 0.0, 4.0), 9: (0.0, 2.0, 1.9)}))
    assert choose_slot(close, held=2) == 9
    assert choose_slot(_belief(env, candidates=_candidates(env, {}))) is None


def test_candidates_with_a_nearer_teammate_are_left_to_it() -> None:
    """A candidate next to a teammate is avoided, unless there is no other."""
    env = _env("goal")
    env.reset(seed=0)
    mates = (Teammate(1, np.array([-1.5, 2.0, 0.0]), np.eye(3), np.full(2, np.nan)),)
    two = _candidates(env, {2: (7.0, 0.0, 7.5), 9: (0.0, 2.0, 3.0)})
    assert choose_slot(_belief(env, candidates=two, teammates=mates)) == 2
    one = _candidates(env, {9: (0.0, 2.0, 3.0)})
    assert choose_slot(_belief(env, candidates=one, teammates=mates)) == 9


def test_patrol_goals_are_far_and_reachable() -> None:
    """A patrol goal is far away and reachable over known floor."""
    env = _env("continuous", max_cycles=100, num_robots=1)
    env.reset(seed=1, options={"start_poses": [[8.0, 2.0, 1.0]]})
    while env.agents:
        env.step({"robot_0": np.array([0.1, 0.8])})
    belief = env.belief("robot_0")
    places = np.array([patrol_goal(belief, np.random.default_rng(seed)) for seed in range(5)])
    for place in places:
        assert plan_path(belief.grid.cells, belief.pose[:2], place) is not None
    assert np.linalg.norm(places - belief.pose[:2], axis=1).min() > 2.0
    assert len(np.unique(places, axis=0)) > 1


def test_blocked_patrol_goals_are_replaced() -> None:
    """A robot that cannot come closer to a patrol goal because of a newly seen wall gets another goal."""
    env = _env("continuous")
    env.reset(seed=0)
    grid = OccupancyGrid()
    grid.clear_disc([0.0, 0.0, 0.0], 4.0)
    policy, pose, way = make_policy("frontier", "continuous"), np.zeros(3), []
    belief = _belief(env, pose=pose, candidates=_candidates(env, {}), grid=grid.read_only_view())
    row, col = cell_of(patrol_goal(belief, np.random.default_rng(0)))  # the same goal as the policy's
    assert row > 150 < col
    rng = np.random.default_rng(0)
    for tick in range(400):
        belief = _belief(env, pose=pose, candidates=_candidates(env, {}), grid=grid.read_only_view())
        speed, turn = policy.act(None, belief, rng)
        if tick == 0:
            (top, left), evidence = grid.known.corner, grid.known.values.copy()
            evidence[row - top + np.arange(-4, 5), col - left - np.arange(-4, 5)] = 1  # across the path to it
            know(grid, evidence, (top, left))
        pose = compose(pose, [0.1 * speed, 0.0, 0.15 * turn])
        way.append(pose[:2])
    assert np.ptp(way[200:], axis=0).max() > 2.0


def test_unknown_names_and_mismatches() -> None:
    """Unknown policies and unsupported action types are refused, with the supported names."""
    with pytest.raises(ValueError, match=r"policy: expected one of 'frontier', 'random_.*, got 'best'"):
        make_policy("best", "goal")
    with pytest.raises(ValueError, match="action_type: expected one of 'continuous', 'discrete', 'goal', got 'jump'"):
        make_policy("frontier", "jump")
    with pytest.raises(ValueError, match="action_type: expected 'goal' for policy 'random_goals', got 'discrete'"):
        make_policy("random_goals", "discrete")
    with pytest.raises(ValueError, match="expected 'continuous' or 'discrete' for policy 'random_walk', got 'goal'"):
        make_policy("random_walk", "goal")


MODULE = """
class Still:
    action_type = "continuous"

    def reset(self):
        pass

    def act(self, observation, belief, rng):
        return [0.0, 0.0]


def first_goal():
    policy = Still()
    policy.act = lambda observation, belief, rng: 1
    return policy


class Mute:
    def reset(self):
        pass


class Broken(Still):
    def __init__(self):
        raise RuntimeError("no weights")


class Odd(Still):
    action_type = "flight"


NUMBER = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module in the current folder, which is not on Python's import path."""
    name = "policies_of_a_user"
    (tmp_path / f"{name}.py").write_text(MODULE)
    (tmp_path / "asks_for_more.py").write_text("import a_missing_module\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    yield name
    assert sys.path == path
    for loaded in (name, "asks_for_more"):
        sys.modules.pop(loaded, None)


def test_a_policy_is_found_in_the_current_folder(module: str) -> None:
    """A class or function is called for each robot; its attribute gives the action type, `goal` by default."""
    one, other = (make_policy(f"{module}:Still", "continuous") for _ in range(2))
    assert type(one).__name__ == "Still"
    assert one is not other
    assert action_types(f"{module}:Still") == ("continuous",)
    assert action_types(f"{module}:first_goal") == ("goal",)
    assert make_policy(f"{module}:first_goal", "goal").act(None, None, None) == 1  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "action_type", "says"),
    [
        ("nowhere_at_all:Still", "goal", "policy: expected MODULE:NAME of a policy, got no module 'nowhere_at_all'"),
        ("nowhere.at_all:Still", "goal", "policy: expected MODULE:NAME of a policy, got no module 'nowhere.at_all'"),
        ("{}:Moving", "goal", "policy: expected MODULE:NAME of a policy, got no class or function 'Moving' in"),
        ("{}:NUMBER", "goal", "policy: expected MODULE:NAME of a policy, got no class or function 'NUMBER' in"),
        ("{}:Mute", "goal", "policy: expected MODULE:NAME of a policy, got a Mute without act. A policy has"),
        (
            "os:system",
            "goal",
            "policy: expected MODULE:NAME of a policy, got no policy factory: os:system. A policy has",
        ),
        (
            "os:abort",
            "goal",
            "policy: expected MODULE:NAME of a policy, got no policy factory: os:abort. A policy has",
        ),
        (
            "builtins:int",
            "goal",
            "policy: expected MODULE:NAME .* got no policy factory: builtins:int. A policy has",
        ),
        ("numpy:sin", "goal", "policy: expected MODULE:NAME of a policy, got no policy factory: numpy:sin"),
        ("shutil:rmtree", "goal", "policy: expected MODULE:NAME of a policy, got no policy factory: shutil:rmtree"),
        ("{}:Odd", "goal", "policies_of_a_user:Odd.action_type: expected one of 'continuous', .* got 'flight'"),
        ("{}:Still", "goal", "action_type: expected 'continuous' for policy 'policies_of_a_user:Still', got 'goal'"),
    ],
)
def test_invalid_policies_have_specific_errors(module: str, name: str, action_type: str, says: str) -> None:
    """Missing modules and names, missing methods, and unsupported action types have specific errors."""
    with pytest.raises(ValueError, match=says):
        make_policy(name.format(module), action_type)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("asks_for_more:Still", "ModuleNotFoundError: No module named 'a_missing_module' (asks_for_more.py, line 1)"),
        ("{}:Broken", "RuntimeError: no weights (policies_of_a_user.py, line "),
    ],
)
def test_modules_and_classes_that_raise_have_errors_of_one_line(module: str, name: str, says: str) -> None:
    """What a module of a user raises while it is imported, or a class while it is made, becomes one line."""
    with pytest.raises(ValueError, match="expected it to be imported and made, got ") as raised:
        make_policy(name.format(module), "continuous")
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)
    assert raised.value.__cause__ is not None


def test_paths_are_not_taken_for_modules() -> None:
    """Drive letters, names with slashes and plain names are left to the registry."""
    assert is_plugin("package.module:Name")
    assert not any(map(is_plugin, ("C:\\models\\best.npz", "runs/train-0-1", "frontier", "module:", ":Name", "a:b.c")))
