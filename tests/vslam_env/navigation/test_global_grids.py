"""Pictures of all that was seen, which are drawn again where something has changed."""

import numpy as np
import pytest

from slam_backend.state import restore, take
from vslam_env.navigation import OccupancyGrid
from vslam_env.navigation._view_kernels import COARSE, NUM_COARSE, write_global_grid
from vslam_env.navigation.global_grids import GlobalGrids
from vslam_env.navigation.looks import TeamLooks
from vslam_env.navigation.team_grids import TeamGrids
from vslam_env.navigation.validation import ray_directions

ANGLES = np.linspace(-1.5, 1.5, 64)
REACH, HALF_FOV = 8.0, 1.2
HARDWARE = ray_directions(ANGLES), REACH, 0.2


def assert_drawn(pictures: GlobalGrids, grids: TeamGrids, looks: TeamLooks) -> None:
    """Expect all pictures to be those that are drawn from nothing."""
    pictures.update(grids, looks)
    for robot in range(len(grids.cells)):
        picture, frame = np.empty((NUM_COARSE, COARSE, COARSE), np.uint8), np.empty(3, np.float32)
        write_global_grid(grids.cells[robot], looks.counts[robot], grids.bounds[robot], picture, frame)
        np.testing.assert_array_equal(pictures.pictures[robot], picture)
        np.testing.assert_array_equal(pictures.frames[robot], frame)


@pytest.mark.parametrize("seed", range(3))
def test_pictures_follow_scans_merges_and_restored_states(seed: int) -> None:
    """Whatever was written since, and wherever, the pictures are those that are drawn from nothing."""
    rng, num = np.random.default_rng(seed), 2
    grids, looks = TeamGrids(num), TeamLooks(num, ANGLES, HALF_FOV, REACH)
    pictures, places = GlobalGrids(num), rng.uniform(-30.0, 30.0, (num, num, 3))
    assert_drawn(pictures, grids, looks)
    kept, kinds = None, set()
    for step in range(160):
        places += rng.normal(0.0, 0.8, places.shape)
        places[0, 0, 0] += 90.0 if step == 80 else 0.0
        scans = rng.uniform(0.5, 1.2, (num, len(ANGLES))) * rng.uniform(2.0, 8.0, (num, 1))
        shared = rng.integers(0, 2, (num, num))
        grids.update(shared, places, scans, rng.random(num) < 0.2, *HARDWARE)
        looks.update(shared, places, scans, grids.size)
        kind = rng.integers(0, 12)
        if kind == 0:
            other = OccupancyGrid()
            other.update_from_scan((3.0, -9.0, 0.4), scans[0], ANGLES)
            grids.grids[1].merge(other, rng.uniform(-20.0, 20.0, 3))
            looks.reserve(grids.size)
            looks.merge(1, looks.counts[0].copy(), rng.uniform(-5.0, 5.0, 3))
        elif kind == 1:
            kept = take(grids.grids[0]), looks.part(0)
        elif kind == 2 and kept is not None:
            restore(grids.grids[0], kept[0])
            looks.reserve(grids.size)
            looks.restore_part(0, kept[1])
        kinds.add(int(kind))
        if rng.random() < 0.7:
            assert_drawn(pictures, grids, looks)
    assert {0, 1, 2} <= kinds
    assert grids.size > 600
