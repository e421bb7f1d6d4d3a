from typing import Any

import numpy as np
import pytest
from small_env import MEETING, small_env, turning

from agents import make_policy
from slam_backend.alignment import Alignment
from vslam_env import vslam_v0
from vslam_env.oracle import true_alignment
from vslam_env.reward import TERMS, Standing, evaluate, make_terms


def _standing(**changes: Any) -> Standing:
    values: dict[str, Any] = {
        "map_errors": np.array([0.7, 0.6]),
        "map_recalls": np.array([0.1, 0.2]),
        "pose_errors": np.zeros(2),
        "coverage": 0.25,
        "collisions": np.array([0, 3]),
        "distances": np.array([1.0, 2.0]),
        "bytes_sent": np.zeros(2, np.int64),
        "merges": 0,
    }
    return Standing(**values | changes)


def test_named_terms() -> None:
    """Each named term is what its name says, times its weight."""
    after = _standing(map_errors=np.array([0.5, 0.65]), coverage=0.5, collisions=np.array([2, 3]))
    rewards = evaluate(make_terms({"map_error": 2.0, "coverage": 3.0, "collisions": 0.1}), _standing(), after)
    assert set(rewards) == set(TERMS)
    assert np.allclose(rewards["map_error"], [0.4, -0.1])
    assert np.allclose(rewards["coverage"], [0.75, 0.75])
    assert np.allclose(rewards["collisions"], [-0.2, 0.0])


def test_terms_of_ones_own() -> None:
    """An object with name, weight and a call is a term: it is added and reported under its name."""

    class Frugal:
        name, weight = "frugal", -0.5

        def __call__(self, before: Standing, after: Standing) -> Any:
            return after.distances - before.distances

    env = small_env(reward=[*make_terms({"map_error": 1.0}), Frugal()])
    assert env.config.reward == {"map_error": 1.0, "frugal": -0.5}
    env.reset(seed=0)
    for _ in range(5):
        _, rewards, _, _, infos = env.step(turning(env.agents))
        for agent in env.agents:
            info = infos[agent]
            assert np.isclose(rewards[agent], info["reward/map_error"] + info["reward/frugal"])
            assert info["reward/frugal"] < 0.0


def test_reward_telescopes() -> None:
    """An episode's return is the first map error minus the last, a merge included."""
    env = small_env(max_cycles=120)
    first = env.reset(seed=5, options={"start_poses": MEETING})[1]
    total = dict.fromkeys(env.agents, 0.0)
    while env.agents:
        _, rewards, _, _, infos = env.step(turning(env.agents))
        for agent, reward in rewards.items():
            total[agent] += reward
    assert any(event.kind == "merge" for event in env.events)
    for agent in env.possible_agents:
        assert np.isclose(total[agent], first[agent]["map_error"] - infos[agent]["map_error"], atol=1e-12)


def test_a_wrong_merge_costs() -> None:
    """A merge with the true transform lowers every map error; half a metre and ten degrees off it raises both."""
    changes = []
    for shift in ([0.0, 0.0, 0.0], [0.5, -0.5, np.radians(10.0)]):
        quiet = small_env().config.replace(belief={"attempts": {"every": 10**6}})
        env = small_env(config=quiet, max_cycles=400)
        env.reset(seed=5, options={"start_poses": MEETING})
        for _ in range(60):
            infos = env.step(turning(env.agents))[4]
        episode = env.episode
        claims = [episode.ledger.claims((r,), episode.belief.filter_map(r).ids) for r in range(2)]
        true = true_alignment(*claims, *episode.true_starts)
        assert true is not None
        pose = true.transform + shift
        inliers = true.inliers if shift[0] == 0.0 else np.empty((0, 2), np.int64)
        used = Alignment(True, "", *pose.tolist(), true.covariance, inliers, 0.0)
        episode.ledger.rename(episode.belief.merge(0, 1, used))
        changes.append([score.error - infos[f"robot_{r}"]["map_error"] for r, score in enumerate(episode.map_scores())])
    assert max(changes[0]) < 0.0
    assert min(changes[1]) > 0.01


@pytest.mark.slow
def test_the_reward_cannot_be_farmed() -> None:
    """200 idle ticks, or a second turn on the spot, change the return by less than 1 % of a frontier episode's.

    Means over 20 seeds of one robot in the office; the frontier episode is 40 s long.
    """
    idle, turn, frontier = [], [], []
    spinner = vslam_v0.parallel_env(num_robots=1, decision_ticks=42)  # at 1.5 rad/s a whole turn and a little
    idler = vslam_v0.parallel_env(num_robots=1, decision_ticks=200)
    explorer = vslam_v0.parallel_env(num_robots=1, max_cycles=40, action_type="goal")
    for seed in range(20):
        spinner.reset(seed=seed)
        turns = [spinner.step({"robot_0": np.array([0.0, 1.0])})[1]["robot_0"] for _ in range(2)]
        turn.append(turns[1])
        idler.reset(seed=seed)
        # The idle robot has seen what it sees: before that, standing and looking is honest work.
        looks = [idler.step({"robot_0": np.zeros(2)})[1]["robot_0"] for _ in range(2)]
        idle.append(looks[1])

        policy, rng = make_policy("frontier", "goal"), np.random.default_rng(seed)
        observations = explorer.reset(seed=seed)[0]
        total = 0.0
        while explorer.agents:
            action = policy.act(observations["robot_0"], explorer.belief("robot_0"), rng)
            observations, rewards, *_ = explorer.step({"robot_0": action})
            total += rewards["robot_0"]
        frontier.append(total)
    gained = float(np.mean(frontier))
    assert gained > 0.03
    assert abs(np.mean(idle)) < 0.01 * gained
    assert abs(np.mean(turn)) < 0.01 * gained
