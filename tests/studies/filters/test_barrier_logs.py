"""Logs of robots among walls: what they see, and what filters make of them."""

from dataclasses import asdict

import numpy as np

from studies.filters import barrier_logs as barriers


def test_walls_block_the_line_of_sight() -> None:
    """Of two points, the one behind a wall is not seen."""
    wall = np.array([[[1.0, -1.0], [1.0, 1.0]]])
    blocked = barriers.crosses(np.zeros(2), np.array([[2.0, 0.1], [0.5, 0.1], [2.0, 3.0]]), wall)
    assert blocked.tolist() == [True, False, False]


def test_robots_keep_away_from_walls_and_see_few_landmarks() -> None:
    """Robots of one hall share its landmarks, drive differently, and measure with the field of view and rate given."""
    one, other = barriers.simulate(3, 2, 60.0)
    assert (one.landmarks == other.landmarks).all()
    assert not (one.truth == other.truth).all()
    assert min(barriers.wall_distance(pose[:2], one.walls) for pose in one.truth) > 0.0
    seen = sum(frame is not None for frame in one.frames)
    assert 0 < seen < len(one.frames)
    wide = barriers.simulate(3, 1, 60.0, view=np.pi / 2, num_walls=0)[0]
    assert sum(len(ids) for ids in wide.identities if ids is not None) > 2 * sum(
        len(ids) for ids in one.identities if ids is not None
    )


def test_filters_and_teams_have_a_line_each() -> None:
    """A short log gives a map error of centimetres to decimetres for one robot, and for a team of two."""
    config = barriers.Config(conditions=("wide",), robots=(1, 2), duration=60.0, seeds=1)
    rows = [asdict(trial) | barriers.play(config, trial) for trial in barriers.trials(config)]
    assert [(row["robots"], row["filter"]) for row in rows] == [
        *((1, name) for name in barriers.FILTERS), *((2, name) for name in barriers.TEAM_FILTERS),
    ]  # fmt: skip
    assert all(0.0 < row["map_rmse_m"] < 0.5 for row in rows)
    assert all(1 <= row["groups"] <= row["robots"] for row in rows)
    assert len(barriers.STUDY.tables[0].lines(rows)) == 5
