"""Errors of estimates of a stereo run: by a filter, or by least squares with true data associations."""

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.metrics import align_se2, ate, map_rmse, nees
from training.stereo_runs.batch_ml import BatchEstimate, batch_ml
from training.stereo_runs.batch_problem import BatchProblem
from training.stereo_runs.runs import FALSE_POINT, StereoRun

REJUVENATE_EVERY = 25  # steps
CONFIRMED = 2  # measurements that confirm a landmark
LEAST_SIGMA = 1e-5  # [m, rad]; lower limit, because a collapsed particle set has no NEES


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Estimates of a method for a run; None for quantities that it does not estimate."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame. Online methods: estimates at the time of each step.
    covariances: FloatArray | None = None  # (K, T, 3, 3) float64. Covariances of these poses.
    means: FloatArray | None = None  # (n, 3) float64 [m], world frame. Final map.
    # (n,) int64. True landmark of each landmark of the map, by its index in the run; `FALSE_POINT`: none.
    claims: IntArray | None = None
    confirmed: BoolArray | None = None  # (n,) bool. Whether it was measured at least `CONFIRMED` times.
    extra: dict[str, float] | None = None  # Additional metrics of a filter


def score(run: StereoRun, answer: Answer) -> dict[str, float]:
    """Return the errors of an answer.

    Returns:
        `pose_rms_m` (all robots and steps, not aligned), `pose_aligned_rms_m` (after the SE(2) fit of all paths),
        `heading_rms_deg`; `map_rmse_m`, `map_aligned_rmse_m`, `map_recall` (of measured landmarks), `map_precision`,
        `confirmed_recall`, `confirmed_precision` (of landmarks measured at least twice); `nees_median`, `nees_mean`
        (3-D, ideal 3), `anees` (mean over the dimension, ideal 1); for filters `ess_share` (mean of ESS / M), `nis`
        (mean, ideal 3), `wrong_match_share` (of all matches of the most probable particle), `held_back_share` (of all
        measurements, neither matched nor new), `step_ms` (median), `rejuvenation_ms` (median of the steps with an
        attempt), `refused_share` (of these attempts). NaN means unknown.
    """
    errors = answer.paths - run.true_paths
    errors[..., 2] = wrap_angle(errors[..., 2])
    fitted = ate(answer.paths.reshape(-1, 3), run.true_paths.reshape(-1, 3))
    row = {
        "pose_rms_m": fitted.start, "pose_aligned_rms_m": fitted.aligned,
        "heading_rms_deg": float(np.degrees(np.sqrt((errors[..., 2] ** 2).mean()))),
    }  # fmt: skip
    row |= dict.fromkeys(
        ("map_rmse_m", "map_aligned_rmse_m", "map_recall", "map_precision", "confirmed_recall", "confirmed_precision",
         "nees_median", "nees_mean", "anees", "ess_share", "nis", "wrong_match_share", "held_back_share", "step_ms",
         "rejuvenation_ms", "refused_share"),
        float("nan"),
    )  # fmt: skip
    if answer.covariances is not None:
        claimed = answer.covariances[:, 1:].reshape(-1, 3, 3) + LEAST_SIGMA**2 * np.eye(3)  # the start is known
        values = nees(errors[:, 1:].reshape(-1, 3), claimed)
        row |= {"nees_median": float(np.median(values)), "nees_mean": float(values.mean())}
        row["anees"] = row["nees_mean"] / 3.0
    if answer.means is not None and answer.claims is not None:
        row |= _score_map(run, answer.means, answer.claims, answer.confirmed)
    return row | (answer.extra or {})


