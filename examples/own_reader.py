"""Reader of a log in CSV files for `vslam replay own_reader:read --path FOLDER`; see docs/tutorials/own_log.md.

The folder has the files of `own_log.py`, which also simulates one.
"""

from pathlib import Path

from slam_backend import OdometryModel, Trajectory
from slam_backend.readers import range_bearing_steps, read_csv
from training.replay.log import Log, RobotLog

MOTION = OdometryModel(sigma_along=0.1, sigma_across=0.05, sigma_heading=0.2, sigma_turn=0.1, floor_heading=0.003)


def read(folder: Path) -> Log:
    """Return the log of a folder."""
    driven = read_csv(folder / "odometry.csv", ("time", "v", "omega")).numbers
    seen = read_csv(folder / "sightings.csv", ("time", "range", "bearing"), labels=("landmark",))
    steps = range_bearing_steps(driven, seen.numbers, seen.labels[:, 0], sigma_range=0.1, sigma_bearing=0.02)
    truth, landmarks = None, None
    if (folder / "truth.csv").is_file():
        poses = read_csv(folder / "truth.csv", ("time", "x", "y", "theta")).numbers
        truth = Trajectory(poses[:, 0], poses[:, 1:])
    if (folder / "landmarks.csv").is_file():
        stand = read_csv(folder / "landmarks.csv", ("x", "y"), labels=("landmark",))
        place_of = dict(zip(stand.labels[:, 0], stand.numbers, strict=True))
        landmarks = [place_of[name] for name in steps.names]
    robot = RobotLog(
        odometry=steps.odometry,
        measurements=steps.measurements,
        identities=[None if frame is None else frame.descriptors.argmax(axis=1) for frame in steps.measurements],
        truth=truth,
    )
    return Log(
        times=steps.times, robots=[robot], landmarks=landmarks,
        options={"motion": MOTION, "position_gate": 1e4, "new_landmark_gate": 1e6}, notes=steps.notes, title="own log",
    )  # fmt: skip
