"""Training: learning, repeatability, resuming, and refusal of damaged or missing files."""

import hashlib
import json
import os
import pickle
import signal
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from builders.goal_choices import SPACE, GoalChoices
from gymnasium import spaces
from numpy.typing import NDArray
from typer.testing import CliRunner

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: pip install .[train]")

import torch
from sb3_contrib import MaskablePPO

from agents.goal_network import logits
from agents.trained import load_model
from slam_backend.state.codec import decode, encode
from training.cli import app
from training.rl.checkpoint import (
    CHECKPOINT_FILE,
    FORMAT,
    MAGIC,
    as_arrays,
    as_tensors,
    check_device,
    read_checkpoint,
    stored_checkpoint,
    write_checkpoint,
)
from training.rl.config import TrainConfig
from training.rl.network import GoalPolicy, check_finite
from training.rl.ppo import Training
from training.vec_env import ExplorationVecEnv
from vslam_env import NUM_CANDIDATES

SMOKE = TrainConfig.from_mapping({"preset": "smoke", "seed": 5})
runner = CliRunner()


class _NearIsGood(GoalChoices):
    """Environment whose reward is larger for shorter paths."""

    def draw(self, seen: Any) -> NDArray[np.int64]:
        slots = self.rng.permutation(16)[: self.rng.integers(2, 7)]
        seen["candidates"][slots, 2] = self.rng.uniform(0.5, 15.0, len(slots))
        self.lengths = seen["candidates"][:, 2].copy()
        return slots

    def reward(self, action: int) -> float:
        return 0.0 if action == 0 else 1.0 / (1.0 + float(self.lengths[action - 1]))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return the folder of an uninterrupted training, and its weights."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, _trained(folder)


def _trained(folder: Path, stop_after: int | None = None, resume: bool = False) -> dict[str, Any]:
    training = Training(SMOKE, folder)
    if resume:
        training.restore(stored_checkpoint(folder, SMOKE))
    counted: list[int] = []
    training.watch.listen(lambda row: None, lambda: len(training.rows) == stop_after, counted.append)
    assert training.run() == (stop_after is None)
    assert counted == list(range(20 if resume else 4, 20 if stop_after else 52, 4))  # each step once
    training.close()
    weights: dict[str, Any] = training.model.policy.actor_weights()
    return weights


