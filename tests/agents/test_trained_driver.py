"""Trained policies that drive: the network in numpy, the model file, and where they can play."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents import make_policy
from agents.driver_network import NAMES, SHAPES, outputs, weight_shapes
from agents.registry import action_types
from agents.trained import DRIVER, TrainedDriver, load_model, save_model, trained_policy
from training.rl.config import EvaluateConfig
from vslam_env import EnvConfig, vslam_v1

CONFIG = EnvConfig(world="fig5", num_robots=2, observation_keys="driver", decision_ticks=5, max_cycles=4)
ABOUT = {"version": "0", "network": DRIVER, "ticks": 5, "environment": CONFIG.to_toml()}


def weights(seed: int = 0) -> dict[str, Any]:
    """Return random weights."""
    rng = np.random.default_rng(seed)
    return {
        name: (rng.standard_normal(shape) / np.sqrt(shape[0])).astype(np.float32)
        for name, shape in weight_shapes().items()
    }


def observations(count: int, seed: int = 0) -> dict[str, Any]:
    """Return random observations (n, ...)."""
    rng = np.random.default_rng(seed)
    drawn = {name: rng.uniform(0.0, 1.0, (count, *shape)).astype(np.float32) for name, shape in SHAPES.items()}
    return drawn | {"local_grid": 255 * rng.integers(0, 2, (count, *SHAPES["local_grid"])).astype(np.uint8)}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Return the path of a model."""
    file = tmp_path / "model.npz"
    save_model(file, weights(), ABOUT)
    return file


def test_patches_are_those_of_a_convolution() -> None:
    """The first layer gives each patch the product with its weights; outputs of a batch are those of its parts."""
    mine, seen = weights(), observations(3)
    whole = outputs(mine, seen)
    assert whole.shape == (3, 2)
    for i in range(3):
        alone = outputs(mine, {name: values[i : i + 1] for name, values in seen.items()})
        np.testing.assert_allclose(alone[0], whole[i], rtol=1e-4, atol=1e-5)
    moved = {**seen, "local_grid": np.roll(seen["local_grid"], 12, axis=3)}  # by whole patches of both layers
    same = dict(mine)
    first = np.zeros_like(mine["layer.0.weight"])
    first[: 16 * 32] = np.tile(mine["layer.0.weight"][:32], (16, 1))  # all places count alike
    same["layer.0.weight"] = first
    np.testing.assert_allclose(outputs(same, moved), outputs(same, seen), rtol=1e-4, atol=1e-5)


def test_a_driver_holds_its_decisions_and_takes_the_rest_from_its_belief(model: Path) -> None:
    """A decision holds for the ticks of the training; without an observation the belief tells the same."""
    env = vslam_v1.parallel_env(config=CONFIG.replace(decision_ticks=1, max_cycles=12))
    seen, _ = env.reset(seed=0)
    given, own = trained_policy(model, greedy=True), trained_policy(model, greedy=True)
    assert isinstance(given, TrainedDriver)
    actions = []
    for _ in range(12):
        belief = env.belief("robot_0")
        action = given.act(seen["robot_0"], belief, np.random.default_rng(0))
        np.testing.assert_array_equal(action, own.act(np.zeros(1), belief, np.random.default_rng(0)))
        actions.append(action)
        seen, *_ = env.step({"robot_0": action, "robot_1": np.zeros(2, np.float32)})
    assert all((actions[i] == actions[5 * (i // 5)]).all() for i in range(12))
    assert (actions[0] != actions[5]).any()
    given.reset()
    assert (given.act(seen["robot_0"], env.belief("robot_0"), np.random.default_rng(0)) != actions[-1]).any()


def test_draws_are_those_of_the_distribution(model: Path) -> None:
    """Not greedy, the standard deviation is that of the weights; actions lie in their space."""
    mine = load_model(model)[0]
    still = {name: np.zeros_like(mine[name]) for name in ("layer.2.weight", "layer.2.bias")}
    driver = TrainedDriver({**mine, **still, "log_std": np.log(np.float32([0.05, 0.1]))}, ticks=1)
    rng, single = np.random.default_rng(1), {name: values[0] for name, values in observations(1).items()}
    drawn = np.array([driver.act(single, None, rng) for _ in range(4000)])  # type: ignore[arg-type]
    assert np.abs(drawn).max() <= 1.0
    np.testing.assert_allclose(drawn.std(axis=0), [0.05, 0.1], rtol=0.06)


def test_models_that_drive_are_known_by_their_file(model: Path, tmp_path: Path) -> None:
    """They play with continuous actions alone; evaluations compare them with policies that drive, at each tick."""
    assert action_types(str(model)) == ("continuous",)
    assert isinstance(make_policy(str(model), "continuous"), TrainedDriver)
    with pytest.raises(ValueError, match="action_type: expected 'continuous' for policy"):
        make_policy(str(model), "goal")
    config = EvaluateConfig.from_mapping({"model": str(model)})
    assert config.policies == ("random_walk", "frontier")
    environment = config.environment()
    assert (environment.action_type, environment.ticks_per_step, environment.num_cycles) == ("continuous", 1, 20)
    save_model(tmp_path / "other.npz", weights(), ABOUT | {"network": "other"})
    with pytest.raises(ValueError, match="model: expected a network 'goal' or 'driver', got 'other'"):
        load_model(tmp_path / "other.npz")
    save_model(tmp_path / "few.npz", {"log_std": np.zeros(2)}, ABOUT)
    with pytest.raises(ValueError, match=r"got no 'picture\.0\.weight'"):
        load_model(tmp_path / "few.npz")
    assert set(NAMES) <= set(CONFIG.observed)
