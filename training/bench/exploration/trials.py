"""Trial of `vslam bench exploration`: an episode, and its metrics for the comparison of policies."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose
from training.bench.config import ExplorationBenchConfig, ExplorationTrial
from training.bench.exploration.players import parted
from training.episodes.guard import PolicyError
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, MergeRecord, run_episode
from training.experiments.trial_store import FAILED
from vslam_env import vslam_v0

TRIALS_FILE = "trials.jsonl"
NEARLY_ALL = 0.9  # share of the floor
WATCHED_S = 20.0  # a wrong merge that persists for this long, or to the end, is false
CURVE_POINTS = 25
TEAM = ("map_error", "map_rmse_m", "map_recall", "map_precision", "ate_start_m", "ate_aligned_m")
CURVES = ("coverage", "map_error", "pose_error")


def play(config: ExplorationBenchConfig, trial: ExplorationTrial) -> dict[str, Any]:
    """Run an episode and return the trial with its metrics, means over the robots unless noted otherwise.

    - `coverage`: share of the reachable floor seen at the end; `mean_coverage`: its mean over time;
      `reached_90`: whether 90 % are reached; `below_90_s`: whole seconds until then, or of the whole episode.
    - At the end, in start frames: `TEAM`, as in `score_episode`, `pose_error`, and `way_m`, the distance driven.
    - For the team: `right_merges`, `false_merges`, `undone_merges`, `first_merge_s`, `last_merge_s`, see
      `count_merges`; `one_group`: whether all share a map at the end; `attempts`, `collisions` (ticks),
      `invalid_actions`.
    - `decision_ms`, `decision_p99_ms`: median and 99th percentile of the processor time of a decision of the policy, of
      a team policy for all robots.
    - `curves`: `time_s` and the values of `CURVES` at these times.

    If the policy fails, the trial is returned with the error as `failed`, and no metrics.
    """
    env = vslam_v0.parallel_env(config=config.environment(trial))
    team = parted(trial.policy).make(env, config.decision_limit)
    invalid = 0

    def count(progress: Any) -> None:
        nonlocal invalid
        invalid += sum(info["invalid_action"] for info in progress.infos.values())

    try:
        record = run_episode(env, team, trial.seed, count)
    except PolicyError as error:
        return {**asdict(trial), FAILED: str(error)}
    finally:
        env.close()
    taken = 1e3 * np.array(team.seconds)
    scores = score_episode(record)
    seconds = np.arange(np.floor(record.times[-1]) + 1.0)
    covered = values_at(record.times, record.coverage, seconds)
    errors = pose_errors(record)
    reached = np.flatnonzero(covered >= NEARLY_ALL)
    points = np.linspace(0.0, record.times[-1], CURVE_POINTS)
    lines = (record.coverage, record.map_errors.mean(axis=0), errors)
    return {
        **asdict(trial), "coverage": float(record.coverage[-1]), "mean_coverage": float(covered.mean()),
        "reached_90": bool(len(reached)),
        "below_90_s": float(seconds[reached[0]] if len(reached) else record.times[-1]),
        **{name: scores["team"][name] for name in TEAM}, "pose_error": float(errors[-1]),
        "way_m": scores["team"]["path_m"], **count_merges(record.merges), "one_group": len(record.groups) == 1,
        "attempts": record.attempts, "collisions": sum(int(info["collisions"]) for info in record.infos),
        "invalid_actions": invalid,
        "decision_ms": float(np.median(taken)), "decision_p99_ms": float(np.quantile(taken, 0.99)),
        "curves": {"time_s": points} | {
            name: values_at(record.times, line, points) for name, line in zip(CURVES, lines, strict=True)
        },
    }  # fmt: skip


def count_merges(merges: Sequence[MergeRecord]) -> dict[str, Any]:
    """Return the numbers of right, false and undone merges, and the times of the first and last right merge.

    A false merge has an error above 0.5 m or 5 degrees and persists for 20 s, or until the end. Without right merges
    `first_merge_s` and `last_merge_s` are None.
    """
    false = [m for m in merges if m.is_false and (m.undone is None or m.undone - m.time >= WATCHED_S)]
    right = [merge.time for merge in merges if not merge.is_false and merge.undone is None]
    return {
        "right_merges": len(right), "false_merges": len(false),
        "undone_merges": sum(merge.undone is not None for merge in merges), "first_merge_s": min(right, default=None),
        "last_merge_s": max(right, default=None),
    }  # fmt: skip


def values_at(times: FloatArray, values: FloatArray, when: FloatArray) -> FloatArray:
    """Return the last of the values (T,) at or before each time (n,)."""
    return values[np.searchsorted(times, when + 1e-6, side="right") - 1]


def pose_errors(record: EpisodeRecord) -> FloatArray:
    """Return the mean over robots (T + 1,) [m] of the position error, with start frames at the true start poses."""
    believed = np.stack([
        compose(truth[0], path) for truth, path in zip(record.true_poses, record.estimated, strict=True)
    ])  # fmt: skip
    gaps: FloatArray = np.linalg.norm((believed - record.true_poses)[..., :2], axis=-1).mean(axis=0)
    return gaps
