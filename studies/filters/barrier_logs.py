"""Maps of filters with and without rejuvenation, on simulated logs of robots among barriers.

python -m studies.filters.barrier_logs --seeds 12
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between, compose, wrap_angle
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.metrics import align_se2
from slam_backend.models.measurements import Measurements
from slam_backend.readers.conversions import points_from_polar
from slam_backend.readers.mrclam import SightingNoise
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, RobotCount, first_seed, option
from training.experiments.study import Column, ResultTable, Study
from training.replay.core import PARTICLES_PER_ROBOT
from training.replay.readers import GATES, MAX_SIGMA_HEADING, MOTION, POSITION_FLOOR

Condition = Literal["assumed", "odometry", "wide", "open", "often", "slow"]
CONDITIONS: dict[Condition, dict[str, Any]] = {
    "assumed": {},
    "odometry": {"odometry_scale": 2.0},  # noise twice the assumed one
    "wide": {"view": math.radians(90.0)},  # field of view of 180 degrees
    "open": {"num_walls": 0},
    "often": {"rate": 4.0},  # measurements per second
    "slow": {"speed": 0.1, "turn": math.radians(10.0)},
}
FILTERS: dict[str, dict[str, Any]] = {
    "100 particles": {"rejuvenate_every": None},
    "1,000 particles": {"num_particles": 1000, "rejuvenate_every": None},
    "rejuvenated": {"rejuvenate_every": 100},
}
TEAM_FILTERS = ("100 particles", "rejuvenated")  # with `PARTICLES_PER_ROBOT` for each robot
DT = 0.25  # [s]
HALL = np.array([15.0, 8.0])  # [m]
NUM_LANDMARKS = 15
NEAREST, FARTHEST = 0.5, 6.0  # limits of measured ranges [m]
MISSING = 1  # landmarks that merged maps need not share, as in the replay of MR.CLAM
MARGIN = 0.3  # distance that robots keep from walls [m]
TRUE_SHARE = 0.5  # true over assumed noise of the measurements, as in MR.CLAM
LASTING = 4.0  # correlation time of measurement errors (to 1 / e) [s]


@dataclass(frozen=True, slots=True, eq=False)
class BarrierLog:
    """Motion and readings of one robot in T steps.

    Attributes:
        landmarks: (15, 2) float64 [m]. Positions of the landmarks.
        walls: (w, 2, 2) float64 [m]. End points of the walls.
        truth: (T, 3) float64 [m, m, rad]. True poses.
        odometry: (T, 3) float64 [m, m, rad]. Odometry readings.
        frames: Measurements of the T steps, None where nothing was seen.
        identities: Names of the measured landmarks, one row each.
    """

    landmarks: FloatArray
    walls: FloatArray
    truth: FloatArray
    odometry: FloatArray
    frames: tuple[Measurements | None, ...]
    identities: tuple[IntArray | None, ...]


def crosses(p: FloatArray, q: FloatArray, walls: FloatArray) -> BoolArray:
    """Return whether a wall (w, 2, 2) lies between points p (2,) and q (n, 2): (n,)."""
    a, b = walls[:, 0], walls[:, 1]
    q = np.atleast_2d(q)[:, None]

    def side(o: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
        return (u[..., 0] - o[..., 0]) * (v[..., 1] - o[..., 1]) - (u[..., 1] - o[..., 1]) * (v[..., 0] - o[..., 0])

    one = side(p, q, a) * side(p, q, b) < 0.0
    two = side(a, b, p) * side(a, b, q) < 0.0
    return np.asarray((one & two).any(axis=1))


def wall_distance(p: FloatArray, walls: FloatArray) -> float:
    """Return the distance of the nearest wall (w, 2, 2) from p (2,) [m]."""
    a, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    t = np.clip(((p - a) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.hypot(*(p - a - t[:, None] * along).T).min())


def make_hall(num_walls: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return landmarks (15, 2) and walls (w, 2, 2) [m]; without walls, a single distant one."""
    walls = np.full((max(num_walls, 1), 2, 2), [[-90.0, -90.0], [-91.0, -90.0]])
    for k in range(num_walls):
        middle, turn, half = rng.uniform([1.5, 1.5], HALL - 1.5), rng.uniform(0.0, math.pi), rng.uniform(0.8, 1.6)
        walls[k] = middle + half * np.array([[-1.0], [1.0]]) * [math.cos(turn), math.sin(turn)]
    landmarks: list[FloatArray] = []
    while len(landmarks) < NUM_LANDMARKS:
        p = rng.uniform([0.3, 0.3], HALL - 0.3)
        if wall_distance(p, walls) > 0.2 and all(np.hypot(*(p - other)) > 0.8 for other in landmarks):
            landmarks.append(p)
    return np.array(landmarks), walls


