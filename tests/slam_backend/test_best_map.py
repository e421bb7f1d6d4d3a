"""The compiled gather of the most probable particle's map agrees with the plain one."""

import numpy as np
import pytest
from gappy_filter import filter_after_some_steps

from slam_backend import FastSlam, Measurements
from slam_backend.fastslam.particle_maps import best_map, write_outline
from slam_backend.maps.landmark_map import OutlineRows

UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _filter_after_some_steps() -> FastSlam:
    """Return a filter that has resampled, and in which landmarks came and went."""
    slam, points, looks = filter_after_some_steps(70, seed=3)
    slam.state.maps.release(slam.state.maps.used_slots()[[2, 5]])
    extra = Measurements(points[:2] + np.array([0.0, 0.0, 3.0]), -looks[:2])
    slam.step([None], [extra])
    return slam


def test_the_gather_agrees_with_fancy_indexing() -> None:
    """For each of 70 particles and any least count: the same landmarks, by ascending id, with the same bits."""
    slam = _filter_after_some_steps()
    maps = slam.state.maps
    slots = maps.used_slots()
    assert not (np.diff(slots) > 0).all()  # slots were used again: ids do not ascend with them
    for m in range(70):
        values, counts = maps.of_particle(m, slots)
        for least in (1, 2, 5):
            means, covariances, looks, times, ids = best_map(maps, m, least)
            held = counts >= least
            np.testing.assert_array_equal(means, values[held, :3])
            np.testing.assert_array_equal(covariances, values[held][:, 3:][:, UNPACK])
            np.testing.assert_array_equal(looks, maps.descriptors[slots[held]])
            np.testing.assert_array_equal(times, counts[held])
            np.testing.assert_array_equal(ids, maps.ids[slots[held]])


def test_an_outline_is_that_of_the_map() -> None:
    """It has the map's landmarks in the map's order, with the same bits, whatever the least count."""
    slam = _filter_after_some_steps()
    for least in (0, 1, 3, 9):
        for got, expected in zip(slam.outline(least), slam.map(min_count=least).outline, strict=True):
            np.testing.assert_array_equal(got, expected)
    assert len(FastSlam(num_particles=3).outline().ids) == 0


@pytest.mark.parametrize("room", [0, 5, 9, 100])
def test_an_outline_tells_how_much_room_it_takes(room: int) -> None:
    """Behind rows that are taken, and where there are too few: then none but those that there are is written."""
    slam = _filter_after_some_steps()
    expected = slam.outline(2)
    size = len(expected.ids)
    assert 9 - 3 < size < 100 - 3
    rows = OutlineRows(np.full((room, 4), -7.0), np.full((room, 2), -7))
    assert write_outline(slam.state.maps, slam.best_particle, 2, rows, 3) == 3 + size
    for got in rows:
        assert (got[:3] == -7).all()
        assert (got[3 + size :] == -7).all()
    if room >= 3 + size:
        for got, own in zip(rows.part(3, 3 + size), expected, strict=True):
            np.testing.assert_array_equal(got, own)


def test_a_least_count_leaves_out_what_was_seen_less() -> None:
    """`map(min_count=n)` is the subset of `map()` that was measured n times; an empty filter has an empty map."""
    slam = _filter_after_some_steps()
    whole, some = slam.map(), slam.map(min_count=3)
    assert 0 < len(some) < len(whole)
    np.testing.assert_array_equal(some.ids, whole.ids[whole.counts >= 3])
    np.testing.assert_array_equal(some.means, whole.means[whole.counts >= 3])
    mixed = slam.map("mixture", min_count=3)
    np.testing.assert_array_equal(mixed.ids, some.ids)
    assert len(FastSlam(num_particles=3).map()) == 0
