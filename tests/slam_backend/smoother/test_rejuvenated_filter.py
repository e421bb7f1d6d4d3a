"""`FastSlam(rejuvenate_every=...)`: what the smoother gives the filter, and that nothing is lost on the way."""

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import dense
from builders.runs import small_run
from builders.worlds import EXACT_MOTION

from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import REJUVENATE_EVERY
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.team import TeamSlam
from training.stereo_runs.runs import RunSpec, simulate_run
from training.stereo_runs.scores import follow, score
from vslam_env.belief.belief import default_filter_options

EVERY = 8


def rejuvenated(run, seed=1, every=EVERY, **options):
    """Return a filter for a run, rejuvenated every few steps."""
    return run.build_filter(30, "fastslam2", seed, rejuvenate_every=every, **options)


def test_particles_are_rejuvenated_at_the_interval():
    """In every eighth step, and no other, the report has a rejuvenation with a sufficient sample size."""
    run = small_run(2)
    slam = rejuvenated(run)
    for step, reading in enumerate(run.readings(), start=1):
        report = slam.step(**reading).rejuvenation
        assert (report is not None) == (step % EVERY == 0)
        if report is not None:
            assert report.reason == ""
            assert 0.8 * 30 < report.ess <= 30.0
            assert np.ptp(slam.particles(0)[0], axis=0).min() > 0.0


def test_filters_and_teams_are_rejuvenated_by_default_and_never_with_none():
    """After 50 steps, as in environments, a filter built without options is rejuvenated; those of a team in turn."""
    assert default_filter_options().rejuvenate_every == REJUVENATE_EVERY
    frame = Measurements([[0.5, 0.0, 3.0], [-0.5, 0.1, 4.0], [0.1, -0.2, 5.0]], np.eye(3, dtype=np.float32))
    for options, expected in (({}, [REJUVENATE_EVERY]), ({"rejuvenate_every": None}, [])):
        slam, team = FastSlam(**options), TeamSlam(1, **options)
        alone, grouped = [], []
        for step in range(1, REJUVENATE_EVERY + 10):
            alone += [step] * (slam.step([np.zeros(3)], [frame]).rejuvenation is not None)
            grouped += [step] * bool(team.step([np.zeros(3)], [frame]).rejuvenations)
        assert alone == expected
        assert len(grouped) == len(expected)


def test_a_rejuvenation_waits_for_enough_measurements():
    """With little effort allowed it comes later than asked: only when enough was measured for what there is to redo."""
    run = small_run()
    slam = rejuvenated(run, every=2, smoothing=SmoothingOptions(effort=0.5, free_sightings=0))
    tried = [slam.step(**reading).rejuvenation is not None for reading in run.readings()]
    graph = slam.rejuvenation.graph
    assert tried[1]  # at first there is nothing to redo
    assert np.diff(np.flatnonzero(tried)).max() > 2
    assert len(graph.points) > 0


def test_a_loop_closure_brings_the_rejuvenation_forward():
    """Landmarks matched that were not seen for long bring the next rejuvenation forward, once."""
    run = small_run()
    readings = list(run.readings())
    smoothing = SmoothingOptions(closure_after=6)
    slam = rejuvenated(run, every=100, smoothing=smoothing)
    for reading in readings[:8]:
        slam.step(**reading)
    back = {"odometry": [np.zeros(3)], "measurements": [None]}
    for _ in range(12):
        assert slam.step(**back).rejuvenation is None
    assert slam.step([np.zeros(3)], readings[7]["measurements"], readings[7]["identities"]).rejuvenation is not None
    assert slam.step([np.zeros(3)], readings[7]["measurements"], readings[7]["identities"]).rejuvenation is None


def with_false_points(frame, rng):
    """Return a frame with one more point, of something that is not there, a little ahead."""
    point, look = [0.3 * rng.normal(), 0.0, 1.5 + rng.random()], rng.normal(size=frame.descriptors.shape[1])
    look /= np.linalg.norm(look)
    return Measurements(np.vstack([frame.points, point]), np.vstack([frame.descriptors, look]))


