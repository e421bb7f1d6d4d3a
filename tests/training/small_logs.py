"""Small logs in three replayable formats, with exact or noisy readings of a known world."""

from pathlib import Path

import numpy as np
from scipy.io import savemat

from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.pose_graph import Factors, PoseGraph
from slam_backend.readers.conversions import integrate_commands
from slam_backend.readers.kitti import ABSENT
from slam_backend.readers.victoria import SENSOR, axle_velocities

ANGLES, RADII = np.random.default_rng(11).uniform([[0.0], [2.8]], [[2.0 * np.pi], [4.2]], (2, 14))
LANDMARKS = np.column_stack([RADII * np.cos(ANGLES), RADII * np.sin(ANGLES)])  # a ring around both robots
STARTS = {2: (0.5, -1.0, 0.4), 5: (-1.5, 1.0, -2.0)}
SECONDS = 45.0

TREE_ANGLES = np.linspace(0.0, 2.0 * np.pi, 17, endpoint=False)
RING = np.array([0.0, 14.0])  # middle of the vehicle's circle
TREES = np.vstack([RING + 8.0 * np.column_stack([np.cos(TREE_ANGLES[::2]), np.sin(TREE_ANGLES[::2])]),
                   RING + 24.0 * np.column_stack([np.cos(TREE_ANGLES), np.sin(TREE_ANGLES)])])  # fmt: skip
EAST = np.array([100.0, -50.0, 0.8])  # start pose in the GPS frame


def write_log(folder: Path, noise: float, seed: int = 3) -> None:
    """Write a log of two robots that drive in circles among 14 landmarks, with `noise` times the usual errors."""
    rng = np.random.default_rng(seed)
    subjects = np.arange(6, 6 + len(LANDMARKS))
    (folder / "Barcodes.dat").write_text("".join(f"{n} {100 + n}\n" for n in [1, 2, 3, 4, 5, *subjects]))
    lines = [f"{n} {x} {y} 0 0\n" for n, (x, y) in zip(subjects, LANDMARKS, strict=True)]
    (folder / "Landmark_Groundtruth.dat").write_text("".join(lines))
    for robot, start in STARTS.items():
        times = 1000.0 + 0.1 * np.arange(round(SECONDS / 0.1))
        driven = np.column_stack([times, np.full_like(times, 0.5), np.full_like(times, 0.6 if robot == 2 else -0.5)])
        readings = driven * [1.0, 1.0 + 0.2 * noise, 1.0 - 0.15 * noise]
        np.savetxt(folder / f"Robot{robot}_Odometry.dat", readings, fmt="%.6f")
        poses = compose(start, integrate_commands(driven, times))
        np.savetxt(folder / f"Robot{robot}_Groundtruth.dat", np.column_stack([times, poses]), fmt="%.9f")
        rows = []
        for time, pose in zip(times[::3], poses[::3], strict=True):
            seen = transform_points(inverse(pose), LANDMARKS)
            ranges, bearings = np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])
            for n in np.flatnonzero((np.abs(bearings) < 0.5) & (ranges < 9.0)):
                r, b = [ranges[n], bearings[n]] + noise * rng.normal(0.0, [0.05, 0.01])
                rows.append(f"{time:.3f} {100 + subjects[n]} {r:.9f} {b:.9f}\n")
        (folder / f"Robot{robot}_Measurement.dat").write_text("".join(rows))


def write_park(folder: Path, skew: float = 0.0) -> None:
    """Write a log of a vehicle that drives two rounds among trees; its steering has an error `skew` [rad]."""
    times = np.arange(0.0, 60.0, 0.025)
    steering = np.full_like(times, np.arctan(2.83 / 14.0))
    driven = axle_velocities(np.column_stack([times, np.full_like(times, 3.0), steering]))
    laser = np.array([*SENSOR[:2], 0.0])
    scan_times = np.arange(0.1, 59.0, 0.2)
    cells = np.empty(len(scan_times), dtype=object)
    for k, pose in enumerate(compose(integrate_commands(driven, scan_times), laser)):
        seen = transform_points(inverse(pose), TREES)
        bearings = np.arctan2(seen[:, 1], seen[:, 0])
        front = np.abs(bearings) < 0.5 * np.pi
        polar = [np.hypot(*seen[front].T), bearings[front] + 0.5 * np.pi, np.full(front.sum(), 0.4)]
        cells[k] = np.array(polar)
    stamps = np.arange(500, 58000, 200)
    fixes = transform_points(EAST, compose(integrate_commands(driven, stamps / 1000.0), laser)[:, :2])
    readings = {"time": times * 1000, "speed": np.full_like(times, 3.0), "steering": steering + skew}
    savemat(folder / "aa3_dr.mat", readings)
    savemat(folder / "VictoriaParkSinSincronizar.mat", {"TLsr": scan_times, "zt": cells[None]})
    savemat(folder / "aa3_gpsx.mat", {"timeGps": stamps, "Lo_m": fixes[:, 0], "La_m": fixes[:, 1]})


