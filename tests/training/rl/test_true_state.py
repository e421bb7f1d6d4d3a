"""`WithTrueState`: the critic sees the truth, the actor does not."""

import threading
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")

import torch
from builders.goal_choices import SPACE
from gymnasium import spaces

from agents.goal_network import logits
from agents.trained import MODEL_FILE, TrainedGoalPolicy, load_model
from training.rl.config import TrainConfig
from training.rl.network import GoalPolicy
from training.rl.ppo import Training, Update
from training.rl.true_state import ROBOT_SCALE, STATE, TEAM_VALUES, WithTrueState
from training.vec_env import make_vec_env
from vslam_env import NUM_CANDIDATES, vslam_v0
from vslam_env.config import EnvConfig

GOALS = EnvConfig().replace(
    world="fig5", num_robots=3, action_type="goal", max_cycles=3, belief={"filter": {"num_particles": 5}}
)
SIZE = 3 * len(ROBOT_SCALE) + TEAM_VALUES
WITH_STATE = spaces.Dict({**SPACE.spaces, STATE: spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)})


def test_environments_that_do_not_fit_name_the_cure() -> None:
    """Flat observations take no state, and the network says which key is not observed."""
    with pytest.raises(ValueError, match=r"observation_type: expected 'dict', to which .* got 'flat'\. Choose dicts\."):
        WithTrueState(vslam_v0.parallel_env(config=GOALS.replace(observation_type="flat")))
    env = vslam_v0.parallel_env(config=GOALS.replace(observation_keys="driver"))
    says = r"observation: expected 'landmark_counts' .* got no 'landmark_counts'\. .*observation_keys=\"goal\""
    with pytest.raises(ValueError, match=says):
        GoalPolicy(env.observation_space("robot_0"), env.action_space("robot_0"), lambda left: 1.0)


def test_each_robot_comes_first_in_its_own_state() -> None:
    """States hold `ExplorationEnv.state`, scaled, with the observing robot first; all else stays as it is."""
    env, plain = WithTrueState(vslam_v0.parallel_env(config=GOALS)), vslam_v0.parallel_env(config=GOALS)
    (seen, _), (expected, _) = env.reset(seed=4), plain.reset(seed=4)
    for _ in range(GOALS.num_cycles):
        state = plain.state()
        robots = state[:-TEAM_VALUES].reshape(3, -1) * ROBOT_SCALE
        for place, agent in enumerate(plain.possible_agents):
            rows = [robots[(place + other) % 3] for other in range(3)]
            np.testing.assert_array_equal(seen[agent][STATE], np.concatenate([*rows, state[-TEAM_VALUES:]]))
            assert env.observation_space(agent).contains(seen[agent])
            for name, values in expected[agent].items():
                np.testing.assert_array_equal(seen[agent][name], values)
        actions = {agent: np.flatnonzero(seen[agent]["action_mask"])[-1] for agent in plain.possible_agents}
        seen, *others = env.step(actions)
        expected, *same = plain.step(actions)
        assert others[:3] == same[:3]


def test_vector_environments_have_the_state() -> None:
    """The last observation of an episode has it, too, and snapshots restore wrapped environments."""
    env = make_vec_env(GOALS, 2, seed=1, monitor=False, wrap=WithTrueState)
    env.reset()
    kept = None
    for step in range(3):
        if step == 1:
            kept = env.get_state()
        _, _, dones, infos = env.step(np.zeros(env.num_envs, np.int64))
        assert dones.all() == (step == 2)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["terminal_observation"][STATE].shape == (SIZE,)
    assert kept is not None
    env.set_state(kept)
    env.step(np.zeros(env.num_envs, np.int64))
    assert env.step(np.zeros(env.num_envs, np.int64))[2].all()
    env.close()


def _policy(space: spaces.Dict) -> GoalPolicy:
    torch.manual_seed(3)
    return GoalPolicy(space, spaces.Discrete(1 + NUM_CANDIDATES), lambda left: 1e-3)


def _some(space: spaces.Dict, n: int) -> dict[str, Any]:
    space.seed(1)
    drawn = [space.sample() for _ in range(n)]
    return {name: np.stack([each[name] for each in drawn]) for name in space.spaces}


def test_the_true_state_moves_values_and_no_action() -> None:
    """Values depend on each part of the state; logits, those of numpy too, and the actor's weights do not."""
    policy, plain = _policy(WITH_STATE), _policy(SPACE)
    assert policy.actor_weights().keys() == plain.actor_weights().keys()
    seen = _some(WITH_STATE, 5)
    batch = {name: torch.as_tensor(values) for name, values in seen.items()}
    batch[STATE].requires_grad_(True)
    features = policy.encode(batch)
    values, log_probs = policy.values(features), policy.log_probs(features)
    by_state = torch.autograd.grad(values.sum(), batch[STATE], retain_graph=True)[0]
    assert (by_state.abs().sum(0) > 0).all()
    assert not torch.autograd.grad(log_probs.sum(), batch[STATE])[0].any()
    ours = logits(policy.actor_weights(), seen)
    shares = np.exp(ours - ours.max(axis=1, keepdims=True))
    theirs = np.exp(log_probs.detach().numpy())
    np.testing.assert_allclose(theirs, shares / shares.sum(axis=1, keepdims=True), atol=1e-5)
    with torch.no_grad():
        tensors = policy.obs_to_tensor(seen)[0]
        np.testing.assert_allclose(policy.predict_values(tensors)[:, 0], values.detach(), atol=1e-5)


def test_what_is_saved_has_no_critic(tmp_path: Any) -> None:
    """The model of a training with the true state is one for observations without it."""
    training = Training(TrainConfig.from_mapping({"preset": "smoke", "seed": 1, "steps": 8}), tmp_path)
    training.run()
    training.close()
    weights = load_model(tmp_path / MODEL_FILE)[0]
    assert not [name for name in weights if name.startswith("value")]
    env = vslam_v0.parallel_env(config=GOALS)
    seen, _ = env.reset(seed=0)
    policy, rng = TrainedGoalPolicy(weights), np.random.default_rng(0)
    first = policy.act(seen["robot_0"], env.belief("robot_0"), rng)
    assert env.action_space("robot_0").contains(first)


def test_an_update_runs_beside_its_caller() -> None:
    """Its result and its errors reach the caller, and a cancelled one ends."""
    begun = threading.Event()

    def endless(stops: threading.Event) -> dict[str, float]:
        begun.set()
        stops.wait()
        return {}

    update = Update(endless)
    assert begun.wait(30.0)
    update.cancel()
    assert Update(lambda stops: {"loss": 2.0}).result() == {"loss": 2.0}

    def fails(stops: threading.Event) -> dict[str, float]:
        raise ArithmeticError("no gradient today")

    with pytest.raises(ArithmeticError, match="no gradient today"):
        Update(fails).result()
    torch.set_num_threads(1)
    assert Update(lambda stops: {"threads": float(torch.get_num_threads())}).result() == {"threads": 1.0}
