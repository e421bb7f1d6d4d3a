"""Trials on a Ray cluster: all rows, also if a node is lost."""

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest
from builders.ray_cluster import two_nodes

from training.experiments.run_folder import RunFolder
from training.experiments.trial_store import finished_trials, run_trials

ray = pytest.importorskip("ray", reason="extra distributed is not installed")


@dataclass(frozen=True)
class Waiting:
    """Trial that takes a while."""

    number: int


def wait_and_square(trial: Waiting) -> dict[str, Any]:
    """Return the square, the node and the number of threads."""
    time.sleep(0.5)
    if trial.number < 0:
        raise ValueError("number: expected an int >= 0, got -1. Use 0 or more.")
    node = ray.get_runtime_context().get_node_id()
    return {**asdict(trial), "square": trial.number**2, "node": node, "threads": os.environ["OMP_NUM_THREADS"]}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Cluster of two nodes with one core each, on this machine."""
    with two_nodes(Path(__file__).parent) as started:  # where its processes find this module
        yield started


@pytest.mark.slow
def test_trials_of_a_lost_node_are_run_again(cluster: Any, tmp_path: Path) -> None:
    """All rows arrive although one of two nodes stops; processes have one thread each; errors keep their text."""
    folder = RunFolder.create(tmp_path / "run", "test", {}, 0)
    trials, rows = [Waiting(number) for number in range(12)], []

    def on_trial(row: dict[str, Any]) -> None:
        rows.append(row)
        if len({each["node"] for each in rows}) == 2 and len(cluster.worker_nodes) == 1:
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)

    run_trials(folder, "trials.jsonl", wait_and_square, trials, 1, lambda: False, on_trial, cluster.address)
    assert not cluster.worker_nodes  # both nodes ran trials
    assert sorted(row["square"] for row in rows) == [number**2 for number in range(12)]
    assert {row["threads"] for row in rows} == {"1"}
    assert set(finished_trials(folder.path / "trials.jsonl", Waiting)) == set(trials)
    with pytest.raises(ValueError, match="number: expected an int >= 0"):
        run_trials(folder, "bad.jsonl", wait_and_square, [Waiting(-1)], 1, lambda: False, on_trial, cluster.address)


def test_an_unreachable_cluster_is_an_error(tmp_path: Path) -> None:
    """The error comes at once and names the option."""
    folder = RunFolder.create(tmp_path / "run", "test", {}, 0)
    with pytest.raises(ValueError, match=r"ray: expected the address of a Ray cluster that runs, got '127.0.0.1:1'"):
        run_trials(folder, "trials.jsonl", wait_and_square, [Waiting(1)], 1, lambda: False, print, "127.0.0.1:1")
