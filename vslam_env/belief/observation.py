"""Observations of agents, computed from beliefs, and their spaces; `ExplorationEnv` lists the keys."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.validation import check_choice
from vslam_env.belief._observation_kernels import (
    CHANNELS,
    COUNT_BINS,
    GRID_ON,
    MAX_SECONDS_LEFT,
    MAX_TEAMMATES,
    SIZE,
    write_observations,
)
from vslam_env.belief.belief import Belief, BeliefBatch
from vslam_env.belief.observation_keys import KEYS, MASK, NUM_ACTIONS, READ_GLOBAL_GRIDS, key_spaces
from vslam_env.navigation.candidates import FIRST_KIND

GRIDS = "local_grid", "global_grid"

Observation = dict[str, NDArray[Any]]


def observe(belief: Belief, keys: Collection[str]) -> Observation:
    """Return what one robot observes.

    Args:
        belief: Belief of the robot.
        keys: Keys to observe.

    Returns:
        New arrays by key, see `vslam_env.environment.ExplorationEnv`.

    Raises:
        ValueError: If a key is unknown.
    """
    for key in keys:
        check_choice("keys", key, KEYS, "Give keys, as in ('pose', 'scan').")
    return observe_team(BeliefBatch.of(belief, keys), keys)[0]


def observe_team(view: BeliefBatch, keys: Collection[str]) -> list[Observation]:
    """Return the observations of n robots. Pictures that no key shows are not drawn.

    Args:
        view: Observable part of the robots' beliefs, with what the keys read.
        keys: Keys to observe.

    Returns:
        New arrays by key for each robot, see `observe`.
    """
    count, candidates = len(view.robots), view.features
    own_poses, deviations = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    stats, ranges = np.empty((count, 6), np.float32), np.empty(view.scans.shape, np.float32)
    teammates, present = np.empty((count, MAX_TEAMMATES, 5), np.float32), np.empty((count, MAX_TEAMMATES), np.int8)
    pictures = np.empty((count, len(CHANNELS) if "local_grid" in keys else 0, SIZE, SIZE), np.uint8)
    team_poses, ((positions, counts_and_ids), parts) = view.team_poses, view.map_summaries
    counts = np.empty((count, len(COUNT_BINS)), np.float32)
    arrays = own_poses, deviations, stats, pictures, ranges, candidates, teammates, present, counts
    write_observations(
        view.robots, team_poses.poses, team_poses.beliefs, positions, counts_and_ids, parts, view.cells, view.scans,
        arrays,
    )  # fmt: skip
    rows: dict[str, NDArray[Any]] = {
        "pose": own_poses,
        "pose_std": deviations,
        "map_stats": stats,
        "local_grid": pictures,
        "scan": ranges,
        "candidates": candidates,
        "teammates": teammates,
        "teammates_mask": present,
        "landmark_counts": counts,
        "time_left": np.full((count, 1), min(view.seconds_left, MAX_SECONDS_LEFT), np.float32),
    }
    if not READ_GLOBAL_GRIDS.isdisjoint(keys):
        rows |= {"global_grid": view.global_grids.pictures.copy(), "global_grid_frame": view.global_grids.frames.copy()}
    if MASK in keys:
        rows[MASK] = action_mask(candidates)
    shown = [(key, rows[key]) for key in KEYS if key in keys]
    return [{key: values[robot] for key, values in shown} for robot in range(count)]


def action_mask(candidates: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return which `goal` actions are valid (..., 33) int8: staying, and the slots with a candidate.

    Args:
        candidates: (..., C, F) float32. Features of candidates, zeros in empty slots.
    """
    masks = np.ones((*candidates.shape[:-2], NUM_ACTIONS), np.int8)
    masks[..., 1:] = candidates[..., FIRST_KIND:].any(axis=-1)
    return masks


def flatten(observation: Observation) -> NDArray[np.float32]:
    """Return an observation without its action mask as one float32 vector, grids from 0 to 1."""
    parts = [
        (value / np.float32(GRID_ON) if name in GRIDS else value).ravel()
        for name, value in observation.items()
        if name != MASK
    ]
    return np.concatenate(parts).astype(np.float32)


def observation_space(
    keys: Sequence[str] = KEYS, num_rays: int = 32, scan_range: float = 8.0, flat: bool = False
) -> spaces.Space[Any]:
    """Return the observation space of one agent.

    Args:
        keys: Keys that are observed, in their order.
        num_rays: Number of rays R of a scan.
        scan_range: Range of the scan [m].
        flat: Whether observations are one vector, or with an action mask `{"observation", "action_mask"}`.

    Returns:
        `Dict` space, or a `Box` if flat and without a mask.
    """
    boxes = key_spaces(num_rays, scan_range)
    if not flat:
        return spaces.Dict({key: boxes[key] for key in keys})
    vector = spaces.Box(
        flatten({key: boxes[key].low for key in keys}), flatten({key: boxes[key].high for key in keys}),
        dtype=np.float32,
    )  # fmt: skip
    return spaces.Dict({"observation": vector, MASK: boxes[MASK]}) if MASK in keys else vector
