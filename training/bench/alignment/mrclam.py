"""Real maps aligned pairwise: each robot of a MR.CLAM log maps alone from its own start; barcodes seen, then hidden."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from slam_backend.core.validation import IntArray, check_float, check_int
from slam_backend.geometry import between, transform_points, wrap_angle
from slam_backend.maps.alignment import RIVAL_ANGLE, RIVAL_DISTANCE, Alignment, AlignmentOptions, align_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.mrclam import MrclamLog, load_mrclam
from training.experiments.config import PlainConfig, check_each_once
from training.experiments.statistics import grouped
from training.replay.metrics import align_to_truth
from training.replay.mrclam import Replay, ReplayConfig, replay

COMMAND = "bench mrclam"
METHODS = ("ransac", "clique")
ENOUGH_SHARED = 5  # landmarks from which on maps are to be aligned by their barcodes
# Maps are bent by tenths of a metre, by more the younger they are.
OPTIONS = AlignmentOptions(position_floor=0.3, min_inliers=ENOUGH_SHARED, max_sigma_heading=0.05)
BARCODES: dict[str, AlignmentOptions] = {"given": OPTIONS, "hidden": replace(OPTIONS, appearance=False)}


@dataclass(frozen=True, slots=True, kw_only=True)
class MrclamPairsConfig(PlainConfig):
    """All that decides the table.

    Attributes:
        path: Folder of the log.
        durations: After how many seconds maps are aligned [s]; 0: at the end.
        particles: Of each robot's filter.
        seed: Of the filters.
    """

    path: str
    durations: tuple[float, ...] = (100.0, 200.0, 400.0, 0.0)
    particles: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        for duration in self.durations:
            check_float("durations", duration, "Give seconds; 0 means all.", at_least=0.0)
        check_each_once("durations", self.durations)
        check_int("particles", self.particles, 1, "Use at least one particle.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")


def align_log(config: MrclamPairsConfig, on_part: Callable[[float], None] = lambda share: None) -> list[dict[str, Any]]:
    """Let each robot map alone for each duration, and align all pairs of maps.

    Args:
        config: Log and sizes.
        on_part: Called with the share of the work that is done, in (0, 1].

    Returns:
        Rows as `align_pairs` gives them, with `duration_s` (None: the whole log).
    """
    rows = []
    for place, duration in enumerate(config.durations):
        limit = duration or None
        log = load_mrclam(config.path, None, limit, None)
        alone = ReplayConfig(path=config.path, duration=limit, alone=True, particles=config.particles, seed=config.seed)
        done = place / len(config.durations)
        result = replay(log, alone, lambda share, report, d=done: on_part(d + share / len(config.durations)))  # type: ignore[misc]
        rows += [{"duration_s": limit} | row for row in align_pairs(result, log)]
    return rows


def align_pairs(result: Replay, log: MrclamLog) -> list[dict[str, Any]]:
    """Align the maps of all pairs of robots, barcodes given and hidden, by all methods.

    Returns:
        Rows of `robots` (as the log numbers them), `shared` landmarks, `barcodes`, `method`, `accepted`, `reason`,
        `inliers`; `error_m` where b's landmarks lie and `error_deg`, against the motion between both maps' fits to the
        true landmarks, None where refused.
    """
    numbers = [robot.robot for robot in log.robots]
    rows = []
    for a, b in combinations(range(len(numbers)), 2):
        maps, claims = (result.maps[a], result.maps[b]), (result.claims[a], result.claims[b])
        shared = len(np.intersect1d(*claims))
        for barcodes, options in BARCODES.items():
            for method in METHODS:
                found = align_maps(*maps, method, np.random.default_rng(0), options)
                error = _error(found, maps, claims, log)
                rows.append(
                    {
                        "robots": [numbers[a], numbers[b]], "shared": shared, "barcodes": barcodes, "method": method,
                        "accepted": found.success, "reason": found.reason, "inliers": len(found.inliers),
                        "error_m": error[0] if error else None, "error_deg": error[1] if error else None,
                    }
                )  # fmt: skip
    return rows


def _error(
    found: Alignment, maps: Sequence[LandmarkMap], claims: Sequence[IntArray], log: MrclamLog
) -> tuple[float, float] | None:
    """Return how far a motion is off [m, degrees]; None if it was refused or a map cannot be fitted to the truth."""
    fits = [align_to_truth(own, named, log) for own, named in zip(maps, claims, strict=True)]
    if not found.success or fits[0] is None or fits[1] is None:
        return None
    true = between(fits[0].world_from_map, fits[1].world_from_map)
    middle = maps[1].means[:, :2].mean(axis=0)
    offset = transform_points(found.transform, middle) - transform_points(true, middle)
    return float(np.hypot(*offset)), abs(float(np.rad2deg(wrap_angle(found.theta - true[2]))))


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a line per duration, barcodes and method.

    Returns:
        Lines of `duration_s`, `barcodes`, `method`, `pairs` that share enough landmarks, `accepted` of these, `false`
        (off by more than 0.5 m or 5 degrees), `median_m`, `worst_m`, `median_deg`, `worst_deg` of what was accepted.
    """
    lines = []
    for (duration, barcodes, method), own in grouped(rows, ("duration_s", "barcodes", "method")).items():
        apart = np.array([[row["error_m"], row["error_deg"]] for row in own if row["error_m"] is not None])
        line: dict[str, Any] = {
            "duration_s": duration, "barcodes": barcodes, "method": method,
            "pairs": sum(row["shared"] >= ENOUGH_SHARED for row in own),
            "accepted": sum(row["accepted"] for row in own), "false": 0,
        } | dict.fromkeys(("median_m", "worst_m", "median_deg", "worst_deg"))  # fmt: skip
        if len(apart):
            line["false"] = int(((apart[:, 0] > RIVAL_DISTANCE) | (apart[:, 1] > np.rad2deg(RIVAL_ANGLE))).sum())
            for column, unit in enumerate(("m", "deg")):
                line[f"median_{unit}"] = float(np.median(apart[:, column]))
                line[f"worst_{unit}"] = float(apart[:, column].max())
        lines.append(line)
    return lines
