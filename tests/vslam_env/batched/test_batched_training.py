"""PPO of batched teams: its terms, what it learns in a toy world, and its files."""

import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from builders.batched import jax, jnp
from scipy.stats import norm

from agents import make_policy
from agents.driver_network import SHAPES, outputs, weight_shapes
from training import cli
from training.bench.speed import batched
from training.bench.speed.config import BatchedSpeedConfig
from training.rl.batched_config import BatchedTrainConfig

ppo = pytest.importorskip("training.rl.batched_ppo")
CONFIG = BatchedTrainConfig(
    world="fig5", robots=2, batch=8, steps=8, updates=50, minibatches=2, epochs=2, learning_rate=1e-2, gamma=0.9,
    duration=4.0,
)  # fmt: skip


class Part(NamedTuple):
    """Something with a part."""

    episode: Any = None
    belief: Any = None
    covariance: Any = None


class Toy(NamedTuple):
    """Environment of two robots that are rewarded for driving slowly ahead; episodes take four steps."""

    agents: tuple[str, ...] = ("robot_0", "robot_1")
    num_agents: int = 2
    broken: float = 0.0

    def reset(self, key: Any) -> Any:
        """Return observations of nothing, and the step as all that there is."""
        seen = {name: jnp.zeros(shape) for name, shape in SHAPES.items()}
        return {agent: dict(seen) for agent in self.agents}, self._state(jnp.zeros(()))

    def check_batch(self, batch: int) -> None:
        """All batches fit."""

    def _state(self, step: Any) -> Any:
        return Part(episode=Part(belief=Part(covariance=step)))

    def step(self, key: Any, state: Any, actions: Any) -> Any:
        """Return what follows."""
        before = state.episode.belief.covariance
        is_over = before >= 3
        rewards = {agent: -((actions[agent][0] - 0.6) ** 2) for agent in self.agents}
        infos = {"map_error": jnp.array([0.2, 0.4]), "map_recall": jnp.ones(2), "group": jnp.array([0, 0])}
        value = jnp.where(is_over, 0.0, before + 1.0) / jnp.where(jax.random.uniform(key) < self.broken, 0.0, 1.0)
        return self.reset(key)[0], self._state(value), rewards, {"__all__": is_over}, infos


def trained(folder: Path, updates: int) -> Any:
    """Return a training in the toy world after some rollouts."""
    training = ppo.BatchedTraining(CONFIG, Toy(), folder)
    for _ in range(updates):
        training.update()
    return training


def speed(weights: Any) -> float:
    """Return the mean speed that a driver chooses."""
    nothing = {name: np.zeros((1, *shape), np.float32) for name, shape in SHAPES.items()}
    return float(outputs(weights, nothing)[0, 0])


@pytest.mark.nightly
def test_a_driver_learns_the_rewarded_speed_and_its_training_continues(tmp_path: Path) -> None:
    """Returns rise to the optimum but for the noise of the actions; a checkpoint restores weights and rows."""
    training = trained(tmp_path, CONFIG.updates)
    assert abs(speed(training.weights) - 0.6) < 0.1
    first, last = training.rows[0], training.rows[-1]
    assert first["return"] < -0.3 * CONFIG.steps
    assert last["return"] > first["return"]
    assert (last["episodes"], last["map_error"], last["merges"]) == (CONFIG.batch * 2, pytest.approx(0.3), 1.0)
    assert last["steps"] == CONFIG.updates * CONFIG.batch * CONFIG.steps * 2
    training.save()
    other = ppo.BatchedTraining(CONFIG, Toy(), tmp_path)
    other.restore()
    assert other.rows == training.rows
    for name, values in training.weights.items():
        np.testing.assert_array_equal(other.weights[name], values)
    assert other.update()["steps"] > last["steps"]
    assert speed(make_policy(str(tmp_path), "continuous")._weights) == pytest.approx(speed(training.weights))


def test_bad_checkpoints_are_refused(tmp_path: Path) -> None:
    """Missing and broken ones, and those of another configuration, raise with the name of the option."""
    with pytest.raises(ValueError, match="resume: expected the checkpoint of a training, got no such file"):
        trained(tmp_path, 0).restore()
    (tmp_path / ppo.CHECKPOINT_FILE).write_bytes(b"nothing")
    with pytest.raises(ValueError, match="resume: expected the checkpoint of a training, got a broken file"):
        trained(tmp_path, 0).restore()
    trained(tmp_path, 1).save()
    another = ppo.BatchedTraining(CONFIG.replace(learning_rate=1e-3), Toy(), tmp_path)
    with pytest.raises(ValueError, match="resume: expected a checkpoint of the folder's configuration"):
        another.restore()


