"""Relations between places on a hand-drawn grid of two rooms and a door."""

import numpy as np
import pytest
from builders.environments import know

from vslam_env.navigation import (
    DistanceMap,
    OccupancyGrid,
    cells_of,
    distance_map,
    frontier_cells,
    lengths_between,
    plan_path,
    rooms_of,
    sees,
)

LEFT, RIGHT, DOOR = (-3.0, 1.0), (3.0, -1.0), (0.1, 0.1)  # two rooms of about 6 x 4 m


@pytest.fixture(scope="module")
def grid() -> OccupancyGrid:
    """Two rooms side by side, with a door of 1 m between them; an unknown corner in the right one."""
    grid = OccupancyGrid()
    evidence = np.zeros((300, 300), np.int8)
    evidence[140:161, 120:181] = -10
    for walls in (
        np.s_[140, 120:181],
        np.s_[160, 120:181],
        np.s_[140:161, 120],
        np.s_[140:161, 180],
        np.s_[140:161, 150],
    ):
        evidence[walls] = 10
    evidence[148:154, 150] = -10  # the door
    evidence[156:160, 176:180] = 0
    know(grid, evidence)
    return grid


@pytest.fixture(scope="module")
def ways(grid: OccupancyGrid) -> DistanceMap:
    """Distance map from the left room."""
    return distance_map(grid.cells, LEFT)


def test_lengths_agree_with_planned_paths(grid: OccupancyGrid, ways: DistanceMap) -> None:
    """Lengths are symmetric within a cell, at least the straight distance, and near those of planned paths."""
    places = np.array([LEFT, RIGHT, DOOR, (4.0, 1.0)])
    lengths = lengths_between(ways, places, places)
    assert np.allclose(lengths, lengths.T, atol=0.3)
    straight = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert (lengths >= straight - 0.3).all()
    for i, j in ((0, 1), (0, 3), (2, 1)):
        path = plan_path(grid.cells, places[i], places[j])
        assert path is not None
        planned = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert planned - 0.3 <= lengths[i, j] <= 1.1 * planned + 0.3  # paths of cells turn by 45 degrees


def test_places_behind_walls_have_no_path(ways: DistanceMap) -> None:
    """A place in unknown ground has an infinite length, from and to it."""
    assert np.isinf(lengths_between(ways, [LEFT], [(20.0, 20.0)])).all()
    assert np.isinf(lengths_between(ways, [(20.0, 20.0)], [LEFT])).all()
    assert lengths_between(ways, np.empty((0, 2)), [LEFT]).shape == (0, 1)


def test_walls_block_the_view(ways: DistanceMap) -> None:
    """Places see each other through the door, not through the wall, and not beyond the range."""
    places = np.array([(-1.0, 1.5), (1.0, 1.5), (1.0, -0.6), (-1.0, 0.8)])
    visible = sees(ways, places, cells_of(ways, places), 8.0)
    assert visible.diagonal().all()
    assert not visible[0, 1]
    assert visible[2, 3]
    assert np.array_equal(visible, visible.T)
    assert not sees(ways, places, cells_of(ways, places), 1.0)[2, 3]
    pairs = np.eye(4, dtype=np.bool_)
    pairs[0] = True
    assert np.array_equal(sees(ways, places, cells_of(ways, places), 8.0, among=pairs), visible & pairs)


def test_frontier_cells_border_on_free_ones(grid: OccupancyGrid, ways: DistanceMap) -> None:
    """Frontier cells are the seven unknown cells of the corner that touch free ones; plain loops find the same."""
    found = {tuple(cell) for cell in frontier_cells(ways) + ways.corner}
    plain = {
        (r, c)
        for r in range(130, 170)
        for c in range(110, 190)
        if grid.cells[r, c] == 0 and 1 in grid.cells[[r - 1, r + 1, r, r], [c, c, c - 1, c + 1]]
    }  # fmt: skip
    assert found == plain
    assert len(found) == 7


def test_rooms_are_separated_by_doors(ways: DistanceMap) -> None:
    """Places of one room share a number, those of the other room have another one."""
    rooms = rooms_of(ways, [LEFT, (-5.0, -1.5), RIGHT, (5.0, 0.0), (-0.6, 0.0)])
    assert rooms[0] == rooms[1] == rooms[4]
    assert rooms[2] == rooms[3]
    assert rooms[0] != rooms[2]
    assert rooms_of(ways, [LEFT, RIGHT], core=9.0).tolist() == [1, 1]
