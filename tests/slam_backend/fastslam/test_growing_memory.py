"""Memory of large maps grows where it is."""

import sys
from copy import deepcopy

import numpy as np
import pytest

from slam_backend.fastslam import particle_maps
from slam_backend.fastslam.particle_maps import GrowingMemory, ParticleMaps

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="memory moves on Linux alone")


@LINUX
def test_numbers_stay_when_memory_grows() -> None:
    """The first numbers are as before, and the memory begins at a cache line; while an array is in use it stays."""
    memory = GrowingMemory(1000)
    array = memory.array(1000)
    array[:] = np.arange(1000.0)
    assert not memory.reserve(10**6)
    del array
    assert memory.reserve(10**6)
    grown = memory.array(10**6)
    np.testing.assert_array_equal(grown[:1000], np.arange(1000.0))
    assert grown.ctypes.data % particle_maps.LINE == 0
    grown[-1] = 1.0


@LINUX
def test_new_values_stay_in_the_allocator_longer_than_values_that_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Below the limit for new values, memory of its own comes with the first growth."""
    monkeypatch.setattr(particle_maps, "GROWN", 1)
    maps = ParticleMaps(20)
    maps.reserve(200, 8)
    assert maps._memory is None
    maps.reserve(2000, 8)
    assert maps._memory is not None


@LINUX
@pytest.mark.parametrize("is_held", [False, True])
def test_large_maps_grow_as_small_ones_do(is_held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values and counts are equal, in copies, too, whether memory grows where it is or must be copied."""
    states = []
    for least in (1 << 40, 1):
        for name in ("GROWN", "LARGE"):
            monkeypatch.setattr(particle_maps, name, least)
        maps, rng, held = ParticleMaps(20), np.random.default_rng(3), []
        for number in range(3):
            maps.reserve(200 * (number + 1), 8)
            maps.values[:] = rng.random(maps.values.shape)
            maps.counts[:] = 1
            held += [maps.values] if is_held else []
        copied = deepcopy(maps)
        copied.reserve(5000, 8)
        np.testing.assert_array_equal(copied.values[: len(maps.values)], maps.values)
        states.append((maps.values.copy(), maps.counts.copy(), maps.free_rows.copy()))
    for small, large in zip(*states, strict=True):
        np.testing.assert_array_equal(small, large)