def _score_map(run: StereoRun, means: FloatArray, claims: IntArray, confirmed: Any) -> dict[str, float]:
    """Return the metrics of a map; recall counts only measured landmarks."""
    measured = run.measured_landmarks()
    rows = np.full(len(run.landmarks), FALSE_POINT)
    rows[measured] = np.arange(len(measured))
    named = np.where(claims == FALSE_POINT, FALSE_POINT, rows[claims])
    truths = run.landmarks[measured]
    whole = map_rmse(means, truths, named)
    sure = map_rmse(means[confirmed], truths, named[confirmed])
    pairs = whole.matched
    aligned = float("nan")
    if len(pairs):
        motion = align_se2(truths[pairs[:, 1], :2], means[pairs[:, 0], :2])
        apart = transform_points(motion, means[pairs[:, 0]]) - truths[pairs[:, 1]]
        aligned = float(np.sqrt((apart**2).sum(axis=1).mean()))
    return {
        "map_rmse_m": whole.rmse, "map_aligned_rmse_m": aligned, "map_recall": whole.recall,
        "map_precision": whole.precision, "confirmed_recall": sure.recall, "confirmed_precision": sure.precision,
    }  # fmt: skip


def follow(run: StereoRun, slam: FastSlam) -> Answer:
    """Run a new filter of `run.build_filter` on a run; record each pose estimate at its own step."""
    robots = range(slam.num_robots)
    claims: dict[int, int] = {}  # id of a landmark -> true landmark behind the measurement that created it
    paths, covariances, ess, nis, times = [], [], [], [], []
    attempts: list[tuple[float, bool]] = []
    matched = wrong = held_back = total = 0
    for reading, names in zip(run.readings(), run.names, strict=True):
        begin = time.perf_counter()
        report = slam.step(**reading)
        times.append(time.perf_counter() - begin)
        if report.rejuvenation is not None:
            attempts.append((times[-1], report.rejuvenation.reason != ""))
        ess.append(report.ess / slam.num_particles)
        nis.append(report.nis)
        for robot in robots:
            found, name = report.associations[robot].tolist(), names[robot].tolist()
            pairs = [(claims[i], n) for i, n in zip(found, name, strict=True) if i in claims]
            matched += len(pairs)
            wrong += sum(claim == FALSE_POINT or claim != n for claim, n in pairs)
            held_back += sum(i < 0 for i in found)
            total += len(found)
        for robot in robots:
            made = report.created[robot]
            claims |= {int(made[b]): int(names[robot][b]) for b in np.flatnonzero(made >= 0)}
        estimates = [slam.pose(robot) for robot in robots]
        paths.append([estimate.mean for estimate in estimates])
        covariances.append([estimate.covariance for estimate in estimates])
    held = slam.map()
    return Answer(
        paths=np.array(paths).transpose(1, 0, 2), covariances=np.array(covariances).transpose(1, 0, 2, 3),
        means=held.means, claims=np.array([claims[int(i)] for i in held.ids], dtype=np.int64),
        confirmed=held.counts >= CONFIRMED,
        extra={
            "ess_share": float(np.mean(ess)),
            "nis": float(np.mean(values)) if len(values := np.array(nis)[np.isfinite(nis)]) else float("nan"),
            "wrong_match_share": wrong / max(matched, 1),
            "held_back_share": held_back / max(total, 1),
            "step_ms": 1e3 * float(np.median(times)),
            "rejuvenation_ms": 1e3 * float(np.median([t for t, _ in attempts])) if attempts else float("nan"),
            "refused_share": float(np.mean([refused for _, refused in attempts])) if attempts else float("nan"),
        },
    )  # fmt: skip


def least_squares_answer(
    problem: BatchProblem, paths: FloatArray, covariances: FloatArray, landmarks: FloatArray
) -> Answer:  # fmt: skip
    """Return the answer with estimates of the unknowns of a run's problem."""
    sightings = np.bincount(problem.landmarks, minlength=len(problem.names))
    return Answer(paths, covariances, landmarks, problem.names, sightings >= CONFIRMED)


@lru_cache(maxsize=1)
def batch_of(run: StereoRun) -> tuple[BatchProblem, BatchEstimate]:
    """Optimise a run once for consecutive trials."""
    problem = BatchProblem.of_run(run)
    return problem, batch_ml(problem)