def test_the_reports_say_when_a_landmark_was_seen_last():
    """Each landmark bears the last step in which the most probable particle matched or started it.

    That outlives resamplings, rejuvenations and snapshots; where landmarks turn out not to
    exist others take their slots, and begin from zero.
    """
    run, rng = small_run(), np.random.default_rng(7)
    slam = rejuvenated(run, existence=ExistenceModel())
    seen, owners, renewed, taken_over = {}, {}, 0, 0
    for step, reading in enumerate(run.readings(), start=1):
        if step % 5 == 0:
            twin = FastSlam()
            twin.set_state(slam.get_state())
            slam = twin
        report = slam.step(reading["odometry"], [with_false_points(reading["measurements"][0], rng)])
        seen |= {name: step for name in report.associations[0].tolist() if name >= 0}
        slots = slam.maps.used_slots()
        names = slam.maps.ids[slots].tolist()
        assert slam.maps.last_seen[slots].tolist() == [seen.get(name, 0) for name in names]
        taken_over += sum(owners.get(slot, name) != name for slot, name in zip(slots, names, strict=True))
        owners |= dict(zip(slots, names, strict=True))
        renewed += report.rejuvenation is not None
    assert renewed == 2
    assert taken_over > 5


def test_after_a_rejuvenation_all_particles_hold_the_same_landmarks():
    """After a rejuvenation each particle holds each landmark, under the caller's own name, as often as it was seen."""
    run = small_run()
    slam = rejuvenated(run, every=21)
    for reading in run.readings():
        slam.step(**reading)
    ids, _, covariances, counts = dense(slam)
    seen = np.bincount(np.concatenate([names[0] for names in run.names]))
    slots = slam.maps.used_slots()
    np.testing.assert_array_equal(slam.maps.ids[slots], ids)
    np.testing.assert_array_equal(counts, np.repeat(seen[slam.maps.identities[slots]][:, None], 30, axis=1))
    full = covariances.transpose(0, 2, 1)[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    assert np.linalg.eigvalsh(full).min() > 0.0


@pytest.mark.parametrize("left", [0, 2])
def test_landmarks_without_sightings_are_deleted(left, monkeypatch):
    """Of those that the filter held only those stay that the new particles have, be it none."""
    run = small_run(2)
    slam, kept = rejuvenated(run), []

    def renew(new):
        kept.append(new.ids[:left])
        landmarks = new.landmarks._replace(rows=new.landmarks.rows[:left])
        renew_all(new._replace(ids=new.ids[:left], landmarks=landmarks, counts=new.counts[:left]))

    renew_all = slam._replace_particles
    monkeypatch.setattr(slam, "_replace_particles", renew)
    readings = list(run.readings())
    for reading in readings[:EVERY]:
        slam.step(**reading)
    np.testing.assert_array_equal(slam.map().ids, np.sort(kept[0]))


@pytest.mark.parametrize("incremental", [False, True])
@pytest.mark.parametrize("robots", [1, 2])
def test_a_snapshot_continues_bit_for_bit(robots, incremental):
    """Taken between two rejuvenations or slices, a snapshot goes on as the filter does, through the next two, twice."""
    limits = {"max_keys": 3, "recent_keys": 2} if incremental else {}
    run = small_run(robots)
    readings = list(run.readings())
    slam = rejuvenated(
        run, every=20 if incremental else EVERY, smoothing=SmoothingOptions(incremental=incremental, **limits)
    )
    for reading in readings[:11]:
        slam.step(**reading)
    state = slam.get_state()
    for reading in readings[11:]:
        slam.step(**reading)
    for _ in range(2):  # what the first one did has not changed the state
        other = FastSlam(robots, num_particles=3, seed=9)
        other.set_state(state)
        for reading in readings[11:]:
            other.step(**reading)
        assert_same(slam.get_state(), other.get_state())


def test_robots_can_be_renumbered():
    """A filter with renumbered robots continues like one with renumbered input."""
    run = small_run(2)
    slam = rejuvenated(run)
    for step, reading in enumerate(run.readings()):
        if step == 10:
            slam.reorder(np.array([1, 0]))
        if step >= 10:
            reading = {name: value[::-1] for name, value in reading.items()}
        report = slam.step(**reading).rejuvenation
        assert report is None or report.reason == ""
    for robot, other in ((0, 1), (1, 0)):
        error = slam.pose(robot).mean - run.true_paths[other, -1]
        assert np.hypot(error[0], error[1]) < 0.2


def test_without_anything_to_smooth_the_filter_continues():
    """A robot that stands, exact odometry or poses, or a descent that fails: the old particles stay, with a reason."""
    run = small_run()
    hasty = SmoothingOptions(max_iterations=1)
    cases = (
        (rejuvenated(run, every=1), list(run.readings())[:1], None, "no pose to seek"),
        (rejuvenated(run, motion=EXACT_MOTION), list(run.readings()), None, "odometry without noise"),
        (rejuvenated(run), list(run.readings()), run.true_paths[0], "poses that were given as exact"),
        (rejuvenated(run, smoothing=hasty), list(run.readings()), None, "no convergence in 1 iterations"),
    )
    for slam, readings, path, reason in cases:
        reasons = set()
        for step, reading in enumerate(readings):
            exact = None if path is None else [path[step] - run.true_paths[0, 0] * [1.0, 1.0, 0.0]]
            report = slam.step(**reading, poses=exact)
            if report.rejuvenation is not None:
                reasons.add(report.rejuvenation.reason)
                assert np.isnan(report.rejuvenation.ess)
        assert {told.partition(";")[0] for told in reasons} == {reason}
        assert np.isfinite(slam.pose(0).mean).all()


@pytest.mark.parametrize("incremental", [False, True])
def test_a_requested_rejuvenation_with_given_poses_is_refused(incremental):
    """Asked for new particles, in slices or not, a filter that is never rejuvenated says why there can be none."""
    run = small_run()
    slam = rejuvenated(run, every=None, smoothing=SmoothingOptions(incremental=incremental))
    for step, reading in enumerate(run.readings()):
        slam.step(**reading, poses=[run.true_paths[0, step]])
    before = slam.get_state()
    assert slam.rejuvenate().reason == "poses that were given as exact"
    assert_same(slam.get_state(), before)


@pytest.mark.parametrize("share", [0.9999, 1.0])
def test_weights_are_tempered_where_the_sample_size_is_too_small(share):
    """No draw is refused; the report tells the sample size before; the particles scatter about the same mean."""
    run = small_run()
    slam = rejuvenated(run, every=20, smoothing=SmoothingOptions(least_ess=share))
    plain = rejuvenated(run, every=20, smoothing=SmoothingOptions(least_ess=0.0))
    for reading in run.readings():
        reports = slam.step(**reading).rejuvenation, plain.step(**reading).rejuvenation
        if reports[0] is not None:
            break
    assert_same(*reports)
    assert reports[0].reason == ""
    assert reports[0].ess < share * 30
    sizes = [1.0 / (each.weights**2).sum() for each in (slam, plain)]
    assert sizes[1] == pytest.approx(reports[0].ess)
    assert sizes[0] == pytest.approx(share * 30, rel=1e-6)
    np.testing.assert_allclose(slam.particles(0)[0], plain.particles(0)[0], atol=1e-3)  # the gauge is weighted, too
    off = slam.particles(0)[0].mean(axis=0) - plain.pose(0).mean
    assert 30.0 * off @ np.linalg.solve(plain.pose(0).covariance, off) < 16.3  # 99.9 % of 3 degrees of freedom


@pytest.mark.slow
def test_a_rejuvenated_filter_has_smaller_map_errors_and_nees():
    """After 80 m with 30 particles, map errors are below two thirds of the plain filter's, and NEES below a fifth."""
    maps, nees = np.zeros((2, 3)), np.zeros((2, 3))
    for i, seed in enumerate(range(121, 124)):
        run = simulate_run(RunSpec(length=80.0, measurements=8), seed)
        for method, every in enumerate((None, 25)):
            row = score(run, follow(run, run.build_filter(30, "fastslam2", seed, rejuvenate_every=every)))
            maps[method, i], nees[method, i] = row["map_rmse_m"], row["nees_median"]
    assert np.sqrt((maps[1] ** 2).mean()) < 0.67 * np.sqrt((maps[0] ** 2).mean())
    assert nees[1].mean() < 0.2 * nees[0].mean()


NOISE = 0.05  # [m]


def rejuvenated_map(landmark_noise: float) -> LandmarkMap:
    """Return the map just after the particles of a robot that drives past six landmarks were drawn again."""
    rng = np.random.default_rng(3)
    landmarks = np.column_stack([rng.uniform(-1.0, 1.0, 6), rng.uniform(-0.5, 0.5, 6), rng.uniform(3.0, 5.0, 6)])
    slam = FastSlam(num_particles=5, rejuvenate_every=6, landmark_noise=landmark_noise)
    for step in range(6):
        points = landmarks - [0.0, 0.0, 0.2 * step]
        move = None if step == 0 else np.array([0.2, 0.0, 0.0])
        report = slam.step([move], [Measurements(points, np.eye(6))], identities=[np.arange(6)])
    assert report.rejuvenation is not None
    assert report.rejuvenation.reason == ""
    return slam.map()


def test_landmark_process_noise_is_added_after_a_rejuvenation() -> None:
    """To the smoother they stand still; what it leaves is widened by the variance of one walk along each axis."""
    still, walking = rejuvenated_map(0.0), rejuvenated_map(NOISE)
    wider = walking.covariances - still.covariances
    np.testing.assert_allclose(wider, np.tile(NOISE**2 * np.eye(3), (6, 1, 1)), atol=0.02 * NOISE**2)
