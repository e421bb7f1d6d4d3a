"""False loop closures in look-alike corridors: does a filter take a corridor for the one that looks the same?

python -m studies.filters.false_closures --trials 1000
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between, wrap_angle
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Study
from vslam_env.belief.belief import default_filter_options
from vslam_env.sensors.landmark_sensor import LandmarkSensor, LandmarkSensorConfig
from vslam_env.world import LandmarkConfig, Landmarks, OdometryNoise, World
from vslam_env.world.landmarks import draw_descriptors
from vslam_env.world.odometry import draw_bias, read_odometry

Kind = Literal["seen", "blind", "turned"]
KINDS: tuple[Kind, ...] = get_args(Kind)
WIDTH = 3.0  # of corridors [m]
LENGTHS, PITCHES = (6.0, 10.0), (4.0, 7.0)  # ranges of the length of corridors, and of their distance [m]
# Short walls across a corridor: length [m], range of the distance to the next one [m], landmarks per metre of face.
# Cameras see no wall along which they move.
RIB, GAPS, RIB_DENSITY = 0.9, (1.0, 2.0), 2.5
STEP, TURN = 0.1, 0.15  # largest motion in a tick [m, rad]
CLOSING, WITHIN = 3, 10  # wrong matches that count as a false closure, in so many ticks
LONG_UNSEEN = 100  # ticks after which a landmark that is matched again closes a loop
FAR = 4.0  # standard deviations of the offset to the copy within which a trial counts as ambiguous


class Config(ExperimentConfig):
    """Drives through look-alike corridors."""

    trials: int = option(1000, "Number of drives.", ge=1, hint="Use at least one drive.")
    seed: int = first_seed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One drive."""

    kind: Kind  # Kind of the corridors
    seed: int  # Seed of corridors and noise


def trials(config: Config) -> list[Trial]:
    """Return all trials; kinds alternate."""
    seeds = range(config.seed, config.seed + config.trials)
    return [Trial(kind=KINDS[seed % len(KINDS)], seed=seed) for seed in seeds]


@dataclass(frozen=True, slots=True, eq=False)
class Corridors:
    """Two look-alike corridors, and a path through both."""

    world: World
    landmarks: Landmarks
    path: FloatArray  # (T, 3) float64 [m, m, rad], world frame
    in_b: int  # First tick in B
    back: int  # First tick on the way back through A


def rectangle(x1: float, y1: float, x2: float, y2: float) -> list[list[float]]:
    """Return the four walls of an axis-parallel rectangle."""
    return [[x1, y1, x2, y1], [x2, y1, x2, y2], [x2, y2, x1, y2], [x1, y2, x1, y1]]


def drive(points: Sequence[tuple[float, float]]) -> tuple[FloatArray, list[int]]:
    """Return the poses (T, 3) of a robot that drives from point to point and turns on the spot; ticks of arrival."""
    poses, arrivals = [np.array([*points[0], np.arctan2(*np.subtract(points[1], points[0])[::-1])])], [0]
    for a, b in pairwise(points):
        way = np.subtract(b, a)
        heading = float(np.arctan2(way[1], way[0]))
        turn = float(wrap_angle(heading - poses[-1][2]))
        for share in np.linspace(0.0, 1.0, int(np.ceil(abs(turn) / TURN)) + 1)[1:]:
            poses.append(np.array([*a, wrap_angle(heading - (1.0 - share) * turn)]))
        for share in np.linspace(0.0, 1.0, int(np.ceil(np.hypot(*way) / STEP)) + 1)[1:]:
            poses.append(np.array([*(np.asarray(a) + share * way), heading]))
        arrivals.append(len(poses) - 1)
    return np.array(poses), arrivals


def ribs_of(length: float, rng: np.random.Generator) -> FloatArray:
    """Return short walls (n, 4) across a corridor from (0, 0) to (length, 0), which protrude from one side each."""
    half = 0.5 * WIDTH
    gaps = rng.uniform(*GAPS, int(length / GAPS[0]))
    x = half + np.cumsum(gaps)
    x = x[x < length - half]
    side = rng.choice([-1.0, 1.0], len(x))
    return np.column_stack([x, side * half, x, side * (half - RIB)])


