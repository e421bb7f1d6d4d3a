"""Simulated teams that have merged by a known alignment, and contacts by hand."""

import numpy as np
from simulated_team import SimulatedTeam

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.geometry import compose
from slam_backend.maps.alignment import Alignment
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam

NEVER = AttemptOptions(enabled=False)
NO_PAIRS = np.empty((0, 2), np.int64)


def links(num_robots: int, *pairs: tuple[int, int]) -> BoolArray:
    """Return contacts (K, K) between these pairs only."""
    contacts = np.eye(num_robots, dtype=np.bool_)
    for one, other in pairs:
        contacts[one, other] = contacts[other, one] = True
    return contacts


def true_alignment(simulation: SimulatedTeam, team: TeamSlam, robot_a: int, robot_b: int) -> Alignment:
    """Return the true motion between the map frames of two robots' groups, without pairs."""
    motion = simulation.true_motion(team.members(robot_a)[0], team.members(robot_b)[0])
    return Alignment(True, "", *motion, np.diag([1e-4, 1e-4, 1e-6]), NO_PAIRS, 0.0)


def merged_team(simulation: SimulatedTeam, steps: int = 30, **options: object) -> TeamSlam:
    """Return a team whose robots have all been merged, one after the other, by the true motions after some steps."""
    team = simulation.build(**({"attempts": NEVER, "num_particles": 13} | options))
    simulation.run(team, steps)
    for robot in range(1, simulation.num_robots):
        team.merge(0, robot, true_alignment(simulation, team, 0, robot))
    return team


def false_alignment(simulation: SimulatedTeam, team: TeamSlam, offset: FloatArray) -> Alignment:
    """Return the true motion between the maps of robots 0 and 1 plus an offset (3,), with the eight nearest pairs."""
    motion = simulation.true_motion(0, 1) + offset
    points_a, points_b = team.map(0).means[:, :2], team.map(1).means
    moved = compose(motion, np.column_stack([points_b[:, :2], np.zeros(len(points_b))]))[:, :2]
    distances = np.linalg.norm(points_a[:, None] - moved, axis=2)
    pairs = []
    for _ in range(8):
        row, column = np.unravel_index(distances.argmin(), distances.shape)
        pairs.append((row, column))
        distances[row] = distances[:, column] = np.inf
    return Alignment(True, "", *motion, 1e-3 * np.eye(3), np.array(pairs), 0.0)
