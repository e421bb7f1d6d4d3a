"""Recordings of replays: maps over time, placed as the final map is."""

from pathlib import Path

import numpy as np
import pytest
from small_logs import write_log, write_park

from training.replay.config import MrclamConfig, VictoriaConfig
from training.replay.core import MOST_STAGES, is_stage, replay_log
from training.replay.readers import read_mrclam, read_victoria
from training.replay.recordings import record_replay


def test_stages_are_spread_and_end_with_the_last_step() -> None:
    """Short replays keep each map, long ones at most `MOST_STAGES` + 1."""
    assert all(is_stage(step, 20) for step in range(20))
    kept = [step for step in range(9999) if is_stage(step, 9999)]
    assert len(kept) <= MOST_STAGES + 1
    assert (kept[0], kept[-1]) == (0, 9998)
    assert max(np.diff(kept)) == 134


def test_the_map_of_one_robot_grows(tmp_path: Path) -> None:
    """Maps have ever more landmarks; the last one is the final map, and lies at the last recorded step."""
    write_park(tmp_path)
    log = read_victoria(tmp_path)
    result = replay_log(log, VictoriaConfig(path="log", particles=2))
    recording = record_replay(log, result, [None])
    assert len(recording.keyframes) == len(recording.map_ends) > 20
    assert (np.diff(recording.keyframes) > 0).all()
    assert recording.keyframes[-1] == len(recording.times) - 1
    sizes = np.diff(recording.map_ends[:, 0], prepend=0)
    assert sizes[0] < 0.5 * sizes[-1]
    np.testing.assert_allclose(recording.map_points[-sizes[-1] :, :2], result.maps[0].means[:, :2])


@pytest.mark.parametrize("alone", [True, False])
def test_maps_of_a_team_are_those_of_its_groups(alone: bool, tmp_path: Path) -> None:
    """Each group has one map, that of its first robot; the last ones are the final maps."""
    write_log(tmp_path, noise=0.0)
    log = read_mrclam(tmp_path, alone=alone)
    replay = replay_log(log, MrclamConfig(path=str(tmp_path), particles=5, seed=1))
    recording = record_replay(log, replay, [None, None])
    sizes = np.diff(recording.map_ends.ravel(), prepend=0).reshape(recording.map_ends.shape)
    assert (sizes[len(sizes) // 5] > 0).all()  # both robots have a map of their own at first
    firsts = [group[0] for group in replay.groups]
    for robot in range(2):
        assert sizes[-1, robot] == (len(replay.maps[robot]) if robot in firsts else 0)
    assert recording.keyframes[-1] == len(recording.times) - 1
