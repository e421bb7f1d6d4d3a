"""Soak test of merges in random worlds with similar landmarks: are false merges avoided, or detected and undone?

python -m studies.merging.soak --worlds aisles,random --seeds 20
python -m studies.merging.soak --worlds aisles --forced
python -m studies.merging.soak --worlds FOLDER_OF_PLANS,maze --seeds 3
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from agents.registry import make_policy
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import between, rotation
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import MergeEvent
from slam_backend.team.team import TeamSlam
from training.commands.study import run_program
from training.episodes.config import RunConfig
from training.episodes.metrics import score_episode
from training.episodes.runner import Progress, is_false_merge, run_episode
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Row, Study
from training.stereo_runs.runs import STEP, RunSpec, simulate_run
from vslam_env import ExplorationEnv, preset_config
from vslam_env.evaluation.map_scores import FALSE, GroundTruthAssociation
from vslam_env.sensors.landmark_sensor import padded
from vslam_env.world import portable_source

AISLES, RANDOM = "aisles", "random"
FAMILIES = ("office", "loops", "maze", "hall", "fig5")
REPEATED = (0.0, 0.5, 1.0)  # shares of landmarks with a twin
RADIOS: tuple[dict[str, Any], ...] = ({}, {"comm_range": 8.0}, {"comm_line_of_sight": True}, {"comm_loss": 0.2})
LOSES, FINDS = 0.02, 0.05  # probabilities per step that a link is lost, and restored
ENOUGH = 20  # minimum landmarks of each map for a forced merge
HYPOTHESES, COINCIDENCE = 2000, 0.25  # number of hypotheses and inlier distance of forced merges [-, m]
WINDOW = 200  # steps after which a false merge counts
WHEN = {  # errors of a merge, with their names in the table
    "unsmoothed": "by unsmoothed maps", "made": "when made", "later": "200 steps later", "last": "at the end",
}  # fmt: skip


class Config(ExperimentConfig):
    """Runs of teams whose merges are observed."""

    worlds: tuple[str, ...] = option(
        (AISLES,), "aisles: stereo runs; random: episodes with random settings; or worlds of vslam run: families, "
        "floor plans, folders of plans.",
    )  # fmt: skip
    cycles: int | None = option(
        None, "Number of steps of a run in aisles, or with random settings.", shown="400; random 1500", ge=2,
        hint="Give a number of steps.",
    )  # fmt: skip
    forced: bool = option(False, "Force wrong merges, in aisles or with random settings.")
    shift: float | None = option(
        None, "Shift of forced merges [m], without rotation.", shown="the wrong transform that fits best", ge=0.0,
        hint="Give metres.",
    )  # fmt: skip
    rejuvenate_every: int | None = option(
        None, "Steps between rejuvenations of a filter.", shown="never in aisles, else 50", ge=1, hint="Give steps."
    )
    straighten: bool = option(True, "Smooth maps before a merge.")
    sure: float = option(
        MergeOptions().min_sigmas, "Required certainty of a merge in standard deviations; 0: none.", ge=0.0,
        hint="Use 0 for none.",
    )  # fmt: skip
    seeds: int = option(10, "Number of runs in each world.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()

    def check(self) -> None:
        """Refuse a shift without forced merges, and forced merges in given worlds."""
        if self.shift is not None and not self.forced:
            raise argument_error("shift", "metres, with --forced", self.shift, "Add --forced, or omit it.")
        if self.forced and (named := set(self.worlds) - {AISLES, RANDOM}):
            raise argument_error("worlds", f"{AISLES} or {RANDOM} with --forced", sorted(named), "Omit --forced.")

    @classmethod
    def completed(cls, values: Any) -> dict[str, Any]:
        """Replace folders by the sorted plans in them, and make paths absolute."""
        found: list[str] = []
        for world in values.get("worlds", (AISLES,)):
            plans = sorted(map(str, Path(world).glob("*.png"))) if Path(world).is_dir() else [world]
            found += plans if world in (AISLES, RANDOM) else map(portable_source, plans)
        return {**values, "worlds": tuple(found)}

    @property
    def merging(self) -> dict[str, Any]:
        """Merge options."""
        return {"smooth_first": self.straighten, "min_sigmas": self.sure}

    @property
    def filter(self) -> dict[str, Any]:
        """Filter options that differ from the defaults of environments."""
        return {} if self.rejuvenate_every is None else {"rejuvenate_every": self.rejuvenate_every}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One run."""

    world: str
    seed: int


