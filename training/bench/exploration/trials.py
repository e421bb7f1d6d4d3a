"""Trial of `vslam bench exploration`: an episode, and its metrics for the comparison of policies."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from slam_backend.core.text_files import read_text
from slam_backend.core.validation import BoolArray, FloatArray, argument_error
from slam_backend.geometry import compose
from slam_backend.metrics import MapErrorParts, map_error_parts
from training.bench.exploration.machine import machine
from training.bench.exploration.players import BOUND, Player, parted
from training.episodes.digest import episode_digest
from training.episodes.guard import PolicyError
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, MergeRecord, run_episode
from training.experiments.trial_store import FAILED, TRIALS_FILE
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv

HALF, NEARLY_ALL = 0.5, 0.9  # shares of the floor
WATCHED_S = 20.0  # a wrong merge that persists for this long, or to the end, is false
CURVE_POINTS = 25
ROUNDED = 1e-4  # m, rad, and units of what else counts in a task
DIGEST = 8  # hexadecimal digits of the digest of a task
TEAM = ("map_error", "map_rmse_m", "map_recall", "map_precision", "ate_start_m", "ate_aligned_m")
CURVES = ("coverage", "map_error", "pose_error")


class Bench(Protocol):
    """Configuration of trials."""

    @property
    def decision_limit(self) -> float:
        """Longest time of a decision [s]."""

    def environment(self, trial: Any) -> EnvConfig:
        """Return the environment of a trial."""


def play(config: Bench, trial: Any) -> dict[str, Any]:
    """Run an episode and return the trial with its metrics, means over the robots unless noted otherwise.

    - `coverage`: share of the reachable floor seen at the end; `mean_coverage`: its mean over time;
      `reached_90`: whether 90 % are reached; `below_50_s`, `below_90_s`: whole seconds until half and 90 % are reached,
      or of the whole episode; `overlap`: share of the seen floor that at least two robots have seen.
    - At the end, in start frames: `TEAM`, as in `score_episode`, `pose_error`, and `way_m`, the distance driven;
      `squared_misplaced`, ...: what E^2 consists of, see `map_error_parts`.
    - `nees`: median of the NEES of the poses over robots and time, None if all poses are known.
    - `balance`: shortest over longest path of the robots.
    - For the team: `right_merges`, `false_merges`, `undone_merges`, `first_merge_s`, `last_merge_s`, see
      `count_merges`; `one_group`: whether all share a map at the end; `attempts`, `refusals` (by reason), `collisions`
      (ticks), `invalid_actions`, `bytes_sent`.
    - `decision_ms`, `decision_p99_ms`: median and 99th percentile of the processor time of a decision of the policy, of
      a team policy for all robots.
    - `curves`: `time_s` and the values of `CURVES` at these times.
    - `task`: see `task_digest`; `digest`: see `episode_digest`; `policy_digest`: that of a custom policy's file or a
      model; `version` of this package; `machine`: what last bits depend on.

    If the policy fails, the trial is returned with the error as `failed`, and no metrics.
    """
    player = parted(trial.policy)
    env = vslam_v1.parallel_env(config=config.environment(trial), observation_keys=player.observation_keys)
    team = player.make(env, config.decision_limit)
    invalid, task = 0, ""

    def count(progress: Any) -> None:
        nonlocal invalid, task
        task = task or task_digest(env)
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
    below = {share: np.append(seconds, record.times[-1])[_first(covered >= share)] for share in (HALF, NEARLY_ALL)}
    paths = np.array([info["distance"] for info in record.infos])
    refusals = sum((Counter(pair.refusals) for pair in record.pairs), Counter[str]())
    points = np.linspace(0.0, record.times[-1], CURVE_POINTS)
    lines = (record.coverage, record.map_errors.mean(axis=0), errors)
    return {
        **asdict(trial), "coverage": float(record.coverage[-1]), "mean_coverage": float(covered.mean()),
        "reached_90": bool((covered >= NEARLY_ALL).any()), "below_50_s": float(below[HALF]),
        "below_90_s": float(below[NEARLY_ALL]), "overlap": record.overlap,
        **{name: scores["team"][name] for name in TEAM}, **_error_parts(record, env.config.map_error_cutoff),
        "pose_error": float(errors[-1]),
        "nees": float(np.nanmedian(record.nees)) if np.isfinite(record.nees).any() else None,
        "way_m": scores["team"]["path_m"], "balance": float(paths.min() / paths.max()) if paths.max() > 0.0 else 1.0,
        **count_merges(record.merges), "one_group": len(record.groups) == 1, "attempts": record.attempts,
        "refusals": dict(refusals), "bytes_sent": sum(int(info["bytes_sent"]) for info in record.infos),
        "collisions": sum(int(info["collisions"]) for info in record.infos), "invalid_actions": invalid,
        "decision_ms": float(np.median(taken)), "decision_p99_ms": float(np.quantile(taken, 0.99)),
        "curves": {"time_s": points} | {
            name: values_at(record.times, line, points) for name, line in zip(CURVES, lines, strict=True)
        },
        "action_type": player.action_type, "task": task, "digest": episode_digest(record),
        "policy_digest": player.source_digest(), "version": version("vslam-env"),
        "machine": machine(),
    }  # fmt: skip


def task_digest(env: ExplorationEnv) -> str:
    """Return eight hexadecimal digits of SHA-256 over what an episode is before its first step.

    That is walls, scored landmarks, starts, biases of the odometry, the seed of the filters, and the first readings;
    numbers are rounded, so that last bits do not matter. Policies, actions and the estimator do not count.
    """
    scenario, landmarks = env.episode.scenario, env.episode.scenario.world.landmarks
    assert landmarks is not None
    readings = [part for robot in env.readings for part in (robot.scan, robot.measurements.points)]
    place = scenario.world.walls, landmarks.positions, landmarks.descriptors, scenario.true_starts, scenario.bias
    content = hashlib.sha256(repr((scenario.belief_seed, scenario.observable_landmarks.tolist())).encode())
    for part in (*place, *readings):
        content.update(np.rint(np.asarray(part, np.float64) / ROUNDED).astype(np.int64).tobytes())
    return content.hexdigest()[:DIGEST]


def first_steps(environment: EnvConfig, player: Player, seed: int, decision_limit: float) -> None:
    """Run the first two steps of an episode, to detect worlds that cannot be built, and compile what its policy needs.

    The trial itself reports a policy that fails.
    """
    steps = iter(range(2))
    if player.role == BOUND:
        return
    env = vslam_v1.parallel_env(config=environment)
    with suppress(PolicyError):
        team = player.make(env, decision_limit)
        run_episode(env, team, seed, should_stop=lambda: next(steps, None) is None)
    env.close()


def checks(bench: Bench, trials: Sequence[Any]) -> list[Callable[[], None]]:
    """Return the first steps of each policy, world family and number of robots."""
    firsts = {(t.policy, getattr(t, "family", t.world), t.robots): t for t in reversed(trials)}.values()
    return [partial(first_steps, bench.environment(t), parted(t.policy), t.seed, bench.decision_limit) for t in firsts]


def check_same_policies(out: Path | None, policies: Collection[str]) -> None:
    """Refuse to resume a folder whose episodes were played with another version of a custom policy or model.

    Args:
        out: Run folder; None: a new one.
        policies: Labels of the policies of this run; episodes of others are not looked at.

    Raises:
        ValueError: If the file of a policy has changed since.
    """
    file = None if out is None else out / TRIALS_FILE
    if file is None or not file.is_file():
        return
    now: dict[str, str] = {}
    for line in read_text(file, "out", "a file of trials").splitlines():
        with suppress(json.JSONDecodeError, TypeError, KeyError):  # `finished_trials` reports damage
            row = json.loads(line)
            policy, before = row["policy"], row["policy_digest"]
            if policy in policies and now.setdefault(policy, parted(policy).source_digest()) != before:
                hint = "Choose another folder, or restore the file."
                raise argument_error("out", f"episodes of {policy!r} as it is now", "episodes of another version", hint)


def _first(reached: BoolArray) -> int:
    """Return the index of the first true entry, or the length if there is none."""
    return int(reached.argmax()) if reached.any() else len(reached)


def _error_parts(record: EpisodeRecord, cutoff: float) -> dict[str, float]:
    """Return the means over robots of the parts of E^2 at the end [m^2]."""
    parts = [
        map_error_parts(landmark_map.moved(start).means, claims, record.true_landmarks, cutoff)
        for landmark_map, start, claims in zip(record.maps, record.true_poses[:, 0], record.map_claims, strict=True)
    ]
    return {
        f"squared_{name}": float(mean) for name, mean in zip(MapErrorParts._fields, np.mean(parts, axis=0), strict=True)
    }


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
