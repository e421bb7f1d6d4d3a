"""Replays of bags: `vslam replay bag`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import bags
from builders.bags import views_of, write_circle, write_odometry, written

from slam_backend.fastslam.options import FilterOptions
from slam_backend.maps.landmark_map import LandmarkMap
from training.replay.readers import read_bag

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install .[ros]")

ONE = ("--odometry", "/odom", "--landmarks", "/tags")


@pytest.mark.slow
def test_the_landmarks_of_a_bag_are_found(vslam: Any, tmp_path: Path) -> None:
    """The map has each tag that was seen near its place, and the path is better than its odometry; a run repeats."""
    path, run, again = tmp_path / "circle.mcap", tmp_path / "run", tmp_path / "again"
    write_circle(path, noise=0.03, scale=1.03, seconds=60.0)
    said = vslam("replay", "bag", "--path", str(path), *ONE, "--truth", "/gt", "--particles", "30", "--out", str(run))
    assert said.status == 0, said.err
    assert "/tags: taken to be in the frame 'base_link' of the robot" in said.out
    metrics = json.loads((run / "metrics.json").read_text())
    (row,) = metrics["robots"]
    assert row["ate_aligned_m"] < 0.1 < 0.2 < row["dead_reckoning_ate_aligned_m"]
    seen = sorted({int(number) for view in views_of(seconds=60.0) for number in view.ids})
    found = LandmarkMap.load(run / "map_1.npz")
    assert sorted(found.descriptors.argmax(axis=1)) == list(range(len(seen)))
    true = bags.LANDMARKS[[seen[row] for row in found.descriptors.argmax(axis=1)]]
    assert np.median(np.linalg.norm(found.means - true, axis=1)) < 0.25  # the robot starts at the origin of the world
    assert vslam("replay", "bag", "--config", str(run), "--out", str(again)).status == 0
    assert metrics == json.loads((again / "metrics.json").read_text())


@pytest.mark.slow
def test_robots_of_a_bag_find_each_other(vslam: Any, tmp_path: Path) -> None:
    """Two robots with unknown starts end in one group; alone they do not."""
    path = tmp_path / "team.bag"
    with written(path) as bag:
        for robot in (0, 1):
            write_odometry(bag, f"/r{robot}/odom", robot, seconds=60.0, scale=1.03)
            for view in views_of(robot, seconds=60.0, noise=0.03):
                bag.write(f"/r{robot}/tags", view.time, bags.tags(bag, view))
    topics = ("--odometry", "/r0/odom,/r1/odom", "--landmarks", "/r0/tags,/r1/tags", "--particles", "60")
    said = vslam("replay", "bag", "--path", str(path), *topics, "--out", str(tmp_path / "run"))
    assert said.status == 0, said.err
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["groups"] == [[1, 2]]
    alone = ("--alone", "--duration", "5", "--out", str(tmp_path / "alone"))
    assert vslam("replay", "bag", "--path", str(path), *topics, *alone).status == 0
    assert json.loads((tmp_path / "alone" / "metrics.json").read_text())["groups"] == [[1], [2]]


@pytest.mark.parametrize(("given", "status"), [((), 0), (("--odometry", "/odom"), 2)])
def test_topics_are_listed_where_one_is_missing(
    given: tuple[str, ...], status: int, vslam: Any, tmp_path: Path
) -> None:
    """Without both topics the bag is listed; without one of them the error that names it comes after the table."""
    path = write_circle(tmp_path / "circle.bag", seconds=2.0)
    said = vslam("replay", "bag", "--path", str(path), *given)
    assert said.status == status
    for word in ("/odom", "nav_msgs/Odometry", "40", "/tags", "apriltag_ros/AprilTagDetectionArray", "landmarks"):
        assert word in said.out
    needed = "expected the topic of the landmarks, got no --landmarks. Choose a topic above that can be landmarks."
    assert said.err == (f"error landmarks: {needed}\n" if status else "")


def test_descriptors_have_the_usual_gates(tmp_path: Path) -> None:
    """Identities open the gates as barcodes do; descriptors leave them, and have no true identities."""
    table = np.random.default_rng(3).normal(size=(15, 6))

    def look(bag: Any, view: Any) -> Any:
        return bags.cloud(bag, view, extra={"descriptor": table[view.ids]})

    topics: dict[str, Any] = {"odometry": ["/odom"], "landmarks": ["/tags"]}
    described = read_bag(write_circle(tmp_path / "cloud.mcap", look, seconds=3.0), **topics)
    tagged = read_bag(write_circle(tmp_path / "tags.mcap", seconds=3.0), **topics)
    assert set(described.options) == {"motion"}
    assert not described.has_identities
    assert tagged.options["position_gate"] > 100 * FilterOptions().position_gate
    assert tagged.has_identities