def test_the_network_is_the_same_in_numpy_and_in_jax() -> None:
    """Outputs agree within float32."""
    rng = np.random.default_rng(0)
    weights = {name: rng.normal(size=shape).astype(np.float32) * 0.1 for name, shape in weight_shapes().items()}
    seen = {name: rng.uniform(0.0, 3.0, (2, 3, *shape)).astype(np.float32) for name, shape in SHAPES.items()}
    flat = {name: values.reshape(6, *SHAPES[name]) for name, values in seen.items()}
    found = jax.jit(ppo.of_all)(weights, {name: jnp.asarray(values) for name, values in seen.items()})
    np.testing.assert_allclose(np.asarray(found).reshape(6, -1), outputs(weights, flat), rtol=1e-4, atol=1e-5)


def test_log_probabilities_are_those_of_normal_actions() -> None:
    """Both components are independent."""
    actor = {"log_std": jnp.array([-0.5, 0.3])}
    means, actions = np.random.default_rng(0).normal(size=(2, 5, 2))
    expected = norm.logpdf(actions, means, np.exp([-0.5, 0.3])).sum(axis=-1)
    np.testing.assert_allclose(ppo.log_probability(actor, means, actions), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("lam", [1.0, 0.0])
def test_advantages_are_returns_or_surprises(lam: float) -> None:
    """With lambda 1 they are the discounted rewards of the episode minus the value, with 0 single surprises."""
    rng, config = np.random.default_rng(0), CONFIG.replace(gae_lambda=max(lam, 1e-9), gamma=0.9)
    rewards, values = rng.normal(size=(2, 12, 3, 2))
    last, dones = rng.normal(size=(3, 2)), np.zeros((12, 3, 2))
    dones[5, 1] = 1.0
    found = jax.jit(partial(ppo.advantages_of, config=config))(rewards, values, dones, last)
    expected = np.zeros_like(rewards)
    for t in reversed(range(12)):
        after = last if t == 11 else values[t + 1]
        further = last if t == 11 else values[t + 1] + expected[t + 1]
        following = further if lam else after
        expected[t] = rewards[t] + 0.9 * following * (1.0 - dones[t]) - values[t]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("broken", [0.0, 1.0])
def test_the_bench_counts_episodes_with_numbers_that_are_none(monkeypatch: pytest.MonkeyPatch, broken: float) -> None:
    """All episodes of all plays count once; the rate is that of all ticks."""
    monkeypatch.setattr("vslam_env.batched.environment.BatchedExploration", lambda *_, **__: Toy(broken=broken))
    config = BatchedSpeedConfig(batches=(3,), beside=0, steps=4, plays=2)
    told = batched.play(config, batched.trials(config)[0])
    assert told["not_finite"] == (6 if broken else 0)
    assert told["ticks_per_second"] > 0.0
    assert told["compile_s"] > 0.0


def called(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Call the command line, and return its exit status."""
    monkeypatch.setattr("sys.argv", ["vslam", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


def test_commands_write_what_they_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file of --json is the `metrics.json` of both commands; a complete training resumes to its end."""
    monkeypatch.setattr("vslam_env.batched.environment.BatchedExploration", lambda *_, **__: Toy())
    monkeypatch.setattr(ppo, "make_env", lambda config: Toy())
    driver, rate, copy = tmp_path / "driver", tmp_path / "rate", tmp_path / "copy.json"
    for folder, words in {driver: ("train-batched",), rate: ("bench", "speed", "batched", "--beside", "0")}.items():
        given = "--quick", "--out", str(folder), "--json", str(copy)
        assert called(monkeypatch, *words, *given) == 0, capsys.readouterr().err
        assert copy.read_text() == (folder / "metrics.json").read_text()
    names = {file.name for file in driver.iterdir()}
    assert {"model.npz", "checkpoint.npz", "curves.csv", "learning.png", "report.html"} <= names
    assert json.loads((driver / "metrics.json").read_text())["complete"]
    assert called(monkeypatch, "train-batched", "--resume", str(driver)) == 0, capsys.readouterr().err
    assert "Next: vslam evaluate" in capsys.readouterr().out
