"""Landmarks that are not there: the model of existence, and filters that keep it."""

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.kernels import python_entry
from builders.worlds import EXACT_MOTION, StereoWorld
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.records import Viewpoint
from slam_backend.fastslam._kernels.update.existence import in_view, landmarks_in_view, updated_log_odds
from slam_backend.fastslam.existence import ExistenceModel, FieldOfView
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.geometry import between, compose
from slam_backend.maps.alignment import Alignment
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.team.filter_merging.merging import merge_filters
from slam_backend.team.team import TeamSlam

in_view, updated_log_odds = map(python_entry, (in_view, updated_log_odds))

MODELS = [
    ExistenceModel(),
    ExistenceModel(detection=0.9, false_alarm=0.02, prior=0.3, delete_below=0.02, cap=0.99),
    ExistenceModel(detection=0.4, false_alarm=0.1, prior=0.6, delete_below=0.05, cap=0.999),
]
EVERY_MODEL = pytest.mark.parametrize("model", MODELS)


def probability(log_odds: float) -> float:
    """Return the probability that log-odds stand for."""
    return float(1.0 / (1.0 + np.exp(-log_odds)))


def misses_to_delete(model: ExistenceModel, log_odds: float) -> int:
    """Return the least number of consecutive misses that deletes a landmark with these log-odds."""
    return max(0, int((log_odds - model.log_odds_floor) // -model.increments()[1]) + 1)


def deletion_bound(model: ExistenceModel, looks: int) -> float:
    """Return a bound on the probability that a true landmark, expected in view `looks` times, is ever deleted.

    For a landmark that exists and is detected with probability `detection`, E exp(-l) of its log-odds l is constant. By
    Ville's inequality they ever fall by h with probability at most exp(-h). A landmark starts at its prior, and again
    whenever it leaves the cap, at most `looks` times.
    """
    from_prior = np.exp(model.log_odds_floor - model.log_odds_prior)
    return float(min(1.0, from_prior + looks * np.exp(model.log_odds_floor - model.log_odds_cap)))


@EVERY_MODEL
@given(sightings=st.lists(st.booleans(), max_size=12))
def test_log_odds_are_bayes_rule(model: ExistenceModel, sightings: list[bool]) -> None:
    """Over any sequence of sightings and misses the probability is that of Bayes' rule on the whole sequence."""
    sighting, miss = model.increments()
    log_odds = model.log_odds_prior
    likelihood_right, likelihood_false = 1.0, 1.0
    for seen in sightings:
        log_odds = updated_log_odds(log_odds, seen, True, sighting, miss, np.inf)
        likelihood_right *= model.detection if seen else 1.0 - model.detection
        likelihood_false *= model.false_alarm if seen else 1.0 - model.false_alarm
    joint = model.prior * likelihood_right
    assert probability(log_odds) == pytest.approx(joint / (joint + (1.0 - model.prior) * likelihood_false), rel=1e-9)


def test_landmarks_not_expected_in_view_change_only_when_seen() -> None:
    """A miss counts in view only, a sighting anywhere, and the cap holds."""
    for before in (-1.0, 0.5):
        assert updated_log_odds(before, False, False, 2.0, -1.5, 6.0) == before
        assert updated_log_odds(before, False, True, 2.0, -1.5, 6.0) == before - 1.5
        assert updated_log_odds(before, True, True, 2.0, -1.5, 6.0) == before + 2.0
        assert updated_log_odds(before, True, False, 2.0, -1.5, 6.0) == before + 2.0
    assert updated_log_odds(5.0, True, True, 2.0, -1.5, 6.0) == 6.0


@EVERY_MODEL
def test_a_false_landmark_is_deleted_after_the_stated_number_of_misses(model: ExistenceModel) -> None:
    """From the prior, from the cap and from levels between, that many misses delete it and one fewer does not."""
    sighting, miss = model.increments()
    for start in (model.log_odds_prior, 0.5 * (model.log_odds_prior + model.log_odds_cap), model.log_odds_cap):
        log_odds, misses = start, 0
        while log_odds >= model.log_odds_floor:
            log_odds = updated_log_odds(log_odds, False, True, sighting, miss, model.log_odds_cap)
            misses += 1
        assert misses == misses_to_delete(model, start)
        assert probability(start + misses * miss) < model.delete_below <= probability(start + (misses - 1) * miss)
    assert misses_to_delete(model, model.log_odds_floor - 1e-9) == 0


def lives(model: ExistenceModel, seen_with: float, looks: int, runs: int, seed: int) -> tuple[int, int]:
    """Return how many of `runs` landmarks die, and how many ever reach the cap before, in so many looks."""
    rng = np.random.default_rng(seed)
    sighting, miss = model.increments()
    log_odds = np.full(runs, model.log_odds_prior)
    alive, capped = np.ones(runs, dtype=np.bool_), np.zeros(runs, dtype=np.bool_)
    for _ in range(looks):
        log_odds = np.minimum(model.log_odds_cap, log_odds + np.where(rng.random(runs) < seen_with, sighting, miss))
        alive &= log_odds >= model.log_odds_floor
        capped |= alive & (log_odds >= model.log_odds_cap)
    return int(np.count_nonzero(~alive)), int(np.count_nonzero(capped))


@EVERY_MODEL
@pytest.mark.parametrize("looks", [10, 200])
def test_a_true_landmark_survives_with_the_stated_probability(model: ExistenceModel, looks: int) -> None:
    """Seen with probability `detection`, no more than the stated share is ever deleted; false alarm 1e-3."""
    died, _ = lives(model, model.detection, looks, 20_000, seed=100)
    assert 0 < died <= stats.binom.isf(1e-3, 20_000, deletion_bound(model, looks))


@EVERY_MODEL
def test_a_false_landmark_rarely_becomes_certain_and_is_always_deleted(model: ExistenceModel) -> None:
    """Seen with probability `false_alarm`, at most the share exp(prior - cap) is ever sure, and all die; alarm 1e-3."""
    died, capped = lives(model, model.false_alarm, 300, 20_000, seed=101)
    assert capped <= stats.binom.isf(1e-3, 20_000, np.exp(model.log_odds_prior - model.log_odds_cap))
    assert died == 20_000


def test_a_limited_number_of_measurements_weakens_a_miss() -> None:
    """With E landmarks in view and at most L reported, each is seen with d L / E; beyond use nothing is learnt."""
    model = ExistenceModel(detection=0.8, false_alarm=0.05, frame_limit=5)
    assert model.increments(5) == model.increments() == ExistenceModel().increments(1000)
    sighting, miss = model.increments(20)
    assert sighting == pytest.approx(np.log(0.8 * 5 / 20 / 0.05))
    assert miss == pytest.approx(np.log((1.0 - 0.8 * 5 / 20) / 0.95))
    assert model.increments(80) == model.increments(10_000) == (0.0, 0.0)


@numba.njit
def compiled(points: FloatArray, view: FieldOfView, out: Any) -> None:
    """Ask for each point as a filter's loop does."""
    for i in range(len(points)):
        out[i] = in_view(points[i, 0], points[i, 1], points[i, 2], view)


def test_expected_in_view_is_what_a_smaller_camera_sees() -> None:
    """Inside the image less its margin and within the share of the range, compiled or not, for points all around."""
    model = ExistenceModel(margin_px=10.0, range_share=0.75, nearest=0.6)
    camera = StereoCamera(width=300, height=200, focal_px=250.0, mount=(0.1, 0.2, 0.3))
    smaller = replace(camera, width=280, height=180, max_range=6.0)
    rng = np.random.default_rng(7)
    camera_points = rng.uniform([-3.0, -3.0, -2.0], [3.0, 3.0, 7.0], (4000, 3))
    depth = camera_points[:, 2]
    expected = smaller.sees(camera_points) & (depth > 0.6)
    in_robot_axes = camera.robot_from_camera(camera_points) - camera.mount
    found = np.zeros(4000, dtype=np.bool_)
    compiled(np.ascontiguousarray(in_robot_axes), model.view(camera), found)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal([in_view(*point, model.view(camera)) for point in in_robot_axes[:300]], found[:300])
    assert 500 < found.sum() < 3500
    assert np.any(camera.sees(camera_points) & ~expected)


def test_a_frame_lists_landmarks_that_a_particle_matched_or_expects() -> None:
    """Landmarks are read through their ancestor maps, in all blocks of lanes; those just started are left out."""
    rng, count, num, best = np.random.default_rng(11), LANES + 9, 60, 3
    maps, model = ParticleMaps(count, 0.0), ExistenceModel()
    held = rng.random((num, count)) < 0.2
    held[:, 0] = True
    ids = np.arange(num)
    maps.load_metadata(held.astype(np.int32), np.zeros((num, 4), np.float32), ids, ids, num)
    maps.blocks[:num] = rng.uniform(-9.0, 9.0, maps.blocks[:num].shape)
    maps.maps = np.tile(np.arange(maps.padded, dtype=np.int32), (2, 1))
    maps.maps[1, :count] = np.sort(rng.integers(0, count, count))
    maps.users, maps.map_of[:num:2] = np.array([0, num // 2]), 1
    places = np.where(maps.map_of[:num, None] > 0, maps.maps[1, :count], np.arange(count))
    poses = rng.uniform(-3.0, 3.0, (3, maps.padded))
    view, mount, near = model.view(StereoCamera()), np.array([0.1, 0.0, 0.2]), 12.0
    camera = Viewpoint(poses, np.cos(poses[2]), np.sin(poses[2]), mount)
    found, new_slots = np.full((2, maps.padded), -1, np.int32), np.array([7, -1])
    found[1, 5] = 8
    told = landmarks_in_view(maps.arrays, count, best, camera, view, near, found, new_slots)

    expected = []
    for slot in range(num):
        row, own = maps.row_of[slot], places[slot]
        values, holds = maps.blocks[row, own // LANES, :, own % LANES], maps.counts[row, own] > 0
        if not holds.any() or slot == 7:
            continue
        first = best if holds[best] else int(np.argmax(holds))
        is_near = np.hypot(*(values[first, :2] - poses[:2, best])) <= near
        in_robot_axes = between(poses[:, :count].T, np.column_stack([values[:, :2], np.zeros(count)])) - mount
        in_sight = [in_view(depth, lateral, 0.0, view) for depth, lateral, _ in in_robot_axes]
        if slot == 8 or (is_near and (holds & in_sight).any()):
            expected.append(slot)
    assert told.tolist() == expected
    assert 8 in expected
    assert 10 < len(expected) < num - 10


PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
MOVE = np.array([0.25, 0.02, 0.3])
HARMLESS = ExistenceModel(delete_below=1e-300)  # keeps the books, and never deletes
HASTY = ExistenceModel(delete_below=0.45)  # deletes what is not seen again at once
POINTS = np.array([[0.2, 0.1, 3.0], [-0.5, 0.2, 2.5], [0.6, -0.3, 3.5]])  # camera frame, well in view of the origin


def frame(*which: int) -> Measurements:
    """Return a frame of some of `POINTS`, exactly measured."""
    return Measurements(POINTS[list(which)], np.eye(3, dtype=np.float32)[list(which)])


def standing(existence: ExistenceModel, robots: int = 1, particles: int = 5, **changes: Any) -> FastSlam:
    """Return a filter of robots at the origin, whose odometry has no noise."""
    return FastSlam(robots, num_particles=particles, motion=EXACT_MOTION, existence=existence, seed=1, **changes)


def circle(steps: int) -> list[tuple[list[FloatArray], list[Measurements]]]:
    """Return noisy odometry and frames of a robot that drives in a circle, where each landmark is sometimes missed."""
    world = StereoWorld(np.random.default_rng(5))
    pose, result = np.zeros(3), []
    for _ in range(steps):
        pose = compose(pose, MOVE)
        seen = world.visible(pose)
        odometry = MOVE + world.rng.normal(0.0, [0.02, 0.01, 0.01])
        result.append(([odometry], [world.measure(pose, seen[world.rng.random(len(seen)) < 0.8])]))
    return result


def in_circle(existence: ExistenceModel | None, **changes: Any) -> FastSlam:
    """Return a filter for such a robot, before its first step."""
    options: dict[str, Any] = {"num_particles": 37, "resample_threshold": 0.9, "seed": 3}
    camera = StereoWorld(np.random.default_rng(5)).camera
    return FastSlam(camera=camera, existence=existence, **(options | changes))


def aligned() -> Alignment:
    """Return the alignment of two maps that lie on each other."""
    return Alignment(True, "", 0.0, 0.0, 0.0, 1e-6 * np.eye(3), np.empty((0, 2), np.int64), 0.0)


@PROPOSALS
@pytest.mark.parametrize("model", [ExistenceModel(), ExistenceModel(detection=0.4, false_alarm=0.1), HASTY])
def test_an_unconfirmed_landmark_is_deleted_after_the_stated_number_of_misses(
    model: ExistenceModel, proposal: Any
) -> None:
    """It is held through one miss less than the model says, and nothing remains of it after that miss."""
    slam = standing(model, proposal=proposal, resample_threshold=0.0)
    slam.step([None], [frame(0, 2)])
    misses = misses_to_delete(model, model.log_odds_prior)
    for _ in range(misses - 1):
        slam.step([None], [frame(0)])
    np.testing.assert_array_equal(slam.map().ids, [0, 1])
    slam.step([None], [frame(0)])
    np.testing.assert_array_equal(slam.map().ids, [0])
    assert slam.num_landmarks == 1
    assert slam.step([None], [frame(2)]).created[0].tolist() == [2]  # it may come back, under a new name


def test_only_a_frame_in_which_a_landmark_is_expected_is_a_miss() -> None:
    """A step without a frame, and frames in which it is behind, beside or too far away, do not count."""
    slam = standing(ExistenceModel())
    slam.step([None], [frame(0)])
    _, before = slam.existence()
    for pose, seen in (([0.0, 0.0, 0.0], None), ([0.0, 0.0, 3.0], frame()), ([0.0, 0.0, 0.6], frame()),
                       ([-5.0, 0.0, 0.0], frame()), ([2.8, 0.0, 0.0], frame())):  # fmt: skip
        slam.step([None], [seen], poses=[pose])
        np.testing.assert_array_equal(slam.existence()[1], before)
    slam.step([None], [frame()], poses=[np.zeros(3)])
    assert slam.existence()[1] < before


def test_probabilities_of_existence_are_those_of_the_model() -> None:
    """They belong to the ids of the map; a new landmark has the prior, and Bayes' rule and the cap do the rest."""
    model = ExistenceModel(detection=0.7, false_alarm=0.1, prior=0.4, cap=0.98)
    slam = standing(model)
    odds = {0: model.log_odds_prior, 1: model.log_odds_prior}
    slam.step([None], [frame(0, 1)])
    sighting, miss = model.increments()
    for seen in ([0], [0, 1], [0], [0], [0, 1], [0]):
        ids, found = slam.existence()
        np.testing.assert_array_equal(ids, slam.map().ids)
        np.testing.assert_allclose(found, [1.0 / (1.0 + np.exp(-odds[landmark])) for landmark in ids.tolist()])
        slam.step([None], [frame(*seen)])
        for landmark in odds:
            odds[landmark] = min(odds[landmark] + (sighting if landmark in seen else miss), model.log_odds_cap)
    assert slam.existence()[1][0] == pytest.approx(model.cap)


def test_a_filter_with_a_measurement_limit_keeps_unreported_landmarks() -> None:
    """Of three landmarks a sensor reports one at a time: the model that knows keeps them, the other loses one."""
    knows, does_not = standing(ExistenceModel(frame_limit=1)), standing(ExistenceModel())
    for slam in (knows, does_not):
        slam.step([None], [frame(0, 1, 2)])
        for turn in range(30):
            slam.step([None], [frame(turn % 2)] if turn < 4 else [frame(turn % 3)])
    np.testing.assert_array_equal(knows.map().ids, [0, 1, 2])
    assert 2 not in does_not.map().ids


def test_a_landmark_deleted_within_a_step_keeps_its_id_in_the_report() -> None:
    """The first robot starts a landmark, the second misses and the filter deletes it: the report is of what was."""
    slam = standing(HASTY, robots=3)
    report = slam.step([None] * 3, [frame(0), frame(), frame(1)])
    assert [made.tolist() for made in report.created] == [[0], [], [1]]
    assert [found.tolist() for found in report.associations] == [[0], [], [1]]
    assert (report.num_new, report.num_matched, report.num_rejected) == (2, 0, 0)
    np.testing.assert_array_equal(slam.map().ids, [1])


def test_a_filter_without_landmarks_continues_from_its_state() -> None:
    """Only the descriptor size and the next landmark id are left."""
    slam, twin = (standing(ExistenceModel(), resample_threshold=0.0) for _ in range(2))
    slam.step([None], [Measurements(POINTS[:1], np.eye(5, dtype=np.float32)[:1])])
    while slam.num_landmarks:
        slam.step([None], [Measurements.empty(5)])
    twin.set_state(slam.get_state())
    assert twin.descriptor_size == 5
    for filter_ in (slam, twin):
        report = filter_.step([None], [Measurements(POINTS[1:2], np.eye(5, dtype=np.float32)[1:2])])
        assert report.created[0].tolist() == [1]


@PROPOSALS
def test_memory_of_deleted_landmarks_is_reused(proposal: Any) -> None:
    """Two hundred landmarks, one after the other and each seen once, never need more room than a few."""
    slam = standing(ExistenceModel(), proposal=proposal, resample_threshold=0.0)
    looks = np.eye(200, dtype=np.float32)
    held = []
    for step in range(200):
        slam.step([None], [Measurements(POINTS[step % 3 : step % 3 + 1], looks[step : step + 1])])
        held.append(slam.num_landmarks)
        if step == 20:
            memory = slam.maps.nbytes
    assert max(held) == misses_to_delete(ExistenceModel(), 0.0)
    assert slam.maps.nbytes == memory
    assert slam.maps.next_id == 200


@pytest.mark.parametrize("delete_below", [0.01, 0.05])
def test_true_landmarks_survive_as_the_model_predicts(delete_below: float) -> None:
    """Of right landmarks seen with probability d, no more are ever deleted than the bound's binomial law allows."""
    model = ExistenceModel(delete_below=delete_below)
    rng = np.random.default_rng(11)
    looks, num = 150, 200
    depths = rng.uniform(2.0, 6.0, num)
    points = np.column_stack([rng.uniform(-0.4, 0.4, num) * depths, rng.uniform(-0.3, 0.3, num) * depths, depths])
    names = np.arange(num)
    slam = standing(model, particles=1, proposal="fastslam1")
    descriptors = np.ones((num, 1), dtype=np.float32)
    slam.step([None], [Measurements(points, descriptors)], [names])
    alive = np.ones(num, dtype=bool)  # of those that were never deleted; who was comes back under a new name
    for _ in range(looks):
        seen = rng.random(num) < model.detection
        slam.step([None], [Measurements(points[seen], descriptors[seen])], [names[seen]])
        alive &= np.isin(names, slam.map().ids)
    bound = deletion_bound(model, looks)
    assert bound < 0.1
    assert np.count_nonzero(~alive) <= stats.binom.ppf(1.0 - 1e-6, num, bound)


@PROPOSALS
def test_a_model_that_deletes_nothing_changes_nothing(proposal: Any) -> None:
    """Without deletions a filter with a model holds and reports, bit for bit, what one without a model does."""
    with_model, without = in_circle(HARMLESS, proposal=proposal), in_circle(None, proposal=proposal)
    resampled = 0
    for odometry, frames in circle(25):
        report = without.step(odometry, frames)
        assert_same(with_model.step(odometry, frames), report)
        resampled += report.resampled
    found, expected = contents(with_model), contents(without)
    for state in (found, expected):
        del state["options"], state["maps"]["odds"]
    assert_same(found, expected)
    assert resampled > 5


@pytest.mark.parametrize("particles", [(4, 4), (3, 40)])
def test_a_merge_adds_the_log_odds_of_a_landmark(particles: tuple[int, int]) -> None:
    """Log-odds of landmarks in common add up, their prior counting once, up to the cap; the others stay as they are."""
    model = ExistenceModel(detection=0.6, false_alarm=0.2, prior=0.4)
    a, b = (
        standing(model, particles=count, proposal=proposal)
        for count, proposal in zip(particles, ("fastslam2", "fastslam1"), strict=True)
    )
    for slam, first in ((a, frame(0, 1)), (b, frame(1, 2))):
        slam.step([None], [first])
        slam.step([None], [first])
    b.step([None], [frame(2)])
    sighting, miss = model.increments()
    joint, _ = merge_filters(a, b, aligned(), np.array([[1, 0]]), np.random.default_rng(0))
    ids, found = joint.existence()
    np.testing.assert_array_equal(ids, [0, 1, 2])
    log_odds = model.log_odds_prior + np.array([sighting, 2.0 * sighting + miss, 2.0 * sighting])
    np.testing.assert_allclose(found, 1.0 / (1.0 + np.exp(-log_odds)))
    for _ in range(20):
        a.step([None], [frame(0, 1)])
        b.step([None], [frame(1, 2)])
    joint, _ = merge_filters(a, b, aligned(), np.array([[1, 0]]), np.random.default_rng(0))
    np.testing.assert_allclose(joint.existence()[1], model.cap)


def test_landmarks_doubted_by_both_filters_are_deleted_at_the_next_miss() -> None:
    """A merge deletes nothing, as its ids are handed on: what both have missed is left with the least probability."""
    model = ExistenceModel()
    a, b = standing(model), standing(model)
    for slam in (a, b):
        slam.step([None], [frame(0, 1)])
        for _ in range(misses_to_delete(model, 0.0) - 1):
            slam.step([None], [frame(0)])
    joint, _ = merge_filters(a, b, aligned(), np.array([[0, 0], [1, 1]]), np.random.default_rng(0))
    np.testing.assert_array_equal(joint.map().ids, [0, 1])
    assert joint.existence()[1][1] == pytest.approx(model.delete_below)
    joint.step([None, None], [frame(0), None])
    np.testing.assert_array_equal(joint.map().ids, [0])


def test_a_merge_with_a_filter_that_keeps_no_existence_starts_its_landmarks_at_the_prior() -> None:
    """The joint filter has the options of the first: with a model, the second's landmarks get its prior; else none."""
    model = ExistenceModel(prior=0.3)
    a, b = standing(model), FastSlam(1, num_particles=5, motion=EXACT_MOTION, seed=2)
    for slam, seen in ((a, frame(0, 1)), (b, frame(1, 2))):
        slam.step([None], [seen])
        slam.step([None], [seen])
    seen_twice = a.existence()[1][0]
    joint, _ = merge_filters(a, b, aligned(), np.array([[1, 0]]), np.random.default_rng(0))
    np.testing.assert_allclose(joint.existence()[1], [seen_twice, seen_twice, 0.3])
    joint, _ = merge_filters(b, a, aligned(), np.array([[0, 1]]), np.random.default_rng(0))
    assert joint.options.existence is None
    np.testing.assert_array_equal(joint.map().ids, [0, 1, 2])


def test_a_team_passes_the_model_on_to_its_filters() -> None:
    """What one robot of a team sees once, and then no more, leaves its map; the other robot's map is its own."""
    team = TeamSlam(2, num_particles=5, motion=EXACT_MOTION, existence=ExistenceModel())
    team.step([None, None], [frame(0, 1), frame(0, 1)])
    for _ in range(3):
        team.step([None, None], [frame(0), frame(0, 1)])
    assert [len(team.map(robot)) for robot in (0, 1)] == [1, 2]