def trials(config: Config) -> list[Trial]:
    """Return all trials."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [Trial(world=world, seed=seed) for world, seed in product(config.worlds, seeds)]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run a team and observe its merges.

    Returns:
        Numbers of `steps`, and of `groups` at the end; whether that is `one_group`; `ate_m` after the best fit, the
        mean over the robots, None if it is not known; `put_off`: attempts with an alignment of the unsmoothed maps, but
        not of the smoothed ones; `merges`, as `Follower` has them.
    """
    how = {AISLES: play_aisles, RANDOM: play_random}.get(trial.world, play_world)
    team, follower, steps, ate_m = how(config, trial)
    put_off = [e for e in team.events if e.unsmoothed_alignment is not None and not e.alignment.success]
    return {
        "steps": steps, "groups": len(team.groups), "one_group": len(team.groups) == 1, "ate_m": ate_m,
        "put_off": len(put_off), "merges": list(follower.merges.values()),
    }  # fmt: skip


# ---------------------------------------------------------------------- runs

Run = tuple[TeamSlam, "Follower", int, float | None]  # team, observer, number of steps, ATE [m]


def play_aisles(config: Config, trial: Trial) -> Run:
    """Run a team on a stereo run through an office of aisles.

    Classes of one to three landmarks look the same, and there are false points and wrong descriptors.
    """
    rng = np.random.default_rng([trial.seed, 17])
    robots, look_alikes = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    spec = RunSpec(
        robots=robots, length=(config.cycles or 400) * STEP, measurements=5 * robots, association="unknown",
        look_alikes=look_alikes,
    )  # fmt: skip
    run = simulate_run(spec, trial.seed)
    noise = spec.noise
    camera = replace(noise.camera, sigma_px=2 * noise.sigma_px, sigma_disparity_px=2 * noise.sigma_disparity_px)
    team = TeamSlam(
        robots, seed=trial.seed, attempts=AttemptOptions(enabled=not config.forced),
        merging=MergeOptions(**config.merging), num_particles=50, camera=camera, motion=noise.motion,
        rejuvenate_every=config.rejuvenate_every,
    )  # fmt: skip
    starts = run.true_paths[:, 0]
    ground_truth = GroundTruthAssociation(
        robots, run.landmarks, np.ones(len(run.landmarks), dtype=np.bool_), cutoff=1.0
    )
    follower = Follower(team, ground_truth, starts)
    broken = not config.forced and rng.random() < 0.5
    up = np.ones((robots, robots), dtype=np.bool_)
    for step, (reading, names) in enumerate(zip(run.readings(), run.names, strict=True)):
        if broken:
            change = np.triu(np.where(up, rng.random(up.shape) < LOSES, rng.random(up.shape) < FINDS), 1)
            up = up ^ (change | change.T)
        ground_truth.record(team.step(reading["odometry"], reading["measurements"], up), padded(names))
        if config.forced and not team.events and min(len(team.map(robot)) for robot in range(2)) >= ENOUGH:
            team.merge(0, 1, forced_alignment(starts, team.map(0), team.map(1), rng, config.shift))
        follower.note(step)
    return team, follower, run.num_steps, None


def random_env(config: Config, seed: int) -> ExplorationEnv:
    """Return the environment of an episode, which the seed determines completely."""
    rng = np.random.default_rng([seed, 17])
    return ExplorationEnv(preset_config("standard").replace(
        world=str(rng.choice(FAMILIES)), num_robots=int(rng.integers(2, 5)), max_cycles=config.cycles or 1500,
        landmarks={"repeated": float(rng.choice(REPEATED))},
        belief={"attempts": {"enabled": not config.forced}, "merging": config.merging, "filter": config.filter},
        **({} if config.forced else RADIOS[int(rng.integers(len(RADIOS)))]),
    ))  # fmt: skip


def play_random(config: Config, trial: Trial) -> Run:
    """Run an episode in a random world family, in which up to all landmarks have a twin and links may fail."""
    env = random_env(config, trial.seed)
    rng = np.random.default_rng([trial.seed, 18])
    policies = {agent: make_policy("frontier", env.config.action_type) for agent in env.possible_agents}
    observations, _ = env.reset(seed=trial.seed)
    follower = Follower(env.episode.belief.team, env.episode.ground_truth, env.true_start_poses)
    while env.agents:
        if config.forced and not env.events:
            force(env, rng, config.shift)
        actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        observations = env.step(actions)[0]
        follower.note(env.episode.tick - 1)
    return env.episode.belief.team, follower, env.episode.tick, None