def points_on(walls: FloatArray, per_metre: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, IntArray]:
    """Draw landmarks on both faces of walls (n, 4): positions (m, 3), normals (m, 2), and the wall of each (m,)."""
    ways = walls[:, 2:] - walls[:, :2]
    lengths = np.hypot(*ways.T)
    owner = np.repeat(np.arange(len(walls)), np.ceil(2.0 * per_metre * lengths).astype(int))
    planar = walls[owner, :2] + rng.uniform(size=len(owner))[:, None] * ways[owner]
    normals = np.column_stack([-ways[:, 1], ways[:, 0]]) / lengths[:, None]
    heights = rng.uniform(LandmarkConfig().min_height, LandmarkConfig().max_height, len(owner))
    return np.column_stack([planar, heights]), normals[owner] * rng.choice([-1.0, 1.0], (len(owner), 1)), owner


def build_corridors(kind: Kind, length: float, pitch: float, rng: np.random.Generator) -> Corridors:
    """Build three corridors along x, joined at both ends: A at y = 0, B at y = pitch, and the way round beyond B."""
    half = 0.5 * WIDTH
    outline = rectangle(-half, -half, length + half, 2.0 * pitch + half)
    for row in (0, 1):
        outline += rectangle(half, row * pitch + half, length - half, (row + 1) * pitch - half)
    ribs, shift = ribs_of(length, rng), np.array([0.0, pitch])
    positions, normals, owner = points_on(ribs, RIB_DENSITY, rng)
    turn, planar = (-1.0, np.array([length, pitch])) if kind == "turned" else (1.0, shift)
    copied = turn * ribs + np.tile(planar, 2)
    copies = np.column_stack([turn * positions[:, :2] + planar, positions[:, 2]])
    own_ribs = ribs_of(length, rng) + np.tile(2.0 * shift, 2)
    others = np.vstack([own_ribs, np.array(outline)[[1, 3]]])  # of the way round, and the walls at both ends
    rest, rest_normals, rest_owner = points_on(others, RIB_DENSITY, rng)
    if kind != "seen":
        rest, rest_normals, rest_owner = rest[:0], rest_normals[:0], rest_owner[:0]
    descriptors = draw_descriptors(len(positions) + len(rest), LandmarkConfig(), rng)
    of_copies, first = descriptors[: len(positions)], len(outline)
    of_others = np.concatenate([first + 2 * len(ribs) + np.arange(len(own_ribs)), [1, 3]])
    landmarks = Landmarks(
        np.vstack([positions, copies, rest]), np.vstack([normals, turn * normals, rest_normals]),
        np.concatenate([first + owner, first + len(ribs) + owner, of_others[rest_owner]]),
        np.vstack([of_copies, of_copies, descriptors[len(positions) :]]),
    )  # fmt: skip
    walls = np.vstack([outline, ribs, copied, own_ribs])
    a0, a1, b0, b1 = (0.0, 0.0), (length, 0.0), (0.0, pitch), (length, pitch)
    c0, c1 = (0.0, 2.0 * pitch), (length, 2.0 * pitch)
    points = [a0, a1, b1, b0, a0, a1] if kind == "turned" else [a0, a1, c1, c0, b0, b1, c1, c0, a0, a1]
    path, arrivals = drive(points)
    return Corridors(
        world=World("look-alike corridors", walls), landmarks=landmarks, path=path,
        in_b=arrivals[2 if kind == "turned" else 4], back=arrivals[-2],
    )  # fmt: skip


