"""Pose graphs in g2o and pyfg: round trips, documented examples, and refusals with file and line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.core.validation import FloatArray
from slam_backend.pose_graph import Factors, PoseGraph
from slam_backend.readers.pose_graphs import MOST_MEGABYTES, read_graph, write_graph

KINDS = ("motions", "sightings", "pose_priors", "landmark_priors")


def matrices(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    """Return positive definite matrices (count, size, size) of different scales."""
    roots = rng.standard_normal((count, size, size)) * rng.uniform(1e-3, 1e2, (count, 1, 1))
    return roots @ roots.transpose(0, 2, 1) + 1e-6 * np.eye(size)


def drawn(seed: int, **parts: Any) -> PoseGraph:
    """Return a graph of three robots with 5, 1 and 4 poses, 7 landmarks and all kinds of measurements."""
    rng = np.random.default_rng(seed)
    robots = np.repeat([0, 1, 2], [5, 1, 4])
    links = np.array([[0, 1], [1, 2], [3, 2], [3, 4], [6, 7], [7, 8], [8, 9], [0, 9], [4, 0]])
    sights = np.column_stack([rng.integers(0, 10, 13), rng.integers(0, 7, 13)])
    values = {
        "poses": 10.0 * rng.standard_normal((10, 3)), "robots": robots,
        "pose_ids": np.array([0, 2, 3, 17, 40, 0, 1, 2, 3, 4]), "times": rng.uniform(0.0, 1e9, 10),
        "landmarks": rng.standard_normal((7, 2)), "landmark_ids": np.array([2, 4, 5, 6, 9, 12, 31]),
        "motions": Factors(links, rng.standard_normal((9, 3)), matrices(rng, 9, 3)),
        "sightings": Factors(sights, rng.standard_normal((13, 2)), matrices(rng, 13, 2)),
        "pose_priors": Factors(np.array([6, 0]), rng.standard_normal((2, 3)), matrices(rng, 2, 3)),
        "landmark_priors": Factors(np.array([5]), rng.standard_normal((1, 2)), matrices(rng, 1, 2)),
    }  # fmt: skip
    return PoseGraph(**values | parts)


def assert_same(a: PoseGraph, b: PoseGraph, but: tuple[str, ...] = (), exactly: bool = True) -> None:
    """Compare all fields of two graphs; covariances up to rounding unless `exactly`."""
    for name in ("poses", "robots", "pose_ids", "times", "landmarks", "landmark_ids", "fixed"):
        if name not in but:
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for name in KINDS:
        one, other = getattr(a, name), getattr(b, name)
        assert np.array_equal(one.rows, other.rows), name
        assert np.array_equal(one.values, other.values), name
        for left, right in zip(one.covariances, other.covariances, strict=True):
            np.testing.assert_allclose(
                left, right, rtol=0.0 if exactly else 1e-6, atol=0.0 if exactly else 1e-9 * left.max()
            )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("suffix", ["pyfg", "fg"])
def test_pyfg_reads_back_bit_for_bit(seed: int, suffix: str, tmp_path: Path) -> None:
    """A graph written as pyfg reads back equal, covariances included."""
    graph = drawn(seed)
    assert_same(graph, read_graph(write_graph(graph, tmp_path / f"a.{suffix}")))


@pytest.mark.parametrize("seed", range(5))
def test_g2o_reads_back(seed: int, tmp_path: Path) -> None:
    """A graph written as g2o reads back equal but for times, and covariances but for the rounding of two inverses."""
    ids = np.array([0, 1, 3, 7, 8, 20, 100, 101, 102, 103])
    fixed = np.arange(10) % 3 == 0
    graph = drawn(seed, pose_ids=ids, fixed=fixed)
    again = read_graph(write_graph(graph, tmp_path / "a.g2o"))
    assert_same(graph, again, but=("times",), exactly=False)
    assert again.times is None


def test_g2o_numbers_poses_after_landmarks_where_ids_clash(tmp_path: Path) -> None:
    """Clashing ids leave those of the landmarks, and poses get the next ones in their order."""
    graph = drawn(1)
    again = read_graph(write_graph(graph, tmp_path / "a.g2o"))
    assert_same(graph, again, but=("times", "pose_ids"), exactly=False)
    assert again.pose_ids.tolist() == list(range(32, 42))


def test_pyfg_writes_fixed_poses_as_tight_priors(tmp_path: Path) -> None:
    """As pyfg has no exact poses, one of variance 1e-12 reads back as fixed."""
    graph = drawn(2, fixed=np.arange(10) == 5)
    path = write_graph(graph, tmp_path / "a.pyfg")
    assert "VERTEX_SE2:PRIOR" in path.read_text()
    assert "1e-12 0.0 0.0 1e-12 0.0 1e-12" in path.read_text()
    assert_same(graph, read_graph(path))


def test_example_of_g2o(tmp_path: Path) -> None:
    """Records in any order, with comments, read as their documentation says: upper triangles of information."""
    (tmp_path / "a.g2o").write_text(
        "# comment\nEDGE_SE2 1 4 1 0.5 0.25 4 0 0 16 0 25\nVERTEX_SE2 4 1 0 0\nVERTEX_SE2 1 0 0 0\nFIX 1\n"
        "VERTEX_XY 7 3 2\nEDGE_SE2_XY 4 7 2 1 4 1 2  # sighting\n"
    )
    graph = read_graph(tmp_path / "a.g2o")
    assert graph.pose_ids.tolist() == [1, 4]
    assert graph.robots.tolist() == [0, 0]
    assert graph.fixed.tolist() == [True, False]
    assert graph.motions.rows.tolist() == [[0, 1]]
    assert graph.sightings.rows.tolist() == [[1, 0]]
    np.testing.assert_allclose(graph.motions.covariances[0], np.diag([0.25, 0.0625, 0.04]))
    np.testing.assert_allclose(graph.sightings.covariances[0] @ [[4.0, 1.0], [1.0, 2.0]], np.eye(2), atol=1e-15)
    assert graph.landmark_ids.tolist() == [7]
    assert graph.landmarks.tolist() == [[3.0, 2.0]]


def test_example_of_pyfg(tmp_path: Path) -> None:
    """Names have a letter for each robot and L for landmarks, vertices and measurements have stamps."""
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 0.5 A0 0 0 0\nVERTEX_SE2 1.5 A1 1.033099 0.093536 0.4499639\nVERTEX_SE2 0.5 B0 2 0 0\n"
        "VERTEX_XY L0 2.5 -0.5\nVERTEX_SE2:PRIOR 0.5 A0 0 0 0 0.01 0 0 0.01 0 0.04\n"
        "VERTEX_XY:PRIOR 0.5 L0 2.5 -0.5 0.01 0 0.01\nEDGE_SE2 0.5 A0 A1 1 0.1 0.45 0.01 0 0 0.01 0 0.04\n"
        "EDGE_SE2_XY 0.5 B0 L0 0.5 -0.5 0.01 0.001 0.02\n"
    )
    graph = read_graph(tmp_path / "a.pyfg")
    assert graph.names() == (["A0", "A1", "B0"], ["L0"])
    assert graph.times.tolist() == [0.5, 1.5, 0.5]
    assert graph.sightings.rows.tolist() == [[2, 0]]
    assert graph.sightings.covariances[0].tolist() == [[0.01, 0.001], [0.001, 0.02]]
    assert graph.pose_priors.rows.tolist() == [0]
    assert graph.landmark_priors.values.tolist() == [[2.5, -0.5]]


def test_graph_without_vertices_starts_from_its_motions(tmp_path: Path) -> None:
    """Without vertices poses are chained and landmarks placed where first seen; ids may be those of poses."""
    (tmp_path / "a.g2o").write_text(
        "EDGE_SE2 0 1 1 0 1.5707963267948966 50 0 0 50 0 100\nEDGE_SE2 1 3 2 0 0 50 0 0 50 0 100\n"
        "LANDMARK2 3 1 1 0 10 0 10\n"
    )
    graph = read_graph(tmp_path / "a.g2o")
    np.testing.assert_allclose(graph.poses, [[0, 0, 0], [1, 0, np.pi / 2], [1, 2, np.pi / 2]], atol=1e-12)
    np.testing.assert_allclose(graph.landmarks, [[1, 3]], atol=1e-12)


def test_another_robot_begins_where_the_chain_of_g2o_breaks(tmp_path: Path) -> None:
    """Poses that no motion links to the one before belong to the next robot."""
    lines = [f"VERTEX_SE2 {i} 0 0 0" for i in (0, 1, 5, 6, 9)]
    lines += [f"EDGE_SE2 {a} {b} 1 0 0 1 0 0 1 0 1" for a, b in ((1, 0), (5, 6), (0, 9))]
    (tmp_path / "a.g2o").write_text("\n".join(lines))
    assert read_graph(tmp_path / "a.g2o").robots.tolist() == [0, 0, 1, 1, 2]


BAD_G2O = {
    "EDGE_RANGE 0 1 2.0 0.1": r"path: expected records VERTEX_SE2, .*, FIX, got 'EDGE_RANGE'\. Remove or convert such "
    r"records, as in line 5 of ",
    "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1": "got 'EDGE_SE3:QUAT'",
    "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1": "got 'VERTEX_SE3:QUAT'",
    "VERTEX_TRACKXYZ 3 0 0 0": "got 'VERTEX_TRACKXYZ'",
    "EDGE_BEARING_SE2_XY 0 5 0.1 1": "got 'EDGE_BEARING_SE2_XY'",
    "VERTEX2 7 0 0 0": "got 'VERTEX2'",
    "VERTEX_SE2 3 0 0": "path: expected 3 finite numbers after the ids of VERTEX_SE2, got 'VERTEX_SE2 3 0 0'. Correct",
    "VERTEX_SE2 3 0 0 nan": "path: expected 3 finite numbers",
    "VERTEX_SE2 3 0 0 1_0": "path: expected 3 finite numbers",
    "VERTEX_SE2 -3 0 0 0": "path: expected an id, an int >= 0",
    "VERTEX_SE2 99999999999999999999 0 0 0": "path: expected an id, an int >= 0",
    "VERTEX_SE2": "path: expected an id, an int >= 0",
    "VERTEX_SE2 0 1 1 1": "path: expected each vertex once, got 'VERTEX_SE2 0 1 1 1'. Correct line 5",
    "EDGE_SE2 0 3 1 0 0 1 0 0 1 0 1": "path: expected the id of a pose that has a vertex, got '3'. Correct line 5",
    "EDGE_SE2_XY 0 1 1 0 1 0 1": "path: expected the id of a landmark that has a vertex, got '1'. Correct line 5",
    "EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1": "path: expected two different poses, got '0'. Correct line 5",
    "EDGE_SE2 0 1 1 0 0 1 0 0 1 0": "path: expected 9 finite numbers after the ids of EDGE_SE2",
    "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 0": "path: expected a positive definite information matrix, got '1 0 0 1 0 0'.",
    "EDGE_SE2_XY 0 5 1 0 1 2 1": "path: expected a positive definite information matrix, got '1 2 1'. Correct line 5",
    "EDGE_SE2_XY 0 5 1 0 1 0 inf": "path: expected 5 finite numbers",
    "FIX 9": "path: expected the id of a vertex, got '9'. Correct line 5",
    "FIX 5": "path: expected FIX of a pose, got '5'. Correct line 5",
    "FIX": "path: expected FIX with an id, got 'FIX'. Correct line 5",
}


@pytest.mark.parametrize("line", BAD_G2O)
def test_bad_lines_of_g2o_are_refused(line: str, tmp_path: Path) -> None:
    """Other records, malformed lines, bad numbers, matrices and ids are refused with the line and what helps."""
    good = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 5 1 1\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    (tmp_path / "a.g2o").write_text(good + line + "\n")
    with pytest.raises(ValueError, match=BAD_G2O[line]) as caught:
        read_graph(tmp_path / "a.g2o")
    assert "line 5 of " in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_PYFG = {
    "EDGE_RANGE 0 A0 L0 2.0 0.1": "got 'EDGE_RANGE'",
    "VERTEX_SE2 0 L1 0 0 0": "path: expected a name such as A3 or B12",
    "VERTEX_SE2 0 A 0 0 0": "path: expected a name such as A3 or B12",
    "VERTEX_SE2 x A1 0 0 0": "path: expected 1 finite numbers",
    "VERTEX_XY A1 0 0": "path: expected a name such as L3",
    "EDGE_SE2_XY 0 A0 A0 1 1 1 0 1": "path: expected a name such as L3",
    "EDGE_SE2_XY 0 A0 L0 1 1 1 2 1": "path: expected a positive definite covariance matrix",
    "EDGE_SE2_XY 0 B0 L0 1 1 1 0 1": "path: expected the id of a pose that has a vertex, got 'B0'. Correct line 3",
    "FIX A0": "got 'FIX'",
}


@pytest.mark.parametrize("line", BAD_PYFG)
def test_bad_lines_of_pyfg_are_refused(line: str, tmp_path: Path) -> None:
    """Names of other kinds, range measurements and records of g2o are refused with the line and what helps."""
    (tmp_path / "a.pyfg").write_text("VERTEX_SE2 0 A0 0 0 0\nVERTEX_XY L0 1 1\n" + line + "\n")
    with pytest.raises(ValueError, match=BAD_PYFG[line]) as caught:
        read_graph(tmp_path / "a.pyfg")
    assert "line 3 of " in str(caught.value)


def test_bad_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing, empty, too large or otherwise named file is refused in one line, before it is read."""
    graphs = r"path: expected a pose graph \(\.g2o, \.pyfg, \.fg\), got"
    (tmp_path / "a.txt").touch()
    with pytest.raises(ValueError, match=rf"{graphs} .*a\.txt'\. Give it the suffix of its format"):
        read_graph(tmp_path / "a.txt")
    with pytest.raises(ValueError, match=rf"{graphs} no such file\. Check '.*a\.g2o'"):
        read_graph(tmp_path / "a.g2o")
    (tmp_path / "a.g2o").write_text("# notes\nsome words\n")
    with pytest.raises(ValueError, match=rf"{graphs} 'some words'\. Check line 2 of .*a\.g2o: graphs have records"):
        read_graph(tmp_path / "a.g2o")
    (tmp_path / "a.g2o").write_text("# nothing\n")
    with pytest.raises(ValueError, match="path: expected a graph with poses, got no VERTEX_SE2"):
        read_graph(tmp_path / "a.g2o")
    with open(tmp_path / "b.pyfg", "wb") as large:
        large.truncate((MOST_MEGABYTES << 20) + 1)
    with pytest.raises(ValueError, match=r"expected a pose graph \(pyfg\) of at most 64 MiB"):
        read_graph(tmp_path / "b.pyfg")
    many = PoseGraph(poses=np.zeros((26, 3)), robots=np.arange(26))
    assert read_graph(write_graph(many, tmp_path / "many.g2o")).num_robots == 26
    with pytest.raises(ValueError, match="graph: expected at most 25 robots, got 26"):
        write_graph(many, tmp_path / "many.pyfg")
    with pytest.raises(ValueError, match="graph: expected a PoseGraph, got 3"):
        write_graph(3, tmp_path / "c.g2o")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"poses": np.zeros((10, 2))}, r"poses: expected an array of shape \(n, 3\), got shape \(10, 2\)"),
        ({"poses": np.full((10, 3), np.nan)}, "poses: expected finite numbers"),
        ({"robots": -np.ones(10)}, "robots: expected ints >= 0, got -1"),
        ({"landmark_ids": np.zeros(7)}, "landmark_ids: expected distinct ids"),
        ({"pose_ids": np.zeros(10)}, "pose_ids: expected distinct ids"),
        ({"times": np.zeros(3)}, r"times: expected an array of shape \(10,\)"),
        ({"fixed": np.zeros(3)}, r"fixed: expected an array of shape \(10,\)"),
        (
            {"sightings": Factors(np.array([[0, 7]]), np.zeros((1, 2)), np.eye(2)[None])},
            "sightings.rows: expected rows of",
        ),
        (
            {"sightings": Factors(np.array([[0, 6]]), np.zeros((1, 2)), -np.eye(2)[None])},
            "sightings.covariances: expected",
        ),
        (
            {"motions": Factors(np.array([[0, 1]]), np.zeros((2, 3)), np.eye(3)[None])},
            "motions.values: expected an array",
        ),
    ],
)
def test_arrays_that_are_no_graph_are_refused(parts: dict[str, Any], message: str) -> None:
    """Wrong shapes, rows, ids and matrices are refused when a graph is made."""
    with pytest.raises(ValueError, match=message):
        drawn(1, **parts)


