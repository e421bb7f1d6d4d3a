"""Trained policies: the numpy network, the model file, and refusals."""

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agents import make_policy
from agents.goal_choice import DrivingPolicy
from agents.goal_network import (
    CHANNELS,
    FEED_WIDTH,
    INVALID,
    NUM_LAYERS,
    PATCHES,
    PICTURE_SIZE,
    SHAPES,
    VECTOR_SIZE,
    WIDTH,
    logits,
)
from agents.policy import keys_for, keys_of
from agents.registry import LEARNED, POLICIES, action_types
from agents.trained import FORMAT, OWN_GOAL, TrainedGoalPolicy, _digest, check_observation, load_model, save_model
from vslam_env import CANDIDATE_FEATURES, NUM_CANDIDATES, EnvConfig, vslam_v0, vslam_v1
from vslam_env.belief.observation import action_mask, observation_space

SPACE = observation_space()
ABOUT = {"version": "0", "environment": ""}


def _weights(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    shapes = {
        "picture.0": (CHANNELS[0], 3, PATCHES[0], PATCHES[0]),
        "picture.2": (CHANNELS[1], CHANNELS[0], PATCHES[1], PATCHES[1]),
        "robot": (WIDTH, PICTURE_SIZE + VECTOR_SIZE),
        "candidate": (WIDTH, len(CANDIDATE_FEATURES)),
        "teammate": (WIDTH, 5),
        "query": (WIDTH, WIDTH),
        "key": (WIDTH, WIDTH),
        "stay": (1, WIDTH),
    }
    norms = ["last_norm"]
    for layer in range(NUM_LAYERS):
        name = f"layers.{layer}"
        shapes |= {f"{name}.query_key_value": (3 * WIDTH, WIDTH), f"{name}.out": (WIDTH, WIDTH)}
        shapes |= {f"{name}.feed_in": (FEED_WIDTH, WIDTH), f"{name}.feed_out": (WIDTH, FEED_WIDTH)}
        norms += [f"{name}.norm", f"{name}.feed_norm"]
    weights = {}
    for name, shape in shapes.items():
        weights[f"{name}.weight"] = (rng.standard_normal(shape) / np.sqrt(np.prod(shape[1:]))).astype(np.float32)
        weights[f"{name}.bias"] = (0.1 * rng.standard_normal(shape[0])).astype(np.float32)
    for name in norms:
        weights[f"{name}.weight"] = rng.uniform(0.5, 1.5, WIDTH).astype(np.float32)
        weights[f"{name}.bias"] = (0.1 * rng.standard_normal(WIDTH)).astype(np.float32)
    return weights


def _observation(seed: int = 0) -> dict[str, Any]:
    SPACE.seed(seed)
    observation = SPACE.sample()
    observation["candidates"] = np.random.default_rng(seed).uniform(-5.0, 5.0, SHAPES["candidates"]).astype(np.float32)
    observation["teammates"] = np.random.default_rng(seed).uniform(-3.0, 3.0, SHAPES["teammates"]).astype(np.float32)
    observation["teammates_mask"][:] = [1, 0, 1, 0, 0, 1, 0]
    observation["landmark_counts"], observation["time_left"] = np.arange(5.0, dtype=np.float32), np.float32([30.0])
    observation["map_stats"] = np.array([40.0, 0.1, 0.3, 8.0, 0.5, 2.0], np.float32)
    observation["action_mask"][:] = [1, *([1, 0, 1, 1] * (NUM_CANDIDATES // 4))]
    return observation


def test_logits_do_not_depend_on_slots() -> None:
    """Permuting candidates permutes their logits, and keeps the logit of staying; teammates may stand in any row."""
    observation, rng = _observation(), np.random.default_rng(5)
    order, mates = rng.permutation(NUM_CANDIDATES), rng.permutation(7)
    moved = observation | {
        "candidates": observation["candidates"][order],
        "action_mask": observation["action_mask"][np.concatenate([[0], 1 + order])],
        "teammates": observation["teammates"][mates], "teammates_mask": observation["teammates_mask"][mates],
    }  # fmt: skip
    before, after = (logits(_weights(), {k: v[None] for k, v in o.items()})[0] for o in (observation, moved))
    np.testing.assert_allclose(after[1:], before[1:][order], atol=1e-5)
    assert after[0] == pytest.approx(before[0], abs=1e-5)
    assert np.ptp(before[observation["action_mask"] != 0]) > 0.1


def test_candidates_and_teammates_are_seen_together() -> None:
    """The logit of a candidate depends on the others and on teammates; empty rows have no effect."""
    observation, weights = _observation(), _weights()
    kept = observation["action_mask"][1:] != 0
    before = logits(weights, {k: v[None] for k, v in observation.items()})[0]
    assert (before[1:][~kept] == np.float32(INVALID)).all()
    for name, row, is_seen in (
        ("candidates", 0, True), ("candidates", 1, False), ("teammates", 0, True), ("teammates", 1, False),
    ):  # fmt: skip
        other = observation[name].copy()
        other[row] += 1.0
        after = logits(weights, {k: v[None] for k, v in (observation | {name: other}).items()})[0]
        assert (abs(after[3] - before[3]) > 1e-4) == is_seen


def test_decisions_are_fast_and_models_small(tmp_path: Path) -> None:
    """A decision takes less than 5 ms, the best of several, with all slots full; a model has less than 1 MB."""
    weights, observation = _weights(), _observation()
    observation["action_mask"][:], observation["teammates_mask"][:] = 1, 1
    policy, rng, times = TrainedGoalPolicy(weights), np.random.default_rng(0), []
    belief: Any = None  # only the observation matters
    for _ in range(20):
        begin = time.process_time()
        policy.act(observation, belief, rng)
        times.append(time.process_time() - begin)
    assert min(times) < 5e-3
    assert _saved(tmp_path / "model.npz").stat().st_size < 1_000_000


def test_batched_observations_are_independent() -> None:
    """Each observation of a batch has the same logits as alone."""
    some = [_observation(seed) for seed in range(3)]
    together = logits(_weights(), {name: np.stack([o[name] for o in some]) for name in SHAPES})
    for row, observation in zip(together, some, strict=True):
        alone = logits(_weights(), {name: observation[name][None] for name in SHAPES})[0]
        np.testing.assert_allclose(row, alone, atol=1e-5)


def test_actions_are_drawn_from_the_softmax_of_the_valid_ones() -> None:
    """Invalid actions never occur; valid ones have the frequencies of the softmax; greedy takes the best."""
    observation, weights = _observation(3), _weights()
    scores = logits(weights, {name: observation[name][None] for name in SHAPES})[0].astype(np.float64)
    valid = observation["action_mask"] != 0
    chances = np.where(valid, np.exp(scores), 0.0) / np.exp(scores[valid]).sum()
    policy, rng = TrainedGoalPolicy(weights), np.random.default_rng(0)
    policy.reset()
    belief: Any = None  # only the observation matters
    counts = np.bincount([policy.act(observation, belief, rng) for _ in range(2000)], minlength=1 + NUM_CANDIDATES)
    assert (counts[~valid] == 0).all()
    spread = np.sqrt(2000.0 * chances * (1.0 - chances))
    assert (np.abs(counts - 2000.0 * chances) <= 4.5 * spread + 1e-9).all()
    greedy = TrainedGoalPolicy(weights, greedy=True)
    assert greedy.act(observation, belief, rng) == int(np.where(valid, scores, -np.inf).argmax())


def test_models_work_like_other_policies(tmp_path: Path) -> None:
    """`make_policy` accepts the path of a model or of its folder, and the policy drives teams of any size."""
    save_model(tmp_path / "model.npz", _weights(), ABOUT)
    for name in (str(tmp_path / "model.npz"), str(tmp_path)):
        env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=5, action_type="goal", max_cycles=3)
        observations, _ = env.reset(seed=1)
        policy, rng = make_policy(name, "goal"), np.random.default_rng(0)
        while env.agents:
            actions = {agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents}
            observations, _, _, _, infos = env.step(actions)
            assert not any(info["invalid_action"] for info in infos.values())


@pytest.mark.parametrize("action_type", ["continuous", "discrete"])
def test_the_robots_of_a_model_drive_to_its_goals(action_type: str) -> None:
    """Without the environment's driving, robots of `learned` drive to what the network chooses, once a second."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=5, action_type=action_type, max_seconds=3.0)
    seen, _ = env.reset(seed=2)
    policies = {agent: make_policy("learned", action_type) for agent in env.agents}
    rng, chosen = np.random.default_rng(0), 0
    while env.agents:
        actions = {}
        for agent in env.agents:
            driving, belief = policies[agent], env.belief(agent)
            assert isinstance(driving, DrivingPolicy)
            actions[agent] = driving.act(seen[agent], belief, rng)
            chooser: Any = driving._chooser
            if belief.tick % 10 == 0 and chooser._last > 0 and driving.goal is not None:
                chosen += 1
                assert np.linalg.norm(driving.goal - belief.candidates.goals[chooser._last - 1]) < 0.5
        seen, _, _, _, _ = env.step(actions)
    assert chosen >= 3


@pytest.mark.parametrize("action_type", ["continuous", "discrete", "goal"])
def test_the_policy_acts_alike_whatever_is_observed(action_type: str) -> None:
    """What the network reads comes from the belief where it is not observed: all actions are those of version 0."""
    options: dict[str, Any] = {"world": "fig5", "num_robots": 2, "num_particles": 5, "max_seconds": 4.0}
    some: tuple[str, ...] = ("pose", "scan", *(["action_mask"] if action_type == "goal" else []))
    ways: list[dict[str, Any]] = [{"observation_keys": keys} for keys in ("all", "driver", "goal", some)]
    found = []
    for way in [*ways, {"observation_type": "flat"}]:
        env = vslam_v1.parallel_env(**options, action_type=action_type, **way)
        seen, _ = env.reset(seed=2)
        policies = {agent: make_policy("learned", action_type) for agent in env.agents}
        rng, taken = np.random.default_rng(0), []
        while env.agents:
            actions = {agent: policies[agent].act(seen[agent], env.belief(agent), rng) for agent in env.agents}
            taken.append(list(actions.values()))
            seen = env.step(actions)[0]
        found.append(np.array(taken))
    assert len(np.unique(found[0], axis=0)) > 1
    for actions in found[1:]:
        np.testing.assert_array_equal(actions, found[0])


def test_policies_say_what_they_read() -> None:
    """Planners read beliefs alone, `learned` the inputs of its network; a policy that does not say may read all."""
    for name in POLICIES:
        read = tuple(SHAPES) if name == "learned" else ()
        for action_type in action_types(name):
            policy = make_policy(name, action_type)
            assert keys_of(policy) == read
            config = EnvConfig(action_type=action_type, observation_keys=keys_for(policy, action_type))
            mask = {"action_mask"} if action_type == "goal" else set()
            assert set(config.observed) == set(read or ("pose",)) - {"action_mask"} | mask
    other: Any = SimpleNamespace()
    assert keys_of(other) is None
    assert keys_for(other, "goal") == "all"
    other.observation_keys = "driver"
    assert keys_for(other, "goal") == "driver"


def test_without_a_mask_the_last_choice_is_marked_as_the_goal() -> None:
    """Where the environment does not drive, the policy tells the network which candidates exist and which it chose."""
    weights, observation = _weights(), _observation(seed=3)
    observation["candidates"][5:] = 0.0
    observation["action_mask"] = action_mask(observation["candidates"])
    observation["candidates"][:, OWN_GOAL] = 0.0
    bare = {name: value for name, value in observation.items() if name != "action_mask"}
    policy, rng, belief = TrainedGoalPolicy(weights, greedy=True), np.random.default_rng(0), None
    first = policy.act(bare, belief, rng)  # type: ignore[arg-type]
    assert first == TrainedGoalPolicy(weights, greedy=True).act(observation, belief, rng)  # type: ignore[arg-type]
    assert 0 < first <= 5
    marked = {**observation, "candidates": observation["candidates"].copy()}
    marked["candidates"][first - 1, OWN_GOAL] = 1.0
    expected = logits(weights, {name: marked[name][None] for name in SHAPES})[0].argmax()
    assert policy.act(bare, belief, rng) == expected  # type: ignore[arg-type]
    assert not bare["candidates"][:, OWN_GOAL].any()  # the caller's arrays stay as they were


@pytest.mark.slow
def test_models_need_no_learning_library(tmp_path: Path) -> None:
    """A saved model gives the same logits in another process, which imports neither torch nor Stable-Baselines3."""
    save_model(tmp_path / "model.npz", _weights(), ABOUT)
    np.savez(tmp_path / "seen.npz", **_observation())
    program = (
        "import sys, json, numpy as np; from agents.trained import load_model; from agents.goal_network import logits; "
        f"w, _ = load_model({str(tmp_path)!r}); seen = np.load({str(tmp_path / 'seen.npz')!r}); "
        "found = logits(w, {n: seen[n][None] for n in seen.files})[0].tolist(); "
        "print(json.dumps([found, any(n in sys.modules for n in ('torch', 'stable_baselines3'))]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    found, learner = json.loads(done.stdout)
    assert not learner
    np.testing.assert_allclose(
        found, logits(_weights(), {k: v[None] for k, v in _observation().items()})[0], rtol=1e-6, atol=1e-6
    )


def test_models_are_restored_exactly(tmp_path: Path) -> None:
    """Weights and metadata are restored exactly."""
    weights = _weights(4)
    save_model(tmp_path / "a.npz", weights, {"steps": 7, **ABOUT})
    kept, about = load_model(tmp_path / "a.npz")
    assert kept.keys() == weights.keys()
    for name, array in weights.items():
        np.testing.assert_array_equal(kept[name], array)
    assert about["steps"] == 7
    assert about["format"] == FORMAT
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_damaged_models_are_refused(tmp_path: Path) -> None:
    """A missing, truncated, changed or foreign file, or one of another version, is refused with a hint."""
    file = tmp_path / "model.npz"
    with pytest.raises(ValueError, match=r"model: expected a model that vslam train wrote, got no such file. Check"):
        load_model(file)
    save_model(file, _weights(), ABOUT)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"model: .* got a broken file. .* cannot be read"):
        load_model(file)
    file.write_text("not a model")
    with pytest.raises(ValueError, match=r"model: .* got a broken file"):
        load_model(file)
    with np.load(_saved(tmp_path / "b.npz"), allow_pickle=False) as content:
        arrays = {name: content[name] for name in content.files}
    np.savez(file, **arrays | {"stay.bias": arrays["stay.bias"] + 1.0})
    with pytest.raises(ValueError, match=r"model: .* got a broken file. .* was changed"):
        load_model(file)
    about = json.loads(str(arrays["about"])) | {"format": FORMAT + 1, "version": "9.9"}
    np.savez(file, **arrays | {"about": np.array(json.dumps(about))})
    with pytest.raises(ValueError, match=r"expected one of format 3, got a model of format 4. .* wrote it, 9.9"):
        load_model(file)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("stay.bias", None, r"expected weights 'stay.bias' of shape \(1,\), float32, got no 'stay.bias'"),
        (
            "robot.weight",
            lambda values: values[:, :-1],
            r"'robot.weight' of shape \(64, 559\), .* \(64, 558\)",
        ),
        ("key.bias", lambda values: values.astype(np.float64), r"'key.bias' .* got shape \(64,\), float64"),
        ("key.bias", lambda values: values * np.nan, r"expected finite numbers in 'key.bias', got NaN or infinity"),
        ("layers.1.out.bias", lambda values: values + np.inf, r"finite numbers in 'layers.1.out.bias'"),
        ("another", lambda values: np.zeros(2), r"expected no others, got 'another'"),
    ],
)
def test_weights_of_another_network_are_refused(name: str, change: Any, says: str, tmp_path: Path) -> None:
    """A model with a valid digest, but other names, shapes, types or no finite numbers, is refused with the first."""
    weights = _weights()
    values = weights.pop(name, None)
    if change is not None:
        weights[name] = change(values)
    arrays = {each: np.asarray(array) for each, array in weights.items()}
    about = {"format": FORMAT, "weights": _digest(arrays), **ABOUT}
    np.savez(tmp_path / "model.npz", about=np.array(json.dumps(about)), **arrays)
    with pytest.raises(ValueError, match=f"^model: .*{says}"):
        load_model(tmp_path)


def test_models_without_their_environment_are_refused(tmp_path: Path) -> None:
    """A model says in what environment it was trained; other metadata are refused, however they are nested."""
    save_model(tmp_path / "model.npz", _weights(), {"environment": 3})
    with pytest.raises(ValueError, match="model: expected the environment of its training"):
        load_model(tmp_path)
    for text in ("[" * 50_000, "[3]", '"text"', '{"format": 3}'):
        np.savez(tmp_path / "model.npz", about=np.array(text))
        with pytest.raises(ValueError, match=r"model: .* got a broken file"):
            load_model(tmp_path)


def test_other_spaces_are_refused() -> None:
    """Observations of another shape, or without the mask of goals, are refused by name."""
    observation = _observation()
    short = observation | {"scan": observation["scan"][:16]}
    with pytest.raises(ValueError, match=r"observation: expected 'scan' of shape \(32,\), .* got shape \(16,\)"):
        TrainedGoalPolicy(_weights()).act(short, None, np.random.default_rng(0))  # type: ignore[arg-type]
    shapes = {name: np.shape(value) for name, value in observation.items() if name != "action_mask"}
    with pytest.raises(ValueError, match=r"observation: expected 'action_mask' .* got no 'action_mask'. Use dict"):
        check_observation(shapes)


def _saved(file: Path) -> Path:
    save_model(file, _weights(), ABOUT)
    return file


def test_the_shipped_model_is_small_and_has_a_card() -> None:
    """`learned` plays the model in `agents/pretrained/`, of less than 1 MB, greedily; its card names these weights.

    `vslam evaluate` plays its environment, which is one of this version.
    """
    assert LEARNED.stat().st_size < 1_000_000
    weights, about = load_model(LEARNED)
    assert about["weights"] in LEARNED.with_suffix(".md").read_text(encoding="utf-8")
    assert EnvConfig.from_toml_text(about["environment"]).action_type == "goal"
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=5, action_type="goal", max_seconds=5.0)
    seen, _ = env.reset(seed=2)
    for agent in env.agents:
        inputs = {name: np.asarray(seen[agent][name])[None] for name in SHAPES}
        actions = {make_policy("learned", "goal").act(seen[agent], None, np.random.default_rng(k)) for k in range(5)}
        assert actions == {int(logits(weights, inputs)[0].argmax())}
