"""Recordings for the viewer rerun (extra `rerun`): an episode as a .rrd file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from training.report.recording import Recording, check_export, part_of
from vslam_env.rendering.palette import robot_colour

TIMELINE = "episode"
SPOT, LINE, ROBOT = 0.06, 0.02, 0.2  # radii of points, lines and robots [m]
GREY = (150, 152, 158)
Array = NDArray[Any]


def check_rerun(file: Path) -> None:
    """Check that a file for rerun can be written, see `check_export`."""
    check_export(file, "rerun", "rerun", "rerun-sdk", ".rrd")


def write_rerun(recording: Recording, file: Path) -> Path:
    """Write an episode as a file for rerun, on a timeline in seconds of simulated time.

    Coordinates are those of the recording, with y upwards in the world and thus negated in pictures, whose y points
    down. Entities are `world/walls`, `world/landmarks`, `robots/<k>/...` (`truth`, `estimate`, `path`, `sights`, `map`,
    `candidates`, `goal`), `scores/<metric>/<k>`, `scores/coverage` and `events`.

    Raises:
        ValueError: If rerun is not installed or the file cannot be written.
    """
    check_rerun(file)
    import rerun

    stream = rerun.RecordingStream("vslam_env")
    stream.save(file, default_blueprint=_layout())
    if len(recording.walls):
        walls = _picture(recording.walls.reshape(-1, 2, 2))
        stream.log("world/walls", rerun.LineStrips2D(walls, radii=LINE, colors=[GREY]), static=True)
    if len(recording.landmarks):
        points = rerun.Points2D(_picture(recording.landmarks), radii=SPOT, colors=[GREY])
        stream.log("world/landmarks", points, static=True)
    robots = recording.estimate.shape[1]
    colours = [robot_colour(robot) for robot in range(robots)]
    events = sorted(recording.about["events"], key=lambda event: float(event["time"]))
    for step, time in enumerate(recording.times):
        stream.set_time(TIMELINE, duration=float(time))
        for robot, colour in enumerate(colours):
            _log_robot(rerun, stream, recording, step, robot, colour)
        if recording.coverage.size:
            stream.log("scores/coverage", rerun.Scalars([float(recording.coverage[step])]))
    for key, step in enumerate(recording.keyframes):
        stream.set_time(TIMELINE, duration=float(recording.times[step]))
        for robot, colour in enumerate(colours):
            _log_map(rerun, stream, recording, key, robot, colour)
    for event in events:
        stream.set_time(TIMELINE, duration=float(event["time"]))
        stream.log("events", rerun.TextLog(event["text"], level="INFO" if event["success"] else "DEBUG"))
    stream.flush()
    stream.disconnect()
    return file


def _layout() -> Any:
    """Return the views with which the viewer opens: the world, beside it scores and events."""
    from rerun import blueprint

    charts = {"map error E [m]": "map_error", "position error [m]": "pose_error", "coverage": "coverage"}
    beside = [
        blueprint.TimeSeriesView(origin=f"scores/{metric}", name=title) for title, metric in charts.items()
    ] + [blueprint.TextLogView(origin="events", name="merges")]  # fmt: skip
    world = blueprint.Spatial2DView(contents=["world/**", "robots/**"], name="world")
    return blueprint.Blueprint(
        blueprint.Horizontal(world, blueprint.Vertical(*beside), column_shares=[3, 2]), collapse_panels=True
    )


def _picture(points: Array) -> Array:
    """Return points (..., 2) with y downwards."""
    return np.asarray(points, np.float64) * [1.0, -1.0]


def _log_robot(
    rerun: Any, stream: Any, recording: Recording, step: int, robot: int, colour: tuple[int, int, int]
) -> None:
    """Log poses, the path so far, lines of sight and scores of a robot at a step."""
    root = f"robots/{robot}"
    for name, poses in (("truth", recording.truth), ("estimate", recording.estimate)):
        x, y, heading = (float(value) for value in poses[step, robot])
        if np.isnan(x):
            continue
        ahead = ROBOT * 2.0 * np.array([np.cos(heading), np.sin(heading)])
        arrow = rerun.Arrows2D(
            vectors=_picture(ahead[None]), origins=_picture(np.array([[x, y]])), radii=LINE,
            colors=[colour if name == "estimate" else GREY], labels=[f"{robot}"] if name == "estimate" else None,
        )  # fmt: skip
        stream.log(f"{root}/{name}", arrow)
    path = recording.estimate[: step + 1, robot, :2]
    path = path[np.isfinite(path).all(axis=1)]
    if len(path) > 1:
        stream.log(f"{root}/path", rerun.LineStrips2D([_picture(path)], radii=LINE, colors=[colour]))
    if recording.sight_ends.size:
        seen = recording.sights[part_of(recording.sight_ends, step, robot)]
        x, y = (float(value) for value in recording.truth[step, robot, :2])
        lines = np.stack([np.broadcast_to([x, y], seen.shape), seen], axis=1)
        stream.log(f"{root}/sights", rerun.LineStrips2D(_picture(lines), radii=0.3 * LINE, colors=[colour]))
    if recording.scores.size:
        stream.log(f"scores/map_error/{robot}", rerun.Scalars([float(recording.scores[step, robot, 0])]))
    off = float(np.hypot(*(recording.estimate - recording.truth)[step, robot, :2]))
    if np.isfinite(off):
        stream.log(f"scores/pose_error/{robot}", rerun.Scalars([off]))


def _log_map(rerun: Any, stream: Any, recording: Recording, key: int, robot: int, colour: tuple[int, int, int]) -> None:
    """Log map and candidates of a robot at a step that has them; a shared map is logged with its first robot."""
    points = recording.map_points[part_of(recording.map_ends, key, robot), :2]
    stream.log(f"robots/{robot}/map", rerun.Points2D(_picture(points), radii=SPOT, colors=[colour]))
    if recording.candidate_ends.size:
        rows = recording.candidates[part_of(recording.candidate_ends, key, robot)]
        goals = rows[rows[:, 3] > 0]
        places = rerun.Points2D(_picture(rows[:, :2]), radii=SPOT, colors=[GREY])
        stream.log(f"robots/{robot}/candidates", places)
        stream.log(f"robots/{robot}/goal", rerun.Points2D(_picture(goals[:, :2]), radii=2 * SPOT, colors=[colour]))