def play_world(config: Config, trial: Trial) -> Run:
    """Run the episode of `vslam run` in a world."""
    run = RunConfig(world=trial.world, seed=trial.seed)
    env = ExplorationEnv(run.environment().replace(belief={"merging": config.merging, "filter": config.filter}))
    followers: list[Follower] = []

    def note(progress: Progress) -> None:
        if followers:
            followers[0].note(env.episode.tick - 1)
        else:
            followers.append(Follower(env.episode.belief.team, env.episode.ground_truth, env.true_start_poses))

    record = run_episode(env, run.make_policies(env), trial.seed, note)
    return env.episode.belief.team, followers[0], env.episode.tick, score_episode(record)["team"]["ate_aligned_m"]


class Follower:
    """Observer of the merges of a run, step by step.

    A merge can be wrong in two ways. Its pairs may not be the same landmarks. And the transform between the groups'
    start frames may have an error although all pairs are right, if the path from a start to the shared landmarks has
    an error: this error exists before the merge, which reveals it.

    Args:
        team: Team whose merges are observed.
        ground_truth: True landmark of each landmark in the maps.
        starts: (K, 3) true start poses, world frame.

    Attributes:
        merges: Records by number of the event: `step`, `robots_a`, `robots_b`; `wrong_pairs`, the share of merged pairs
            that are two landmarks in truth; `uncertainty` of the attempt that led to it; `undone_after`, in steps;
            errors as `[m, degrees]` of the transform: by the `unsmoothed` maps, when `made`, and in the joint filter
            `later`, at most 200 steps, and `last`, at the end or just before it was undone. What is unknown is None.
    """

    def __init__(self, team: TeamSlam, ground_truth: GroundTruthAssociation, starts: FloatArray) -> None:
        self._team, self._ground_truth, self._starts = team, ground_truth, starts
        self.merges: dict[int, dict[str, Any]] = {}

    def note(self, step: int) -> None:
        """Update the records after a step."""
        events = self._team.events
        undone = {id(event.alignment): event.step for event in events if event.kind == "undo"}
        for number, event in enumerate(events):
            if event.kind != "merge":
                continue
            merge = self.merges.get(number) or self.merges.setdefault(number, self._begun(event, events[:number]))
            if id(event.alignment) not in undone:
                merge["last"] = self._error_now(event)
                if step - event.step <= WINDOW:
                    merge["later"] = merge["last"]
            elif merge["undone_after"] is None:
                after = merge["undone_after"] = undone[id(event.alignment)] - event.step
                merge["later"] = None if after <= WINDOW else merge["later"]

    def _begun(self, event: MergeEvent, before: Sequence[MergeEvent]) -> dict[str, Any]:
        """Return the record of a new merge; the events before it include the attempt that led to it, if any."""
        attempt = next((earlier for earlier in before if earlier.alignment is event.alignment), None)
        unsmoothed = None if attempt is None else attempt.unsmoothed_alignment
        return {
            "step": event.step, "robots_a": event.robots_a, "robots_b": event.robots_b,
            "wrong_pairs": self._share_of_wrong_pairs(event),
            "uncertainty": None if attempt is None else attempt.uncertainty, "undone_after": None,
            "unsmoothed": None if unsmoothed is None else self._error(event, unsmoothed.transform),
            "made": self._error(event, event.alignment.transform), "later": None, "last": None,
        }  # fmt: skip

    def _error_now(self, merge: MergeEvent) -> tuple[float, float]:
        """Return the error [m, degrees] of the transform between the groups' frames in their joint filter."""
        trunk = self._team._group_of(merge.robots_a[0]).trunk
        robots = (group[0] for group in (merge.robots_a, merge.robots_b))
        return self._error(merge, between(*(trunk.filter.start_pose(trunk.robots.index(robot)) for robot in robots)))

    def _error(self, merge: MergeEvent, motion: FloatArray) -> tuple[float, float]:
        """Return the error [m, degrees] of a transform between two groups' frames."""
        error = between(between(self._starts[merge.robots_a[0]], self._starts[merge.robots_b[0]]), motion)
        return float(np.hypot(*error[:2])), float(abs(np.degrees(error[2])))

    def _share_of_wrong_pairs(self, merge: MergeEvent) -> float | None:
        """Return the share of wrong pairs of a new merge; pairs with false points are wrong."""
        sides = next(one.sides for one in self._team._merges.watched if one.alignment is merge.alignment)
        claims = []
        for side, joined, rows in zip(sides, self._team.merged_maps(merge), merge.alignment.inliers.T, strict=True):
            claims.append(self._ground_truth.claims_of(side["number"], joined.ids[rows]))
        return float(np.mean((claims[0] != claims[1]) | (claims[0] == FALSE))) if len(claims[0]) else None


