"""Observations of agents, computed from belief and scan, and their spaces; `ExplorationEnv` lists the keys."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray
from vslam_env.belief._observation_kernels import (
    CHANNELS,
    COUNT_BINS,
    GRID_ON,
    MAP_STATS_LIMIT,
    MAX_POSITION,
    MAX_SECONDS_LEFT,
    MAX_TEAMMATES,
    POSE_LIMIT,
    SIZE,
    write_observations,
)
from vslam_env.belief.belief import Belief, BeliefBatch
from vslam_env.navigation._view_kernels import COARSE, NUM_COARSE
from vslam_env.navigation.candidates import CANDIDATE_FEATURES, FIRST_KIND, NUM_CANDIDATES

NUM_ACTIONS = 1 + NUM_CANDIDATES
GRIDS = "local_grid", "global_grid"

Observation = dict[str, NDArray[Any]]


def observe(belief: Belief, scan: FloatArray, goal_actions: bool) -> Observation:
    """Return the observation of one robot.

    Args:
        belief: Belief of the robot.
        scan: (R,) float64 [m]. Last scan of the robot.
        goal_actions: Whether actions choose candidates and are masked.

    Returns:
        New arrays by name, see `vslam_env.environment.ExplorationEnv`.
    """
    return observe_team(BeliefBatch.of(belief), scan[None], goal_actions)[0]


def observe_team(view: BeliefBatch, scans: FloatArray, goal_actions: bool) -> list[Observation]:
    """Return the observations of n robots.

    Args:
        view: Observable part of the robots' beliefs.
        scans: (n, R) float64 [m]. Last scans of the robots.
        goal_actions: Whether actions choose candidates and are masked.

    Returns:
        New arrays by name for each robot, see `observe`.
    """
    count, candidates = len(view.robots), view.features
    own_poses, deviations = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    stats, ranges = np.empty((count, 6), np.float32), np.empty(scans.shape, np.float32)
    teammates, present = np.empty((count, MAX_TEAMMATES, 5), np.float32), np.empty((count, MAX_TEAMMATES), np.int8)
    pictures = np.empty((count, len(CHANNELS), SIZE, SIZE), np.uint8)
    team_poses, ((positions, counts_and_ids), parts) = view.team_poses, view.map_summaries
    counts, time_left = np.empty((count, len(COUNT_BINS)), np.float32), min(view.seconds_left, MAX_SECONDS_LEFT)
    global_grids, frames = view.global_grids.pictures.copy(), view.global_grids.frames.copy()
    arrays = own_poses, deviations, stats, pictures, ranges, candidates, teammates, present, counts
    write_observations(
        view.robots, team_poses.poses, team_poses.beliefs, positions, counts_and_ids, parts, view.cells, scans, arrays
    )
    observations: list[Observation] = []
    for i in range(count):  # by index: iterating over arrays costs microseconds
        observation: Observation = {
            "pose": own_poses[i],
            "pose_std": deviations[i],
            "map_stats": stats[i],
            "local_grid": pictures[i],
            "scan": ranges[i],
            "candidates": candidates[i],
            "teammates": teammates[i],
            "teammates_mask": present[i],
            "landmark_counts": counts[i],
            "time_left": np.array([time_left], np.float32),
            "global_grid": global_grids[i],
            "global_grid_frame": frames[i],
        }
        if goal_actions:
            observation["action_mask"] = action_mask(candidates[i])
        observations.append(observation)
    return observations


def action_mask(candidates: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return which `goal` actions are valid (33,) int8: staying, and the slots with a candidate."""
    mask = np.ones(NUM_ACTIONS, np.int8)
    mask[1:] = candidates[:, FIRST_KIND:].any(axis=1)
    return mask


def flatten(observation: Observation) -> NDArray[np.float32]:
    """Return an observation without its action mask as one float32 vector, grids from 0 to 1."""
    parts = [
        (value / np.float32(GRID_ON) if name in GRIDS else value).ravel()
        for name, value in observation.items()
        if name != "action_mask"
    ]
    return np.concatenate(parts).astype(np.float32)


def observation_space(num_rays: int, scan_range: float, goal_actions: bool, flat: bool) -> spaces.Space[Any]:
    """Return the observation space of one agent.

    Args:
        num_rays: Number of rays R of a scan.
        scan_range: Range of the scan [m].
        goal_actions: Whether actions are masked.
        flat: Whether observations are one vector, or with masked actions `{"observation", "action_mask"}`.

    Returns:
        `Dict` space, or a `Box` if flat and without a mask.
    """
    named: dict[str, spaces.Space[Any]] = {
        "pose": _box(-POSE_LIMIT, POSE_LIMIT),
        "pose_std": _box(np.zeros(3), POSE_LIMIT),
        "map_stats": _box(np.zeros(6), MAP_STATS_LIMIT),
        "local_grid": spaces.Box(0, GRID_ON, (len(CHANNELS), SIZE, SIZE), np.uint8),
        "scan": _box(np.zeros(num_rays), np.full(num_rays, scan_range)),
        "candidates": _box(
            np.full((NUM_CANDIDATES, len(CANDIDATE_FEATURES)), -MAX_POSITION),
            np.full((NUM_CANDIDATES, len(CANDIDATE_FEATURES)), MAX_POSITION),
        ),
        "teammates": _box(np.full((MAX_TEAMMATES, 5), -MAX_POSITION), np.full((MAX_TEAMMATES, 5), MAX_POSITION)),
        "teammates_mask": spaces.Box(0, 1, (MAX_TEAMMATES,), np.int8),
        "landmark_counts": _box(np.zeros(len(COUNT_BINS)), np.full(len(COUNT_BINS), MAP_STATS_LIMIT[0])),
        "time_left": _box(np.zeros(1), np.full(1, MAX_SECONDS_LEFT)),
        "global_grid": spaces.Box(0, GRID_ON, (NUM_COARSE, COARSE, COARSE), np.uint8),
        "global_grid_frame": _box(np.full(3, -MAX_POSITION), np.full(3, MAX_POSITION)),
    }
    mask = spaces.Box(0, 1, (NUM_ACTIONS,), np.int8)
    if not flat:
        return spaces.Dict(named | ({"action_mask": mask} if goal_actions else {}))
    lows = flatten({name: space.low for name, space in named.items() if isinstance(space, spaces.Box)})
    highs = flatten({name: space.high for name, space in named.items() if isinstance(space, spaces.Box)})
    vector = spaces.Box(lows, highs, dtype=np.float32)
    return spaces.Dict({"observation": vector, "action_mask": mask}) if goal_actions else vector


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
