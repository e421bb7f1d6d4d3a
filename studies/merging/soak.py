"""Soak test of merges in random worlds with similar landmarks: are false merges avoided, or detected and undone?

    python -m studies.merging.soak --minutes 10 --json merge_soak.json
    python -m studies.merging.soak --minutes 10 --forced
    python -m studies.merging.soak --minutes 10 --kind environment
    python -m studies.merging.soak --minutes 10 --kind both
    python -m studies.merging.soak --minutes 60 --world FOLDER_OF_PLANS --seeds 3
    python -m studies.merging.soak --minutes 60 --world maze --world loops --seeds 10

Runs are stereo runs through offices of aisles, 100 m per robot, with classes of one to three similar landmarks, false
points and wrong descriptors; or episodes of the environment in all world families, in which up to all landmarks have a
twin. Numbers of robots and contacts vary between runs. A merge is false if its error exceeds 0.5 m or 5 degrees; it
counts if it persists for 200 steps or until the end. The error of the team's estimate at that time, and the share of
wrong pairs, are reported as well, see `merge_outcomes`. With `--forced` robots do not merge by themselves: once two
maps are large enough they are merged with the wrong transform that fits them best, and the question is how many of
these merges the team undoes, and when; `--shift 0.6` instead shifts the true transform by this distance in metres.
With `--world` the runs are those of `vslam run --world WORLD --seed SEED`, for all given worlds, where a folder stands
for the floor plans in it, with `--seeds` seeds each, starting at `--first-seed`; `--minutes` ends them early.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from agents.registry import make_policy
from slam_backend.core.files import check_writable, write_file
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_choice, check_int
from slam_backend.geometry import between, rotation
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam
from studies.merging.outcomes import Delay, Follower, MergeOutcome, RunEnd, RunOutcomes, collect_outcomes, summarise
from training.episodes.config import RunConfig
from training.episodes.metrics import score_episode
from training.episodes.runner import Progress, is_false_merge, run_episode
from training.experiments.run_folder import plain
from training.stereo_runs.runs import STEP, RunSpec, simulate_run
from vslam_env import ExplorationEnv, preset_config
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors.landmark_sensor import padded

KINDS = ("aisles", "environment", "both")
WORLDS = ("office", "loops", "maze", "hall", "fig5")
REPEATED = (0.0, 0.5, 1.0)  # shares of landmarks with a twin
RADIOS: tuple[dict[str, Any], ...] = ({}, {"comm_range": 8.0}, {"comm_line_of_sight": True}, {"comm_loss": 0.2})
LOSES, FINDS = 0.02, 0.05  # probabilities per step that a link is lost, and restored
ENOUGH = 20  # minimum landmarks of each map for a forced merge
HYPOTHESES, COINCIDENCE = 2000, 0.25  # number of hypotheses and inlier distance of forced merges [-, m]
Runs = tuple[RunOutcomes, int]  # outcomes of a run, and its number of steps


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Options of all runs, from the command line.

    Attributes:
        forced: Whether wrong merges are forced.
        shift: Shift of forced merges [m]; None: the wrong transform with the best fit.
        rejuvenate_every: Interval of rejuvenations; None: never in aisles, the default in environments.
        straighten: Whether maps are smoothed before a merge.
        sure: Required certainty of a transform, see `MergeOptions.min_sigmas`.
    """

    forced: bool = False
    shift: float | None = None
    rejuvenate_every: int | None = None
    straighten: bool = True
    sure: float = MergeOptions().min_sigmas

    @property
    def merging(self) -> dict[str, Any]:
        """Merge options."""
        return {"smooth_first": self.straighten, "min_sigmas": self.sure}

    @property
    def filter(self) -> dict[str, Any]:
        """Filter options that differ from the defaults."""
        return {} if self.rejuvenate_every is None else {"rejuvenate_every": self.rejuvenate_every}


def make_env(seed: int, cycles: int, setting: Setting) -> ExplorationEnv:
    """Return the environment of an episode, which the seed determines completely."""
    rng = np.random.default_rng([seed, 17])
    config = preset_config("standard").replace(
        world=str(rng.choice(WORLDS)),
        num_robots=int(rng.integers(2, 5)),
        max_cycles=cycles,
        landmarks={"repeated": float(rng.choice(REPEATED))},
        belief={
            "attempts": {"enabled": not setting.forced},
            "merging": setting.merging,
            "filter": setting.filter,
        },
        **({} if setting.forced else RADIOS[int(rng.integers(len(RADIOS)))]),
    )
    return ExplorationEnv(config)


