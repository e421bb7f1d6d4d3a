"""Candidates in a large known area: most updates search near the robot, and leave what is far as it was."""

import numpy as np
import pytest
from builders.environments import know

from vslam_env.navigation import (
    CELL,
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    TeamCandidates,
    TeamGrids,
    TeamLooks,
    cell_of,
)

CAMERA = (0.46, 8.0, 0.2)
NO_LANDMARKS = np.empty((0, 4)), np.empty((0, 2), np.int64), np.zeros(3)
NO_PLACES = np.full((4, 3), np.nan)
NEAR, PERIOD = 12.0, 5
SHARE = 0.2**2 * (290 * 42 // PERIOD + 10)  # [m^2], so that a few hundred square metres are searched in parts
WHOLE = 1e9


def crossing(blind: tuple[float, ...] = ()) -> np.ndarray:
    """Return a corridor from -29 to 29 m with side rooms, open to the unknown at both ends and at x = -9, 9 and 21.

    Openings at these places that are named in `blind` are walls.
    """
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)

    def fill(low: tuple[float, float], high: tuple[float, float], state: int) -> None:
        (r1, c1), (r2, c2) = cell_of((low[0] + 0.1, low[1] + 0.1)), cell_of((high[0] - 0.1, high[1] - 0.1))
        cells[r1 : r2 + 1, c1 : c2 + 1] = state

    fill((-29.0, -4.2), (29.0, 4.2), OCCUPIED)
    fill((-28.8, -4.0), (28.8, 4.0), FREE)
    for x in (-9.0, 9.0, 21.0):
        fill((x - 0.6, 4.0), (x + 0.6, 4.2), OCCUPIED if x in blind else UNKNOWN)
    return cells


class Robot:
    """Candidates of robots that know the same cells; the first one is looked at."""

    def __init__(self, cells: np.ndarray, num_robots: int = 1, share: float = SHARE) -> None:
        self.grids = TeamGrids(num_robots)
        self.candidates = TeamCandidates(num_robots, CAMERA, NEAR, share)
        self.looks = TeamLooks(num_robots, np.zeros(1), 0.46, 8.0)
        self.looks.counts[:] = 255
        self.know(cells)

    def know(self, cells: np.ndarray) -> None:
        """Let the robots know other cells from now on."""
        evidence = np.where(cells == FREE, -5, np.where(cells == OCCUPIED, 5, 0)).astype(np.int8)
        for grid in self.grids.grids:
            know(grid, evidence)

    def update(self, x: float, *mates: tuple[float, float], places: np.ndarray = NO_PLACES) -> np.ndarray:
        """Update the first robot's candidates at (x, 0), and return the rows of its frontiers, by x."""
        poses = np.array([[(x, 0.0, 0.0), *((*mate, 0.0) for mate in mates)]])
        self.candidates.update(0, self.grids, self.looks, poses, NO_LANDMARKS, places)
        rows = self.candidates.rows(0)[:16]
        rows = rows[~np.isnan(rows[:, 0])]
        return rows[rows[:, 0].argsort()]


def reference(cells: np.ndarray, x: float) -> np.ndarray:
    """Return the frontiers that a search over all known floor finds."""
    return Robot(cells, share=WHOLE).update(x)


def test_near_updates_find_what_a_whole_search_finds_nearby() -> None:
    """Frontiers that appear near the robot are found at once, with the same goals and lengths."""
    robot = Robot(crossing(blind=(-9.0, 9.0, 21.0)))
    assert len(robot.update(-9.0)) == 0
    robot.know(cells := crossing())
    found, expected = robot.update(-9.0), reference(cells, -9.0)
    near = np.abs(expected[:, 0] + 9.0) < 7.0
    assert 0 < near.sum() < len(expected)
    np.testing.assert_array_equal(found, expected[near])