def play(config: Config, trial: Trial, **changes: Any) -> dict[str, Any]:
    """Drive through corridors, with the default noise, camera and filter of environments.

    A match is wrong if the landmark was created by a measurement of another true landmark. A false loop closure is
    three wrong matches within ten ticks; a true one, which shows that closing is possible at all, is three right
    matches, on the way back, with landmarks of A that were not seen for 100 ticks.

    Args:
        changes: Options of the filter that differ.

    Returns:
        `sigma_m` and `error_m`: claimed standard deviation and true error across the corridors on entering B; `offset`:
        whether `pitch_m`, the distance of A and B, is beyond four of the former; numbers of `matches`, of `wrong` ones
        and of `false_closures`; whether there is a `true_closure`; `end_error_m`: position error at the end.
    """
    rng = np.random.default_rng(trial.seed)
    length, pitch = rng.uniform(*LENGTHS), rng.uniform(*PITCHES)
    built = build_corridors(trial.kind, length, pitch, rng)
    noise, sensor = OdometryNoise(), LandmarkSensor(LandmarkSensorConfig(), built.world.walls, built.landmarks)
    bias = draw_bias(noise, 1, rng)
    slam = FastSlam.from_options(1, replace(default_filter_options(), **changes), trial.seed)
    claims: dict[int, int] = {}
    matched_at: dict[int, int] = {}  # last tick at which each true landmark was created or rightly matched
    wrong_at: list[int] = []  # wrong matches by tick
    matched, known_again, sigma, error = 0, 0, 0.0, 0.0
    for tick, pose in enumerate(built.path):
        frame = sensor.measure(pose[None], rng).per_robot()[0]
        odometry = read_odometry(built.path[tick - 1 : tick], pose[None], bias, noise, rng)[0] if tick else None
        report = slam.step([odometry], [frame.measurements])
        truths, found, made = frame.true_ids.tolist(), report.associations[0].tolist(), report.created[0].tolist()
        claims |= {new: truth for new, truth in zip(made, truths, strict=True) if new >= 0}
        pairs = [
            (claims.get(own), truth)
            for own, new, truth in zip(found, made, truths, strict=True)
            if own >= 0 and new < 0 and truth >= 0
        ]
        matched += len(pairs)
        wrong_at.append(sum(claim != truth for claim, truth in pairs))
        if tick >= built.back:
            known_again += sum(claim == t and tick - matched_at[t] > LONG_UNSEEN for claim, t in pairs)
        matched_at |= {t: tick for claim, t in pairs if claim == t}
        matched_at |= {truth: tick for new, truth in zip(made, truths, strict=True) if new >= 0}
        if tick == built.in_b:
            belief = slam.pose()
            sigma = float(np.sqrt(belief.covariance[1, 1]))
            error = float(abs(belief.mean[1] - between(built.path[0], pose)[1]))
    recent = np.convolve(wrong_at, np.ones(WITHIN))[: len(wrong_at)] >= CLOSING
    begins = np.diff(recent.astype(int), prepend=0) > 0
    off = slam.pose().mean - between(built.path[0], built.path[-1])
    return {
        "offset": f"<= {FAR:g}" if pitch <= FAR * sigma else f"> {FAR:g}", "pitch_m": pitch, "sigma_m": sigma,
        "error_m": error, "matches": matched, "wrong": sum(wrong_at), "false_closures": int(begins.sum()),
        "true_closure": known_again >= CLOSING, "end_error_m": float(np.hypot(*off[:2])),
    }  # fmt: skip


STUDY = Study(
    name="false_closures",
    about="""Count false loop closures in look-alike corridors.

    A robot drives along corridor A, by a way round into corridor B, which has the same landmarks with the same
    descriptors at the same places, along it, and back into A. Corridors are 6 to 10 m long, 3 m wide, and their centre
    lines 4 to 7 m apart. Kinds: seen, B is A shifted, and there are landmarks, which look different, on the way round;
    blind, nothing is seen on the way round, so that the pose is uncertain at the entrance to B; turned, B is A turned
    by half a turn and driven in the opposite direction: the robot sees in B what it saw in A. Columns: trials with a
    false closure, wrong matches among all, trials whose loop is closed on the way back.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    quick={"trials": 6},
    tables=(
        ResultTable(
            name="closures", title="False loop closures in look-alike corridors", by=("kind", "offset"),
            pooled=("offset",), words={"offset": ("offset [sigma]", str)},
            columns=(
                Column("trials", statistic=len, digits=0),
                Column("false_closures", "false", lambda rows: sum(r["false_closures"] > 0 for r in rows),
                       digits=0),
                Column("wrong", "wrong matches", "sum", digits=0), Column("matches", statistic="sum", digits=0),
                Column("true_closure", "closed", "sum", digits=0),
                Column("sigma_m", "sigma [m]", "median", digits=2),
                Column("end_error_m", "end error [m]", "median", digits=2),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