def play_environment(seed: int, cycles: int, setting: Setting) -> RunOutcomes:
    """Run one episode and return the outcomes of its merges."""
    env = make_env(seed, cycles, setting)
    rng = np.random.default_rng([seed, 18])
    policies = [make_policy("frontier", env.config.action_type) for _ in env.possible_agents]
    observations, _ = env.reset(seed=seed)
    follower = Follower(env.episode.belief.team, env.episode.ground_truth, env.true_start_poses)
    while env.agents:
        if setting.forced and not env.events:
            force(env, rng, setting.shift)
        actions = {
            agent: policy.act(observations[agent], env.belief(agent), rng)
            for agent, policy in zip(env.agents, policies, strict=True)
        }
        observations = env.step(actions)[0]
        follower.note(env.episode.tick - 1)
    alike = f"{env.config.landmarks.repeated:.0%} with a twin"
    return collect_outcomes(env.events, env.true_start_poses, seed, env.config.world, alike, env.episode.tick, follower)


def play_world(world: str, seed: int, setting: Setting) -> RunOutcomes:
    """Run the episode of `vslam run` in one world and return the outcomes of its merges."""
    run = RunConfig(world=world, seed=seed)
    belief = {"merging": setting.merging, "filter": setting.filter}
    env = ExplorationEnv(run.environment().replace(belief=belief))
    follower: Follower | None = None

    def note(progress: Progress) -> None:
        nonlocal follower
        if follower is None:
            follower = Follower(env.episode.belief.team, env.episode.ground_truth, env.true_start_poses)
        else:
            follower.note(env.episode.tick - 1)

    record = run_episode(env, run.make_policies(env), seed, note)
    assert follower is not None
    name = Path(world).stem
    found, late, end = collect_outcomes(env.events, env.true_start_poses, seed, name, "", env.episode.tick, follower)
    return found, late, replace(end, ate_m=score_episode(record)["team"]["ate_aligned_m"])


def named_worlds(worlds: Sequence[str]) -> list[str]:
    """Return world families and floor plans, with folders replaced by the sorted plans in them."""
    found = []
    for world in worlds:
        folder = Path(world)
        found += sorted(map(str, folder.glob("*.png"))) if folder.is_dir() else [world]
    return found


def play_random(minutes: float, first_seed: int, cycles: int | None, kind: str, setting: Setting) -> Iterator[Runs]:
    """Run random runs until the time is over."""
    begin = time.monotonic()
    for seed in count(first_seed):
        if time.monotonic() - begin > 60.0 * minutes:
            break
        aisles = kind == "aisles" or (kind == "both" and seed % 2 == 0)
        length = (400 if aisles else 1500) if cycles is None else cycles
        yield (play_aisles if aisles else play_environment)(seed, length, setting), length


def play_named(minutes: float, first_seed: int, worlds: Sequence[str], seeds: int, setting: Setting) -> Iterator[Runs]:
    """Run all seeds in each of some worlds, or until the time is over."""
    begin = time.monotonic()
    for world in named_worlds(worlds):
        for seed in range(first_seed, first_seed + seeds):
            if time.monotonic() - begin < 60.0 * minutes:
                yield play_world(world, seed, setting), RunConfig().num_steps


def play_aisles(seed: int, cycles: int, setting: Setting) -> RunOutcomes:
    """Run a team on one stereo run of `cycles` steps and return the outcomes of its merges."""
    rng = np.random.default_rng([seed, 17])
    robots, look_alikes = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    spec = RunSpec(
        robots=robots, length=cycles * STEP, measurements=5 * robots, association="unknown", look_alikes=look_alikes
    )
    run = simulate_run(spec, seed)
    noise = spec.noise
    camera = replace(noise.camera, sigma_px=2 * noise.sigma_px, sigma_disparity_px=2 * noise.sigma_disparity_px)
    team = TeamSlam(
        robots, seed=seed, attempts=AttemptOptions(enabled=not setting.forced),
        merging=MergeOptions(**setting.merging), num_particles=50, camera=camera, motion=noise.motion,
        rejuvenate_every=setting.rejuvenate_every,
    )  # fmt: skip
    starts = run.true_paths[:, 0]
    ground_truth = GroundTruthAssociation(
        robots, run.landmarks, np.ones(len(run.landmarks), dtype=np.bool_), cutoff=1.0
    )
    follower = Follower(team, ground_truth, starts)
    broken = not setting.forced and rng.random() < 0.5
    up = np.ones((robots, robots), dtype=np.bool_)
    for step, (reading, names) in enumerate(zip(run.readings(), run.names, strict=True)):
        if broken:
            change = np.triu(np.where(up, rng.random(up.shape) < LOSES, rng.random(up.shape) < FINDS), 1)
            up = up ^ (change | change.T)
        ground_truth.record(team.step(reading["odometry"], reading["measurements"], up), padded(names))
        if setting.forced and not team.events and min(len(team.map(robot)) for robot in range(2)) >= ENOUGH:
            team.merge(0, 1, forced_alignment(starts, team.map(0), team.map(1), rng, setting.shift))
        follower.note(step)
    return collect_outcomes(team.events, starts, seed, "aisles", f"classes of {look_alikes}", run.num_steps, follower)


