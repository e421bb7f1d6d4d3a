"""Imitation: labels on disk, their collection, cloning, rounds, resuming, and refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: pip install .[train]")

import torch

from agents import make_policy
from agents.goal_network import SHAPES, logits
from agents.trained import load_model
from training.cli import app
from training.rl.checkpoint import CHECKPOINT_FILE, stored_checkpoint
from training.rl.config import SPLIT_TRAIN, TrainConfig
from training.rl.imitation import (
    FORMAT,
    LABELS,
    Imitation,
    Labels,
    collect,
    draw,
    joined,
    make_taught_envs,
    pack,
    read_labels,
    write_labels,
)
from training.rl.ppo import Training
from vslam_env import vslam_v0
from vslam_env.belief.observation import observation_space

SMALL = {
    "preset": "imitate", "world": "fig5", "robots": 2, "particles": 5, "max_cycles": 4, "envs": 2, "steps": 32,
    "rounds": 2, "epochs": 2, "batch": 8, "thin": 1, "seed": 5,
}  # fmt: skip
CONFIG = TrainConfig.from_mapping(SMALL)
SPACE = observation_space()
ABOUT = {"environment": "this one", "seed": 3}
runner = CliRunner()


def _seen(n: int) -> dict[str, Any]:
    """Return random inputs of the network."""
    rng = np.random.default_rng(0)
    seen: dict[str, Any] = {}
    for name, shape in SHAPES.items():
        dtype = SPACE[name].dtype
        if dtype == np.float32:
            seen[name] = rng.normal(0.0, 10.0, (n, *shape)).astype(dtype)
        else:
            seen[name] = rng.integers(0, 2, (n, *shape)).astype(dtype) * dtype.type(255 if name == "local_grid" else 1)
    return seen


def _labels(n: int = 6) -> Labels:
    rng = np.random.default_rng(1)
    preferences = np.where(rng.random((n, 33)) < 0.5, -np.inf, 0.0).astype(np.float32)
    return pack(_seen(n), rng.integers(0, 33, n), preferences)


def _run(folder: Path, stop_after: int | None = None) -> Imitation:
    """Imitate in a folder, from its checkpoint if there is one; stop at the nth time it may."""
    folder.mkdir(exist_ok=True)
    imitation = Imitation(CONFIG, folder)
    if (folder / CHECKPOINT_FILE).is_file():
        imitation.restore(stored_checkpoint(folder, CONFIG))
    asked = iter(range(1000))
    assert imitation.run(should_stop=lambda: next(asked) + 1 == stop_after) == (stop_after is None)
    imitation.close()
    return imitation


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Imitation]:
    """Return the folder of an uninterrupted imitation, and the imitation."""
    folder = tmp_path_factory.mktemp("imitated") / "run"
    return folder, _run(folder)


def test_labels_keep_the_inputs_of_the_network() -> None:
    """Inputs come back with their types, grids and masks exactly, other numbers to 0.8 %."""
    seen = _seen(6) | {"time_left": np.array([[0.0], [-2e-7], [1e9], [1.0], [119.9], [-1e9]], np.float32)}
    found = pack(seen, np.zeros(6, np.int64), np.zeros((6, 33), np.float32)).inputs(slice(None))
    for name, values in seen.items():
        assert found[name].dtype == values.dtype
        if values.dtype != np.float32:
            np.testing.assert_array_equal(found[name], values)
        elif name != "time_left":
            np.testing.assert_allclose(found[name], values, rtol=0.0085, atol=1e-4)
    assert (found["time_left"] == [[0.0], [-0.0], [59904.0], [1.0], [120.0], [-59904.0]]).all()


def test_files_of_labels_are_restored_exactly(tmp_path: Path) -> None:
    """Files keep packed inputs, choices and preferences to the bit; any of them can be taken."""
    labels = _labels()
    size = write_labels(tmp_path / "a.npz", labels, ABOUT)
    assert size == (tmp_path / "a.npz").stat().st_size
    kept = joined([read_labels(tmp_path / "a.npz", ABOUT)] * 2)
    for rows in (slice(0, 6), slice(6, 12)):
        part = kept.take(np.arange(12)[rows])
        for name, values in labels.packed.items():
            assert part.packed[name].tobytes() == values.tobytes()
            assert part.packed[name].dtype == values.dtype
        np.testing.assert_array_equal(part.chosen, labels.chosen)
        np.testing.assert_array_equal(part.preferences, labels.preferences)
    for name, values in kept.inputs(np.array([2, 7])).items():
        np.testing.assert_array_equal(values, labels.inputs(np.array([2, 1]))[name])


def test_foreign_and_damaged_labels_are_refused(tmp_path: Path) -> None:
    """Files that are missing, cut, of another environment, another format or other shapes are refused with a hint."""
    file = tmp_path / "a.npz"
    with pytest.raises(ValueError, match="labels: expected labels that vslam train wrote, got no such file"):
        read_labels(file, ABOUT)
    write_labels(file, _labels(), ABOUT)
    with pytest.raises(
        ValueError, match=r"labels: expected those of this environment, got .those of another environment"
    ):
        read_labels(file, {"environment": "another"})
    whole = file.read_bytes()
    with np.load(file) as content:
        arrays = dict(content)
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"labels: .* got a broken file. .* cannot be read. Delete it"):
        read_labels(file, ABOUT)
    np.savez(file, **arrays | {"about": np.array(json.dumps({"format": FORMAT + 1}))})
    with pytest.raises(ValueError, match=f"labels: expected those of format {FORMAT}, got 'format {FORMAT + 1}'"):
        read_labels(file, ABOUT)
    for changed in (
        {"scan": arrays["scan"][:, :16]}, {"scan": arrays["scan"][0]}, {"preferences": arrays["preferences"][:, :17]},
        {"local_grid": arrays["local_grid"][:, :, :5]}, {"chosen": arrays["chosen"] + 33},
        {"chosen": arrays["chosen"].astype(np.int64) - 99}, {"chosen": arrays["chosen"] * np.nan},
        {"preferences": arrays["preferences"] * np.float16(np.nan)}, {"scan": arrays["scan"] | np.uint8(0x7C)},
    ):  # fmt: skip
        np.savez(file, **arrays | changed)
        with pytest.raises(ValueError, match=r"labels: .* got .another file.\. .* has other arrays"):
            read_labels(file, ABOUT)


def test_the_teacher_labels_what_it_does() -> None:
    """Driving, the teacher does what its policy does; its choice is the most preferred action, and a valid one."""
    env = make_taught_envs(CONFIG.make_env_configs(SPLIT_TRAIN), 1, 0)
    counted: list[int] = []
    labels, _ = collect(env, np.ones(4, bool), 7, None, counted.append)
    assert counted == [2, 4, 6, 8]
    assert len(labels) == 8
    best = np.take_along_axis(labels.preferences, labels.chosen[:, None], 1)
    assert (best == 0.0).all()
    assert (labels.preferences.max(axis=1) == 0.0).all()
    considered = np.isfinite(labels.preferences)
    assert (labels.inputs(slice(None))["action_mask"][considered] == 1).all()
    assert (considered.sum(axis=1) >= 1).all()

    alone = vslam_v0.parallel_env(config=CONFIG.make_env_config(SPLIT_TRAIN))
    seen, _ = alone.reset(seed=env.seed(7)[0])
    policies = {agent: make_policy("next_best_view", "goal") for agent in alone.agents}
    actions: list[list[int]] = []
    rng = np.random.default_rng(0)
    while alone.agents:
        chosen = {agent: policies[agent].act(seen[agent], alone.belief(agent), rng) for agent in alone.agents}
        actions.append(list(chosen.values()))
        seen, *_ = alone.step(chosen)
    np.testing.assert_array_equal(labels.chosen, np.array(actions).T.ravel())

    thinned, _ = collect(env, np.array([False, True, False, True]), 7)
    env.close()
    rows = np.array([1, 3, 5, 7])
    np.testing.assert_array_equal(thinned.chosen, labels.chosen[rows])
    for name, values in labels.take(rows).packed.items():
        np.testing.assert_array_equal(thinned.packed[name], values)


def test_pupils_drive_by_their_own_network(whole: tuple[Path, Imitation]) -> None:
    """Actions are valid, drawn from the softmax of the logits, and a pupil gets to places of its own."""
    weights, env = whole[1].policy.actor_weights(), make_taught_envs(CONFIG.make_env_configs(SPLIT_TRAIN), 1, 0)
    driven, _ = collect(env, np.ones(4, bool), 7, weights)
    taught, _ = collect(env, np.ones(4, bool), 7)
    env.close()
    np.testing.assert_array_equal(driven.packed["scan"][[0, 4]], taught.packed["scan"][[0, 4]])
    assert not np.array_equal(driven.packed["scan"], taught.packed["scan"])
    seen = {name: np.repeat(values, 4000, axis=0) for name, values in taught.inputs(slice(0, 1)).items()}
    scores = logits(weights, {name: values[:1] for name, values in seen.items()})[0].astype(np.float64)
    chances = np.exp(scores - scores.max())
    counts = np.bincount(draw(weights, seen, np.random.default_rng(1)), minlength=33)
    assert (counts[seen["action_mask"][0] == 0] == 0).all()
    np.testing.assert_allclose(counts / 4000.0, chances / chances.sum(), atol=0.04)


@pytest.mark.slow
def test_cloning_learns_the_choice(tmp_path: Path) -> None:
    """The pupil learns a rule, to take the path nearest to 6 m, for labels that it has not seen."""
    rng = np.random.default_rng(2)
    n = 1200
    seen: dict[str, Any] = {name: np.zeros((n, *shape), SPACE[name].dtype) for name, shape in SHAPES.items()}
    lengths = rng.uniform(0.5, 15.0, (n, 32)).astype(np.float32)
    valid = rng.random((n, 32)) < 0.2
    valid[:, 0] = True
    seen["candidates"][:] = rng.uniform(-5.0, 5.0, seen["candidates"].shape)  # the others do not matter
    seen["candidates"][:, :, 4], seen["action_mask"][:, 0], seen["action_mask"][:, 1:] = lengths, 1, valid
    wishes = np.concatenate([np.full((n, 1), -np.inf), np.where(valid, -np.abs(lengths - 6.0), -np.inf)], axis=1)
    chosen = wishes.argmax(axis=1)
    wishes -= wishes.max(axis=1, keepdims=True)
    rows = [slice(0, 1000), slice(1000, n)]
    learn, tried = (
        pack({k: v[part] for k, v in seen.items()}, chosen[part], wishes[part].astype(np.float32)) for part in rows
    )
    imitation = Imitation(
        TrainConfig.from_mapping(SMALL | {"batch": 40, "epochs": 10, "learning_rate": 3e-3}), tmp_path
    )
    before = imitation._score(tried)
    losses = [imitation._fit(learn, 0, epoch, lambda *progress: None) for epoch in range(8)]
    after = imitation._score(tried)
    assert losses[-1] < losses[0]
    assert after["cross_entropy"] < 0.6 * before["cross_entropy"]
    assert after["agreement"] > 0.7 > 0.4 > before["agreement"]


def test_rounds_add_labels_and_leave_a_model(whole: tuple[Path, Imitation]) -> None:
    """Each epoch has a row, each round adds labels, validation included, and the model is the pupil."""
    folder, imitation = whole
    assert [(row["round"], row["epoch"], row["labels"]) for row in imitation.rows] == [
        (0.0, 1.0, 16.0), (0.0, 2.0, 16.0), (1.0, 1.0, 32.0), (1.0, 2.0, 32.0),
    ]  # fmt: skip
    files = sorted(file.name for file in (folder / LABELS).iterdir())
    assert files == ["00-train-000.npz", "00-validation-000.npz", "01-train-000.npz", "01-validation-000.npz"]
    weights, about = load_model(folder)
    for name, values in imitation.policy.actor_weights().items():
        np.testing.assert_array_equal(weights[name], values)
    assert imitation.best_row in imitation.rows[2:]
    tried = read_labels(folder / LABELS / "01-validation-000.npz", {})
    assert imitation._score(tried)["cross_entropy"] == pytest.approx(imitation.best_row["driven_cross_entropy"])
    assert about["seed"] == 5
    assert about["config"]["teacher"] == "next_best_view"
    assert list((folder / "tensorboard").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("stop_after", [1, 3, 5, 7])
def test_an_interrupted_imitation_ends_with_the_same_weights(
    whole: tuple[Path, Imitation], tmp_path: Path, stop_after: int
) -> None:
    """Stopped after a file of labels or an epoch, and resumed, it has the rows and the weights of the whole one."""
    _run(tmp_path / "run", stop_after)
    resumed = _run(tmp_path / "run")
    assert resumed.rows == whole[1].rows
    for name, values in whole[1].policy.actor_weights().items():
        np.testing.assert_array_equal(resumed.policy.actor_weights()[name], values)


def test_lost_labels_are_collected_again_and_other_checkpoints_refused(tmp_path: Path) -> None:
    """Lost labels of the teacher are collected again when a run resumes, to the byte; half a checkpoint is refused."""
    _run(tmp_path / "run", 4)
    file = tmp_path / "run" / LABELS / "00-train-000.npz"
    kept = file.read_bytes()
    file.write_bytes(kept[:99])
    with pytest.raises(ValueError, match=r"labels: expected .*, got a broken file\. .* Delete it"):
        _run(tmp_path / "run", 1)
    file.unlink()
    _run(tmp_path / "run", 1)
    assert file.read_bytes() == kept
    checkpoint = tmp_path / "run" / CHECKPOINT_FILE
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"resume: expected the checkpoint of a training, .* got a broken file"):
        _run(tmp_path / "run")


def test_the_best_epoch_of_a_round_is_kept(tmp_path: Path) -> None:
    """An epoch that predicts the teacher worse than one before it leaves the model as it was."""
    imitation = Imitation(CONFIG, tmp_path)
    first = imitation.policy.actor_weights()
    imitation._keep_best(1.5, 0)
    with torch.no_grad():
        imitation.policy.mlp_extractor.stay.bias += 1.0
    imitation._keep_best(1.6, 1)
    for name, values in imitation.policy.actor_weights().items():
        np.testing.assert_array_equal(values, first[name])


def test_work_adds_up(whole: tuple[Path, Imitation], tmp_path: Path) -> None:
    """The reported work grows, of a total that is known from the beginning and reached at the end."""
    told: list[tuple[float, float]] = []
    imitation = Imitation(CONFIG, tmp_path)
    assert imitation.run(lambda stage, done, total: told.append((done, total)))
    imitation.close()
    done, totals = zip(*told, strict=True)
    assert sorted(done) == list(done)
    assert set(totals) == {done[-1]}


def test_environments_play_the_worlds_in_turn() -> None:
    """Each of several worlds has as many environments; other numbers and thinning to nothing are refused."""
    config = TrainConfig.from_mapping(SMALL | {"world": "fig5,maze"})
    env = make_taught_envs(config.make_env_configs(SPLIT_TRAIN), 2, 0)
    assert [config.world for config in env.get_attr("config", env.first_slots)] == ["fig5", "maze"]
    env.close()
    assert [each.world_split for each in config.make_env_configs(SPLIT_TRAIN)] == ["train", "train"]
    with pytest.raises(ValueError, match="envs: expected a multiple of the 2 worlds, got 3"):
        TrainConfig.from_mapping(SMALL | {"world": "fig5,maze", "envs": 3})
    with pytest.raises(ValueError, match=r"world: .*got 'mase'"):
        TrainConfig.from_mapping(SMALL | {"world": "fig5,mase"})
    with pytest.raises(ValueError, match="thin: expected at most max_cycles, 4, got 5"):
        TrainConfig.from_mapping(SMALL | {"thin": 5})


def test_trainings_begin_with_a_model(whole: tuple[Path, Imitation], tmp_path: Path) -> None:
    """Imitation and PPO begin with the weights of `start`, which must be a model."""
    weights = whole[1].policy.actor_weights()
    values = SMALL | {"start": str(whole[0]), "seed": 6}
    ppo = {name: value for name, value in values.items() if name not in ("rounds", "thin")} | {"preset": "smoke"}
    trainings = (
        Imitation(TrainConfig.from_mapping(values), tmp_path), Training(TrainConfig.from_mapping(ppo), tmp_path)
    )  # fmt: skip
    for policy in (trainings[0].policy, trainings[1].model.policy):
        for name, expected in weights.items():
            np.testing.assert_array_equal(policy.actor_weights()[name], expected)
    for training in trainings:
        training.close()
    with pytest.raises(ValueError, match="start: expected a model that vslam train wrote, got no such file"):
        TrainConfig.from_mapping(SMALL | {"start": str(tmp_path / "none.npz")})


def test_rounds_need_a_teacher() -> None:
    """Rounds without a teacher, a teacher without rounds, and more rounds than rollouts are refused."""
    with pytest.raises(ValueError, match=r"rounds: expected no number, without a teacher, got 2\. Use --preset"):
        TrainConfig.from_mapping({"rounds": 2})
    with pytest.raises(ValueError, match="rounds: expected a number of rounds for the teacher, got None"):
        TrainConfig.from_mapping({"teacher": "next_best_view"})
    with pytest.raises(ValueError, match="rounds: expected at most one per rollout, 2, got 3"):
        TrainConfig.from_mapping(SMALL | {"rounds": 3})


@pytest.mark.slow
def test_the_command_imitates_resumes_and_its_model_drives(tmp_path: Path) -> None:
    """`--preset imitate` writes labels, curves and metrics; `--resume` has nothing left; `run` plays the model."""
    out, setup = tmp_path / "run", tmp_path / "config.toml"
    values = {name: value for name, value in SMALL.items() if name != "seed"}
    lines = [f"{name} = {json.dumps(value)}" for name, value in values.items()]
    setup.write_text('command = "train"\nseed = 5\n[config]\n' + "\n".join(lines) + "\n")
    result = runner.invoke(app, ["train", "--config", str(setup), "--workers", "0", "--out", str(out)])
    assert result.exit_code == 0, result.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["complete"]
    assert metrics["labels"] == 32
    assert metrics["label_bytes"] == sum(file.stat().st_size for file in (out / LABELS).iterdir())
    assert {"curves.csv", "learning.png", "model.npz", "report.html"} <= {file.name for file in out.iterdir()}
    result = runner.invoke(app, ["train", "--resume", str(out), "--workers", "0"])
    assert "This training is complete already." in result.output
    played = tmp_path / "played"
    arguments = ["run", "--policy", str(out), "--world", "fig5", "--robots", "2", "--particles", "5", "--max-cycles"]
    result = runner.invoke(app, [*arguments, "3", "--no-video", "--out", str(played)])
    assert result.exit_code == 0, result.output
