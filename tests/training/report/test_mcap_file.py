"""Files of ROS 2 for Foxglove and rerun."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.readers.bag_files import open_bag
from slam_backend.readers.bags import load_bag
from training.report.mcap_file import write_mcap
from training.report.recording import part_of
from vslam_env.navigation.occupancy_grid import CELL, FREE, OCCUPIED

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install .[ros]")


def _seconds(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _points(cloud: Any) -> Any:
    return np.asarray(cloud.data).view(np.float32).reshape(-1, 3)[:, :2]


def test_a_file_of_ros_holds_the_episode(episode: Any, tmp_path: Path) -> None:
    """Poses, maps, grids, walls and events come back from the file alone, at their times and places."""
    recording = episode[2]
    file = write_mcap(recording, tmp_path / "episode.mcap")
    assert list(tmp_path.iterdir()) == [file]
    with open_bag(file) as bag:
        read = {topic: list(bag.messages("path", topic)) for topic in bag.topics}
    assert [len(read[topic]) for topic in ("/tf_static", "/walls", "/landmarks")] == [1, 1, 1]
    assert len(read["/tf"]) == len(recording.times)
    for robot in range(2):
        found = read[f"/robot{robot}/estimate"]
        np.testing.assert_allclose([_seconds(each) for each in found], recording.times, atol=1e-9)
        places = [(each.pose.position.x, each.pose.position.y) for each in found]
        np.testing.assert_array_equal(places, recording.estimate[:, robot, :2])
        truths = [2.0 * np.arctan2(m.pose.pose.orientation.z, m.pose.pose.orientation.w) for m in read["/robot1/truth"]]
        np.testing.assert_allclose(truths, recording.truth[:, 1, 2], atol=1e-12)
        for key, (spots, grid) in enumerate(zip(read[f"/robot{robot}/map"], read[f"/robot{robot}/grid"], strict=True)):
            points = recording.map_points[part_of(recording.map_ends, key, robot), :2]
            np.testing.assert_array_equal(_points(spots), points.astype(np.float32))
            runs = part_of(recording.grid_ends, key, robot)
            cells = np.repeat(recording.grid_values[runs], recording.grid_runs[runs])
            if len(cells):
                assert (grid.info.height, grid.info.width) == tuple(recording.grid_boxes[key, robot, 2:])
                assert (np.asarray(grid.data) == 100).sum() == (cells == OCCUPIED).sum()
                assert (np.asarray(grid.data) == 0).sum() == (cells == FREE).sum() > 0
    (walls,) = read["/walls"][0].markers
    ends = np.array([(point.x, point.y) for point in walls.points]).reshape(-1, 4)
    np.testing.assert_array_equal(ends, recording.walls)
    np.testing.assert_array_equal(_points(read["/landmarks"][0]), recording.landmarks.astype(np.float32))
    texts = [event["text"] for event in recording.about["events"]]
    assert [each.msg for each in read["/events"]] == texts
    assert texts


def test_occupied_cells_lie_on_walls(episode: Any, tmp_path: Path) -> None:
    """In the world, by the start frame and the origin of the grid, occupied cells are where a wall is."""
    recording = episode[2]
    with open_bag(write_mcap(recording, tmp_path / "episode.mcap")) as bag:
        grid = list(bag.messages("path", "/robot0/grid"))[-1]
        (static,) = bag.messages("path", "/tf_static")
    moved = static.transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id) == ("world", grid.header.frame_id)
    assert grid.info.resolution == pytest.approx(CELL)
    cells = np.asarray(grid.data).reshape(grid.info.height, grid.info.width)
    rows, columns = np.nonzero(cells == 100)
    x = grid.info.origin.position.x + (columns + 0.5) * CELL
    y = grid.info.origin.position.y + (rows + 0.5) * CELL
    heading = 2.0 * np.arctan2(moved.transform.rotation.z, moved.transform.rotation.w)
    at = moved.transform.translation
    world_x = at.x + np.cos(heading) * x - np.sin(heading) * y
    world_y = at.y + np.sin(heading) * x + np.cos(heading) * y
    to_wall = np.minimum.reduce([np.abs(world_x), np.abs(world_x - 7.0), np.abs(world_y), np.abs(world_y - 5.0)])
    assert len(rows) > 10
    assert np.median(to_wall) < CELL


def test_landmarks_of_the_world_are_no_sightings(episode: Any, tmp_path: Path) -> None:
    """The reader of bags refuses a map in the frame `world`, which is none of the robot."""
    file = write_mcap(episode[2], tmp_path / "episode.mcap")
    with pytest.raises(
        ValueError, match="landmarks: expected landmarks of /robot0/map in a frame of the robot, got 'world'"
    ):
        load_bag(file, ["/robot0/truth"], ["/robot0/map"])


def test_other_names_and_a_missing_package_are_refused_for_ros(refusal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are refused before a folder is made, with the cure."""
    assert "mcap: expected a name that ends in .mcap, got 'episode.bag'." in refusal("run", "--mcap", "episode.bag")
    assert "mcap: expected a file that can be written" in refusal("run", "--mcap", "none/episode.mcap")
    monkeypatch.setattr("training.report.mcap_file.find_spec", lambda name: None)
    assert "mcap: expected the package rosbags, got no such package. Install it" in refusal("run", "--mcap", "a.mcap")
