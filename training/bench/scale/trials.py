"""Trial of `vslam bench scale`: a timed episode."""

import os
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from training.bench.config import ScaleBenchConfig, ScaleTrial
from training.bench.exploration.players import parted
from training.bench.exploration.trials import CURVE_POINTS, TEAM, count_merges, pose_errors, values_at
from training.episodes.guard import PolicyError
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, Progress, run_episode
from training.experiments.trial_store import FAILED
from vslam_env import save_state, warm_up
from vslam_env.environment import ExplorationEnv

TRIALS_FILE = "trials.jsonl"
DECISION_LIMIT = 10.0  # [s] longest time of a decision
LATE_SHARE = 0.25  # last part of an episode, in which maps are largest
SNAPSHOTS = 5  # repeated snapshots at the end, the median counts
SHARED = 15  # true landmarks that two maps share, so that they should be merged
CURVES = ("coverage", "map_error", "pose_error", "step_ms")


class TimedEnv(ExplorationEnv):
    """Environment that keeps the processor time of each step [s]."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.seconds: list[float] = []

    def step(self, actions: Mapping[str, Any]) -> Any:
        """Execute the actions of all robots, see `ExplorationEnv.step`."""
        begin = time.process_time()
        results = super().step(actions)
        self.seconds.append(time.process_time() - begin)
        return results


def play(config: ScaleBenchConfig, trial: ScaleTrial) -> dict[str, Any]:
    """Run an episode and return the trial with its metrics.

    - Processor times of `env.step`, of all robots and all ticks of a decision: `steps_per_s`, the mean rate;
      `median_ms`, `late_ms`: median over the last quarter; `p99_ms`, `longest_ms`. Kernels are compiled before.
    - At the end: `get_state_ms`, `set_state_ms`; `snapshot_mb`, the size of the state as a file; `memory_mb`, that of
      the process, None where the system does not say; `reset_s`.
    - `coverage`, `mean_coverage`, `pose_error`, `landmarks` of a robot's map, and `TEAM`: means over the robots, as in
      `vslam bench exploration`; merges as in `count_merges`.
    - `sharing_pairs`: pairs of robots in one group, or whose maps share 15 true landmarks; `merged_pairs`: the former.
    - `curves`: `time_s` and the values of `CURVES` at these times; `step_ms` is the median since the time before.

    If the policy fails, the trial is returned with the error as `failed`, and no metrics.
    """
    _warm_up()
    env = TimedEnv(config.environment(trial))
    team = parted(config.policy).make(env, DECISION_LIMIT)
    begin = time.process_time()
    first: list[float] = []
    ends: list[dict[str, Any]] = []

    def watch(progress: Progress) -> None:
        if progress.step == 0:
            first.append(time.process_time() - begin)
        elif not env.agents:
            ends.append(_snapshot_costs(env))

    try:
        record = run_episode(env, team, trial.seed, watch)
    except PolicyError as error:
        return {**asdict(trial), FAILED: str(error)}
    finally:
        env.close()
    taken = 1e3 * np.array(env.seconds)
    late = taken[int((1.0 - LATE_SHARE) * len(taken)) :]
    scores = score_episode(record)["team"]
    errors = pose_errors(record)
    points = np.linspace(0.0, record.times[-1], CURVE_POINTS)
    marks = np.searchsorted(record.times, points + 1e-6, side="right") - 1  # steps taken until each time
    steps = [None, *(float(np.median(taken[a:b])) if b > a else None for a, b in pairwise(marks))]
    lines = (record.coverage, record.map_errors.mean(axis=0), errors)
    sharing, merged = sharing_pairs(record)
    return {
        **asdict(trial), "steps_per_s": float(1e3 * len(taken) / taken.sum()), "median_ms": float(np.median(taken)),
        "late_ms": float(np.median(late)), "p99_ms": float(np.quantile(taken, 0.99)), "longest_ms": float(taken.max()),
        "reset_s": first[0], **ends[0], "coverage": float(record.coverage[-1]),
        "mean_coverage": float(record.coverage.mean()), "pose_error": float(errors[-1]),
        "landmarks": float(np.mean([len(each) for each in record.maps])), **{name: scores[name] for name in TEAM},
        **count_merges(record.merges), "attempts": record.attempts, "one_group": len(record.groups) == 1,
        "sharing_pairs": sharing, "merged_pairs": merged,
        "curves": {"time_s": points}
        | {name: values_at(record.times, line, points) for name, line in zip(CURVES[:-1], lines, strict=True)}
        | {"step_ms": steps},
    }  # fmt: skip


def sharing_pairs(record: EpisodeRecord) -> tuple[int, int]:
    """Return how many pairs of robots should share a map, and how many do.

    They should if they do, or if their maps contain `SHARED` common true landmarks.
    """
    together = {pair for group in record.groups for pair in combinations(sorted(group), 2)}
    known = [np.unique(claims[claims >= 0]) for claims in record.map_claims]
    sharing = [
        (a, b) in together or len(np.intersect1d(known[a], known[b], assume_unique=True)) >= SHARED
        for a, b in combinations(range(len(known)), 2)
    ]
    return sum(sharing), len(together)


def _snapshot_costs(env: ExplorationEnv) -> dict[str, Any]:
    """Return time and size of snapshots of an environment, and the memory of the process, see `play`."""
    taken, restored = [], []
    for _ in range(SNAPSHOTS):
        begin = time.process_time()
        state = env.get_state()
        middle = time.process_time()
        env.set_state(state)
        taken.append(middle - begin)
        restored.append(time.process_time() - middle)
    memory = memory_mb()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state"
        save_state(state, file)
        size = file.stat().st_size
    return {
        "get_state_ms": 1e3 * float(np.median(taken)), "set_state_ms": 1e3 * float(np.median(restored)),
        "snapshot_mb": size / 1e6, "memory_mb": memory,
    }  # fmt: skip


def memory_mb() -> Any:
    """Return the resident memory of this process [MB], or None where the system has no `/proc`."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@cache
def _warm_up() -> None:
    """Load all kernels into this process, once."""
    warm_up(workers=1)
