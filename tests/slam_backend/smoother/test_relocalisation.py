"""Robots whose odometry jumps: the filter finds them at older landmarks, or says nothing."""

from typing import Any

import numpy as np
import pytest

from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import Relocalisation
from slam_backend.geometry import compose
from slam_backend.models.measurements import Measurements
from studies.filters.circle_world import MOTION, MOVE, circle_log

AT, JUMP = 150, np.array([3.0, 2.0, 1.0])
SOON = 110  # two rejuvenations: the first may fail


def true_path(steps: int) -> np.ndarray:
    """Return the path (T, 3) on the circle."""
    path = np.zeros((steps, 3))
    for step in range(1, steps):
        path[step] = compose(path[step - 1], MOVE)
    return path


def errors(
    slam: FastSlam, seed: int, at: int | None, alike: bool = False, names: bool = False, without: slice = slice(0)
) -> tuple[Any, Any]:
    """Run a filter in the circle world, `without` some steps; return position errors and relocalisations by step."""
    log, found = circle_log("none", seed), {}
    path, off = true_path(len(log.odometry)), []
    readings = list(enumerate(zip(log.odometry, log.measurements, log.identities, strict=True)))
    del readings[without]
    for step, (move, frame, ids) in readings:
        odometry = compose(move, JUMP) if step == at else move
        seen = Measurements(frame.points, np.ones_like(frame.descriptors)) if alike else frame
        report = slam.step([odometry], [seen], [ids] if names else None)
        off.append(np.hypot(*(slam.pose().mean - path[step])[:2]))
        if report.rejuvenation is not None and report.rejuvenation.relocalisation is not None:
            found[step] = report.rejuvenation.relocalisation
    return np.array(off), found


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_whose_odometry_jumped_is_found_and_its_map_is_one_again(seed: int) -> None:
    """One wrong reading is noticed at the second rejuvenation at the latest, reported, and repaired."""
    slam = FastSlam(motion=MOTION, seed=seed)
    off, found = errors(slam, seed, AT)
    (step, told), *more = found.items()
    assert not more
    assert AT < step <= AT + SOON
    assert off[AT:step].min() > 2.0
    assert off[step:].max() < 0.3
    assert slam.map_size == 30
    assert told.outcome == "found"
    assert told.distance > 2.0
    (warning,) = (one for one in slam.consistency.warnings if one.sign == "lost")
    assert (warning.step, warning.num_landmarks, warning.found) == (step, told.num_landmarks, True)
    assert f"found at step {step}" in warning.text
    assert slam.consistency.to_mapping()["warnings"][-1]["sign"] == "lost"


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_with_right_odometry_is_never_lost(seed: int) -> None:
    """Right readings give no relocalisation."""
    slam = FastSlam(motion=MOTION, seed=seed)
    off, found = errors(slam, seed, None)
    assert not found
    assert off.max() < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_was_carried_says_so_once_and_is_not_moved(seed: int) -> None:
    """Nothing tells a carried robot from one at a place that looks alike: one warning, and the map stays as it is."""
    slam = FastSlam(motion=MOTION, seed=seed)
    off, found = errors(slam, seed, None, without=slice(AT, AT + 30))
    assert {one.outcome for one in found.values()} == {"suspected"}
    assert min(found) <= AT + 30 + SOON
    assert off[-1] > 2.0
    (warning,) = (one for one in slam.consistency.warnings if one.sign == "lost")
    assert not warning.found
    assert warning.text.startswith("Perhaps lost at step")
    assert warning.distance == pytest.approx(2.0 * 4.0 * np.sin(30 * MOVE[2] / 2.0), abs=0.5)  # the chord
    assert slam.consistency.verdict == "perhaps lost"


def test_landmarks_that_look_alike_tell_no_place() -> None:
    """Without distinctive landmarks nothing is found, and nothing made worse."""
    off, found = errors(FastSlam(motion=MOTION, seed=0), 0, AT, alike=True)
    assert not found
    assert off[-1] > 2.0


def test_named_landmarks_need_no_relocalisation() -> None:
    """With identities the filter itself returns to its landmarks."""
    off, found = errors(FastSlam(motion=MOTION, seed=0), 0, AT, names=True)
    assert not found
    assert off[AT + 50 :].max() < 0.3


def test_the_other_robots_of_a_lost_one_keep_their_map() -> None:
    """In a joint filter the lost robot alone is moved."""
    log, other = circle_log("none", 0), circle_log("none", 1)
    looks = {int(i): row for ids, m in zip(log.identities, log.measurements, strict=True) for i, row in
             zip(ids, m.descriptors, strict=True)}  # fmt: skip
    slam = FastSlam(2, motion=MOTION, seed=0)
    path, off, robots = true_path(len(log.odometry)), [], []
    for step in range(len(path)):
        odometry = compose(other.odometry[step], JUMP) if step == AT else other.odometry[step]
        second = Measurements(other.measurements[step].points, np.array([looks[i] for i in other.identities[step]]))
        report = slam.step([log.odometry[step], odometry], [log.measurements[step], second])
        off.append([np.hypot(*(slam.pose(robot).mean - path[step])[:2]) for robot in range(2)])
        if report.rejuvenation is not None and report.rejuvenation.relocalisation is not None:
            robots.append(report.rejuvenation.relocalisation.robot)
    assert robots == [1]
    assert np.max(off, axis=0)[0] < 0.3
    assert off[-1][1] < 0.3
    assert slam.map_size == 30


def test_a_lost_robot_is_part_of_the_state() -> None:
    """Warnings survive a snapshot."""
    slam = FastSlam(motion=MOTION, seed=0)
    errors(slam, 0, AT)
    other = FastSlam(motion=MOTION, seed=0)
    other.set_state(slam.get_state())
    assert other.consistency == slam.consistency
    assert other.consistency.verdict in ("lost and found", "inconsistent")


def test_the_distance_is_that_of_the_positions() -> None:
    """Headings do not count."""
    assert Relocalisation(0, (3.0, -4.0, 1.0), 5, "found").distance == 5.0
