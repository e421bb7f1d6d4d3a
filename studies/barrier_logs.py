"""Simulated logs of robots among barriers, and results of filters with and without rejuvenation.

    python -m studies.barrier_logs              # one robot
    python -m studies.barrier_logs --team 3     # three robots that merge

Robots drive at up to 0.3 m/s and 30 degrees/s in a hall of 15 x 8 m with 15 landmarks of known identity. Walls block
the line of sight; one or two measurements per second are read. Noise of odometry and measurements is like that of
MR.CLAM, and filters make the assumptions of the replay of MR.CLAM.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer

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
from training.replay.core import PARTICLES_PER_ROBOT
from training.replay.readers import GATES, MAX_SIGMA_HEADING, MOTION, POSITION_FLOOR

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


def live(log: BarrierLog, seed: int, **options: Any) -> dict[str, float]:
    """Run a filter on a log.

    Returns:
        Map error after the best fit [m], spread of landmarks over the particles [m], mean NIS, and whether the filter
        raised a warning.
    """
    slam = FastSlam(motion=MOTION, seed=seed, **(GATES["given"] | options))
    for step, (move, frame, names) in enumerate(zip(log.odometry, log.frames, log.identities, strict=True)):
        slam.step([move if step else None], [frame], [names])
    consistency = slam.consistency
    maps = slam.maps
    means = maps.dense(maps.used_slots())[0][:, :3]
    return {
        "map": map_error(log, slam),
        "spread": float(np.sqrt(means[:, :2].var(axis=2).sum(axis=1).mean())),
        "nis": consistency.nis_mean,
        "warned": float(bool(consistency.warnings)),
    }


def map_error(log: BarrierLog, slam: FastSlam) -> float:
    """Return the RMS error [m] of a filter's map after the best fit; landmarks have known identities."""
    landmarks, maps = slam.map(), slam.maps
    slots = maps.used_slots()
    names = maps.identities[slots][np.searchsorted(maps.ids[slots], landmarks.ids)]
    true = log.landmarks[names]
    moved = landmarks.moved(align_se2(true, landmarks.means[:, :2]))
    return float(np.sqrt(((moved.means[:, :2] - true) ** 2).sum(axis=1).mean()))


def live_as_team(logs: list[BarrierLog], seed: int, rejuvenate_every: int | None) -> tuple[int, list[int], float]:
    """Run a team on the logs of its robots; return number of groups, sizes of their maps, and the mean error."""
    team = TeamSlam(
        len(logs),
        alignment=AlignmentOptions(
            position_floor=POSITION_FLOOR,
            min_inliers=NUM_LANDMARKS - MISSING,
            max_sigma_heading=MAX_SIGMA_HEADING,
        ),
        attempts=AttemptOptions(new_candidates=1),
        seed=seed,
        num_particles=PARTICLES_PER_ROBOT * len(logs),
        motion=MOTION,
        rejuvenate_every=rejuvenate_every,
        **GATES["given"],
    )
    for step in range(len(logs[0].truth)):
        moves = [log.odometry[step] if step else None for log in logs]
        team.step(moves, [log.frames[step] for log in logs], identities=[log.identities[step] for log in logs])
    filters = [group.trunk.filter for group in team._groups]
    return len(filters), [slam.map_size for slam in filters], float(np.mean([map_error(logs[0], s) for s in filters]))


CONDITIONS: dict[str, dict[str, Any]] = {
    "as assumed": {},
    "odometry noise twice the assumed one": {"odometry_scale": 2.0},
    "field of view of 180 degrees": {"view": math.radians(90.0)},
    "no walls": {"num_walls": 0},
    "4 measurements per second": {"rate": 4.0},
    "0.1 m/s, 10 degrees/s": {"speed": 0.1, "turn": math.radians(10.0)},
}
FILTERS: dict[str, dict[str, Any]] = {
    "100 particles": {"rejuvenate_every": None},
    "1,000 particles": {"num_particles": 1000, "rejuvenate_every": None},
    "rejuvenated": {"rejuvenate_every": 100},
}


def main(
    seeds: Annotated[int, typer.Option(help="Halls.")] = 12,
    team: Annotated[int, typer.Option(help="Number of robots in a team; 0: a single robot.")] = 0,
    odometry_scale: Annotated[
        float, typer.Option(help="Odometry noise of a team, relative to the assumed noise.")
    ] = 1.0,
) -> None:
    """Print map errors under several conditions, as mean (min-max), and the share of filters with a warning."""
    if team:
        for seed in range(seeds):
            logs = simulate(seed, robots=team, odometry_scale=odometry_scale)
            for every in (None, 100):
                groups, sizes, error = live_as_team(logs, seed, every)
                print(f"hall {seed}, every {every}: {groups} groups, landmarks {sizes}, map error {error:.2f} m")
        return
    for condition, changes in CONDITIONS.items():
        logs = [simulate(seed, **changes)[0] for seed in range(seeds)]
        for name, options in FILTERS.items():
            rows = [live(log, seed, **options) for seed, log in enumerate(logs)]
            off = np.array([row["map"] for row in rows])
            mean = {key: np.mean([row[key] for row in rows]) for key in ("spread", "nis", "warned")}
            print(
                f"{condition:34} {name:16} map {off.mean():.3f} ({off.min():.3f}-{off.max():.3f}) m, "
                f"spread {mean['spread']:.3f} m, NIS {mean['nis']:.2f}, warned {mean['warned']:.0%}",
                flush=True,
            )


if __name__ == "__main__":
    typer.run(main)
