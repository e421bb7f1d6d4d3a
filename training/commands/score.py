"""Command `vslam score`: paths and a map of any SLAM system against the truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.commands.helpers.options import Json, naming, words
from training.commands.helpers.run_folder import write_json
from training.experiments.output.console import make_console

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from slam_backend.core.validation import FloatArray
    from slam_backend.metrics import TeamScore

MAPS = "a map, .npz of this project or .csv with columns x, y and perhaps z"
COLUMNS = (("x_m", "y_m", "z_m"), ("x", "y", "z"), ("x_m", "y_m"), ("x", "y"))  # of landmarks, with names for them


def score(
    truth: Annotated[str, typer.Option(help="TUM files of the true paths, with commas between them.")],
    estimate: Annotated[
        str, typer.Option(help="TUM files of the robots' paths in one frame, in the order of --truth.")
    ],
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Map: .npz of this project, or .csv with columns x, y, z.", show_default="none"),
    ] = None,
    landmarks: Annotated[
        Path | None, typer.Option(help="True landmarks: .csv with columns x, y, z.", show_default="none")
    ] = None,
    max_gap: Annotated[float, typer.Option(help="Largest difference of the times of compared poses \\[s].")] = 0.01,
    delta: Annotated[int, typer.Option(help="Poses over which the relative pose error is taken.")] = 1,
    gate: Annotated[float, typer.Option(help="Largest distance of a landmark to its true one \\[m].")] = 0.5,
    json: Json = None,
) -> None:  # fmt: skip
    """Score paths and a map of one robot or a team against the truth, under one alignment.

    One rigid motion fits the positions of all robots together: robots of a team share a frame. ATE and RPE are those of
    evo (evo_ape -a, evo_rpe). The map is moved by the same motion; its landmarks are matched one to one.
    """
    from slam_backend.core.files import check_writable
    from slam_backend.core.validation import argument_error
    from slam_backend.metrics import score_team
    from slam_backend.trajectory import Trajectory
    from training.experiments.run_folder import plain, to_json

    if json is not None and str(json) != "-":
        check_writable(json, "json")
    if (map_file is None) != (landmarks is None):
        missing, other = ("landmarks", "map") if landmarks is None else ("map", "landmarks")
        raise argument_error(missing, f"a file beside --{other}", f"no --{missing}", "Give both, or neither.")
    names = words(estimate)
    with naming(path="truth"):
        truths = [Trajectory.load_tum(name) for name in words(truth)]
    with naming(path="estimate"):
        robots = [Trajectory.load_tum(name) for name in names]
    with naming(path="map"):
        held = None if map_file is None else read_positions(map_file)
    with naming(path="landmarks"):
        true = None if landmarks is None else read_positions(landmarks)
    with naming(estimated="estimate"):
        found = score_team(robots, truths, held, true, max_gap=max_gap, delta=delta, gate=gate)
    print_score(found, [Path(name).name for name in names])
    if json is not None:
        write_json(json, to_json(plain(metrics(found, names))))


def read_positions(file: Path) -> "FloatArray":
    """Return the positions (n, 2 or 3) [m] in a map of this project, or in a CSV file with named columns.

    Raises:
        ValueError: If the file is missing, damaged or of another kind, or has no columns of positions.
    """
    from slam_backend.core.text_files import existing_file
    from slam_backend.core.validation import argument_error
    from slam_backend.maps.landmark_map import LandmarkMap
    from slam_backend.readers.tables import read_csv

    if existing_file(file, kind=MAPS).suffix == ".npz":
        return LandmarkMap.load(file).means
    if file.suffix != ".csv":
        raise argument_error("path", MAPS, file, "Only these are read.")
    for names in COLUMNS:
        try:
            return read_csv(file, names).numbers
        except ValueError as error:
            if "with one column" not in str(error):
                raise
    hint = f"Name the columns of {str(file)!r} in its first line."
    raise argument_error("path", MAPS, "a table without these names", hint)


def metrics(found: "TeamScore", names: "tuple[str, ...]") -> dict[str, object]:
    """Return a score as plain values: metres, radians, and shares."""
    robots = [
        {
            "path": name, "ate_m": robot.ate, "own_ate_m": robot.own_ate, "poses": robot.pairs,
            "rpe_m": None if robot.rpe is None else robot.rpe.translation,
            "rpe_rad": None if robot.rpe is None else robot.rpe.rotation,
        }
        for name, robot in zip(names, found.robots, strict=True)
    ]  # fmt: skip
    score = found.map
    landmarks = None if score is None else {
        "rmse_m": score.rmse, "recall": score.recall, "precision": score.precision, "matched": len(score.matched),
    }  # fmt: skip
    return {"ate_m": found.ate, "truth_from_estimated": found.transform, "robots": robots, "map": landmarks}


def print_score(found: "TeamScore", names: list[str]) -> None:
    """Print the errors of the robots, of the team, and of the map."""
    import numpy as np

    from training.experiments.output.tables import console_table, number

    console = make_console()
    rows = [
        [
            name, number(robot.ate, 3), number(robot.own_ate, 3),
            *(number(None if robot.rpe is None else value, 3) for value in _relative(robot.rpe)), str(robot.pairs),
        ]
        for name, robot in zip(names, found.robots, strict=True)
    ]  # fmt: skip
    headings = ("path", "ATE [m]", "after own fit [m]", "RPE [m]", "RPE [deg]", "poses")
    console.print(console_table("Paths, under one alignment of the team", headings, rows))
    x, y, theta = found.transform
    console.print(f"Team: ATE {found.ate:.3f} m; moved by x {x:.3f} m, y {y:.3f} m, turn {np.degrees(theta):.2f} deg.")
    if found.map is not None:
        score = found.map
        console.print(
            f"Map: RMSE {score.rmse:.3f} m, recall {score.recall:.1%}, precision {score.precision:.1%}, "
            f"{len(score.matched)} landmarks matched."
        )


def _relative(error: "object") -> tuple[float, float]:
    """Return a relative pose error in metres and degrees."""
    import math

    translation, rotation = (getattr(error, name, math.nan) for name in ("translation", "rotation"))
    return translation, math.degrees(rotation)
