"""Environments on a Ray cluster: the same weights as on this machine, also after the loss of a node, and refusals."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ray", reason="extra distributed is not installed")
pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: pip install .[train]")

from builders.ray_cluster import two_nodes

from training.experiments.machine import cluster as cluster_module
from training.experiments.machine.cluster import LostWorkerError, connected
from training.rl.checkpoint import stored_checkpoint
from training.rl.config import TrainConfig
from training.rl.imitation import Imitation
from training.rl.ppo import Training
from training.vec_env import make_vec_env

SMOKE = TrainConfig.from_mapping({"preset": "smoke", "seed": 5})
IMITATION = TrainConfig.from_mapping({
    "preset": "imitate", "world": "fig5", "robots": 2, "particles": 5, "max_cycles": 4, "envs": 2, "steps": 16,
    "rounds": 1, "epochs": 1, "batch": 8, "thin": 1, "seed": 5,
})  # fmt: skip
GOALS = SMOKE.make_env_config("train")


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Cluster of two nodes with one core each, on this machine."""
    with two_nodes() as started:
        yield started


def _trained(training: Any) -> dict[str, Any]:
    """Train to the end, and return the weights."""
    assert training.run()
    training.close()
    weights: dict[str, Any] = (
        training.policy if isinstance(training, Imitation) else training.model.policy
    ).state_dict()
    return {name: tensor.numpy() for name, tensor in weights.items()}


def _assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.slow
@pytest.mark.nightly
def test_weights_do_not_depend_on_the_cluster(cluster: Any, tmp_path: Path) -> None:
    """PPO and imitation give the same weights as here, also if a node is lost and another cluster resumes."""
    for kind, config in ((Imitation, IMITATION), (Training, SMOKE)):
        folders = [tmp_path / f"{kind.__name__}-{where}" for where in ("here", "there")]
        for folder in folders:
            folder.mkdir()
        here = _trained(kind(config, folders[0]))
        there = kind(config, folders[1], cluster=cluster.address)
        if kind is Training:
            assert there.env.spent.shape == (2, 2)  # one worker on each node
        _assert_same(_trained(there), here)

    lost = tmp_path / "lost"
    lost.mkdir()
    training = Training(SMOKE, lost, cluster=cluster.address)

    def stop_a_node(row: Any) -> None:
        if len(training.rows) == 2:
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)

    training.watch.listen(stop_a_node, lambda: False)
    with pytest.raises(
        LostWorkerError, match=r"ray: expected workers that run, got a lost one at .*, with environments"
    ):
        training.run()
    kept = stored_checkpoint(lost, SMOKE)
    assert len(kept["watch"]["rows"]) == 1
    with connected(cluster.address) as ray:
        while ray.cluster_resources()["CPU"] > 1:  # the loss of a worker is known before that of its node
            time.sleep(0.1)
    resumed = Training(SMOKE, lost, cluster=cluster.address)
    assert resumed.env.spent.shape == (1, 2)  # the core that is left
    resumed.restore(kept)
    _assert_same(_trained(resumed), here)


@pytest.mark.slow
def test_bad_clusters_are_refused(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too many workers, busy cores and other versions are refused; errors of workers keep their text and place."""
    with pytest.raises(ValueError, match="workers: expected at most one per core of the cluster, 2, got 3"):
        make_vec_env(GOALS, 3, workers=3, cluster=cluster.address)
    env = make_vec_env(GOALS, 2, cluster=cluster.address)
    env.reset()
    with pytest.raises(ValueError, match=r"actions.* expected an int from 0 to 32, got .*99") as raised:
        env.step(np.full(4, 99))
    assert "In a worker:" in raised.value.__notes__[0]
    with pytest.raises(RuntimeError, match="expected running workers, got closed ones"):
        env.reset()
    monkeypatch.setattr(cluster_module, "_versions", lambda: {"vslam-env": "0.0.1"})
    with pytest.raises(ValueError, match=r"ray: expected vslam-env 0.0.1 on all machines, got .* at "):
        make_vec_env(GOALS, 2, cluster=cluster.address)
    monkeypatch.undo()
    monkeypatch.setattr(cluster_module, "START_S", 0.01)
    with pytest.raises(ValueError, match=r"ray: expected a free core for each worker within 0 s, got '. free of 2'"):
        make_vec_env(GOALS, 2, cluster=cluster.address)


def test_a_cluster_that_cannot_be_reached_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error comes at once and names the option; so does that of a missing package."""
    with pytest.raises(ValueError, match=r"ray: expected the address of a Ray cluster that runs, got '127.0.0.1:1'"):
        make_vec_env(GOALS, 1, cluster="127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"ray: expected an installation of Ray, got 'none'. Install it:"):
        make_vec_env(GOALS, 1, cluster="127.0.0.1:1")


def test_a_lost_worker_is_one_line(vslam: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The command ends with status 2, one line on stderr, and the command that resumes."""

    def lose(self: Training) -> bool:
        self.save()
        raise LostWorkerError("ray: expected workers that run, got a lost one at 10.0.0.7.")

    monkeypatch.setattr(Training, "run", lose)
    said = vslam("train", "--preset", "smoke", "--workers", "0", "--out", str(tmp_path / "run"))
    assert said.status == 2
    assert said.err == "error ray: expected workers that run, got a lost one at 10.0.0.7.\n"
    assert f"Resume: vslam train --resume {tmp_path / 'run'}" in said.out