def force(env: ExplorationEnv, rng: np.random.Generator, shift: float | None) -> None:
    """Force a wrong merge of robots 0 and 1, if their maps are large enough."""
    belief, ground_truth = env.episode.belief, env.episode.ground_truth
    map_a, map_b = belief.team.map(0), belief.team.map(1)
    if min(len(map_a), len(map_b)) < ENOUGH:
        return
    ground_truth.merge(belief.merge(0, 1, forced_alignment(env.true_start_poses, map_a, map_b, rng, shift)))


def forced_alignment(
    starts: FloatArray, map_a: LandmarkMap, map_b: LandmarkMap, rng: np.random.Generator, shift: float | None
) -> Alignment:
    """Return a wrong alignment of the maps of robots 0 and 1: shifted by `shift` [m], or the one with the best fit."""
    if shift is not None:
        return shifted_alignment(starts, map_a, map_b, rng, shift)
    return wrong_alignment(starts, map_a, map_b, rng)


def wrong_alignment(starts: FloatArray, map_a: LandmarkMap, map_b: LandmarkMap, rng: np.random.Generator) -> Alignment:
    """Return the false transform between the maps of robots 0 and 1 with the best fit, ignoring descriptors.

    Among many transforms that map two landmarks of b to two of a, it is the one with the most one-to-one pairs within
    `COINCIDENCE`; these pairs are its inliers.
    """
    truth = between(*starts[:2])
    points_a, points_b = map_a.means[:, :2], map_b.means[:, :2]
    best, pairs = np.empty(0), np.empty((0, 2), np.int64)
    for _ in range(HYPOTHESES):
        (i, j), (k, m) = rng.choice(len(points_a), 2, False), rng.choice(len(points_b), 2, False)
        side_a, side_b = points_a[j] - points_a[i], points_b[m] - points_b[k]
        if abs(np.hypot(*side_a) - np.hypot(*side_b)) > COINCIDENCE:
            continue
        angle = np.arctan2(side_a[1], side_a[0]) - np.arctan2(side_b[1], side_b[0])
        motion = np.array([*(points_a[i] - rotation(angle) @ points_b[k]), angle])
        error = between(truth, motion)
        if not is_false_merge(float(np.hypot(*error[:2])), float(abs(np.degrees(error[2])))):
            continue
        found = coinciding(points_a, points_b, motion)
        if len(found) > len(pairs):
            best, pairs = motion, found
    return claimed(best, pairs)


def shifted_alignment(
    starts: FloatArray, map_a: LandmarkMap, map_b: LandmarkMap, rng: np.random.Generator, metres: float
) -> Alignment:
    """Return the true transform shifted in a random direction, with the pairs that then coincide."""
    angle = rng.uniform(-np.pi, np.pi)
    motion = between(*starts[:2]) + metres * np.array([np.cos(angle), np.sin(angle), 0.0])
    return claimed(motion, coinciding(map_a.means[:, :2], map_b.means[:, :2], motion))


def claimed(motion: FloatArray, pairs: IntArray) -> Alignment:
    """Return an alignment that claims a certain transform (3,) and pairs (k, 2)."""
    x, y, theta = motion.tolist()
    return Alignment(True, "", x, y, theta, np.diag([1e-3, 1e-3, 1e-4]), pairs, 0.0)


def coinciding(points_a: FloatArray, points_b: FloatArray, motion: FloatArray) -> IntArray:
    """Return the rows (a, b) of points that, after moving b, are mutual nearest neighbours within `COINCIDENCE`."""
    moved = points_b @ rotation(motion[2]).T + motion[:2]
    distances = np.linalg.norm(points_a[:, None] - moved, axis=2)
    nearest = distances.argmin(axis=1)
    rows = np.arange(len(points_a))
    mutual = (distances.argmin(axis=0)[nearest] == rows) & (distances[rows, nearest] < COINCIDENCE)
    return np.asarray(np.column_stack([rows, nearest])[mutual])


