"""Pairwise alignment of real maps: robots of an MR.CLAM log map alone; barcodes are known, then unknown.

python -m studies.merging.mrclam_pairs
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions, align_maps
from slam_backend.readers.mrclam import ROBOTS
from training.commands.replay import MRCLAM_LOG
from training.commands.study import run_program
from training.experiments.config import ONE_PARTICLE, ExperimentConfig, option
from training.experiments.study import Column, ResultTable, Row, Study
from training.replay.config import MRCLAM, MrclamConfig, log_path
from training.replay.core import Replay, replay_log
from training.replay.log import Log
from training.replay.metrics import motion_error
from training.replay.readers import read_mrclam

Barcodes = Literal["given", "hidden"]
ENOUGH_SHARED = 5  # shared landmarks from which maps should be alignable by barcodes
# Maps are deformed by tenths of a metre, early ones more.
GIVEN = AlignmentOptions(position_floor=0.3, min_inliers=ENOUGH_SHARED, max_sigma_heading=0.05)
OPTIONS: dict[Barcodes, AlignmentOptions] = {"given": GIVEN, "hidden": replace(GIVEN, appearance=False)}


class Config(ExperimentConfig):
    """Pairwise alignment of the maps of an MR.CLAM log."""

    path: str = log_path(MRCLAM)
    durations: tuple[Annotated[float, Field(ge=0.0)], ...] = option(
        (100.0, 200.0, 400.0, 0.0), "Times at which maps are aligned [s]; 0: at the end.",
        hint="Give seconds; 0 means all.",
    )  # fmt: skip
    particles: int = option(100, "Number of particles per filter.", ge=1, hint=ONE_PARTICLE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One pair of maps."""

    duration: float  # Time at which the maps are aligned [s]; 0: at the end
    barcodes: Barcodes  # Whether landmarks are known by their barcodes
    robot_a: int  # Number of the first robot in the log
    robot_b: int  # Number of the second robot in the log


def trials(config: Config) -> list[Trial]:
    """Return all trials, with trials on the same maps in succession."""
    present = [robot for robot in ROBOTS if (Path(config.path) / f"Robot{robot}_Odometry.dat").is_file()]
    return [
        Trial(duration=duration, barcodes=barcodes, robot_a=a, robot_b=b)
        for duration, barcodes, (a, b) in product(config.durations, OPTIONS, combinations(present, 2))
    ]


@lru_cache(maxsize=1)
def map_alone(path: str, duration: float, particles: int, seed: int) -> tuple[Log, Replay]:
    """Let each robot of a log map alone."""
    limit = duration or None
    log = read_mrclam(path, duration=limit, alone=True)
    return log, replay_log(log, MrclamConfig(path=path, duration=limit, particles=particles, seed=seed))


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Align the maps of two robots.

    Returns:
        Number of `shared` landmarks, and whether there are `enough`; `accepted`, `reason`, `inliers`; of an accepted
        alignment `error_m` at the second robot's landmarks and `error_deg`, relative to the transform between the fits
        of both maps to the true landmarks, and `false` if above 0.5 m or 5 degrees.
    """
    log, found = map_alone(config.path, trial.duration, config.particles, config.seed)
    numbers = [robot.number for robot in log.robots]
    a, b = numbers.index(trial.robot_a), numbers.index(trial.robot_b)
    maps, claims = (found.maps[a], found.maps[b]), (found.claims[a], found.claims[b])
    alignment = align_maps(*maps, "ransac", np.random.default_rng(0), OPTIONS[trial.barcodes])
    shared = len(np.intersect1d(*claims))
    row: dict[str, Any] = {
        "shared": shared, "enough": shared >= ENOUGH_SHARED, "accepted": alignment.success, "reason": alignment.reason,
        "inliers": len(alignment.inliers),
    }  # fmt: skip
    error = motion_error(alignment.transform, maps, claims, log.landmarks) if alignment.success else None
    if error is not None:
        row |= {"error_m": error[0], "error_deg": float(np.rad2deg(error[1]))}
        row["false"] = error[0] > DISTINCT_TRANSLATION or error[1] > DISTINCT_ROTATION
    return row


def _false(rows: Sequence[Row]) -> int:
    """Return the number of false alignments."""
    return sum(row.get("false", False) for row in rows)


STUDY = Study(
    name="mrclam_pairs",
    about="""Align maps of five real robots that mapped alone, for all pairs, with known and unknown barcodes.

    Errors are relative to the transform between the fits of both maps to the true landmarks. The odometry noise was
    calibrated on data sets 7 and 4 of MR.CLAM. Ctrl-C finishes the current pair and summarises the finished ones; the
    same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    log=MRCLAM_LOG,
    tables=(
        ResultTable(
            name="pairs", title="Pairwise alignment of maps of real robots", by=("duration", "barcodes"),
            words={"duration": ("after [s]", lambda duration: f"{duration:g}" if duration else "all")},
            columns=(
                Column("enough", f"pairs with {ENOUGH_SHARED} in common", "sum", digits=0),
                Column("accepted", "aligned", "sum", digits=0), Column("false", "", _false, digits=0),
                Column("error_m", "median [m]", "median", digits=2), Column("error_m", "worst [m]", "worst", digits=2),
                Column("error_deg", "median [°]", "median", digits=2),
                Column("error_deg", "worst [°]", "worst", digits=2),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
