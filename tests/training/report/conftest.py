"""A recorded episode and a run folder around it."""

from pathlib import Path

import numpy as np
import pytest

from training.episodes.config import RunConfig
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, run_episode
from training.experiments.run_folder import RunFolder
from training.report.recording import EpisodeRecorder, Recording
from vslam_env import vslam_v0
from vslam_env.environment import ExplorationEnv
from vslam_env.world import World

STEPS = 41
# A room of 7 x 5 m in which two robots see the same wall from different places.
ROOM = World(
    "room",
    np.array([[0.0, 0.0, 7.0, 0.0], [7.0, 0.0, 7.0, 5.0], [7.0, 5.0, 0.0, 5.0], [0.0, 5.0, 0.0, 0.0]]),
    start_poses=np.array([[2.0, 1.5, 0.2], [1.5, 3.5, -0.4]]),
)


def play(recorded: bool = True) -> tuple[ExplorationEnv, EpisodeRecord, Recording | None]:
    """Run two random walkers whose maps the oracle merges, with or without a recorder."""
    config = RunConfig(robots=2, policy="random_walk", seed=3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, max_cycles=STEPS, num_particles=13, oracle_merge=True)
    recorder = EpisodeRecorder(env, STEPS, 0.1)
    record = run_episode(env, config.make_policies(env), config.seed, *([recorder.on_step] if recorded else []))
    return env, record, recorder.finish(record) if recorded else None


@pytest.fixture(scope="session")
def episode() -> tuple[ExplorationEnv, EpisodeRecord, Recording]:
    """Return an environment at the end of an episode, its record and its recording."""
    env, record, recording = play()
    assert recording is not None
    return env, record, recording


@pytest.fixture
def run(episode: tuple[ExplorationEnv, EpisodeRecord, Recording], tmp_path: Path) -> Path:
    """Return the folder of a run, with metrics and recording, without pictures."""
    _, record, recording = episode
    folder = RunFolder.create(tmp_path / "run", "run", {"world": "room", "policy": "random_walk"}, 3)
    folder.write_metrics(score_episode(record))
    recording.save(folder.path)
    return folder.path
