"""Trial of `vslam bench exploration`: an episode, and its metrics for the comparison of policies."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from agents.policy import Policy
from agents.registry import action_types
from slam_backend.core.validation import FloatArray, check_choice
from slam_backend.geometry import compose
from training.bench.config import ExplorationBenchConfig, ExplorationTrial
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, MergeRecord, run_episode
from vslam_env import vslam_v0
from vslam_env.belief.team_belief import Belief

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
    - `decision_ms`: median processor time of a decision of the policy.
    - `curves`: `time_s` and the values of `CURVES` at these times.
    """
    env = vslam_v0.parallel_env(config=config.environment(trial))
    timed = {agent: _Timed(policy) for agent, policy in config.run(trial).make_policies(env).items()}
    invalid = 0

    def count(progress: Any) -> None:
        nonlocal invalid
        invalid += sum(info["invalid_action"] for info in progress.infos.values())

    record = run_episode(env, timed, trial.seed, count)
    env.close()
    scores = score_episode(record)
    seconds = np.arange(np.floor(record.times[-1]) + 1.0)
    covered = _at(record.times, record.coverage, seconds)
    errors = _pose_errors(record)
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
        "decision_ms": 1e3 * float(np.median([taken for policy in timed.values() for taken in policy.seconds])),
        "curves": {"time_s": points} | {n: _at(record.times, v, points) for n, v in zip(CURVES, lines, strict=True)},
    }  # fmt: skip


def parted(policy: str) -> tuple[str, str]:
    """Return the name and action type of a policy: `goal` if the policy supports it, unless `@` selects another.

    Raises:
        ValueError: If there is no such policy, or it does not support the action type.
    """
    name, at, wanted = policy.rpartition("@") if "@" in policy else (policy, "", "")
    known = action_types(name)
    return name, check_choice(
        f"{name}@", wanted, known, "Choose an action type that the policy supports."
    ) if at else known[0]


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


class _Timed:
    """Policy with a record of the processor time [s] of each decision."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.seconds: list[float] = []

    def reset(self) -> None:
        self._policy.reset()

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> Any:
        begin = time.thread_time()
        action = self._policy.act(observation, belief, rng)
        self.seconds.append(time.thread_time() - begin)
        return action


def _at(times: FloatArray, values: FloatArray, when: FloatArray) -> FloatArray:
    """Return the last of the values (T,) at or before each time (n,)."""
    return values[np.searchsorted(times, when + 1e-6, side="right") - 1]


def _pose_errors(record: EpisodeRecord) -> FloatArray:
    """Return the mean over robots (T + 1,) [m] of the position error, with start frames at the true start poses."""
    believed = np.stack([
        compose(truth[0], path) for truth, path in zip(record.true_poses, record.estimated, strict=True)
    ])  # fmt: skip
    gaps: FloatArray = np.linalg.norm((believed - record.true_poses)[..., :2], axis=-1).mean(axis=0)
    return gaps
