"""`GoalPPO`: updates of MaskablePPO, the anchor to a start policy, and its exact resume."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")

import torch
from builders.goal_choices import GoalChoices
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO

from agents.registry import LEARNED
from agents.trained import load_model
from training.rl.checkpoint import stored_checkpoint
from training.rl.config import TrainConfig
from training.rl.network import GoalPolicy
from training.rl.ppo import GoalPPO, Training
from training.vec_env import ExplorationVecEnv
from vslam_env import NUM_CANDIDATES

SETTINGS: dict[str, Any] = {
    "n_steps": 20, "batch_size": 50, "n_epochs": 2, "ent_coef": 0.01, "vf_coef": 0.5, "gamma": 0.9, "seed": 3,
    "device": "cpu",
}  # fmt: skip
ANCHORED = {"preset": "smoke", "start": "learned", "anchor": 0.5, "value_rollouts": 1, "seed": 5}


class _RandomViews(GoalChoices):
    """Environment with random observations and rewards for the first candidates."""

    def draw(self, seen: Any) -> NDArray[np.int64]:
        slots = self.rng.permutation(NUM_CANDIDATES)[: self.rng.integers(3, 12)]
        seen["candidates"][slots] = self.rng.uniform(0.0, 3.0, (len(slots), seen["candidates"].shape[1]))
        seen["local_grid"][:] = self.rng.integers(0, 255, seen["local_grid"].shape)
        return slots

    def reward(self, action: int) -> float:
        return 1.0 / (1.0 + action)


def _learner(**settings: Any) -> GoalPPO:
    torch.set_num_threads(1)
    return GoalPPO(env=ExplorationVecEnv([_RandomViews] * 5), **SETTINGS | settings)


def _weights(policy: GoalPolicy) -> dict[str, Any]:
    return {name: tensor.numpy().copy() for name, tensor in policy.state_dict().items()}


def _largest_difference(ours: dict[str, Any], theirs: dict[str, Any]) -> float:
    return max(float(np.abs(ours[name] - theirs[name]).max()) for name in ours)


def test_without_anchor_updates_are_those_of_maskable_ppo() -> None:
    """Weights after several updates equal those of sb3-contrib, but for rounding."""
    ours = _learner()
    begin = _weights(ours.policy)
    ours.learn(300)
    theirs = MaskablePPO(GoalPolicy, ExplorationVecEnv([_RandomViews] * 5), **SETTINGS).learn(300)
    moved = _largest_difference(_weights(ours.policy), begin)
    assert _largest_difference(_weights(ours.policy), _weights(theirs.policy)) < 0.02 * moved


class _WaitingPPO(GoalPPO):
    """Learner that waits for each update before it plays the next rollout, still by the policy before."""

    def train(self) -> None:
        super().train()
        self.finish_update()


def test_after_a_start_model_updates_run_beside_rollouts() -> None:
    """Each rollout is played by the policy before the last update; weights are those of one after the other."""
    learners = []
    for kind in (GoalPPO, _WaitingPPO):
        learner = kind(env=ExplorationVecEnv([_RandomViews] * 5), **SETTINGS)  # seeds the global generators
        learners.append(learner)
        learner.start_from(load_model(LEARNED)[0])
        begin = _weights(learner.policy)
        learner.learn(100)
        assert _largest_difference(_weights(learner.policy), begin) > 0.0  # at the end the policy has all updates
        learner.learn(300, reset_num_timesteps=False)
    ours, theirs = (_weights(learner.policy) for learner in learners)
    assert _largest_difference(ours, theirs) == 0.0
    played, trained = _weights(learners[0].policy), _weights(learners[0].trained)
    assert _largest_difference(played, trained) == 0.0
    learners[0].train()
    learners[0].finish_update()
    assert _largest_difference(_weights(learners[0].policy), played) == 0.0
    assert _largest_difference(_weights(learners[0].trained), played) > 0.0


def test_the_penalty_is_the_kl_divergence_from_the_start() -> None:
    """Its value and its gradient by the logits are those of a plain sum in double precision."""
    learner = _learner(anchor=0.7, ent_coef=0.0, vf_coef=0.0)
    learner.start_from(load_model(LEARNED)[0])
    learner.learn(100)  # fills the buffer, and moves the policy away from the start
    data = learner._decisions()
    data["start_log_probs"] = learner._by_chunks(data, learner._start_log_probs)
    batch = {name: values[:30] for name, values in data.items()} | {"advantages": torch.tensor([1.0, -1.0] * 15)}
    batch["old_log_probs"] = torch.zeros(30)
    caught: list[Any] = []
    kept = learner.trained.mlp_extractor.forward_actor

    def catch(features: Any) -> Any:
        scores = kept(features)
        scores.retain_grad()
        caught.append(scores)
        return scores

    learner.trained.mlp_extractor.forward_actor = catch
    terms = learner._losses(batch, 0.2)
    (0.7 * terms["anchor_kl"]).backward()
    terms = {name: value.detach() for name, value in terms.items()}
    scores = caught[0].detach().numpy().astype(np.float64)
    is_valid = batch["action_mask"].numpy() != 0
    start = learner._start.logits({**batch, "local_grid": batch["local_grid"] / 255.0}).numpy().astype(np.float64)
    ours, wished = (_softmax(np.where(is_valid, values, -np.inf)) for values in (scores, start))
    gaps = np.log(np.where(is_valid, wished, 1.0)) - np.log(np.where(is_valid, ours, 1.0))
    expected = (wished * gaps).sum(1).mean()
    assert expected > 1e-6
    assert float(terms["anchor_kl"]) == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(caught[0].grad.numpy(), 0.7 * (ours - wished) / 30, atol=1e-7)
    assert float(terms["loss"]) == pytest.approx(float(terms["policy_gradient_loss"]) + 0.7 * expected, rel=1e-5)


def _softmax(scores: Any) -> Any:
    shares = np.exp(scores - scores.max(axis=1, keepdims=True))
    return shares / shares.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(("anchor", "low", "high"), [(1e-9, 0.03, np.inf), (1.0, 1e-3, 0.03), (1e4, 0.0, 3e-4)])
def test_a_large_weight_keeps_the_policy(anchor: float, low: float, high: float) -> None:
    """With a huge weight the policy's distribution stays the start's; with smaller ones it moves further."""
    learner = _learner(anchor=anchor, learning_rate=1e-4, vf_coef=0.0)
    learner.start_from(load_model(LEARNED)[0])
    learner.learn(1000)
    data = learner._decisions()
    with torch.no_grad():
        now = learner.policy.log_probs(learner.policy.encode(data))
    start = learner._by_chunks(data, learner._start_log_probs)
    divergence = float((start.exp() * (start - now)).sum(1).mean())
    assert low <= divergence <= high


def test_first_rollouts_train_the_value_head_alone() -> None:
    """The actor stays as it was, to the byte, while the value head learns; then the actor learns, too."""
    learner = _learner(anchor=0.1, value_rollouts=2, learning_rate=1e-3)
    learner.start_from(load_model(LEARNED)[0])
    begin, values = learner.policy.actor_weights(), deepcopy(learner.policy.value_net.weight)
    learner.learn(200)
    for name, expected in begin.items():
        np.testing.assert_array_equal(learner.policy.actor_weights()[name], expected)
    assert not torch.equal(learner.policy.value_net.weight, values)
    learner.learn(100, reset_num_timesteps=False)
    assert not np.array_equal(learner.policy.actor_weights()["query.weight"], begin["query.weight"])


def test_a_resumed_training_keeps_its_anchor(tmp_path: Path) -> None:
    """A stopped and resumed training gives the weights of an uninterrupted one; its anchor is in the checkpoint."""
    config = TrainConfig.from_mapping(ANCHORED)
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    weights = [_trained(config, whole), _trained(config, stopped, stop_after=1), _trained(config, stopped, resume=True)]
    assert weights[0] == weights[2] != weights[1]
    assert (whole / "model.npz").read_bytes() == (stopped / "model.npz").read_bytes()
    kept = stored_checkpoint(whole, config)
    np.testing.assert_array_equal(
        kept["learner"]["start"]["mlp_extractor.query.weight"], load_model(LEARNED)[0]["query.weight"]
    )
    training = Training(config, whole)
    with pytest.raises(ValueError, match="resume: expected a checkpoint of this model, got a different one"):
        training.restore(kept | {"learner": kept["learner"] | {"start": None}})
    training.close()


def _trained(config: TrainConfig, folder: Path, stop_after: int | None = None, resume: bool = False) -> bytes:
    folder.mkdir(exist_ok=True)
    training = Training(config, folder)
    if resume:
        training.restore(stored_checkpoint(folder, config))
    training.watch.listen(lambda row: None, lambda: len(training.rows) == stop_after)
    training.run()
    training.close()
    return b"".join(array.tobytes() for array in _weights(training.model.policy).values())


def test_an_anchor_needs_a_start() -> None:
    """An anchor or value rollouts where there is no use for them, and negative weights, are refused."""
    with pytest.raises(ValueError, match=r"anchor: expected PPO that begins with a model, got no start\. Give --start"):
        TrainConfig.from_mapping({"anchor": 0.1})
    with pytest.raises(ValueError, match="anchor: expected PPO that begins with a model, got a planner to imitate"):
        TrainConfig.from_mapping({"preset": "imitate", "start": "learned", "anchor": 0.1})
    with pytest.raises(ValueError, match="value_rollouts: expected 0 in an imitation, got 1"):
        TrainConfig.from_mapping({"preset": "imitate", "value_rollouts": 1})
    with pytest.raises(ValueError, match=r"anchor: expected .*>= 0.*, got -0\.1"):
        TrainConfig.from_mapping({"preset": "ppo", "anchor": -0.1})
    with pytest.raises(ValueError, match="value_rollouts: expected 0 without a model to begin with, got 1"):
        TrainConfig.from_mapping({"preset": "smoke", "value_rollouts": 1})
    with pytest.raises(ValueError, match=r"value_rollouts: expected fewer than the rollouts, 3, got 3"):
        TrainConfig.from_mapping({"preset": "smoke", "start": "learned", "value_rollouts": 3})


def test_learned_is_a_start() -> None:
    """The name of the shipped policy stands for its model, also in a configuration that is read again."""
    config = TrainConfig.from_mapping({"preset": "ppo", "seed": 1})
    assert config.start_file == LEARNED
    again = TrainConfig.from_mapping(config.to_mapping() | {"seed": 1})
    assert again == config
