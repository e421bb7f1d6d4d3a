"""Landmarks of a smoothed run that are one, or are not."""

import numpy as np
import pytest
from builders.runs import TIGHT, camera_of, graph_of, logs_of, small_run
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.smoother.duplicates import find_duplicates, similar_pairs, without_duplicates
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses, extend_graph
from slam_backend.smoother.log_arrays import REJECTED
from slam_backend.smoother.optimizer import optimize
from slam_backend.smoother.reassociation import NO_ONE, LandmarkTable, RejectedMeasurements, find_only, reassociate
from slam_backend.smoother.sampling import sample_paths

OPTIONS = FilterOptions(camera=StereoCamera(sigma_px=0.2, sigma_disparity_px=0.1, mount=(0.1, 0.0, 0.9)))
POSES = {4: np.array([0.0, 0.0, 0.3]), 5: np.array([0.4, 0.1, 0.2]), 7: np.array([0.9, 0.1, -0.1])}
PLACE = np.array([5.0, 0.6, 1.2])
LOOK, OTHER_LOOK = np.eye(4, dtype=np.float32)[:2]


def test_unique_matches_agree_with_plain_arrays():
    """Where none is, or several are, there is no one."""
    rng = np.random.default_rng(8)
    means, known_means = rng.uniform(0.0, 3.0, (60, 3)), rng.uniform(0.0, 3.0, (25, 3))
    looks, known_looks = (rng.normal(size=(n, 8)).astype(np.float32) for n in (60, 25))
    owners = find_only(means, looks, known_means, known_looks, 1.4, 3.7)
    near = np.linalg.norm(means[:, None] - known_means, axis=2) <= 1.4
    fits = near & (np.linalg.norm(looks[:, None] - known_looks, axis=2) <= 3.7)
    np.testing.assert_array_equal(owners, np.where(fits.sum(axis=1) == 1, fits.argmax(axis=1), NO_ONE))
    assert {0, 1, 2} <= set(fits.sum(axis=1).tolist())


def seen_from(pose, place):
    """Return a point (3,) as logs hold it: robot axes, from the camera centre."""
    return transform_points(inverse(pose), place[None])[0] - OPTIONS.camera.mount


def initial_poses_of(poses):
    """Return the robot's poses, by step, as the smoother takes them."""
    return [InitialPoses(np.array(list(poses)), np.array(list(poses.values())))]


def logs_and_refused(places, looks=None, covariances=None):
    """Return a robot's log of one refused measurement in each step, beside one of landmark 3, and what was refused."""
    log, refused = RobotLog(), {}
    for i, (step, pose) in enumerate(POSES.items()):
        points = np.array([seen_from(pose, np.array([6.0, -1.0, 0.5])), seen_from(pose, places[i])])
        log.append(step, None if i == 0 else np.array([0.4, 0.0, 0.0]), points=points, ids=np.array([3, REJECTED]),
                   covariances=covariances)  # fmt: skip
        refused[step] = RejectedMeasurements(np.array([1]), (LOOK if looks is None else looks[i])[None])
    return [log.arrays()], [refused]


def known(off=(0.0, 0.5, 0.0), count=1, sigma=0.2, look=LOOK):
    """Return a map of landmark 9, off by so much from where it is seen [m], and of landmark 3."""
    variances = np.array([sigma**2, 0.0, 0.0, sigma**2, 0.0, sigma**2])
    return LandmarkTable(
        np.array([3, 9]), np.array([[6.0, -1.0, 0.5], PLACE + off]), np.array([0.01 * variances, variances]),
        np.array([9, count], dtype=np.int32), np.array([OTHER_LOOK, look]),
    )  # fmt: skip


def names(places, held, looks=None, poses=POSES):
    """Return the names (3,) of what was refused, after all."""
    logs, refused = logs_and_refused(places, looks)
    found = reassociate(logs, refused, initial_poses_of(poses), held, OPTIONS)[0]
    assert found.ids[::2].tolist() == [3, 3, 3]
    assert logs[0].ids[1::2].tolist() == [REJECTED] * 3
    return found.ids[1::2].tolist()


def test_agreeing_rejected_measurements_are_associated():
    """Three measurements of one place outnumber a landmark's only sighting 2.5 sigma off, and are its."""
    assert names([PLACE] * 3, known()) == [9, 9, 9]


@pytest.mark.parametrize(
    ("held", "why"),
    [
        (known(count=3), "its own sightings are as many"),
        (known(sigma=0.05), "it is another one, 10 sigma off"),
        (known(off=(0.0, 1.2, 0.0), sigma=0.5), "it is farther than what lies too near to be new"),
        (known(look=OTHER_LOOK), "it looks different"),
        (known()._replace(ids=np.array([3, 3])), "its frames saw it elsewhere"),
        (known()._replace(descriptors=np.array([LOOK, LOOK]), means=np.array([PLACE, PLACE])), "two may be it"),
    ],
)
def test_ambiguous_rejected_measurements_are_left(held, why):
    """Nothing has a name for it that could be another's."""
    assert names([PLACE] * 3, held) == [REJECTED] * 3, why


def test_a_single_disagreeing_measurement_is_left():
    """Of two that agree and one elsewhere the two are taken up; of three that lie apart none is."""
    apart = list(PLACE + np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, -0.3, 0.1]]))
    assert names([PLACE, PLACE, apart[2]], known()) == [9, 9, REJECTED]
    assert names(apart, known(sigma=0.5)) == [REJECTED] * 3
    assert names([PLACE] * 3, known(), looks=[LOOK, OTHER_LOOK, OTHER_LOOK]) == [REJECTED] * 3
    assert names([PLACE] * 3, known(), poses={4: POSES[4]}) == [REJECTED] * 3


