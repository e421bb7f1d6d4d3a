"""Pose graphs in files: g2o, and pyfg, the text format of PyFactorGraph.

R. Kuemmerle et al., "g2o: A general framework for graph optimization", ICRA 2011; github.com/RainerKuemmerle/g2o.
github.com/MarineRoboticsGroup/PyFactorGraph.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.files import checked_path, write_file
from slam_backend.core.text_files import data_lines, existing_file, line_error, parse_numbers, place, read_text
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_kind
from slam_backend.geometry import between, compose, transform_points
from slam_backend.pose_graph import LETTERS, Factors, PoseGraph, positive_definite

MOST_MEGABYTES = 64  # of a file; 50,000 poses with 500,000 sightings take 60
LARGEST_ID = 2**62
EXACT = 1e-12  # variance of the prior that stands for a fixed pose in pyfg, which has no FIX
GRAPHS = "a pose graph (.g2o, .pyfg, .fg)"
SUFFIXES = {".g2o": "g2o", ".pyfg": "pyfg", ".fg": "pyfg"}
VERTICES = {"VERTEX_SE2": 3, "VERTEX_XY": 2}
# Records of measurements: field of `PoseGraph`, kinds of the nodes, and length of the value
G2O = {
    "EDGE_SE2": ("motions", ("pose", "pose"), 3), "EDGE_SE2_XY": ("sightings", ("pose", "landmark"), 2),
    "LANDMARK2": ("sightings", ("pose", "landmark"), 2), "EDGE_PRIOR_SE2": ("pose_priors", ("pose",), 3),
    "EDGE_PRIOR_XY": ("landmark_priors", ("landmark",), 2),
}  # fmt: skip
PYFG = {
    "EDGE_SE2": G2O["EDGE_SE2"], "EDGE_SE2_XY": G2O["EDGE_SE2_XY"], "VERTEX_SE2:PRIOR": G2O["EDGE_PRIOR_SE2"],
    "VERTEX_XY:PRIOR": G2O["EDGE_PRIOR_XY"],
}  # fmt: skip
Node = tuple[int, int]  # robot, or -1 for a landmark or any node of g2o, and number


def read_graph(path: str | Path, name: str = "path") -> PoseGraph:
    """Read a planar pose graph from a file; its suffix, .g2o, .pyfg or .fg, says the format.

    Records of g2o are VERTEX_SE2, VERTEX_XY, FIX, EDGE_SE2, EDGE_SE2_XY, EDGE_PRIOR_SE2 and EDGE_PRIOR_XY, with upper
    triangles of information matrices, and LANDMARK2 of SLAM++ for EDGE_SE2_XY. A file without vertices is started from
    its motions. Poses are in order of their ids; where no motion links a pose to the one before, another robot begins.
    A pose and a landmark may have the same id, as in files that GTSAM writes.

    Records of pyfg are VERTEX_SE2, VERTEX_XY, both with :PRIOR, EDGE_SE2 and EDGE_SE2_XY, with covariances. Names have
    a letter of the robot, L for a landmark. Poses are in order of robots and of the file.

    Args:
        path: Text file of at most 64 MiB.
        name: The argument that gave the path, for errors.

    Raises:
        ValueError: If the file is missing or too large, has a record of another type, a malformed line, a number that
            is not finite, a matrix that is not positive definite, or an id that is unknown or repeated; with the line.
    """
    kind = _format(existing_file(path, name, GRAPHS), name)
    text = read_text(path, name, f"a pose graph ({kind})", MOST_MEGABYTES)
    reader = _Reader(path, name, PYFG if kind == "pyfg" else G2O, kind == "pyfg")
    for number, line in data_lines(text):
        reader.read(number, line)
    return reader.graph()


def write_graph(graph: PoseGraph, path: str | Path) -> Path:
    """Write a graph so that `read_graph` returns it again, values bit for bit, covariances but for rounding.

    Marginal covariances have no place in either format. g2o has no times and no robots; its ids belong to poses and
    landmarks alike: where they clash, poses are numbered after the landmarks. pyfg has no exact poses: they are written
    with a prior of variance 1e-12.

    Args:
        graph: The graph.
        path: File with the suffix .g2o, .pyfg or .fg.

    Returns:
        `path`.

    Raises:
        ValueError: If the suffix is another one, the file cannot be written, or there are more than 25 robots for pyfg.
    """
    check_kind("graph", graph, PoseGraph)
    lines = _g2o_lines(graph) if _format(path, "path") == "g2o" else _pyfg_lines(graph)
    return write_file(path, "\n".join(lines) + "\n")


def _format(path: str | Path, name: str) -> str:
    """Return "g2o" or "pyfg", or raise."""
    suffix = checked_path(path, name).suffix.lower()
    if suffix not in SUFFIXES:
        raise argument_error(name, GRAPHS, Path(path), "Give it the suffix of its format.")
    return SUFFIXES[suffix]


class _Reader:
    """Records of a file, collected line by line."""

    def __init__(self, path: str | Path, name: str, records: dict[str, Any], named: bool) -> None:
        self._path, self._name, self._records, self._named = path, name, records, named
        self._vertices: dict[str, dict[Node, tuple[int, list[float]]]] = {"pose": {}, "landmark": {}}
        self._times: list[float] = []
        self._fixed: list[tuple[int, Node]] = []
        self._found: dict[str, list[tuple[int, list[Node], list[float]]]] = {
            field: [] for field, _, _ in records.values()
        }

    def read(self, number: int, line: str) -> None:
        """Read a record."""
        tag, *words = line.split()
        if tag in VERTICES:
            kind = "pose" if tag == "VERTEX_SE2" else "landmark"
            if self._named and kind == "pose":
                self._times += self._numbers(words[:1], 1, number, line)
                words = words[1:]
            node = self._node(words[0] if words else "", kind, number, line)
            if node in self._vertices[kind]:
                raise line_error(self._name, "each vertex once", line, self._path, number)
            self._vertices[kind][node] = number, self._numbers(words[1:], VERTICES[tag], number, line)
        elif tag in self._records:
            field, kinds, size = self._records[tag]
            if self._named:  # a time stamp
                self._numbers(words[:1], 1, number, line)
                words = words[1:]
            nodes = [self._node(word, kind, number, line) for word, kind in zip(words, kinds, strict=False)]
            values = self._numbers(words[len(kinds) :], size + size * (size + 1) // 2, number, line)
            self._found[field].append((number, nodes, values))
        elif tag == "FIX" and not self._named:
            if not words:
                raise line_error(self._name, "FIX with an id", line, self._path, number)
            self._fixed += [(number, self._node(word, "pose", number, line)) for word in words]
        elif not tag.isupper():
            hint = f"Check {place(self._path, number)}: graphs have records such as VERTEX_SE2 or EDGE_SE2."
            raise argument_error(self._name, GRAPHS, repr(line), hint)
        else:
            known = ", ".join(dict.fromkeys([*VERTICES, *self._records, *([] if self._named else ["FIX"])]))
            hint = f"Remove or convert such records, as in {place(self._path, number)}."
            raise argument_error(self._name, f"records {known}", repr(tag), hint)

    def _numbers(self, words: list[str], count: int, number: int, line: str) -> list[float]:
        """Return so many finite numbers, or raise."""
        values = parse_numbers(words)
        if values is None or len(values) != count or not all(map(math.isfinite, values)):
            expected = f"{count} finite numbers after the ids of {line.split()[0]}"
            raise line_error(self._name, expected, line, self._path, number)
        return values

    def _node(self, word: str, kind: str, number: int, line: str) -> Node:
        """Return the node that a word names, or raise."""
        letter, digits = (word[:1], word[1:]) if self._named else ("", word)
        is_id = digits.isascii() and digits.isdecimal() and len(digits) < 20 and int(digits) <= LARGEST_ID
        if not self._named:
            if not is_id:
                raise line_error(self._name, "an id, an int >= 0", line, self._path, number)
            return -1, int(digits)
        if not (is_id and (letter == "L" if kind == "landmark" else letter in LETTERS and letter)):
            expected = "a name such as L3" if kind == "landmark" else "a name such as A3 or B12"
            raise line_error(self._name, expected, line, self._path, number)
        return (-1 if kind == "landmark" else LETTERS.index(letter)), int(digits)

    def graph(self) -> PoseGraph:
        """Return the graph of all records."""
        if not self._named and not any(self._vertices.values()):
            self._start_from_motions()
        poses = self._vertices["pose"]
        if not poses:
            raise argument_error(self._name, "a graph with poses", "no VERTEX_SE2", f"Check {str(self._path)!r}.")
        nodes = list(poses)
        # by id in g2o; by robot in pyfg, in the order of the file
        order = sorted(range(len(nodes)), key=lambda row: nodes[row] if not self._named else nodes[row][0])
        nodes = [nodes[row] for row in order]
        rows = {"pose": {node: row for row, node in enumerate(nodes)}}
        landmarks = self._vertices["landmark"] if self._named else dict(sorted(self._vertices["landmark"].items()))
        rows["landmark"] = {node: row for row, node in enumerate(landmarks)}
        factors: dict[str, Any] = {field: self._factors(field, rows) for field in self._found}
        fixed = np.zeros(len(nodes), dtype=np.bool_)
        for number, node in self._fixed:
            if node in rows["pose"]:
                fixed[rows["pose"][node]] = True
            elif node not in rows["landmark"]:
                raise line_error(self._name, "the id of a vertex", str(node[1]), self._path, number)
            else:
                raise line_error(self._name, "FIX of a pose", str(node[1]), self._path, number)
        robots = [robot for robot, _ in nodes] if self._named else _chains(len(nodes), factors["motions"].rows)
        if self._named:
            factors["pose_priors"], fixed = _exact(factors["pose_priors"], fixed)
        return PoseGraph(
            poses=np.array([poses[node][1] for node in nodes]),
            robots=np.asarray(robots, dtype=np.int64),
            pose_ids=np.array([i for _, i in nodes], dtype=np.int64),
            times=np.array(self._times)[order] if self._named else None,
            landmarks=np.array([values for _, values in landmarks.values()]).reshape(-1, 2),
            landmark_ids=np.array([i for _, i in landmarks], dtype=np.int64),
            fixed=fixed,
            **factors,
        )  # fmt: skip

    def _factors(self, field: str, rows: dict[str, dict[Node, int]]) -> Factors:
        """Return the measurements of one kind, with covariances."""
        _, kinds, size = next(record for record in self._records.values() if record[0] == field)
        found = self._found[field]
        if not found:
            return Factors.none(size, linked=len(kinds) == 2)
        for number, nodes, _ in found:
            for node, kind in zip(nodes, kinds, strict=True):
                if node not in rows[kind]:
                    known = f"the id of a {kind} that has a vertex"
                    text = self._word(node)
                    raise line_error(self._name, known, text, self._path, number)
            if len(set(nodes)) < len(nodes) and kinds == ("pose", "pose"):
                raise line_error(self._name, "two different poses", self._word(nodes[0]), self._path, number)
        at = np.array([[rows[k][node] for node, k in zip(nodes, kinds, strict=True)] for _, nodes, _ in found])
        table = np.array([values for _, _, values in found])
        matrices = np.empty((len(found), size, size))
        upper = np.triu_indices(size)
        matrices[:, upper[0], upper[1]] = matrices[:, upper[1], upper[0]] = table[:, size:]
        bad = np.flatnonzero(~positive_definite(matrices))
        if len(bad):
            kind = "covariance" if self._named else "information"
            got = " ".join(f"{value:g}" for value in table[bad[0], size:])
            raise line_error(self._name, f"a positive definite {kind} matrix", got, self._path, found[bad[0]][0])
        covariances = matrices if self._named else _inverses(matrices)
        return Factors(at if len(kinds) == 2 else at[:, 0], table[:, :size], covariances)

    def _word(self, node: Node) -> str:
        """Return how a file names a node."""
        return str(node[1]) if not self._named else f"{'L' if node[0] < 0 else LETTERS[node[0]]}{node[1]}"

    def _start_from_motions(self) -> None:
        """Place poses by chained motions and landmarks where they are first seen, for files without vertices."""
        poses, landmarks = self._vertices["pose"], self._vertices["landmark"]
        for number, (a, b), values in sorted(self._found["motions"], key=lambda record: record[1]):
            if a not in poses and b not in poses:
                poses[a] = number, [0.0, 0.0, 0.0]
            if a in poses and b not in poses:
                poses[b] = number, compose(poses[a][1], values[:3]).tolist()
            elif b in poses and a not in poses:
                poses[a] = number, compose(poses[b][1], between(values[:3], np.zeros(3))).tolist()
        for number, (pose, landmark), values in self._found["sightings"]:
            if pose in poses:
                at = transform_points(poses[pose][1], np.array([values[:2]]))[0].tolist()
                landmarks.setdefault(landmark, (number, at))


def _chains(count: int, rows: IntArray) -> IntArray:
    """Return the robot (count,) of poses in order of ids: a new one where no motion (m, 2) links it to the last."""
    linked = np.zeros(max(count, 1), dtype=np.bool_)
    low = rows.min(axis=1, initial=count)
    linked[low[np.abs(rows[:, 1] - rows[:, 0]) == 1] + 1] = True
    return np.cumsum(~linked[:count]) - 1


def _exact(priors: Factors, fixed: Any) -> tuple[Factors, Any]:
    """Return the priors but those that stand for fixed poses, and the mask of these."""
    stands = (priors.covariances == EXACT * np.eye(3)).all(axis=(1, 2))
    fixed[priors.rows[stands]] = True
    return Factors(*(column[~stands] for column in priors)), fixed


def _inverses(matrices: FloatArray) -> FloatArray:
    """Return the inverses (n, d, d) of symmetric positive definite matrices, symmetric to the last bit."""
    inverses = np.linalg.inv(matrices)
    return np.asarray(0.5 * (inverses + inverses.transpose(0, 2, 1)))


def _g2o_lines(graph: PoseGraph) -> Iterator[str]:
    """Yield the lines of a graph in g2o."""
    poses, landmarks = graph.pose_ids, graph.landmark_ids
    if len(np.unique(np.concatenate([poses, landmarks]))) < len(poses) + len(landmarks):
        poses = landmarks.max(initial=-1) + 1 + np.arange(len(poses))
    ids = {"pose": poses.tolist(), "landmark": landmarks.tolist()}
    for i, pose in zip(ids["pose"], graph.poses, strict=True):
        yield _line("VERTEX_SE2", [i], pose)
    for i, landmark in zip(ids["landmark"], graph.landmarks, strict=True):
        yield _line("VERTEX_XY", [i], landmark)
    for tag, (field, kinds, size) in G2O.items():
        if tag != "LANDMARK2":
            yield from _factor_lines(tag, getattr(graph, field), [ids[kind] for kind in kinds], size, None)
    for row in np.flatnonzero(graph.fixed).tolist():  # last, as GTSAM reads no further
        yield f"FIX {ids['pose'][row]}"


def _pyfg_lines(graph: PoseGraph) -> Iterator[str]:
    """Yield the lines of a graph in pyfg."""
    poses, landmarks = graph.names()
    names = {"pose": poses, "landmark": landmarks}
    times = np.zeros(len(poses)) if graph.times is None else graph.times
    for time, name, pose in zip(times, poses, graph.poses, strict=True):
        yield _line(f"VERTEX_SE2 {float(time)!r}", [name], pose)
    for name, landmark in zip(landmarks, graph.landmarks, strict=True):
        yield _line("VERTEX_XY", [name], landmark)
    rows = np.flatnonzero(graph.fixed)
    exact = Factors(rows, graph.poses[rows], np.tile(EXACT * np.eye(3), (len(rows), 1, 1)))
    yield from _factor_lines("VERTEX_SE2:PRIOR", exact, [poses], 3, times)
    for tag, (field, kinds, size) in PYFG.items():
        stamps = np.zeros(len(landmarks)) if kinds[0] == "landmark" else times
        yield from _factor_lines(tag, getattr(graph, field), [names[kind] for kind in kinds], size, stamps)


def _factor_lines(
    tag: str, factors: Factors, names: list[list[Any]], size: int, times: FloatArray | None
) -> Iterator[str]:
    """Yield the lines of measurements of one kind, with information matrices, or covariances where there are times."""
    matrices = _inverses(factors.covariances) if times is None else factors.covariances
    upper = np.triu_indices(size)
    rows = factors.rows if factors.rows.ndim == 2 else factors.rows[:, None]
    for nodes, value, matrix in zip(rows.tolist(), factors.values, matrices, strict=True):
        stamp = tag if times is None else f"{tag} {float(times[nodes[0]])!r}"
        words = [of[row] for of, row in zip(names, nodes, strict=True)]
        yield _line(stamp, words, np.concatenate([value, matrix[upper]]))


def _line(tag: str, names: list[Any], numbers: FloatArray) -> str:
    """Return a record, with numbers in the shortest form that reads back bit for bit."""
    return " ".join([tag, *map(str, names), *(repr(float(number)) for number in numbers)])