def _assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_both_forms_of_the_network_agree() -> None:
    """Torch and numpy give the same logits for the same weights and observations."""
    torch.manual_seed(3)
    policy = GoalPolicy(SPACE, spaces.Discrete(1 + NUM_CANDIDATES), lambda left: 1e-3)
    with torch.no_grad():
        for tensor in policy.parameters():
            tensor.add_(0.1 * torch.randn_like(tensor))  # biases, initially zero, matter too
    SPACE.seed(1)
    some = [SPACE.sample() for _ in range(4)]
    for observation in some:
        observation["candidates"] *= 0.02
        observation["teammates"] *= 0.02
        observation["landmark_counts"] *= 0.01
        observation["time_left"] *= 1e-4
        observation["map_stats"] *= np.array([1e-2, 0.1, 0.1, 1e-2, 1.0, 1.0], np.float32)
    seen = {name: np.stack([observation[name] for observation in some]) for name in SPACE.spaces}
    with torch.no_grad():
        theirs = policy.get_distribution(policy.obs_to_tensor(seen)[0]).distribution.logits.numpy()
    ours = logits(policy.actor_weights(), seen)
    ours = ours - np.log(np.exp(ours).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert np.ptp(theirs[seen["action_mask"] != 0]) > 0.1


@pytest.mark.slow
def test_training_improves_the_policy() -> None:
    """If short paths pay, after a few updates the network chooses much shorter ones than chance does."""
    torch.set_num_threads(1)
    env = ExplorationVecEnv([_NearIsGood] * 12)
    model = MaskablePPO(
        GoalPolicy, env, n_steps=50, batch_size=100, n_epochs=6, learning_rate=3e-3, gamma=0.5, seed=1, device="cpu"
    )
    model.learn(3000)
    seen = env.reset()
    chances = torch.softmax(torch.tensor(logits(model.policy.actor_weights(), seen)), 1).numpy() * seen["action_mask"]
    gains = np.hstack([np.zeros((12, 1)), 1.0 / (1.0 + seen["candidates"][:, :, 2])])
    learnt = (chances * gains).sum(1) / chances.sum(1)
    random = (seen["action_mask"][:, 1:] * gains[:, 1:]).sum(1) / seen["action_mask"][:, 1:].sum(1)
    assert learnt.mean() > 1.2 * random.mean()


@pytest.mark.slow
def test_one_seed_gives_the_same_weights(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """A second training equals the first to the byte, and so do its files; another seed does not."""
    again = _trained(tmp_path)
    _assert_same(again, whole[1])
    _assert_same(dict(load_model(tmp_path)[0]), whole[1])
    fresh = Training(TrainConfig.from_mapping({"preset": "smoke", "seed": 6}), tmp_path).model.policy.actor_weights()
    assert not np.array_equal(fresh["candidate.weight"], whole[1]["candidate.weight"])


@pytest.mark.slow
def test_resumed_equals_uninterrupted(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """A training stopped after its first rollout and resumed in a new object ends with the same weights."""
    stopped = _trained(tmp_path, stop_after=1)
    assert not np.array_equal(stopped["candidate.weight"], whole[1]["candidate.weight"])
    _assert_same(_trained(tmp_path, resume=True), whole[1])
    assert read_checkpoint(tmp_path / CHECKPOINT_FILE)["watch"] == read_checkpoint(whole[0] / CHECKPOINT_FILE)["watch"]


def test_rows_summarise_episodes(whole: tuple[Path, dict[str, Any]]) -> None:
    """Each rollout has a row, with a return that is the sum of its terms; TensorBoard has the same numbers."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    rows = read_checkpoint(whole[0] / CHECKPOINT_FILE)["watch"]["rows"]
    assert [row["steps"] for row in rows] == [16.0, 32.0, 48.0]
    assert all(row["return"] == pytest.approx(row["reward/map_error"] + row["reward/own_coverage"]) for row in rows)
    curves = EventAccumulator(str(whole[0] / "tensorboard"))
    curves.Reload()
    for name in ("return", "map_error", "map_recall", "merges", "reward/map_error"):
        points = curves.Scalars(f"episode/{name}")
        assert [point.step for point in points] == [16, 32, 48]
        np.testing.assert_allclose([point.value for point in points], [row[name] for row in rows], rtol=1e-6)


def test_damaged_checkpoints_are_refused(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """A missing, truncated, foreign or changed checkpoint, or one of another configuration or version, is refused."""
    file = tmp_path / CHECKPOINT_FILE
    with pytest.raises(ValueError, match="resume: expected the checkpoint of a training, got no such file"):
        stored_checkpoint(tmp_path, SMOKE)
    bytes_whole = (whole[0] / CHECKPOINT_FILE).read_bytes()
    file.write_bytes(bytes_whole[: len(bytes_whole) // 2])
    with pytest.raises(ValueError, match=r"resume: .* got a broken file of \d+. .* was truncated or changed"):
        stored_checkpoint(tmp_path, SMOKE)
    file.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"resume: .* got a broken file. .* is not a checkpoint"):
        stored_checkpoint(tmp_path, SMOKE)
    file.write_bytes(bytes_whole.replace(b'"torch": "', b'"torch": "0', 1))
    with pytest.raises(ValueError, match=r"resume: expected a checkpoint made with torch .* Install torch==0"):
        stored_checkpoint(tmp_path, SMOKE)
    write_checkpoint(file, {"config": {**SMOKE.to_mapping(), "gamma": 0.5}, "seed": 5})
    with pytest.raises(ValueError, match="resume: expected a checkpoint of the folder's configuration"):
        stored_checkpoint(tmp_path, SMOKE)


class Trap:
    """Object whose pickle creates a file when it is read."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


def _marked(body: bytes, number: int) -> bytes:
    """Return a checkpoint of a given format with another body and a valid checksum."""
    mark = {"format": number, "versions": {}, "bytes": len(body), "sha256": hashlib.sha256(body).hexdigest()}
    return MAGIC + json.dumps(mark).encode() + b"\n" + body


def test_pickles_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No code from the file is run, whatever its format; checkpoints of other formats are refused by number."""
    monkeypatch.setattr("training.rl.checkpoint._versions", dict)
    file, proof = tmp_path / CHECKPOINT_FILE, tmp_path / "proof"
    body = pickle.dumps({"config": Trap(proof)})
    for number, says in (
        (FORMAT, "got a broken file"),
        (1, f"expected one of format {FORMAT}, got a checkpoint of format 1"),
    ):
        file.write_bytes(_marked(body, number))
        with pytest.raises(ValueError, match=f"resume: .*{says}"):
            stored_checkpoint(tmp_path, SMOKE)
    assert not proof.exists()
    file.write_bytes(_marked(encode([1, 2]), FORMAT))
    with pytest.raises(ValueError, match="resume: expected the checkpoint of a training, got a broken file"):
        stored_checkpoint(tmp_path, SMOKE)


def test_tensors_are_kept_as_arrays() -> None:
    """The states of networks and optimizers are restored, moments and step counts included."""
    layer = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(3)).sum().backward()
    optimizer.step()
    for state in (layer.state_dict(), optimizer.state_dict(), torch.get_rng_state(), None):
        arrays = as_arrays(state)
        back = as_tensors(decode(encode(arrays)))
        assert encode(as_arrays(back)) == encode(arrays)
    optimizer.load_state_dict(as_tensors(as_arrays(optimizer.state_dict())))


@pytest.mark.slow
def test_a_checkpoint_with_other_parts_is_refused(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """A valid checkpoint with a part that does not fit this training is refused with a hint."""
    kept = read_checkpoint(whole[0] / CHECKPOINT_FILE)
    training = Training(SMOKE, tmp_path)
    streams = kept["draws"]["numpy"]
    beyond = streams | {"state": streams["state"] | {"pos": 10**9}}
    for part in (
        {"learner": kept["learner"] | {"trained": {}}},
        {"learner": kept["learner"] | {"optimizer": None}},
        {"environments": {"environments": [], "masks": None}},
        {"draws": kept["draws"] | {"numpy": beyond}},
        {"draws": kept["draws"] | {"torch": np.zeros(3, np.uint8)}},
    ):
        with pytest.raises(ValueError, match="resume: expected a checkpoint of this model, got a different one"):
            training.restore(kept | part)
    training.close()


def test_a_missing_gpu_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU is refused if torch finds none; so are invalid devices."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="device: expected a GPU that torch can use, got a machine with 0 of them"):
        check_device("cuda")
    for name in ("gpu", "mps"):
        with pytest.raises(ValueError, match=f"device: expected cpu, cuda or cuda:0, got '{name}'"):
            check_device(name)


@pytest.mark.slow
def test_a_second_ctrl_c_prints_how_to_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an immediate interrupt, the output says whether there is a checkpoint, and how to resume."""
    out = tmp_path / "run"

    def interrupted(training: Training) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(Training, "run", interrupted)
    begin = ["train", "--preset", "smoke", "--workers", "0"]
    result = runner.invoke(app, [*begin, "--out", str(out)])
    assert result.exit_code == 130
    assert "Stopped before the first checkpoint: nothing was saved." in result.output
    monkeypatch.undo()
    result = runner.invoke(app, ["train", "--resume", str(out), "--workers", "0"])
    assert "resume: expected the checkpoint of a training, got no such file" in str(result.exception)
    training = Training(TrainConfig.from_mapping({"preset": "smoke"}), out)
    training.watch.listen(lambda row: None, lambda: True)
    training.run()
    monkeypatch.setattr(Training, "run", interrupted)
    result = runner.invoke(app, ["train", "--resume", str(out), "--workers", "0"])
    assert f"Resume: vslam train --resume {out}" in result.output.replace("\n", "")


@pytest.mark.slow
def test_commands_train_resume_evaluate_and_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C saves, `--resume` finishes the training, `evaluate` compares on paired seeds, `run` uses the model."""
    out = tmp_path / "run"
    begin = ["train", "--preset", "smoke", "--seed", "5", "--workers", "0", "--out", str(out)]
    kept_run = Training.run

    def interrupted(training: Training) -> bool:
        tell = training.watch._tell
        training.watch._tell = lambda row: (tell(row), os.kill(os.getpid(), signal.SIGINT))
        return kept_run(training)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "run", interrupted)
        result = runner.invoke(app, begin)
    assert result.exit_code == 0, result.output
    assert "Stopped; the checkpoint contains all finished rollouts." in result.output
    assert json.loads((out / "metrics.json").read_text())["complete"] is False
    result = runner.invoke(app, ["train", "--resume", str(out), "--workers", "0"])
    assert result.exit_code == 0, result.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["complete"] is True
    assert metrics["decisions"] == 48
    assert (out / "learning.png").stat().st_size > 10_000
    assert len((out / "curves.csv").read_text().splitlines()) == 4
    result = runner.invoke(app, ["train", "--resume", str(out), "--workers", "0"])
    assert "This training is complete already." in result.output
    assert json.loads((out / "metrics.json").read_text())["decisions"] == 48
    result = runner.invoke(app, ["train", "--resume", str(out), "--steps", "96"])
    assert "resume: expected no options that change the training, got ['steps']" in str(result.exception)

    tried = tmp_path / "tried"
    result = runner.invoke(app, ["evaluate", str(out), "--seeds", "2", "--first-seed", "100", "--out", str(tried)])
    assert result.exit_code == 0, result.output
    metrics = json.loads((tried / "metrics.json").read_text())
    tables = metrics["tables"]
    assert [line["policy"] for line in tables["policies"]] == ["model", "random_goals", "frontier"]
    assert [line["policy"] for line in tables["differences"]] == ["random_goals", "frontier"]
    returns = {(row["policy"], row["seed"]): row["return"] for row in metrics["trials"]}
    for line in tables["differences"]:
        gaps = [returns[line["policy"], seed] - returns["model", seed] for seed in (100, 101)]
        assert line["return [m]"] == pytest.approx(np.mean(gaps))
        assert line["return [m] low"] <= line["return [m]"] <= line["return [m] high"]

    plan = tmp_path / "plan.png"
    cv2.imwrite(str(plan), np.pad(np.full((200, 300), 255, np.uint8), 5))
    result = runner.invoke(app, ["evaluate", str(out), "--world", str(plan), "--world-split", "test"])
    assert "split: expected a world family or folder" in str(result.exception)

    played = tmp_path / "played"
    arguments = ["run", "--policy", str(out), "--world", "fig5", "--robots", "2", "--particles", "5", "--max-cycles"]
    result = runner.invoke(app, [*arguments, "3", "--no-video", "--out", str(played)])
    assert result.exit_code == 0, result.output
    assert json.loads((played / "metrics.json").read_text())["config"]["action_type"] == "goal"
    assert tomllib.loads((played / "environment.toml").read_text())["decision_ticks"] == SMOKE.decision_ticks == 20


def test_checkpoints_of_other_programs_are_refused(tmp_path: Path) -> None:
    """An intact file without configuration and seed, or with a head that is no description, is refused in one line."""
    file = tmp_path / CHECKPOINT_FILE
    write_checkpoint(file, {"seed": 1})
    with pytest.raises(ValueError, match=r"^resume: expected the checkpoint .* it has no configuration and seed"):
        read_checkpoint(file)
    head = {"format": FORMAT, "bytes": 0, "sha256": "", "versions": []}
    for text in (b"[" * 50_000, b"[3]", json.dumps(head).encode()):
        file.write_bytes(MAGIC + text + b"\n")
        with pytest.raises(ValueError, match=r"^resume: expected the checkpoint .* is not a checkpoint"):
            read_checkpoint(file)


def test_policies_with_parameters_that_are_not_finite_are_refused() -> None:
    """A single NaN is found, wherever it is."""
    policy = GoalPolicy(SPACE, spaces.Discrete(1 + NUM_CANDIDATES), lambda left: 1e-3)
    check_finite(policy)
    with torch.no_grad():
        policy.value_net.bias[0] = torch.nan
    with pytest.raises(ValueError, match="NaN"):
        check_finite(policy)
