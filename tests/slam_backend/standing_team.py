"""A team whose robots stand at known places and have seen the same landmarks, for merges by hand."""

import numpy as np
from mapped_once import LANDMARKS, frame_of

from slam_backend.geometry import between, inverse, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.team.team import TeamSlam

STARTS = np.array([[0.5, -1.0, 0.3], [4.0, 3.0, 2.0], [9.0, 1.0, -2.5], [2.0, 6.0, -1.2]])  # world
COMMON = np.arange(5)  # names of the landmarks that all robots see first, so that these have ids 0 to 4 in every map
SIGMA = 1e-4


def standing_team(num_robots: int = 3, seed: int = 0) -> TeamSlam:
    """Robots at `STARTS` that have seen the common landmarks, and one more each, from where they stand."""
    rng = np.random.default_rng(seed)
    team = TeamSlam(num_robots, seed=seed, num_particles=7)
    names = [np.append(COMMON, 5 + robot) for robot in range(num_robots)]
    frames = []
    for robot, seen in enumerate(names):
        points = transform_points(inverse(STARTS[robot]), LANDMARKS[seen])
        frames.append(frame_of(points + SIGMA * rng.normal(size=points.shape), seen, SIGMA))
    team.step([None] * num_robots, frames, identities=names)
    return team


def hand_made(team: TeamSlam, robot_a: int, robot_b: int) -> Alignment:
    """Return the true alignment of two robots' groups: of the start frames of their lowest robots."""
    first = {robot: group[0] for group in team.groups for robot in group}
    motion = between(STARTS[first[robot_a]], STARTS[first[robot_b]])
    return Alignment(True, "", *motion, 1e-6 * np.eye(3), np.column_stack([COMMON, COMMON]), 0.0)