def drive(walls: FloatArray, steps: int, speed: float, turn: float, rng: np.random.Generator) -> FloatArray:
    """Return the true poses (T, 3) of a robot that drives between random points in its line of sight."""

    def free() -> FloatArray:
        while True:
            p = rng.uniform([0.6, 0.6], HALL - 0.6)
            if wall_distance(p, walls) > MARGIN:
                return p

    def in_sight(p: FloatArray) -> FloatArray:
        for _ in range(500):
            q = free()
            way = p + np.linspace(0.0, 1.0, 40)[:, None] * (q - p)
            if np.hypot(*(q - p)) > 1.0 and min(wall_distance(w, walls) for w in way[4:]) > MARGIN:
                return q
        return free()

    pose, goal = np.array([*free(), rng.uniform(-math.pi, math.pi)]), None
    poses = np.empty((steps, 3))
    for k in range(steps):
        poses[k] = pose
        if goal is None or np.hypot(*(goal - pose[:2])) < 0.25:
            goal = in_sight(pose[:2])
        off = float(wrap_angle(math.atan2(*(goal - pose[:2])[::-1]) - pose[2]))
        ahead = speed if abs(off) < 0.6 else 0.0
        pose = compose(pose, np.array([ahead * DT, 0.0, np.clip(off, -turn * DT, turn * DT)]))
    return poses


def simulate(
    seed: int, robots: int = 1, duration: float = 900.0, *, odometry_scale: float = 1.0, num_walls: int = 8,
    view: float = math.radians(30.0), rate: float = 1.5, speed: float = 0.3, turn: float = math.radians(30.0),
) -> list[BarrierLog]:  # fmt: skip
    """Return the logs of several robots in one hall.

    Args:
        seed: Seed of the hall and all noise.
        robots: Number of robots.
        duration: Length of the logs [s].
        odometry_scale: Factor on the noise of the odometry that filters assume [-].
        num_walls: Number of walls.
        view: Half the field of view [rad].
        rate: Number of measurement steps per second.
        speed: Maximum speed [m/s].
        turn: Maximum turn rate [rad/s].
    """
    rng = np.random.default_rng(seed)
    landmarks, walls = make_hall(num_walls, rng)
    steps = int(duration / DT)
    noise = SightingNoise()
    logs = []
    for _ in range(robots):
        truth = drive(walls, steps, speed, turn, rng)
        moves = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
        sigmas = np.array([MOTION.sigmas(move) for move in moves]) * odometry_scale
        odometry = moves + sigmas * rng.standard_normal((steps, 3))
        odometry[0] = 0.0
        errors = rng.standard_normal((NUM_LANDMARKS, 2))  # errors of each landmark's range and bearing, in sigmas
        keep = math.exp(-DT / LASTING)
        frames: list[Measurements | None] = []
        seen: list[IntArray | None] = []
        for k in range(steps):
            errors = keep * errors + math.sqrt(1.0 - keep**2) * rng.standard_normal(errors.shape)
            away = landmarks - truth[k, :2]
            ranges, bearings = np.hypot(*away.T), wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - truth[k, 2])
            inside = (np.abs(bearings) < view) & (ranges > NEAREST) & (ranges < FARTHEST)
            inside &= ~crosses(truth[k, :2], landmarks, walls)
            rows = np.flatnonzero(inside) if rng.random() < rate * DT else np.empty(0, np.int64)
            if not len(rows):
                frames.append(None)
                seen.append(None)
                continue
            variances = noise.variances(ranges[rows])
            off = TRUE_SHARE * np.sqrt(variances[:, :2]) * errors[rows]
            points, covariances = points_from_polar(ranges[rows] + off[:, 0], bearings[rows] + off[:, 1], variances)
            frames.append(Measurements(points, np.eye(NUM_LANDMARKS, dtype=np.float32)[rows], covariances))
            seen.append(rows)
        logs.append(BarrierLog(landmarks, walls, truth, odometry, tuple(frames), tuple(seen)))
    return logs