def write_drive(folder: Path, bias: float = 0.0, bus: bool = False) -> None:
    """Write a drive along a bend; the turn rate has an error `bias` [rad/s], optionally with a bus driving ahead."""
    rng = np.random.default_rng(5)
    times = 0.1 * np.arange(120)
    mount = np.array([1.1, -0.3, 0.0])
    commands = np.column_stack([times, np.full(120, 8.0), np.where(times < 6.0, 0.0, 0.3)])
    cameras = compose(integrate_commands(commands, times), mount)
    points = np.column_stack([rng.uniform(-20.0, 120.0, 400), rng.uniform(-40.0, 70.0, 400)])
    features = np.full((4, len(points) + 8, len(times)), ABSENT)
    for k, pose in enumerate(cameras):
        ahead = transform_points(inverse(pose), points)
        if bus:
            ahead = np.vstack([ahead, np.column_stack([np.full(8, 12.0 + 0.3 * k), np.linspace(-1.2, 1.2, 8)])])
        columns = 600.0 - 700.0 * ahead[:, 1] / np.maximum(ahead[:, 0], 1e-3)
        seen = np.flatnonzero((ahead[:, 0] > 3.0) & (ahead[:, 0] < 60.0) & (columns > 0.0) & (columns < 1200.0))
        disparity = 700.0 * 0.5 / ahead[seen, 0]
        features[:, seen, k] = [columns[seen], 180.0 + 0 * seen, columns[seen] - disparity, 180.0 + 0 * seen]
    turns = commands[:, 2] + bias
    zeros = np.zeros(120)
    np.savez(
        folder / "drive.npz", time_stamps=times, features=features,
        K=[[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]],
        linear_velocity=[commands[:, 1], zeros, zeros], rotational_velocity=[zeros, zeros, turns], b=0.5,
        cam_T_imu=np.vstack([np.column_stack([ROBOT_FROM_CAMERA.T, mount]), [0.0, 0.0, 0.0, 1.0]]),
    )  # fmt: skip
    (folder / "poses").mkdir()
    rows = []
    for x, y, theta in compose(inverse(cameras[0]), cameras):
        c, s = np.cos(theta), np.sin(theta)
        rows.append(f"{c} 0 {-s} {-y} 0 1 0 0 {s} 0 {c} {x}\n")
    (folder / "poses" / "00.txt").write_text("".join(rows))


def small_graph(robots: int = 1, noise: float = 1.0, steps: int = 40, seed: int = 4) -> tuple[PoseGraph, PoseGraph]:
    """Return a graph of robots that drive circles in a ring of landmarks, estimates at zero, and the true graph."""
    rng = np.random.default_rng(seed)
    poses, of_robots, motions, sightings = [], [], [], []
    for robot in range(robots):
        pose = np.array([0.4 * robot, -0.3 * robot, 0.9 * robot])
        for step in range(steps):
            if step:
                move = np.array([0.3, 0.0, 0.2 - 0.35 * robot]) + noise * rng.normal(0.0, [0.02, 0.01, 0.01])
                motions.append((len(poses) - 1, len(poses), move))
                pose = compose(pose, [0.3, 0.0, 0.2 - 0.35 * robot])
            for row, point in enumerate(transform_points(inverse(pose), LANDMARKS)):
                if np.abs(np.arctan2(point[1], point[0])) < 1.0:
                    sightings.append((len(poses), row, point + noise * rng.normal(0.0, 0.05, 2)))
            poses.append(pose)
            of_robots.append(robot)
    parts = {
        "robots": np.array(of_robots), "pose_ids": np.tile(np.arange(steps), robots),
        "landmark_ids": 3 + np.arange(len(LANDMARKS)),
        "motions": _factors(motions, np.diag([0.0004, 0.0001, 0.0001])),
        "sightings": _factors(sightings, 0.0025 * np.eye(2)),
    }  # fmt: skip
    unknown = PoseGraph(poses=np.zeros((len(poses), 3)), landmarks=np.zeros((len(LANDMARKS), 2)), **parts)
    return unknown, PoseGraph(poses=np.array(poses), landmarks=LANDMARKS, **parts)


def _factors(rows: list[tuple[int, int, np.ndarray]], covariance: np.ndarray) -> Factors:
    """Return measurements with the same covariance."""
    values = np.array([value for _, _, value in rows])
    return Factors(np.array([(a, b) for a, b, _ in rows]), values, np.tile(covariance, (len(rows), 1, 1)))
