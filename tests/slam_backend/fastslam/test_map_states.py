"""States of large maps: what was not written since the last state is shared, and all is as if it had been copied."""

import copy
import gc
import pickle
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from test_filter_resampling import filter_after, inputs

from slam_backend.core.read_only import is_read_only
from slam_backend.fastslam import particle_maps
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import chunk_sizes


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Divide maps of more than four landmarks into arrays of two."""
    monkeypatch.setattr(particle_maps, "WHOLE", 4)
    monkeypatch.setattr(particle_maps, "CHUNK", 2)


def large_filter() -> tuple[FastSlam, list[Any]]:
    """Return a filter that has driven on a circle, and further readings: some landmarks are in view, others are not."""
    return filter_after(12, 60), inputs(28)[12:]


@pytest.mark.usefixtures("small_chunks")
def test_states_share_what_was_not_written() -> None:
    """Every state equals that of a copy, which shares nothing, though it shares arrays with the state before."""
    slam, readings = large_filter()
    assert slam.map_size > 8
    shared, copied = 0, 0
    last: tuple[Any, ...] = ()
    for odometry, frames in readings:
        fresh = pickle.loads(pickle.dumps(slam)) if copied % 2 else copy.deepcopy(slam)
        state = slam.get_state()
        values = state["maps"]["values"]
        assert_same(state, fresh.get_state())
        assert all(map(is_read_only, values))
        assert [len(part) for part in values] == chunk_sizes(len(state["maps"]["ids"]))
        ours = sum(any(part is other for other in last) for part in values)
        shared, copied, last = shared + ours, copied + len(values) - ours, values
        slam.step(odometry, frames)
    assert shared > 0
    assert copied > 0


@pytest.mark.usefixtures("small_chunks")
def test_a_filter_that_was_set_to_a_state_shares_it_and_continues_alike() -> None:
    """Where nothing was written after `set_state` its arrays come back themselves, and no step writes into them."""
    slam, readings = large_filter()
    start = slam.get_state()
    before = copy.deepcopy(start)
    ends = []
    for _ in range(2):
        slam.set_state(start)
        assert all(a is b for a, b in zip(slam.get_state()["maps"]["values"], start["maps"]["values"], strict=True))
        for odometry, frames in readings:
            slam.step(odometry, frames)
        ends.append(slam.get_state())
        slam.step(*readings[0])
    assert_same(ends[0], ends[1])
    assert_same(start, before)


@pytest.mark.usefixtures("small_chunks")
def test_arrays_live_as_long_as_a_state_that_has_them() -> None:
    """A filter does not keep the arrays of states that were dropped."""
    slam, _ = large_filter()
    state = slam.get_state()
    references = slam.state.maps._copied[1]
    assert all(reference() is not None for reference in references)
    del state
    gc.collect()
    assert all(reference() is None for reference in references)
    assert slam.get_state()["maps"]["values"]


@pytest.mark.usefixtures("small_chunks")
def test_values_divided_in_another_way_are_refused() -> None:
    """One array in place of those that the number of landmarks asks for is named."""
    slam, _ = large_filter()
    state = slam.get_state()
    maps = state["maps"] | {"values": (np.concatenate(state["maps"]["values"]),)}
    with pytest.raises(ValueError, match=r"state\['maps'\]\['values'\]"):
        slam.set_state(state | {"maps": maps})


@pytest.mark.usefixtures("small_chunks")
def test_maps_are_copied_part_by_part() -> None:
    """A state for a copy gives the same maps as any other, and neither takes nor changes what states share."""
    slam, readings = large_filter()
    shared = slam.get_state()["maps"]
    copied = particle_maps.ParticleMaps(slam.num_particles)
    copied.set_state(slam.state.maps.get_state(for_copy=True))
    assert_same(copied.get_state(), shared)
    assert all(one is other for one, other in zip(slam.get_state()["maps"]["values"], shared["values"], strict=True))
    slam.step(*readings[0])
    assert_same(copied.get_state(), shared)