def test_graphs_are_immutable() -> None:
    """The arrays of a graph are read-only copies."""
    poses = np.zeros((2, 3))
    graph = PoseGraph(poses=poses)
    poses[:] = 1.0
    assert not graph.poses.any()
    with pytest.raises(ValueError, match="read-only"):
        graph.poses[0, 0] = 1.0
    assert repr(graph) == "PoseGraph(2 poses of 1 robots, 0 landmarks, 0 motions, 0 sightings)"


def test_files_that_gtsam_writes_can_be_read(tmp_path: Path) -> None:
    """What GTSAM writes reads back: poses, landmarks and motions with their covariances, to its six digits."""
    gtsam = pytest.importorskip("gtsam", reason="gtsam, an optional peer, is not installed: pip install gtsam")
    rng = np.random.default_rng(7)
    (tmp_path / "point.g2o").write_text("VERTEX_XY 2 1.5 -2.5\n")  # Python has no other way to insert a Point2
    graph, values = gtsam.readG2o(str(tmp_path / "point.g2o"), False)
    covariances = matrices(rng, 4, 3)
    poses, motions = rng.standard_normal((5, 3)), rng.standard_normal((4, 3))
    for step, pose in enumerate(poses):
        values.insert(gtsam.symbol("x", step), gtsam.Pose2(*pose))
    for step, (motion, covariance) in enumerate(zip(motions, covariances, strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        keys = gtsam.symbol("x", step), gtsam.symbol("x", step + 1)
        graph.add(gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*motion), noise))
    gtsam.writeG2o(graph, values, str(tmp_path / "a.g2o"))
    read = read_graph(tmp_path / "a.g2o")
    np.testing.assert_allclose(read.poses, poses, rtol=1e-5)
    np.testing.assert_allclose(read.motions.values, motions, rtol=1e-5)
    assert read.landmarks.tolist() == [[1.5, -2.5]]
    assert read.landmark_ids.tolist() == [2]
    assert read.robots.tolist() == [0] * 5
    assert len(read.motions.rows) == 4
