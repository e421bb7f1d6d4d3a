"""A small room, its environments and their actions, a building to navigate, and maps scored for one team."""

from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import between, compose
from slam_backend.maps.landmark_map import TeamMapSummaries
from slam_backend.state import accepted, restore
from vslam_env import ExplorationEnv, World, vslam_v0
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.evaluation.team_metrics import RobotCounts, RobotMetrics, TeamMetrics
from vslam_env.navigation import OccupancyGrid

WALLS = np.array(
    [
        [0.0, 0.0, 11.0, 0.0],
        [11.0, 0.0, 11.0, 13.0],
        [11.0, 13.0, 0.0, 13.0],
        [0.0, 13.0, 0.0, 0.0],
        [0.0, 7.0, 6.0, 7.0],
    ]
)
# Side by side, both looking at the lower right corner: their maps soon have landmarks in common.
MEETING = np.array([[4.0, 3.0, -0.3], [4.5, 4.5, -0.6]])
SMALL_STEREO = {"camera": {"width": 160, "height": 120, "focal_px": 160.0}, "textures": {"texel": 0.02}}


def room() -> World:
    """Return the room."""
    return World("room", WALLS)


def small_env(**kwargs: Any) -> ExplorationEnv:
    """Return an environment in the room: two robots, 20 particles, 40 steps, unless said otherwise."""
    options: dict[str, Any] = {"world": room(), "num_robots": 2, "num_particles": 20, "max_cycles": 40}
    return vslam_v0.parallel_env(**options | kwargs)


def wander(env: ExplorationEnv, rng: np.random.Generator) -> dict[str, Any]:
    """Return valid random actions: mostly ahead, gently turning, or candidates."""
    if env.config.action_type == "continuous":
        return {agent: np.array([0.6, np.clip(0.8 * rng.standard_normal(), -1, 1)], np.float32) for agent in env.agents}
    if env.config.action_type == "discrete":
        return {agent: int(rng.integers(4)) for agent in env.agents}
    valid = {agent: 1 + np.flatnonzero(env.belief(agent).candidates.valid) for agent in env.agents}
    return {agent: int(rng.choice([0, *valid[agent]])) for agent in env.agents}


def turning(agents: list[str], speed: float = 0.25, turn: float = 0.4) -> dict[str, FloatArray]:
    """Return continuous actions that drive every robot in a circle."""
    return {agent: np.array([speed, turn]) for agent in agents}


def standing_at(starts: FloatArray) -> TeamPoses:
    """Return where robots with these starts (K, 3) stand: at the origin of their own frames, without doubt."""
    team_poses = TeamPoses(len(starts))
    team_poses.poses.fill(0.0)
    team_poses.beliefs.fill(0.0)
    team_poses.starts[:] = starts
    return team_poses


def scored(
    ground_truth: GroundTruthAssociation,
    summaries: TeamMapSummaries,
    team_poses: TeamPoses,
    true_starts: FloatArray,
    true_poses: FloatArray,
) -> TeamMetrics:
    """Return the scores of a team; all other metrics are NaN or 0."""
    robots = len(true_poses)
    metrics, nothing = np.full((len(RobotMetrics._fields), robots), np.nan), (0,) * robots
    ground_truth.score(summaries, team_poses, true_starts, true_poses, RobotMetrics(*metrics))
    return TeamMetrics(RobotMetrics(*metrics.tolist()), RobotCounts(nothing, nothing), 0.0, 0, 0.0)


ANGLES = np.deg2rad(np.linspace(-26.5, 26.5, 32))
MAX_RANGE = 8.0


def doored_wall(x1: float, x2: float, y: float, doors: list[float], width: float = 1.2) -> list[list[float]]:
    """Return the segments of a wall along x with doors centred at given places."""
    stops = [x1, *(edge for door in doors for edge in (door - width / 2, door + width / 2)), x2]
    return [[stops[i], y, stops[i + 1], y] for i in range(0, len(stops), 2)]


def building() -> FloatArray:
    """Return the walls (n, 4) of six rooms of different sizes along a corridor, 17 x 11 m."""
    outer = [[0, 0, 17, 0], [17, 0, 17, 11], [17, 11, 0, 11], [0, 11, 0, 0]]
    corridor = doored_wall(0, 17, 4.5, [2.0, 7.3, 13.1]) + doored_wall(0, 17, 6.5, [3.1, 9.0, 15.2])
    rooms = [[5, 0, 5, 4.5], [10, 0, 10, 4.5], [6, 6.5, 6, 11], [12, 6.5, 12, 11]]
    return np.array(outer + corridor + rooms, dtype=np.float64)


def cast(walls: FloatArray, pose: FloatArray) -> FloatArray:
    """Return the true ranges (32,) from a pose to walls (n, 4)."""
    headings = pose[2] + ANGLES
    dx, dy = np.cos(headings)[:, None], np.sin(headings)[:, None]
    ax, ay = walls[:, 0] - pose[0], walls[:, 1] - pose[1]
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    across = dx * ey - dy * ex
    across = np.where(np.abs(across) < 1e-12, np.nan, across)
    along, share = (ax * ey - ay * ex) / across, (ax * dy - ay * dx) / across
    hits = np.where((along > 0) & (share >= 0) & (share <= 1), along, MAX_RANGE)
    return np.minimum(hits.min(axis=1), MAX_RANGE)


def scan(walls: FloatArray, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return ranges (32,) with noise of 1 %; a ray without a hit reads the greatest range."""
    ranges = cast(walls, pose)
    return np.where(ranges < MAX_RANGE, ranges * (1.0 + 0.01 * rng.standard_normal(len(ranges))), MAX_RANGE)


def clearance(walls: FloatArray, points: FloatArray) -> FloatArray:
    """Return the distance (n,) from points (n, 2) to the nearest of walls (m, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = ((points[:, None] - start) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


def drive(pose: FloatArray, speed: float, turn: float, seconds: float = 0.1) -> FloatArray:
    """Return the pose after driving with constant velocities, turning first."""
    turned = compose(pose, [0.0, 0.0, turn * seconds])
    return compose(turned, [speed * seconds, 0.0, 0.0])


def in_start_frame(start: FloatArray, pose: FloatArray) -> FloatArray:
    """Return a pose of the world as seen from the start pose."""
    return between(start, pose)


def know(grid: OccupancyGrid, evidence: np.ndarray, corner: tuple[int, int] = (0, 0)) -> None:
    """Let a grid hold the evidence (h, w) int8 of cells from a corner on, counted in a new grid, and nothing else."""
    restore(grid, accepted(OccupancyGrid, "state", {"known": {"corner": corner, "values": evidence}}))
