"""Path and map from a range-bearing log in CSV files, with errors and a plot.

    python examples/own_log.py FOLDER

The folder contains `odometry.csv` (time, v, omega), `sightings.csv` (time, landmark, range, bearing) and, if the truth
is known, `truth.csv` (time, x, y, theta) and `landmarks.csv` (landmark, x, y): seconds, metres, radians, bearings
positive to the left. The robot moves in the plane. Without a folder the example simulates a log.
The page docs/tutorials/own_log.md explains the changes for another robot.
"""

import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure

from slam_backend import FastSlam, OdometryModel, Trajectory
from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.metrics import AteResult, ate
from slam_backend.readers import integrate_commands, range_bearing_steps, read_csv
from slam_backend.trajectory import dead_reckoning

# Assumed noise of this robot: errors of its odometry, of a range [m] and of a bearing [rad].
MOTION = OdometryModel(sigma_along=0.1, sigma_across=0.05, sigma_heading=0.2, sigma_turn=0.1, floor_heading=0.003)
SIGMA_RANGE, SIGMA_BEARING = 0.1, 0.02


def run(folder: Path, picture: Path) -> dict[str, AteResult]:
    """Map the log of a folder and plot it; return the errors of path, odometry and map, if the truth is known."""
    driven = read_csv(folder / "odometry.csv", ("time", "v", "omega")).numbers
    seen = read_csv(folder / "sightings.csv", ("time", "range", "bearing"), labels=("landmark",))
    steps = range_bearing_steps(
        driven, seen.numbers, seen.labels[:, 0], sigma_range=SIGMA_RANGE, sigma_bearing=SIGMA_BEARING, dt=0.25
    )
    for note in steps.notes:
        print(note)

    # Gates for known identities: no position is unlikely enough to reject an identity.
    slam = FastSlam(num_particles=100, motion=MOTION, position_gate=1e4, new_landmark_gate=1e6, seed=0)
    path = np.zeros((len(steps.times), 3))
    for k, (moved, frame) in enumerate(zip(steps.odometry, steps.measurements, strict=True)):
        slam.step([moved if k else None], [frame])
        path[k] = slam.pose().mean
    for cause in slam.diagnose():
        print(f"{cause.name}: {cause.text}")
    places = slam.map().means[:, :2]
    names = steps.names[slam.map().descriptors.argmax(axis=1)]

    errors = {}
    if (folder / "truth.csv").is_file():
        rows = read_csv(folder / "truth.csv", ("time", "x", "y", "theta")).numbers
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]  # sorted, with one row per time
        known = (steps.times >= rows[0, 0]) & (steps.times <= rows[-1, 0])
        if not known.any():
            sys.exit(f"truth.csv and the log do not overlap: {rows[0, 0]:.1f} to {rows[-1, 0]:.1f} s in truth.csv.")
        true = Trajectory(rows[:, 0], rows[:, 1:]).at(steps.times[known])
        errors["path"] = ate(path[known], true)
        errors["odometry"] = ate(dead_reckoning(np.zeros(3), steps.odometry[1:])[known], true)
    if (folder / "landmarks.csv").is_file():
        stand = read_csv(folder / "landmarks.csv", ("x", "y"), labels=("landmark",))
        place_of = dict(zip(stand.labels[:, 0], stand.numbers, strict=True))
        both = [k for k, name in enumerate(names) if name in place_of]
        errors["map"] = ate(places[both], np.array([place_of[names[k]] for k in both]))

    figure = Figure(layout="constrained")
    axes = figure.subplots()
    if "path" in errors:
        axes.plot(*transform_points(inverse(errors["path"].transform), true[:, :2]).T, color="0.7", lw=3, label="truth")
    axes.plot(*path[:, :2].T, lw=1, label="estimate")
    axes.plot(*places.T, "k.", label="landmarks")
    for name, place in zip(names, places, strict=True):
        axes.annotate(f" {name}", place)
    axes.set(aspect="equal", xlabel="x [m], start frame", ylabel="y [m], start frame")
    axes.legend()
    figure.savefig(picture)
    return errors


def make_log(folder: Path) -> None:
    """Simulate the log of a robot that drives a figure of eight among ten landmarks; its odometry has a 5 % error."""
    rng = np.random.default_rng(7)
    times = np.arange(0.0, 120.0, 0.1)
    driven = np.column_stack([times, np.full_like(times, 0.4), 0.35 * np.where(times % 36.0 < 18.0, 1.0, -1.0)])
    poses = compose([2.0, 1.0, 0.8], integrate_commands(driven, times))
    angles = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
    stand = poses[:, :2].mean(axis=0) + 4.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    noisy = driven * [1.0, 1.05, 0.95] + rng.normal(0.0, [0.0, 0.02, 0.02], driven.shape)
    rows = []
    for time, pose in zip(times[::5], poses[::5], strict=True):
        for name, (x, y) in zip("ABCDEFGHIJ", transform_points(inverse(pose), stand), strict=True):
            if abs(np.arctan2(y, x)) < 0.6:
                spread = rng.normal(0.0, [0.08, 0.015])
                rows.append(f"{time:.2f},{name},{np.hypot(x, y) + spread[0]:.4f},{np.arctan2(y, x) + spread[1]:.5f}")
    (folder / "sightings.csv").write_text("\n".join(["time,landmark,range,bearing", *rows]) + "\n")
    lines = [f"{name},{x},{y}" for name, (x, y) in zip("ABCDEFGHIJ", stand, strict=True)]
    (folder / "landmarks.csv").write_text("\n".join(["landmark,x,y", *lines]) + "\n")
    _write(folder / "odometry.csv", "time,v,omega", noisy)
    _write(folder / "truth.csv", "time,x,y,theta", np.column_stack([times, poses]))


def _write(file: Path, names: str, rows: FloatArray) -> None:
    np.savetxt(file, rows, fmt="%.6f", delimiter=",", header=names, comments="")


def main(
    folder: Annotated[Path | None, typer.Argument(help="Folder of the log.", show_default="a simulated log")] = None,
    picture: Annotated[Path, typer.Option(help="PNG file to draw.")] = Path("own_log.png"),
) -> None:
    """Map a log, and print the errors of path and map."""
    if folder is None:
        folder = Path(tempfile.mkdtemp(prefix="own_log-"))
        make_log(folder)
        print(f"Simulated a log in {folder}")
    try:
        errors = run(folder, picture)
    except ValueError as error:
        sys.exit(f"error {error}")
    summary = ", ".join(f"{name} {error.aligned:.3f} m" for name, error in errors.items())
    print(f"RMS errors after the best rigid fit: {summary}." if summary else "Errors: no ground truth in this folder.")
    print(f"Picture: {picture}")


if __name__ == "__main__":
    typer.run(main)