# ---------------------------------------------------------------------- forced merges


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


# ---------------------------------------------------------------------- results


def is_false(merge: Row, when: str = "made") -> bool:
    """Return whether the error of a merge exceeds 0.5 m or 5 degrees."""
    return merge[when] is not None and is_false_merge(*merge[when])


def is_wrongly_undone(merge: Row) -> bool:
    """Return whether a merge was undone that was right when made and at its undo."""
    return merge["undone_after"] is not None and not is_false(merge) and not is_false(merge, "last")


def counts(merge: Row) -> bool:
    """Return whether a merge is false and persisted for 200 steps, or until the end."""
    return is_false(merge) and (merge["undone_after"] is None or merge["undone_after"] > WINDOW)


def _number(test: Any, rows: Sequence[Row]) -> int:
    return sum(map(test, _merges(rows)))


def _merges(rows: Sequence[Row]) -> Iterator[Row]:
    return (merge for row in rows for merge in row["merges"])


def unfold(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of runs, and a row for each known error of each merge."""
    return [*rows] + [
        {"world": row["world"], "seed": row["seed"], "when": name, "error_m": merge[when][0],
         "error_deg": merge[when][1]}
        for row in rows for merge in row["merges"] for when, name in WHEN.items() if merge[when] is not None
    ]  # fmt: skip


def _rms(rows: Sequence[Row]) -> float:
    return float(np.sqrt(np.mean([row["error_m"] ** 2 for row in rows])))


STUDY = Study(
    name="merge_soak",
    about="""Run teams among similar landmarks, and follow their merges.

    A merge is false if its error exceeds 0.5 m or 5 degrees; it counts if it persists for 200 steps or until the end.
    With --forced robots do not merge by themselves: once two maps are large enough they are merged with the wrong
    transform that fits them best, or with the true one shifted, and the question is how many of these merges the team
    undoes, and when. Ctrl-C finishes the current run and summarises the finished ones; the same command with --out
    FOLDER resumes.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    unfold=unfold,
    quick={"seeds": 1, "cycles": 120},
    tables=(
        ResultTable(
            name="runs", title="Merges", by=("world",), pooled=("world",), where=lambda row: "merges" in row,
            words={"world": ("world", lambda world: Path(world).stem)},
            columns=(
                Column("runs", statistic=len, digits=0), Column("one_group", "in one", "sum", digits=0),
                Column("merges", statistic=partial(_number, lambda merge: True), digits=0),
                Column("false", statistic=partial(_number, is_false), digits=0),
                Column("counts", "after 200", partial(_number, counts), digits=0),
                Column("undone", statistic=partial(_number, lambda m: m["undone_after"] is not None), digits=0),
                Column("wrongly", statistic=partial(_number, is_wrongly_undone), digits=0),
                Column("wrong_pairs", "wrong pairs", partial(_number, lambda m: bool(m["wrong_pairs"])), digits=0),
                Column("put_off", "put off", "sum", digits=0), Column("ate_m", "ATE [m]", digits=3),
            ),
        ),
        ResultTable(
            name="errors", title="Errors of merges", by=("when",), where=lambda row: "when" in row,
            columns=(
                Column("merges", statistic=len, digits=0), Column("error_m", "RMS [m]", _rms),
                Column("error_m", "95 % [m]", "p95", digits=2), Column("error_m", "worst [m]", "worst", digits=2),
                Column("error_deg", "worst [deg]", "worst", digits=1),
                Column("false", statistic=lambda rows: sum(is_false_merge(r["error_m"], r["error_deg"]) for r in rows),
                       digits=0),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