class Config(ExperimentConfig):
    """Logs of robots in halls with walls."""

    conditions: tuple[Condition, ...] = option(
        tuple(CONDITIONS), "Conditions: assumed, odometry (twice the noise), wide (180 degrees), open (no walls), "
        "often (4 measurements a second), slow (0.1 m/s).",
    )  # fmt: skip
    robots: tuple[RobotCount, ...] = option((1,), "Numbers of robots in a hall; several merge.")
    duration: float = option(900.0, "Length of the logs [s].", gt=0.0, hint="Give seconds.")
    seeds: int = option(12, "Number of halls.", ge=1, hint="Use at least one hall.")
    seed: int = first_seed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One filter, or one team, on the logs of a hall."""

    condition: Condition
    robots: int
    filter: str  # Name in `FILTERS`
    seed: int  # Seed of the hall, all noise and the filter


def trials(config: Config) -> list[Trial]:
    """Return all trials."""
    return [
        Trial(condition=condition, robots=robots, filter=name, seed=seed)
        for condition, robots in product(config.conditions, config.robots)
        for name in (FILTERS if robots == 1 else TEAM_FILTERS)
        for seed in range(config.seed, config.seed + config.seeds)
    ]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run a filter, or a team, on the logs of a hall.

    Returns:
        Number of `groups` at the end; means over their filters of the map error after the best fit `map_rmse_m`, the
        spread of landmarks over the particles `spread_m`, and the mean NIS `nis`; whether one `warned`.
    """
    logs = simulate(trial.seed, trial.robots, config.duration, **CONDITIONS[trial.condition])
    filters = run_team(logs, trial) if trial.robots > 1 else [run_alone(logs[0], trial)]
    consistencies = [slam.consistency for slam in filters]
    return {
        "groups": len(filters), "map_rmse_m": float(np.mean([map_error(logs[0], slam) for slam in filters])),
        "spread_m": float(np.mean([spread(slam) for slam in filters])),
        "nis": float(np.mean([consistency.nis_mean for consistency in consistencies])),
        "warned": any(consistency.warnings for consistency in consistencies),
    }  # fmt: skip


def run_alone(log: BarrierLog, trial: Trial) -> FastSlam:
    """Return a filter after a log."""
    slam = FastSlam(motion=MOTION, seed=trial.seed, **(GATES["given"] | FILTERS[trial.filter]))
    for step, (move, frame, names) in enumerate(zip(log.odometry, log.frames, log.identities, strict=True)):
        slam.step([move if step else None], [frame], [names])
    return slam


def run_team(logs: list[BarrierLog], trial: Trial) -> list[FastSlam]:
    """Return the filters of a team's groups after the logs of its robots."""
    team = TeamSlam(
        len(logs), seed=trial.seed, num_particles=PARTICLES_PER_ROBOT * len(logs), motion=MOTION,
        alignment=AlignmentOptions(
            position_floor=POSITION_FLOOR, min_inliers=NUM_LANDMARKS - MISSING, max_sigma_heading=MAX_SIGMA_HEADING
        ),
        attempts=AttemptOptions(new_candidates=1), **(FILTERS[trial.filter] | GATES["given"]),
    )  # fmt: skip
    for step in range(len(logs[0].truth)):
        moves = [log.odometry[step] if step else None for log in logs]
        team.step(moves, [log.frames[step] for log in logs], identities=[log.identities[step] for log in logs])
    return [group.trunk.filter for group in team._groups]


def spread(slam: FastSlam) -> float:
    """Return the spread of the landmarks over the particles [m]."""
    maps = slam.maps
    means = maps.dense(maps.used_slots())[0][:, :3]
    return float(np.sqrt(means[:, :2].var(axis=2).sum(axis=1).mean()))


def map_error(log: BarrierLog, slam: FastSlam) -> float:
    """Return the RMS error [m] of a filter's map after the best fit; landmarks have known identities."""
    landmarks, maps = slam.map(), slam.maps
    slots = maps.used_slots()
    names = maps.identities[slots][np.searchsorted(maps.ids[slots], landmarks.ids)]
    true = log.landmarks[names]
    moved = landmarks.moved(align_se2(true, landmarks.means[:, :2]))
    return float(np.sqrt(((moved.means[:, :2] - true) ** 2).sum(axis=1).mean()))


STUDY = Study(
    name="barrier_logs",
    about="""Map halls with walls by filters with and without rejuvenation.

    Robots drive at up to 0.3 m/s and 30 degrees/s in a hall of 15 x 8 m with 15 landmarks of known identity. Walls
    block the line of sight; one or two measurements per second are read. Noise of odometry and measurements is like
    that of MR.CLAM, and filters make the assumptions of the replay of MR.CLAM.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    quick={"seeds": 2, "duration": 100.0},
    tables=(
        ResultTable(
            name="maps", title="Maps of halls with walls", by=("condition", "robots", "filter"),
            each=("condition", "robots"), words={"robots": ("robots", lambda robots: f"K = {robots}")},
            columns=(
                Column("map_rmse_m", "map [m]", interval=True), Column("map_rmse_m", "least [m]", "least"),
                Column("map_rmse_m", "most [m]", "worst"), Column("spread_m"), Column("nis", "NIS", digits=2),
                Column("warned", "warned [%]", digits=0, factor=100.0), Column("groups", digits=1),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