def describe_merge(merge: MergeOutcome) -> str:
    """Return a line about a merge."""
    if merge.undone_after is None:
        outcome = (
            f"in force, error {merge.later_m:.2f} m {merge.later_deg:.1f} deg later, {merge.end_m:.2f} m "
            f"{merge.end_deg:.1f} deg at the end"
        )
    else:
        outcome = (
            f"undone after {merge.undone_after} steps, {'correctly' if merge.is_rightly_undone else 'WRONGLY'}, "
            f"error {merge.undone_m:.2f} m {merge.undone_deg:.1f} deg then"
        )
    return (
        f"seed {merge.seed} {merge.world} ({merge.alike}): {merge.robots_a} + {merge.robots_b} at "
        f"{merge.step}, error {merge.error_m:.2f} m {merge.error_deg:.1f} deg"
        f"{', FALSE' if merge.is_false else ''}, uncertainty {merge.doubt:.2f}, {merge.moved:.0%} moved, {outcome}"
    )


def main(
    minutes: Annotated[float, typer.Option(help="Duration in minutes; the last run is finished.")] = 10.0,
    first_seed: Annotated[int, typer.Option(help="Seed of the first run.")] = 100,
    cycles: Annotated[
        int | None, typer.Option(help="Number of steps of a run.", show_default="400, episodes 1500")
    ] = None,
    kind: Annotated[str, typer.Option(help="Kind of runs: aisles, environment or both.")] = "aisles",
    forced: Annotated[bool, typer.Option(help="Force wrong merges.")] = False,
    shift: Annotated[float | None, typer.Option(help="Shift of forced merges in metres, without rotation.")] = None,
    rejuvenate_every: Annotated[
        int | None,
        typer.Option(help="Steps between rejuvenations of a filter.", show_default="never; 50 in environments"),
    ] = None,
    straighten: Annotated[bool, typer.Option(help="Smooth maps before a merge.")] = True,
    sure: Annotated[
        float, typer.Option(help="Required certainty of a merge in standard deviations; 0: none.")
    ] = MergeOptions().min_sigmas,
    world: Annotated[list[str] | None, typer.Option(help="World family, floor plan, or folder of floor plans.")] = None,
    seeds: Annotated[int, typer.Option(help="Number of seeds of each given world.")] = 3,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all results to this file.")] = None,
) -> None:
    """Run the soak test and print its results."""
    if not minutes > 0.0:
        raise argument_error("minutes", "a number above 0", minutes, "Give minutes.")
    check_choice("kind", kind, KINDS)
    if shift is not None and not (forced and shift >= 0.0):
        raise argument_error("shift", "metres, with --forced", shift, "Add --forced, or omit it.")
    if cycles is not None:
        check_int("cycles", cycles, 2, "Give a number of steps.")
    check_int("first_seed", first_seed, 0, "Seeds are not negative.")
    check_int("seeds", seeds, 1, "Use at least one seed.")
    if world and (forced or cycles is not None):
        raise argument_error("world", "no --forced and no --cycles with it", world, "Omit them.")
    if json_file is not None:
        check_writable(json_file, "json")
    setting = Setting(
        forced=forced, shift=shift, rejuvenate_every=rejuvenate_every, straighten=straighten, sure=sure
    )  # fmt: skip
    console = Console(highlight=False, soft_wrap=True)
    merges: list[MergeOutcome] = []
    late: list[Delay] = []
    ends: list[RunEnd] = []
    steps = 0
    if world:
        runs = play_named(minutes, first_seed, world, seeds, setting)
    else:
        runs = play_random(minutes, first_seed, cycles, kind, setting)
    for (found, delayed, end), length in runs:
        merges, late, ends, steps = merges + found, late + delayed, [*ends, end], steps + length
        for merge in found:
            console.print(describe_merge(merge))
        if len(end.groups) > 1:
            console.print(f"seed {end.seed} {end.world}: groups {end.groups} at the end")
    summary = summarise(merges, late, ends, steps)
    for name, value in summary.items():
        console.print(f"{name:30s} {value}")
    record = {
        "setting": asdict(setting)
        | {"kind": kind, "minutes": minutes, "first_seed": first_seed, "worlds": world or []},
        "summary": summary,
        "merges": [asdict(merge) for merge in merges],
        "delays": [asdict(delay) for delay in late],
        "ends": [asdict(end) for end in ends],
    }
    if json_file is not None:
        write_file(json_file, json.dumps(plain(record), indent=1), "json")


if __name__ == "__main__":
    typer.run(main)