def test_agreement_follows_the_covariances_of_the_sensor():
    """Places 0.3 m apart agree where the sensor says that it sees to 0.2 m, and do not where it says to 0.05 m."""
    apart = list(PLACE + np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, -0.3, 0.1]]))
    for sigma, found in ((0.2, [9, 9, 9]), (0.05, [REJECTED] * 3)):
        noise = np.tile(np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]) * sigma**2, (2, 1))
        logs, refused = logs_and_refused(apart, covariances=noise)
        assert reassociate(logs, refused, initial_poses_of(POSES), known(), OPTIONS)[0].ids[1::2].tolist() == found


def test_without_rejected_measurements_logs_are_unchanged():
    """Without anything refused, or without a map, the logs are the same arrays."""
    logs, refused = logs_and_refused([PLACE] * 3)
    nothing = LandmarkTable(*(array[:0] for array in known()))
    for missed, held in (([{}], known()), (refused, nothing)):
        found = reassociate(logs, missed, initial_poses_of(POSES), held, OPTIONS)
        assert found[0].ids is logs[0].ids


def error_of_one_first_seen_far_off(every):
    """Return how far off [m] a landmark is after 14 steps without noise but in its first sighting, and its refusals."""
    camera, rng, looks = OPTIONS.camera, np.random.default_rng(5), np.eye(12, dtype=np.float32)
    marks = np.column_stack([rng.uniform(3.0, 7.0, 12), rng.uniform(-1.5, 1.5, 12), rng.uniform(0.3, 1.5, 12)])
    marks[0] = [6.0, 0.0, 1.0]
    slam = FastSlam(num_particles=30, camera=camera, rejuvenate_every=every, seed=1)
    refused = 0
    for step in range(14):
        seen = camera.project(camera.camera_from_robot(marks - [0.1 * step, 0.0, 0.0]))
        seen[0, 2] -= 0.55 * (step == 0)  # 5.5 sigma
        odometry = None if step == 0 else np.array([0.1, 0.0, 0.0])
        report = slam.step([odometry], [Measurements(camera.triangulate(seen), looks)])
        refused += report.associations[0][0] < 0
    held = slam.map()
    own = held.means[held.descriptors[:, 0] > 0.9]
    assert len(own) == 1
    return np.linalg.norm(own[0] - marks[0]), refused


def test_a_landmark_with_a_false_first_sighting_is_corrected():
    """It rejects all later measurements, until new particles are sampled with these associated."""
    off, refused = error_of_one_first_seen_far_off(None)
    assert off > 0.5
    assert refused == 13
    off, refused = error_of_one_first_seen_far_off(5)
    assert off < 0.05
    assert refused <= 5


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
    start = SlamGraph.at_starts(run.true_paths[:, 0])
    mount = np.array(run.spec.noise.camera.mount)
    return run, extend_graph(start, [log.arrays()], run.spec.noise.motion, mount), often


def looks(graph, alike=()):
    """Return descriptors (l, l), all different but for the landmarks of these names."""
    table = np.eye(len(graph.landmark_ids), dtype=np.float32)
    for name in alike:
        table[graph.landmark_ids == name] = table[np.flatnonzero(graph.landmark_ids == alike[0])[0]]
    return table


def found(run, graph, descriptors):
    """Return what is found to be double on a graph."""
    mode = optimize(graph, camera_of(run), TIGHT)
    return find_duplicates(graph, mode, sample_paths(graph, mode, 40, np.random.default_rng(1)), descriptors, 0.45)


def test_a_duplicate_landmark_is_found():
    """The smoothed path shows that both lie in one place; the older name stays."""
    run, graph, often = renamed_run()
    assert found(run, graph, looks(graph, (often, NEW_NAME))).tolist() == [[NEW_NAME, often]]


@given(st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_duplicate_candidates_agree_with_norms_and_sets(num, seed):
    """Each pair is tried by itself: distance, descriptors, and common keyframes."""
    rng = np.random.default_rng(seed)
    landmarks, descriptors = rng.uniform(0.0, 2.0, (num, 3)), rng.normal(size=(num, 2)).astype(np.float32)
    descriptors[rng.random(num) < 0.1, 1] = np.nan
    seen = [np.sort(rng.integers(0, 12, rng.integers(0, 4))) for _ in range(num)]
    starts = np.cumsum([0, *map(len, seen)])
    keys = np.concatenate([np.empty(0, dtype=np.int64), *seen])
    found = similar_pairs(landmarks, descriptors, keys, starts, 0.5, 1.2)
    expected = {
        (a, b)
        for a in range(num)
        for b in range(a + 1, num)
        if np.linalg.norm(landmarks[a] - landmarks[b]) <= 0.5
        and np.linalg.norm(descriptors[a] - descriptors[b]) <= 1.2
        and len(seen[a]) and len(seen[b]) and not set(seen[a]) & set(seen[b])
    }  # fmt: skip
    assert len(found) == len(expected)
    assert {tuple(pair) for pair in found.tolist()} == expected


def test_a_deleted_duplicate_leaves_one_landmark():
    """The mode is that of the run without the duplicate, and one id is an alias of the other."""
    run, graph, often = renamed_run()
    healed = without_duplicates(graph, np.array([[NEW_NAME, often]]))
    mode, right = optimize(healed, camera_of(run), TIGHT), optimize(graph_of(run), camera_of(run), TIGHT)
    np.testing.assert_allclose(mode.poses, right.poses, atol=1e-8)
    assert healed.resolve_ids(np.array([NEW_NAME, 3])).tolist() == [often, 3]
