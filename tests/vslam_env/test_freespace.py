"""Where robots fit, what they reach, what they could see, and where they start."""

from typing import Any

import numpy as np
import pytest

from slam_backend.models.camera import StereoCamera
from vslam_env.sensors import LandmarkSensor, LandmarkSensorConfig
from vslam_env.world import FreeSpace, Landmarks, World, make_world, place_landmarks
from vslam_env.world._kernels.clearance import distances_to_walls

# A 6 x 3 m hall with a 1 m door in the wall x = 4, a closed closet in a corner, and a wall outside.
HALL = [
    [0, 0, 6, 0],
    [6, 0, 6, 3],
    [6, 3, 0, 3],
    [0, 3, 0, 0],
    [4, 0, 4, 1],
    [4, 2, 4, 3],
    [0, 1.5, 1, 1.5],
    [1, 1.5, 1, 3],
    [7, 0, 8, 1],
]


def test_free_space_is_what_the_walls_enclose() -> None:
    """The hall counts on both sides of its door; the closet and the outside do not."""
    free = FreeSpace(World("hall", HALL))
    inside = free.contains(np.array([[2.0, 1.0], [5.0, 2.5], [0.5, 2.5], [6.5, 1.0], [-9.0, 1.0], [9.0, 99.0]]))
    assert inside.tolist() == [True, True, False, False, False, False]
    area = 0.04 * len(free.free_area_cells)
    assert 0.85 * 16.5 < area < 16.5
    assert distances_to_walls(free.free_area_cells, np.array(HALL, dtype=float)).min() > 0.1


def test_a_narrow_door_keeps_large_robots_out() -> None:
    """What a robot reaches depends on its radius: through a door of 1 m goes a disc of 0.3 m, none of 0.6 m."""
    cells = [FreeSpace(World("hall", HALL), radius).reachable for radius in (0.3, 0.6)]
    columns = [np.flatnonzero(mask.any(axis=0)) * 0.1 - 0.3 for mask in cells]
    assert columns[0].max() > 5.5
    assert columns[1].max() < 4.0


def test_start_poses_of_the_world_choose_the_part() -> None:
    """With start poses given, the part that holds them counts, not the largest."""
    free = FreeSpace(World("hall", HALL, start_poses=[[0.5, 2.2, 0.0]]))
    assert free.contains(np.array([[0.5, 2.5], [2.0, 1.0]])).tolist() == [True, False]


@pytest.mark.parametrize("walls", [[[0, 0, 5, 0], [5, 0, 5, 4]], [[0, 0, 0.3, 0], [0.3, 0, 0, 0.3], [0, 0.3, 0, 0]]])
def test_walls_that_enclose_no_room_are_refused(walls: Any) -> None:
    """Open walls, and a room in which no robot fits, are refused with a cure."""
    with pytest.raises(ValueError, match=r"world: expected walls that enclose a space .* Close the outer walls"):
        FreeSpace(World("bad", walls))


@pytest.mark.parametrize("seed", range(8))
def test_drawn_starts_keep_their_promises(seed: int) -> None:
    """Starts stand clear of walls, 5 m apart, in one reachable part, and no landmark is seen from two of them."""
    rng = np.random.default_rng(seed)
    world = make_world("office", rng)
    free = FreeSpace(world)
    marks = place_landmarks(world, rng, None, free)
    starts = free.draw_starts(3, rng, 5.0, StereoCamera(), marks)
    np.testing.assert_array_equal(free.check_starts(starts, 3), starts)
    gaps = np.linalg.norm(starts[:, None, :2] - starts[None, :, :2], axis=2)[np.triu_indices(3, 1)]
    assert gaps.min() >= 5.0
    assert distances_to_walls(starts[:, :2], world.walls).min() >= 0.2
    seen = LandmarkSensor(LandmarkSensorConfig(), world.walls, marks).visible(starts)
    assert seen.sum(axis=0).max() <= 1


def test_robots_that_do_not_fit_are_refused() -> None:
    """Ten robots 5 m apart in a hall of 6 m give one error that says what to relax."""
    free = FreeSpace(World("hall", HALL))
    with pytest.raises(ValueError, match=r"num_robots: expected as many as can start 5 m apart in 'hall', got 10\."):
        free.draw_starts(10, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ([[2, 1, 0], [9, 1, 0]], r"start_poses\[1\]: expected a place that robots can reach"),
        ([[2, 1, 0], [0.5, 2.2, 0]], r"start_poses\[1\]: expected a place that robots can reach"),
        ([[2, 0.1, 0], [5, 1, 0]], r"start_poses\[0\]: expected a place at least 0\.2 m .* got a distance of 0\.100 m"),
        ([[2, 1, 0], [2.3, 1, 0]], r"start_poses\[1\]: expected .* got a distance of 0\.300 m to robot 0"),
        ([[2, 1, 0]], r"start_poses: expected an array of shape \(2, 3\), got shape \(1, 3\)"),
        ([[2, 1, 0], [2, np.nan, 0]], r"start_poses: expected finite numbers"),
    ],
)
def test_bad_starts_are_refused(starts: Any, message: str) -> None:
    """A start inside a wall, cut off, on top of another or of the wrong shape is refused; the robot is named."""
    with pytest.raises(ValueError, match=message):
        FreeSpace(World("hall", HALL)).check_starts(starts, 2)


def test_landmarks_nobody_can_see_do_not_count() -> None:
    """A landmark in the closet, on an outer face, or too high up to be in any view is not counted; others are."""
    positions = [[2.0, 3.0, 0.0], [0.5, 3.0, 0.0], [2.0, 3.0, 0.0], [2.0, 3.0, 4.0], [5.0, 0.0, 0.5]]
    normals = [[0, -1], [0, -1], [0, 1], [0, -1], [0, 1]]
    marks = Landmarks(positions, normals, [2, 2, 2, 2, 0], np.eye(5, 9))
    free = FreeSpace(World("hall", HALL, marks))
    assert free.visible_landmarks(marks, StereoCamera()).tolist() == [True, False, False, False, True]


def test_what_a_robot_sees_can_be_seen() -> None:
    """Whatever a camera sees from a reachable place is among the landmarks that count."""
    rng = np.random.default_rng(5)
    world = make_world("office", rng)
    free = FreeSpace(world)
    marks = place_landmarks(world, rng, None, free)
    countable = free.visible_landmarks(marks, StereoCamera())
    sensor = LandmarkSensor(LandmarkSensorConfig(), world.walls, marks)
    seen = np.zeros(len(marks), dtype=bool)
    for _ in range(150):
        seen |= sensor.visible(free.draw_starts(2, rng, 1.0)[:1])[0]
    assert seen.sum() > 100
    assert countable.mean() > 0.9
    assert (seen & ~countable).sum() == 0
