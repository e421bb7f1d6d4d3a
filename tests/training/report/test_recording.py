"""Recordings of episodes: what they hold, and that they change nothing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import compose
from tests.training.report.conftest import ROOM, STEPS, play
from training.episodes.config import RunConfig
from training.episodes.runner import run_episode
from training.experiments.output.plotting import CHI_SQUARE_95
from training.report import recording as recording_module
from training.report.content import parts_of_error
from training.report.recording import RECORDING_FILE, SCORES, EpisodeRecorder, Recording, run_lengths
from vslam_env import vslam_v0
from vslam_env.navigation import CELL


def test_a_recording_holds_the_record(episode: Any) -> None:
    """Poses, errors and coverage are those of the record, in the world frame; the last step is a keyframe."""
    _, record, recording = episode
    steps = [*range(0, STEPS, 2), STEPS]  # every 0.2 s, and the last
    np.testing.assert_array_equal(recording.times, record.times[steps])
    np.testing.assert_array_equal(recording.truth, np.swapaxes(record.true_poses[:, steps], 0, 1))
    starts = record.true_poses[:, 0]
    for name, paths in (("estimate", record.estimated), ("reckoned", record.reckoned)):
        for robot in range(2):
            np.testing.assert_allclose(getattr(recording, name)[:, robot], compose(starts[robot], paths[robot, steps]))
    np.testing.assert_array_equal(recording.scores[..., SCORES.index("map_error")], record.map_errors.T[steps])
    np.testing.assert_array_equal(recording.coverage, record.coverage[steps])
    assert recording.keyframes.tolist() == [0, 5, 10, 15, 20, 21]  # every second, and the last
    (merge,) = [event for event in recording.about["events"] if event["kind"] == "merge"]
    assert (merge["a"], merge["b"], merge["time"]) == ([0], [1], record.merges[0].time)
    assert merge["error_m"] < 1e-9
    assert merge["text"].startswith("maps of 0 and 1 merged on ")


def test_the_last_map_and_grid_are_those_of_the_belief(episode: Any) -> None:
    """A map that two robots share is stored once, with the first; its grid comes back cell by cell."""
    env, record, recording = episode
    first, last = recording.map_ends[-2, -1], recording.map_ends[-1]
    assert last[0] == last[1]  # robot 1 has the map of robot 0
    held = record.maps[0].moved(record.true_poses[0, 0])
    points = recording.map_points[first : last[0]]
    np.testing.assert_allclose(points[:, :2], held.means[:, :2])
    for (*_, large, small, angle), covariance in zip(points, held.covariances[:, :2, :2], strict=True):
        turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        again = turned @ np.diag([large, small]) ** 2 @ turned.T / CHI_SQUARE_95
        np.testing.assert_allclose(again, covariance, atol=1e-9)
    grid = env.belief("robot_0").grid
    row, column, last_row, last_column = grid.bounds
    begin, end = recording.grid_ends[-2, -1], recording.grid_ends[-1, 0]
    x, y, rows, columns = recording.grid_boxes[-1, 0]
    cells = np.repeat(recording.grid_values[begin:end], recording.grid_runs[begin:end]).reshape(int(rows), int(columns))
    np.testing.assert_array_equal(cells, grid.cells[row:last_row, column:last_column])
    # The start pose, at the origin, is in a free cell of the box.
    at = cells[int(-y / CELL), int(-x / CELL)]
    assert at == env.belief("robot_0").grid.cells[len(grid.cells) // 2, len(grid.cells) // 2]


def test_recording_changes_nothing() -> None:
    """An episode with a recorder has the same record, bit by bit, as one without."""
    (_, with_one, _), (_, without, _) = play(), play(recorded=False)
    for name in ("true_poses", "estimated", "reckoned", "map_errors", "coverage"):
        np.testing.assert_array_equal(getattr(with_one, name), getattr(without, name))
    np.testing.assert_array_equal(with_one.maps[0].means, without.maps[0].means)


def test_long_episodes_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most so many steps and keyframes are recorded, evenly, and the last step always."""
    monkeypatch.setattr(recording_module, "MOST_FRAMES", 15)
    monkeypatch.setattr(recording_module, "MOST_KEYFRAMES", 4)
    _, record, recording = play()
    assert recording is not None
    np.testing.assert_allclose(recording.times, record.times[[*range(0, STEPS, 3), STEPS]])
    assert recording.keyframes.tolist() == [0, 4, 8, 12, 14]  # every 1.2 s
    assert recording.scores.shape == (15, 2, 4)
    assert recording.sight_ends.shape == (15, 2)
    assert recording.sight_ends[-1, -1] == len(recording.sights)


