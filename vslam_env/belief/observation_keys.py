"""Keys of observations: their spaces, the sets that have names, and the choice of an environment.

`ExplorationEnv` says what each key holds. A further key is a line of `key_spaces` and a value of `observe_team`.
"""

from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium import spaces

from slam_backend.core.validation import FloatArray, argument_error, did_you_mean
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
)
from vslam_env.navigation._view_kernels import COARSE, NUM_COARSE
from vslam_env.navigation.candidates import CANDIDATE_FEATURES, NUM_CANDIDATES

NUM_ACTIONS = 1 + NUM_CANDIDATES
MASK = "action_mask"


def key_spaces(num_rays: int, scan_range: float) -> dict[str, spaces.Box]:
    """Return the spaces of all keys, in the order of observations.

    Args:
        num_rays: Number of rays R of a scan.
        scan_range: Range of the scan [m].
    """
    candidates, teammates = (NUM_CANDIDATES, len(CANDIDATE_FEATURES)), (MAX_TEAMMATES, 5)
    return {
        "pose": _box(-POSE_LIMIT, POSE_LIMIT),
        "pose_std": _box(np.zeros(3), POSE_LIMIT),
        "map_stats": _box(np.zeros(6), MAP_STATS_LIMIT),
        "local_grid": spaces.Box(0, GRID_ON, (len(CHANNELS), SIZE, SIZE), np.uint8),
        "scan": _box(np.zeros(num_rays), np.full(num_rays, scan_range)),
        "candidates": _box(np.full(candidates, -MAX_POSITION), np.full(candidates, MAX_POSITION)),
        "teammates": _box(np.full(teammates, -MAX_POSITION), np.full(teammates, MAX_POSITION)),
        "teammates_mask": spaces.Box(0, 1, (MAX_TEAMMATES,), np.int8),
        "landmark_counts": _box(np.zeros(len(COUNT_BINS)), np.full(len(COUNT_BINS), MAP_STATS_LIMIT[0])),
        "time_left": _box(np.zeros(1), np.full(1, MAX_SECONDS_LEFT)),
        "global_grid": spaces.Box(0, GRID_ON, (NUM_COARSE, COARSE, COARSE), np.uint8),
        "global_grid_frame": _box(np.full(3, -MAX_POSITION), np.full(3, MAX_POSITION)),
        MASK: spaces.Box(0, 1, (NUM_ACTIONS,), np.int8),
    }


def _box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


KEYS = tuple(key_spaces(2, 1.0))
COLUMN_SCALES: dict[str, float] = {
    "x": 0.1,
    "y": 0.1,
    "path_length": 0.1,
    "size": 0.25,
    "teammate_path_length": 1.0 / 60.0,
    "unknown_area": 0.05,
    "unseen_wall": 0.25,
    "weak_landmarks": 0.25,
    "uncertain_length": 0.1,
    "nearest_candidate": 0.1,
}  # of candidates; 1 for the others
SCALES: dict[str, tuple[float, ...]] = {
    "pose": (0.1, 0.1, 1.0),
    "pose_std": (2.0, 2.0, 10.0),
    "map_stats": (0.01, 5.0, 5.0, 0.1, 1.0, 0.25),
    "local_grid": (1.0 / GRID_ON,),
    "scan": (0.125,),
    "candidates": tuple(COLUMN_SCALES.get(name, 1.0) for name in CANDIDATE_FEATURES),
    "teammates": (0.1, 0.1, 1.0, 1.0, 2.0),
    "teammates_mask": (1.0,),
    "landmark_counts": (0.02,),
    "time_left": (0.01,),
    "global_grid": (1.0 / GRID_ON,),
    "global_grid_frame": (0.1,),
}  # factors for the columns of all keys but the mask that scale them to the order of one, as networks take them


def in_order_of_one(name: str, values: Any, xp: Any = np) -> Any:
    """Return values (..., columns) of a key in the order of one, float32, in numpy or in jax (`xp`)."""
    return values * xp.asarray(SCALES[name], dtype=xp.float32)


DRIVER = ("pose", "pose_std", "map_stats", "local_grid", "scan", "teammates", "teammates_mask")
CHOICE = ("candidates", "landmark_counts", "time_left", "global_grid", "global_grid_frame")
SETS: dict[str, tuple[str, ...]] = {"driver": DRIVER, "goal": DRIVER + CHOICE, "all": KEYS}  # mask: by action type
READ_CANDIDATES = frozenset(("candidates", MASK))
READ_GLOBAL_GRIDS = frozenset(("global_grid", "global_grid_frame"))


def default_set(action_type: str) -> str:
    """Return the set of keys that environments of version 1 observe by default."""
    return "goal" if action_type == "goal" else "driver"


def checked_keys(chosen: str | Collection[str], action_type: str) -> tuple[str, ...]:
    """Return the keys that are chosen, in the order of observations.

    Args:
        chosen: Name of a set, which has the mask exactly with `goal` actions; or keys in any order.
        action_type: Action type of the environment.

    Raises:
        ValueError: If a set or a key is unknown, the mask is missing or not needed, or there is no other key.
    """
    name, goal = "observation_keys", action_type == "goal"
    if isinstance(chosen, str):
        if chosen not in SETS:
            cure = f"Write ({chosen!r},) for a single key. " if chosen in KEYS else did_you_mean(chosen, SETS)
            expected = f"{', '.join(map(repr, SETS))} or a tuple of keys"
            raise argument_error(name, expected, chosen, f"{cure}The keys are {', '.join(KEYS)}.")
        return tuple(key for key in KEYS if (goal if key == MASK else key in SETS[chosen]))
    if not isinstance(chosen, Collection):
        raise argument_error(name, "the name of a set or a tuple of keys", chosen, "For example ('pose', 'scan').")
    for key in chosen:
        if key == "image":
            raise argument_error(name, "keys other than images", key, "Choose images by observe_images=True.")
        if not isinstance(key, str) or key not in KEYS:
            hint = f"{did_you_mean(key, KEYS)}The keys are {', '.join(KEYS)}."
            raise argument_error(name, "known keys", key, hint)
    if goal and MASK not in chosen:
        raise argument_error(name, f"{MASK!r} among the keys with goal actions", tuple(chosen), f"Add {MASK!r}.")
    if not goal and MASK in chosen:
        hint = f"Leave {MASK!r} out, or choose goal actions."
        raise argument_error(name, f"no {MASK!r} with {action_type} actions", tuple(chosen), hint)
    if not set(chosen) - {MASK}:
        raise argument_error(name, "at least one key besides the mask", tuple(chosen), "Add a key such as 'pose'.")
    return tuple(key for key in KEYS if key in chosen)
