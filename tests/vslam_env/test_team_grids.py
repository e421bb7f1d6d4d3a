"""Readings of a tick are painted into all grids of a team at once, as one after the other."""

import numpy as np
import pytest
from navigation_rooms import ANGLES, MAX_RANGE

from vslam_env.navigation import UNKNOWN, TeamGrids, ray_directions

RADIUS = 0.2
HARDWARE = ray_directions(ANGLES), MAX_RANGE, RADIUS


def test_readings_are_painted_as_their_parts() -> None:
    """Each grid holds, and tells as changed, what scan, disc and bump leave one after the other, in ascending order."""
    rng = np.random.default_rng(4)
    team, apart = TeamGrids(3), [TeamGrids(1) for _ in range(3)]
    parts = [single.grids[0] for single in apart]
    for one in (team, *apart):
        one.changes[:, 0] = 0
    for _ in range(30):
        shared = rng.integers(0, 2, (3, 3))
        poses = rng.uniform(-1.0, 1.0, (3, 3, 3)) * [9.0, 9.0, 3.0]
        scans, bumps = rng.uniform(0.3, 9.0, (3, 32)), rng.random(3) < 0.4
        team.paint_readings(shared, poses, scans, bumps, *HARDWARE)
        for owner, robot in np.argwhere(shared):
            pose = poses[owner, robot]
            parts[owner].paint_scan(pose, scans[robot], ANGLES)
            parts[owner].clear_disc(pose, RADIUS)
            if bumps[robot]:
                parts[owner].bump(pose, RADIUS)
        for robot, (whole, part) in enumerate(zip(team.grids, parts, strict=True)):
            assert (whole.get_state()["evidence"] == part.get_state()["evidence"]).all()
            assert (whole.cells == part.cells).all()
            assert (team.cells[robot] == part.cells).all()
            count = 1 + apart[robot].changes[0, 0]
            assert count > 0
            assert (team.changes[robot, :count] == apart[robot].changes[0, :count]).all()
            team.changes[robot, 0] = apart[robot].changes[0, 0] = 0


@pytest.mark.parametrize(
    ("name", "pose", "ranges"),
    [
        ("pose", [0.0, np.nan, 0.0], np.ones(3)),
        ("ranges", [0.0, 0.0, 0.0], np.array([1.0, -1.0, 1.0])),
        ("ranges", [0.0, 0.0, 0.0], np.array([1.0, np.nan, 1.0])),
    ],
)
def test_a_bad_reading_is_refused(name: str, pose: list[float], ranges: np.ndarray) -> None:
    """Nothing is painted, not even what is good, beside a reading at no place or of negative ranges."""
    team, rays = TeamGrids(2), ray_directions(np.array([-0.1, 0.0, 0.1]))
    poses, scans = np.full((2, 2, 3), np.nan), np.array([np.ones(3), ranges])
    poses[0, 0], poses[1, 1] = 0.0, pose
    with pytest.raises(ValueError, match=rf"^{name}: expected"):
        team.paint_readings(np.eye(2, dtype=np.int64), poses, scans, np.zeros(2, np.bool_), rays, MAX_RANGE, RADIUS)
    assert all((grid.cells == UNKNOWN).all() for grid in team.grids)


@pytest.mark.parametrize("angles", [ANGLES[::-1], ANGLES[:0], np.array([-1.6, 1.6])])
def test_other_rays_are_refused(angles: np.ndarray) -> None:
    """A fan from left to right has no directions, nor has one of no rays, or one that looks behind."""
    with pytest.raises(ValueError, match=r"^angles: expected"):
        ray_directions(angles)