def test_distant_candidates_stay_until_all_is_searched() -> None:
    """A distant frontier that is gone stays a candidate, as it was, until the next search over all known floor."""
    robot = Robot(crossing())
    for _ in range(PERIOD):
        before = robot.update(-9.0)
    np.testing.assert_array_equal(before, reference(crossing(), -9.0))
    robot.know(cells := crossing(blind=(-9.0, 21.0)))
    for _ in range(PERIOD - 1):
        rows = robot.update(-9.0)
        np.testing.assert_array_equal(rows, before[1:])  # the near one is gone at once
    np.testing.assert_array_equal(robot.update(-9.0), reference(cells, -9.0))


def test_all_known_floor_is_searched_when_no_frontier_is_left() -> None:
    """A robot whose last near frontier is gone knows at once of distant ones that came up since the last search."""
    robot = Robot(crossing(blind=(9.0, 21.0)))
    for _ in range(PERIOD):
        assert len(robot.update(-9.0)) == 1
    robot.know(crossing(blind=(-9.0, 9.0)))
    (row,) = robot.update(-9.0)
    assert row[0] == pytest.approx(21.0, abs=0.5)


def test_lengths_of_distant_candidates_and_teammates_stay() -> None:
    """Near updates renew the lengths of teammates nearby alone; those of others stay with their candidates."""
    robot = Robot(crossing(), 3)
    for _ in range(PERIOD):
        rows = robot.update(-9.0, (-15.0, 0.0), (20.0, 0.0))
    order = robot.candidates.rows(0)[:16, 0].argsort()[: len(rows)]
    before = robot.candidates.lengths(0)[order].copy()
    assert np.isfinite(before).all()
    robot.update(-8.0, (-16.0, 0.0), (25.0, 0.0))
    after = robot.candidates.lengths(0)[order]
    assert after[0, 0] != before[0, 0]
    assert after[0, 1] == pytest.approx(before[0, 1] + 1.0, abs=0.6)
    np.testing.assert_array_equal(after[:, 2], before[:, 2])
    np.testing.assert_array_equal(after[-1], before[-1])


def test_rendezvous_far_away_stay_while_their_places_do() -> None:
    """A rendezvous out of reach of a near update stays; when its place moves away, its slot is empty until reached."""
    robot, places = Robot(crossing()), NO_PLACES.copy()
    places[0] = 20.0, 1.0, 0.0
    for _ in range(PERIOD):
        robot.update(-9.0, places=places)
    before = robot.candidates.rows(0)[28].copy()
    assert np.hypot(before[0] - 20.0, before[1] - 1.0) < CELL
    robot.update(-9.0, places=places)
    np.testing.assert_array_equal(robot.candidates.rows(0)[28], before)
    places[0] = 25.0, 1.0, 0.0
    robot.update(-9.0, places=places)
    assert np.isnan(robot.candidates.rows(0)[28]).all()
    places[0] = -4.0, 1.0, 0.0
    robot.update(-9.0, places=places)
    assert np.hypot(*(robot.candidates.rows(0)[28, :2] - [-4.0, 1.0])) < CELL


def test_a_rendezvous_that_moves_near_in_one_update_has_its_path() -> None:
    """A slot whose place was out of reach and now is near has a new candidate, with a length as any other."""
    robot, places = Robot(crossing()), NO_PLACES.copy()
    places[0] = 20.0, 1.0, 0.0
    for _ in range(PERIOD + 1):
        robot.update(-9.0, places=places)
    places[0] = -4.0, 1.0, 0.0
    robot.update(-9.0, places=places)
    row = robot.candidates.rows(0)[28]
    assert np.hypot(*(row[:2] - [-4.0, 1.0])) < CELL
    assert row[4] == robot.candidates.lengths(0)[28, 0] == pytest.approx(5.2, abs=0.5)


@pytest.mark.parametrize("mate", [-21.0, -20.8, -20.6, 2.6, 2.8, 3.0, 3.2, 100.0, np.nan])
def test_teammates_at_the_edge_of_a_near_update_do_no_harm(mate: float) -> None:
    """A teammate at or beyond the edge of what is searched leaves all candidates finite."""
    robot = Robot(crossing(), 2)
    for _ in range(2 * PERIOD):
        rows = robot.update(-9.0, (mate, 0.0))
        assert np.isfinite(rows).all()
        assert not np.isnan(robot.candidates.lengths(0)).any()
