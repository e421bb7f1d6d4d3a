"""Reader of pose graphs as a `Log`: motions between successive poses are odometry, sightings measurements."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import inverse
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.pose_graph import LETTERS, PoseGraph, rotated
from slam_backend.readers.pose_graphs import read_graph
from slam_backend.trajectory import Trajectory
from training.replay.log import Log, RobotLog
from training.replay.readers import GATES

SIGMA_HEIGHT = 0.05  # of a planar sighting [m], as of other planar sensors
MOST_NUMBERS = 64  # of a landmark's descriptor


def read_graph_log(path: str | Path, *, truth: str | None = None) -> Log:
    """Return a pose graph as a log: robots with unknown starts among landmarks whose identities are given.

    Motions between successive poses of a robot are its odometry; the odometry noise of the filter is fitted to their
    covariances. Other motions and priors are not used, and counted in the notes. Estimates of the vertices are not used
    either: the vertices of the graph `truth` are true poses and landmarks. Times are the stamps of a single robot, if
    they increase, or else the numbers of the steps.
    """
    graph = read_graph(path)
    if not len(graph.sightings.rows):
        hint = "The filter maps landmarks: an optimiser is what suits a graph without them."
        raise argument_error("path", "a graph with sightings of landmarks", "a graph without any", hint)
    if graph.num_robots > len(LETTERS):
        hint = "A robot ends where no EDGE_SE2 links successive poses: join its parts, or drop some robots."
        raise argument_error("path", f"a graph of at most {len(LETTERS)} robots", graph.num_robots, hint)
    true = None if truth is None else read_graph(truth, "truth")
    rows = [np.flatnonzero(graph.robots == robot) for robot in np.unique(graph.robots)]
    names, landmark_names = graph.names()
    moves, covariances = _odometry(graph, rows, names, path)
    times = np.arange(max(map(len, rows)), dtype=np.float64)
    if len(rows) == 1 and graph.times is not None and (np.diff(graph.times) > 0.0).all():
        times = graph.times
    frames, seen, repeated = _frames(graph, _descriptors(len(graph.landmarks), len(rows)))
    robots = []
    for number, (own, moved) in enumerate(zip(rows, moves, strict=True), start=1):
        later = [None] * (len(times) - len(own))  # a robot with fewer poses stands still in the end
        odometry = np.zeros((len(times), 3))
        odometry[1 : len(own)] = moved
        path_truth = None if true is None else _true_path(true, [names[row] for row in own], times, str(truth))
        robots.append(
            RobotLog(
                odometry=odometry, measurements=[*(frames[row] for row in own), *later],
                identities=[*(seen[row] for row in own), *later], truth=path_truth, number=number,
            )
        )  # fmt: skip
    landmarks = None if true is None else _true_landmarks(true, landmark_names, str(truth))
    return Log(
        times=times, robots=robots, landmarks=landmarks,
        options={"motion": fitted_noise(np.concatenate(moves), covariances), **GATES["given"]},
        title=Path(path).name, notes=_notes(graph, sum(map(len, moves)), repeated),
    )  # fmt: skip


def _odometry(
    graph: PoseGraph, rows: list[IntArray], names: list[str], path: str | Path
) -> tuple[list[FloatArray], FloatArray]:
    """Return the motions of each robot between its n poses (n - 1, 3), and all covariances, see `fitted_noise`."""
    found: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
    for (a, b), value, covariance in zip(graph.motions.rows.tolist(), *graph.motions[1:], strict=True):
        if a < b:
            found.setdefault((a, b), (value, rotated(covariance[None], value[2:])[0]))
        else:
            back, jacobian = inverse(value), np.eye(3)  # of the motion back by an error in axes of its first pose
            jacobian[:2, 2] = -back[1], back[0]
            found.setdefault((b, a), (back, jacobian @ covariance @ jacobian.T))
    moves, covariances = [], []
    for own in rows:
        pairs = list(zip(own[:-1].tolist(), own[1:].tolist(), strict=True))
        for a, b in pairs:
            if (a, b) not in found:
                expected = f"an odometry edge between {names[a]} and {names[b]}, successive poses"
                raise argument_error("path", expected, "no such edge", f"Add it to {str(path)!r}.")
        moves.append(np.array([found[pair][0] for pair in pairs]).reshape(-1, 3))
        covariances += [found[pair][1] for pair in pairs]
    return moves, np.array(covariances).reshape(-1, 3, 3)


def fitted_noise(odometry: FloatArray, covariances: FloatArray) -> OdometryModel:
    """Return the model whose variances fit those of motions, by least squares of relative errors.

    Args:
        odometry: (n, 3) [m, m, rad]. Motions, in frames of their first poses.
        covariances: (n, 3, 3) [m, m, rad]. Covariances of the motions, in the same axes.

    >>> covariances = np.tile(np.diag([0.01, 0.01, 0.04]), (2, 1, 1))
    >>> model = fitted_noise(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.5]]), covariances)
    >>> round(model.floor_position, 6), round(model.floor_heading, 6), round(model.sigma_along, 6)
    (0.1, 0.2, 0.0)
    """
    if not len(odometry):
        return OdometryModel()
    squares, turns = odometry[:, 0] ** 2 + odometry[:, 1] ** 2, odometry[:, 2] ** 2
    one, none = np.ones(len(odometry)), np.zeros(len(odometry))
    xx, yy, tt = np.diagonal(covariances, axis1=1, axis2=2).T[:, :, None]
    along, across = np.column_stack([squares, none, one]) / xx, np.column_stack([none, squares, one]) / yy
    position, _ = nnls(np.concatenate([along, across]), np.ones(2 * len(odometry)))
    heading, _ = nnls(np.column_stack([squares, turns, one]) / tt, one)
    names = ("sigma_along", "sigma_across", "floor_position", "sigma_heading", "sigma_turn", "floor_heading")
    return OdometryModel(**dict(zip(names, np.sqrt([*position, *heading]).tolist(), strict=True)))


def _descriptors(count: int, robots: int) -> NDArray[np.float32]:
    """Return a descriptor of each landmark; only those of teams, whose maps are aligned, differ."""
    if robots == 1:
        return np.ones((count, 1), dtype=np.float32)
    if count <= MOST_NUMBERS:
        return np.eye(count, dtype=np.float32)
    drawn = np.random.default_rng(0).standard_normal((count, MOST_NUMBERS))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), dtype=np.float32)


def _frames(
    graph: PoseGraph, descriptors: NDArray[np.float32]
) -> tuple[list[Measurements | None], list[IntArray | None], int]:
    """Return the sightings from each pose, the first of each landmark, its rows, and how many others there are."""
    frames: list[Measurements | None] = [None] * len(graph.poses)
    seen: list[IntArray | None] = [None] * len(graph.poses)
    pairs, first = np.unique(graph.sightings.rows, axis=0, return_index=True)
    for pose in np.unique(pairs[:, 0]).tolist():
        chosen = first[pairs[:, 0] == pose]
        points, covariances = np.zeros((len(chosen), 3)), np.zeros((len(chosen), 3, 3))
        points[:, :2], covariances[:, :2, :2] = graph.sightings.values[chosen], graph.sightings.covariances[chosen]
        covariances[:, 2, 2] = SIGMA_HEIGHT**2
        landmarks = graph.sightings.rows[chosen, 1]
        turned = ROBOT_FROM_CAMERA.T @ covariances @ ROBOT_FROM_CAMERA
        frames[pose] = Measurements(points @ ROBOT_FROM_CAMERA, descriptors[landmarks], turned)
        seen[pose] = landmarks
    return frames, seen, len(graph.sightings.rows) - len(pairs)


def _true_path(true: PoseGraph, names: list[str], times: FloatArray, path: str) -> Trajectory:
    """Return the true poses by name, at the first of these times."""
    rows = _rows_of(true.names()[0], names, "the pose", path)
    return Trajectory(times[: len(rows)], true.poses[rows])


def _true_landmarks(true: PoseGraph, names: list[str], path: str) -> FloatArray:
    """Return the true positions (l, 2) of the landmarks by name."""
    return np.asarray(true.landmarks[_rows_of(true.names()[1], names, "the landmark", path)])


def _rows_of(known: list[str], names: list[str], kind: str, path: str) -> IntArray:
    """Return the row of each name among known ones, or raise."""
    rows = {name: row for row, name in enumerate(known)}
    for name in names:
        if name not in rows:
            raise argument_error("truth", f"{kind} {name} of the graph", "no such vertex", f"Add it to {path!r}.")
    return np.array([rows[name] for name in names], dtype=np.int64)


def _notes(graph: PoseGraph, used: int, repeated: int) -> tuple[str, ...]:
    """Return lines about what is not used."""
    motions, priors = len(graph.motions.rows) - used, len(graph.pose_priors.rows) + len(graph.landmark_priors.rows)
    notes = (
        (motions, "of the EDGE_SE2 close loops, link robots or repeat others: the filter takes odometry and landmarks"),
        (repeated, "further sightings of a landmark from the same pose"),
        (priors, "priors: maps begin at the first pose"),
    )
    return tuple(f"Not used: {count} {what}." for count, what in notes if count)
