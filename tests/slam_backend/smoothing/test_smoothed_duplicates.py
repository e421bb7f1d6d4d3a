from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from small_problems import TIGHT, camera_of, graph_of, logs_of, small_run

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.smoother.duplicates import alike_pairs, find_duplicates, without_duplicates
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.sampling import draw_paths

NEW_NAME = 1000


def renamed_run():
    """Return a run's graph in which the landmark seen most is called otherwise from some step on, and its two names."""
    run = small_run()
    every = np.concatenate([names[0] for names in run.names])
    often = int(np.bincount(every).argmax())
    when = [step for step in range(run.num_steps) if often in run.names[step][0]]
    log = RobotLog()
    for row in logs_of(run)[0]:
        ids = np.where((row.ids == often) & (row.step >= when[len(when) // 2]), NEW_NAME, row.ids)
        log.append(row.step, row.motion if row.kind else None, points=row.points, ids=ids)
    start = PathGraph.at_starts(run.true_paths[:, 0])
    mount = np.array(run.spec.noise.camera.mount)
    return run, extended(start, [log.arrays()], run.spec.noise.motion, mount), often


def looks(graph, alike=()):
    """Return descriptors (l, l), all different but for the landmarks of these names."""
    table = np.eye(len(graph.landmark_ids), dtype=np.float32)
    for name in alike:
        table[graph.landmark_ids == name] = table[np.flatnonzero(graph.landmark_ids == alike[0])[0]]
    return table


def found(run, graph, descriptors):
    """Return what is found to be double on a graph."""
    mode = find_mode(graph, camera_of(run), TIGHT)
    return find_duplicates(graph, mode, draw_paths(graph, mode, 40, np.random.default_rng(1)), descriptors, 0.45)


def test_one_landmark_under_two_names_is_found():
    """The smoothed path shows that both lie in one place; the older name stays."""
    run, graph, often = renamed_run()
    assert found(run, graph, looks(graph, (often, NEW_NAME))).tolist() == [[NEW_NAME, often]]


def test_landmarks_that_look_different_stay_two():
    """Place alone does not make two landmarks one, nor does a landmark without a look have a double."""
    run, graph, often = renamed_run()
    assert len(found(run, graph, looks(graph))) == 0
    table = looks(graph, (often, NEW_NAME))
    table[graph.landmark_ids == NEW_NAME] = np.nan
    assert len(found(run, graph, table)) == 0


def test_landmarks_seen_from_one_key_stay_two():
    """What was seen together is not one, however near and alike."""
    run, graph, often = renamed_run()
    twin = replace(
        graph,
        points=np.concatenate([graph.points, graph.points[graph.point_landmarks == _row(graph, often)][:1]]),
        point_noises=np.concatenate([graph.point_noises, np.zeros((1, 6))]),
        given=np.concatenate([graph.given, [False]]),
        point_frames=np.concatenate(
            [graph.point_frames, graph.point_frames[graph.point_landmarks == _row(graph, often)][:1]]
        ),
        point_landmarks=np.concatenate([graph.point_landmarks, [_row(graph, NEW_NAME)]]),
    )
    assert len(found(run, twin, looks(twin, (often, NEW_NAME)))) == 0


@given(st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_pairs_are_those_of_the_tree(num, seed):
    """The compiled sweep finds what a tree, norms and sets say: nearness, looks, and keys that both were seen from."""
    rng = np.random.default_rng(seed)
    landmarks, descriptors = rng.uniform(0.0, 2.0, (num, 3)), rng.normal(size=(num, 2)).astype(np.float32)
    descriptors[rng.random(num) < 0.1, 1] = np.nan
    seen = [np.sort(rng.integers(0, 12, rng.integers(0, 4))) for _ in range(num)]
    starts = np.cumsum([0, *map(len, seen)])
    keys = np.concatenate([np.empty(0, dtype=np.int64), *seen])
    order = np.argsort(landmarks[:, 0])
    found = alike_pairs(order, landmarks, descriptors, keys, starts, 0.5, 1.2)
    expected = {
        (a, b)
        for a, b in cKDTree(landmarks).query_pairs(0.5)
        if np.linalg.norm(descriptors[a] - descriptors[b]) <= 1.2
        and len(seen[a]) and len(seen[b]) and not set(seen[a]) & set(seen[b])
    }  # fmt: skip
    assert len(found) == len(expected)
    assert {tuple(pair) for pair in found.tolist()} == expected


def test_a_duplicate_given_up_leaves_one_landmark():
    """The mode is then that of the run in which nobody was confused, and one name stands for the other."""
    run, graph, often = renamed_run()
    healed = without_duplicates(graph, np.array([[NEW_NAME, often]]))
    mode, right = find_mode(healed, camera_of(run), TIGHT), find_mode(graph_of(run), camera_of(run), TIGHT)
    np.testing.assert_allclose(mode.poses, right.poses, atol=1e-8)
    assert healed.known_as(np.array([NEW_NAME, 3])).tolist() == [often, 3]


def _row(graph, name):
    return int(np.flatnonzero(graph.landmark_ids == name)[0])
