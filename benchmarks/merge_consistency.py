"""Does a merged team know how uncertain it is? NEES of landmarks and poses before and after a merge, both ways.

    python benchmarks/merge_consistency.py --runs 40 --json merge_consistency.json

Two robots explore an office; when their maps align, the team is merged twice from the same state, particle by particle
and by mixture covariances, and both teams go on with the same readings. NEES is divided by its dimension 3, so that 1
is ideal; given are the mean over runs of each run's median landmark (of a chi-square variable: 0.79) and of its mean,
and means over runs of the pose of the second robot: before the merge in its own start frame, afterwards in the first
robot's.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from agents.registry import make_policy
from slam_backend.alignment import align_maps
from slam_backend.errors import FloatArray, check_int
from slam_backend.files import check_writable, write_file
from slam_backend.geometry import between, inverse, transform_points, wrap_angle
from slam_backend.team import TeamSlam
from training.run_folder import plain
from vslam_env import ExplorationEnv, preset_config
from vslam_env.errors_of_maps import ClaimLedger
from vslam_env.readings import Readings

METHODS = ("particles", "mixture")
LATER = 100  # [steps] after the merge
EVERY = 25  # [steps] between two attempts
LONGEST = 1500  # [steps] of a run


class Recording:
    """An office with two robots that never merge by themselves, and what they read.

    Args:
        seed: Of everything.
    """

    def __init__(self, seed: int) -> None:
        config = preset_config("standard").replace(
            num_robots=2, max_cycles=LONGEST + LATER + 1, belief={"attempts": {"enabled": False}}
        )
        self.env = ExplorationEnv(config)
        self.readings: list[tuple[Readings, ...]] = []
        self.true_ids: list[list[Any]] = []
        self.env.recorder = self.readings.append
        self._rng = np.random.default_rng([seed, 19])
        self._policies = [make_policy("frontier", "continuous") for _ in range(2)]
        self._observations = self.env.reset(seed=seed)[0]

    def drive(self, steps: int) -> None:
        """Let both robots explore."""
        for _ in range(steps):
            actions = {
                agent: policy.act(self._observations[agent], self.env.belief(agent), self._rng)
                for agent, policy in zip(self.env.agents, self._policies, strict=True)
            }
            self._observations = self.env.step(actions)[0]
            self.true_ids.append([frame.true_ids for frame in self.env.episode.frames])


def ratios(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return NEES over dimension of errors (..., 3) with covariances (..., 3, 3)."""
    return np.asarray(np.einsum("...i,...i", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]) / 3.0)


def judge(env: ExplorationEnv, team: TeamSlam, ledger: ClaimLedger, robot: int, pose: FloatArray) -> dict[str, float]:
    """Return the consistency of a robot's map and pose in its map frame, against its true `pose` (3,), world frame."""
    origin = env.true_start_poses[team.members(robot)[0]]
    held = team.map(robot, "mixture")
    held = held.subset(np.flatnonzero(held.counts >= 2))
    claims = ledger.claims(robot, held.ids)
    held, claims = held.subset(np.flatnonzero(claims >= 0)), claims[claims >= 0]
    truth = transform_points(inverse(origin), env.true_landmarks[claims])
    landmarks = ratios(held.means - truth, held.covariances)
    estimate = team.pose(robot)
    error = estimate.mean - between(origin, pose)
    error[2] = wrap_angle(error[2])
    return {
        "landmarks_median": float(np.median(landmarks)),
        "landmarks_mean": float(np.mean(landmarks)),
        "landmarks_rms_m": float(np.sqrt(np.mean(np.sum((held.means - truth) ** 2, axis=1)))),
        "pose": float(ratios(error, estimate.covariance)),
        "pose_error_m": float(np.hypot(*error[:2])),
    }


def play(seed: int) -> dict[str, dict[str, float]] | None:
    """Run one trial and return its figures by moment, None if the maps never aligned."""
    recording = Recording(seed)
    env, options = recording.env, recording.env.config.belief
    team = env.episode.belief._team
    for _ in range(LONGEST // EVERY):
        recording.drive(EVERY)
        alignment = align_maps(team.map(0, "mixture"), team.map(1, "mixture"), options=options.alignment)
        if alignment.success:
            break
    else:
        return None
    state, books, then = team.get_state(), env.episode.ledger.get_state(), env.true_poses
    found = {"before": judge(env, team, env.episode.ledger, 1, then[1])}
    begin = len(recording.readings)
    recording.drive(LATER)
    for method in METHODS:
        merged = TeamSlam(2)
        merged.set_state(state | {"merging": replace(options.merging, method=method, watch_steps=0)})
        ledger = ClaimLedger(2, env.world.landmarks.positions, env.episode.setting.countable, 1.0)  # type: ignore[union-attr]
        ledger.set_state(books)
        ledger.rename(merged.merge(0, 1, alignment))
        found[f"{method}, at the merge"] = judge(env, merged, ledger, 1, then[1])
        for readings, true_ids in zip(recording.readings[begin:], recording.true_ids[begin - 1 :], strict=True):
            report = merged.step([r.odometry for r in readings], [r.measurements for r in readings])
            ledger.record(report, true_ids)
        found[f"{method}, {LATER} steps later"] = judge(env, merged, ledger, 1, env.true_poses[1])
    return found


def main(
    runs: Annotated[int, typer.Option(help="How many seeds.")] = 40,
    first_seed: Annotated[int, typer.Option(help="The first of them.")] = 100,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all figures to this file.")] = None,
) -> None:
    """Run the trials and print their means."""
    check_int("runs", runs, 1, "Run at least one.")
    check_int("first_seed", first_seed, 0, "Seeds are not negative.")
    if json_file is not None:
        check_writable(json_file, "json")
    trials = [found for seed in range(first_seed, first_seed + runs) if (found := play(seed)) is not None]
    figures: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for trial in trials:
        for moment, values in trial.items():
            for name, value in values.items():
                figures[moment][name].append(value)
    names = list(next(iter(figures.values()), {}))
    table = Table("moment", *names, title=f"{len(trials)} merges of {runs} runs: means (medians)")
    for moment, values in figures.items():
        table.add_row(moment, *(f"{np.mean(values[name]):.2f} ({np.median(values[name]):.2f})" for name in names))
    Console(width=150).print(table)
    if json_file is not None:
        write_file(json_file, json.dumps(plain({"trials": trials}), indent=2), "json")


if __name__ == "__main__":
    typer.run(main)