def test_files_restore_a_recording(episode: Any, tmp_path: Path) -> None:
    """A saved recording is read again with single precision; a damaged one or another format is refused."""
    _, _, recording = episode
    recording.save(tmp_path)
    again = Recording.load(tmp_path)
    assert dict(again.about) == dict(recording.about) | {"format": 1}
    for name in ("truth", "map_points", "sights", "grid_boxes", "candidates", "scores"):
        np.testing.assert_allclose(getattr(again, name), getattr(recording, name), rtol=1e-6)
    np.testing.assert_array_equal(again.grid_runs, recording.grid_runs)
    file = tmp_path / RECORDING_FILE
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match="folder: expected a recording of an episode, got a broken file"):
        Recording.load(tmp_path)
    Recording(about={}, times=np.zeros(1), estimate=np.zeros((1, 1, 3)), truth=np.zeros((1, 1, 3))).save(tmp_path)
    with np.load(file) as stored:
        other = dict(stored) | {"about": np.frombuffer(b'{"format": 9}', np.uint8)}
    np.savez(file, **other)
    with pytest.raises(ValueError, match="folder: expected a recording of format 1, got a recording of format 9"):
        Recording.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("times", lambda a: a[:-1]), ("times", lambda a: a[::-1]), ("times", lambda a: a * np.nan),
        ("estimate", lambda a: a[:, :1]), ("truth", lambda a: a + np.inf), ("scores", lambda a: a[..., :3]),
        ("frames", lambda a: a + 2), ("sight_ends", lambda a: a + 1), ("sight_ends", lambda a: a[:-1]),
        ("map_ends", lambda a: a[::-1]), ("keyframes", lambda a: a + 1000), ("keyframes", lambda a: -a),
        ("grid_runs", lambda a: a + 1), ("grid_boxes", lambda a: a + np.inf), ("starts", lambda a: a[:1]),
        ("candidates", lambda a: a[:, :2]), ("walls", lambda a: a.astype("U9")), ("another", lambda a: np.zeros(3)),
        ("estimate", None), ("about", lambda a: np.frombuffer(b'{"format": 1}', np.uint8)),
        ("about", lambda a: np.frombuffer(b"[" * 50_000, np.uint8)),
        ("about", lambda a: np.frombuffer(b'{"format": 1, "names": ["a"], "events": [3]}', np.uint8)),
    ],
)  # fmt: skip
def test_recordings_whose_parts_do_not_fit_are_refused(episode: Any, name: str, change: Any, tmp_path: Path) -> None:
    """An intact file with other names, shapes, indices or no finite numbers is refused in one line."""
    _, _, recording = episode
    file = recording.save(tmp_path)
    with np.load(file) as stored:
        arrays = dict(stored)
    values = arrays.pop(name, None)
    if change is not None:
        arrays[name] = change(values)
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match=r"^folder: expected a recording of an episode, got a broken file"):
        Recording.load(tmp_path)


def test_the_parts_of_the_error_add_up(episode: Any) -> None:
    """Missed, false and wrongly placed landmarks give the mean of E^2; without a map only missed ones count."""
    _, _, recording = episode
    parts = parts_of_error(recording)
    errors = recording.scores[..., SCORES.index("map_error")]
    np.testing.assert_allclose(sum(parts.values()), (errors**2).mean(axis=1))
    assert all((part >= -1e-12).all() for part in parts.values())
    assert parts["missed landmarks"][0] == pytest.approx(0.5 * (1.0 - recording.scores[0, :, 1].mean()))


def test_runs_of_cells_are_exact() -> None:
    """Any cells come back from their runs."""
    rng = np.random.default_rng(5)
    for shape in ((7, 11), (1, 1), (0, 0), (3, 300)):
        cells = rng.integers(0, 3, shape, dtype=np.uint8)
        values, lengths = run_lengths(cells)
        np.testing.assert_array_equal(np.repeat(values, lengths).reshape(shape), cells)


def test_goals_of_policies_that_drive_are_recorded() -> None:
    """The goal of a robot is one of its candidates, or a place of its own; it lies where its path ends."""
    config = RunConfig(robots=1, policy="frontier", seed=3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=1, max_cycles=30, num_particles=5)
    policies = config.make_policies(env)
    recorder = EpisodeRecorder(env, 30, 0.1, policies.goals)
    recording = recorder.finish(run_episode(env, policies, 3, recorder.on_step))
    goal = policies.goals()["robot_0"]
    assert goal is not None
    last = recording.candidates[int(recording.candidate_ends[-2, 0]) :]
    (place,) = last[last[:, 3] > 0, :2]
    where = compose(env.true_start_poses[0], [*goal, 0.0])[:2]
    assert np.linalg.norm(place - where) < 0.2
