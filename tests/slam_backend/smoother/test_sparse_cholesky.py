"""Sparse Cholesky factorisation compared with dense matrices: ordering, solutions, covariances and samples."""

from typing import NamedTuple

import numpy as np
import pytest
from builders.runs import BIASED, TIGHT, camera_of, graph_of, small_run

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import _kernels
from slam_backend.smoother.graph import LEVER, NONE, SlamGraph
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise
from slam_backend.smoother.optimizer import MapEstimate, NormalEquations, gathered, optimize
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.sampling import transition_variances


def order_again(system: NormalEquations, graph: SlamGraph, size: int, few: int) -> None:
    """Factor the equations again, landmarks of at most `few` poses first."""
    system.pattern = _kernels.lay_out(system.columns, graph.parents, system.biases, system.sightings, size, few)
    system.factor = system.factor._replace(values=np.empty((len(system.pattern.rows), 9)))
    assert system.factorise(0.0)


class Problem(NamedTuple):
    """A graph, its mode, and the dense information of its poses and landmarks, (N, 3, N, 3).

    Landmarks of at most `few` poses are eliminated first.
    """

    graph: SlamGraph
    mode: MapEstimate
    dense: FloatArray
    few: int


def problem(robots: int, max_keys: int, motion: OdometryModel | None = None, few: int = 0) -> Problem:
    """Return one of each kind: raw and frozen sightings, poses that are given, landmarks that poses share."""
    run = small_run(robots)
    camera = camera_of(run)
    options = SmoothingOptions(max_keys=max_keys, further_keys=0, recent_keys=6, kernel=0.0)
    graph = graph_of(run, motion=motion)
    mode = optimize(graph, camera, TIGHT)
    graph = reduce_keyframes(relinearise(graph, mode, transition_variances(graph, mode)), camera, options)
    mode = optimize(graph, camera, TIGHT)
    system, seen = mode.system, mode.sightings
    assert system is not None
    n = system.num_poses
    size = n + len(graph.landmarks)
    order_again(system, graph, size, few)
    dense = np.zeros((size, 3, size, 3))
    for node, block in enumerate(system.equations.blocks):
        dense[node, :, node] = block[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    for b, a in enumerate(graph.parents):
        if a >= 0 and min(mode.columns[a], mode.columns[b]) >= 0:
            i, j = mode.columns[[b, a]] // 3
            dense[i, :, j], dense[j, :, i] = system.equations.links[b], system.equations.links[b].T
    for b, bias in enumerate(graph.biases_of_odometry()):
        for key in {b, int(graph.parents[b])} if bias >= 0 else ():
            if mode.columns[key] >= 0:
                i, j = mode.columns[[key, bias]] // 3
                dense[i, :, j] = system.equations.bias_links[key]
                dense[j, :, i] = system.equations.bias_links[key].T
    for q, (key, landmark) in enumerate(zip(seen.keys, seen.landmarks, strict=True)):
        if mode.columns[key] >= 0:
            i, j = mode.columns[key] // 3, n + landmark
            dense[i, :, j] += system.equations.cross[q]
            dense[j, :, i] += system.equations.cross[q].T
    return Problem(graph, mode, dense, few)


PROBLEMS = {
    "one robot": problem(1, 12),
    "two robots": problem(2, 1000),
    "one biased robot": problem(1, 12, BIASED),
    "two biased robots": problem(2, 1000, BIASED),
    "few poses first": problem(1, 12, few=3),
    "few of two biased robots first": problem(2, 1000, BIASED, few=4),
}


@pytest.fixture(params=PROBLEMS)
def posed(request: pytest.FixtureRequest) -> Problem:
    """Return each of them in turn."""
    return PROBLEMS[request.param]


def information(posed: Problem) -> FloatArray:
    """Return that of the poses (3 n, 3 n), landmarks integrated out as one learns it."""
    assert posed.mode.system is not None
    size = posed.dense.shape[0] * 3
    whole, n = posed.dense.reshape(size, size), 3 * posed.mode.system.num_poses
    return np.asarray(whole[:n, :n] - whole[:n, n:] @ np.linalg.solve(whole[n:, n:], whole[n:, :n]))


def test_a_node_with_the_fewest_neighbours_goes_first(posed):
    """The order is that of the textbook with sets for neighbours, and so is what it fills in.

    That is so after the landmarks of few poses.
    """
    size = len(posed.dense)
    near = [set(np.flatnonzero(row)) - {i} for i, row in enumerate(np.abs(posed.dense).sum(axis=(1, 3)) > 0)]
    assert posed.mode.system is not None
    pattern = posed.mode.system.pattern
    order = pattern.order
    assert sorted(order.tolist()) == list(range(size))
    left, count = set(range(size)), 0
    landmarks = range(posed.mode.system.num_poses, size)
    first = {node for node in landmarks if len(near[node]) <= posed.few} if posed.few else set()
    assert bool(first) == bool(posed.few)
    assert set(order[: len(first)].tolist()) == first
    for turn, node in enumerate(order.tolist()):
        assert turn < len(first) or len(near[node]) == min(len(near[other]) for other in left)
        left.remove(node)
        count += len(near[node])
        for other in near[node]:
            near[other] = (near[other] | near[node]) - {other, node}
    assert len(pattern.rows) == count


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_solution_is_the_dense_one(posed, damping):
    """Factored block by block, the damped equations have the solution that numpy finds."""
    system, dense = posed.mode.system, posed.dense.copy()
    assert system is not None
    size = 3 * len(dense)
    whole = dense.reshape(size, size)
    each = np.arange(3 * system.num_poses)
    whole[each, each] *= 1.0 + damping
    assert system.factorise(damping)
    poses, landmarks, vector = posed.mode.poses, posed.mode.landmarks, system.equations.vector
    new_poses, new_landmarks, rise, largest = system.step(poses, landmarks)
    assert system.factorise(0.0)
    found = -np.linalg.solve(whole, vector.ravel()).reshape(-1, 3)
    assert rise == pytest.approx((found * vector).sum())
    assert largest == pytest.approx(np.abs(found[: system.num_poses]).max())
    sought = system.columns >= 0
    np.testing.assert_array_equal(new_poses[~sought], poses[~sought])
    order = system.columns[sought] // 3
    np.testing.assert_allclose((new_poses - poses)[sought], found[order], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(new_landmarks - landmarks, found[system.num_poses :], rtol=1e-6, atol=1e-12)


def test_a_matrix_that_is_not_positive_definite_has_no_factor(posed):
    """A pivot of negative information is reported wherever it is."""
    system = posed.mode.system
    assert system is not None
    blocks = system.equations.blocks
    for node in (0, len(blocks) - 1):
        kept = blocks[node].copy()
        blocks[node] = -kept
        assert not system.factorise(0.0)
        blocks[node] = kept
    assert system.factorise(0.0)


def test_covariances_of_poses_are_the_dense_ones(posed):
    """The inverse of the information with all landmarks integrated out."""
    found = posed.mode.covariance(np.flatnonzero(posed.mode.columns >= 0))
    np.testing.assert_allclose(found @ information(posed), np.eye(len(found)), atol=1e-6)


def test_blocks_of_the_inverse_are_the_solutions_for_unit_vectors(posed):
    """Skipped columns would have added zero: the results have the same bits, made symmetric."""
    system = posed.mode.system
    assert system is not None
    nodes = np.array([system.num_poses - 1, 2])
    found = _kernels.covariance(system.factor, system.pattern, nodes)
    expected, poses, landmarks = (
        np.empty((6, 6)),
        np.zeros(posed.mode.poses.shape),
        np.zeros(posed.mode.landmarks.shape),
    )
    for column in range(6):
        vector = np.zeros(system.equations.vector.shape)
        vector[nodes[column // 3], column % 3] = -1.0
        equations = system.equations._replace(vector=vector)
        solved = _kernels.step(equations, system.factor, system.pattern, system.columns, poses, landmarks)[0]
        expected[:, column] = np.concatenate([solved[system.columns == 3 * node].ravel() for node in nodes])
    np.testing.assert_array_equal(found, 0.5 * (expected + expected.T))


def test_drawn_variances_of_motions_are_those_of_the_dense_covariance(posed):
    """Derivatives of motions by differences, and the dense inverse, give how far each motion scatters over draws.

    A mean of 63 squares has a standard deviation of at most 18 %, if one direction dominates; 0.7 is 4 sigma.
    """
    graph, mode = posed.graph, posed.mode
    covariance, found = np.linalg.inv(information(posed)), transition_variances(graph, mode)
    ratios = []
    for b, a in enumerate(graph.parents):
        if a < 0:
            assert found[b] == 0.0
            continue
        rows, columns = [], []
        for key in (a, b):
            for axis in range(3 if mode.columns[key] >= 0 else 0):
                ahead, behind = mode.poses.copy(), mode.poses.copy()
                ahead[key, axis] += 1e-6
                behind[key, axis] -= 1e-6
                columns.append((between(ahead[a], ahead[b]) - between(behind[a], behind[b])) / 2e-6)
                rows.append(mode.columns[key] + axis)
        by = np.array(columns).T
        scatter = np.diag(by @ covariance[np.ix_(rows, rows)] @ by.T)
        ratios.append(found[b] / (scatter[0] + scatter[1] + LEVER**2 * scatter[2]))
    np.testing.assert_allclose(ratios, 1.0, atol=0.7)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


def test_a_symbolic_factor_lists_sampled_nodes(posed):
    """Poses are drawn, and landmarks for which a pose waits."""
    assert posed.mode.system is not None
    p, num_poses = posed.mode.system.pattern, posed.mode.system.num_poses
    assert p.drawn == sum(node < num_poses or rank in p.rows for rank, node in enumerate(p.order.tolist()))


def test_densities_of_paths_are_the_dense_ones(posed):
    """Though some landmarks are drawn with the poses, log q is that of the path alone."""
    mode = posed.mode
    paths, log_densities = mode.paths(40, np.random.default_rng(3))
    off = (paths - mode.poses[:, :, None])[mode.columns >= 0].reshape(-1, 40)
    expected = -0.5 * np.einsum("im,ij,jm->m", off, information(posed), off)
    np.testing.assert_allclose(log_densities - log_densities[0], expected - expected[0], rtol=1e-6, atol=1e-6)
    assert np.ptp(expected) > 1.0
    np.testing.assert_array_equal(paths[:, :, 0], mode.poses)


def test_sightings_are_gathered_as_by_sorting():
    """Frozen sightings and raw measurements, in no order, are put in that of landmarks and keys, and added up."""
    rng = np.random.default_rng(4)
    keys, landmarks, frames = 5, 4, 9
    frozen = np.sort(rng.choice(keys * landmarks, 8, replace=False))
    graph = SlamGraph(
        robots=np.zeros(keys, dtype=np.int64), poses=np.zeros((keys, 3)), landmarks=np.zeros((landmarks, 3)),
        landmark_ids=np.arange(landmarks), first_keys=np.zeros(1, dtype=np.int64),
        bias_keys=np.full(1, NONE),
        last_keys=np.zeros(1, dtype=np.int64),
        latest=np.zeros(1, dtype=np.int64), condensed_keys=frozen % keys, condensed_landmarks=frozen // keys,
        linearisation_points=rng.normal(size=(8, 3)), information=rng.normal(size=(8, 6)),
        gradients=rng.normal(size=(8, 3)),
        counts=rng.integers(1, 5, 8), frame_keys=rng.integers(0, keys, frames), points=np.zeros((60, 3)),
        point_frames=rng.integers(0, frames, 60), point_landmarks=rng.integers(0, landmarks, 60),
    )  # fmt: skip
    seen = gathered(graph)
    of_raw = graph.point_landmarks * keys + graph.frame_keys[graph.point_frames]
    raw, counts = np.unique(of_raw, return_counts=True)
    codes = seen.landmarks * keys + seen.keys
    np.testing.assert_array_equal(codes, np.sort(np.concatenate([frozen, raw]), kind="stable"))
    np.testing.assert_array_equal(codes[seen.condensed], frozen)
    np.testing.assert_array_equal(codes[seen.of_points], of_raw)
    assert not seen.condensed[seen.of_points].any()
    np.testing.assert_array_equal(seen.counts[seen.condensed], graph.counts)
    np.testing.assert_array_equal(seen.counts[~seen.condensed], counts)
    np.testing.assert_array_equal(seen.starts, np.searchsorted(seen.landmarks, np.arange(landmarks + 1)))
    for name in ("linearisation_points", "information", "gradients"):
        np.testing.assert_array_equal(getattr(seen, name)[seen.condensed], getattr(graph, name))
        assert not getattr(seen, name)[~seen.condensed].any()
