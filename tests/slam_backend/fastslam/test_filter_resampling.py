"""What happens to particles and their accumulated weights when they are resampled, and snapshots."""

import copy
import pickle
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import arrays_of, contents, dense, load_landmarks, map_of, plain_filter
from builders.worlds import StereoWorld

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose
from slam_backend.models.measurements import Measurements
from slam_backend.resampling import RESAMPLING

MOVE = np.array([0.25, 0.02, 0.3])
CAMERA = StereoWorld(np.random.default_rng(0)).camera
PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])


def inputs(steps: int, seed: int = 0, noise: float = 1.0) -> list[tuple[Any, Any]]:
    """Return noisy odometry and frames, with `noise` times the camera's, of one robot that drives in a circle."""
    world = StereoWorld(np.random.default_rng(seed))
    pose, result = np.zeros(3), []
    for _ in range(steps):
        pose = compose(pose, MOVE)
        odometry = MOVE + world.rng.normal(0.0, [0.02, 0.01, 0.01])
        result.append(([odometry], [world.measure(pose, world.visible(pose), noise)]))
    return result


def filter_after(steps: int, num_particles: int = 11, **changes: Any) -> FastSlam:
    """Return a filter that has lived through some steps."""
    slam = plain_filter(num_particles=num_particles, seed=3, camera=CAMERA, **changes)
    for odometry, frames in inputs(steps):
        slam.step(odometry, frames)
    return slam


def without_resampling(state: dict[str, Any]) -> FastSlam:
    """Return a filter that goes on from a snapshot but never resamples."""
    slam = plain_filter()
    slam.set_state(state | {"options": replace(state["options"], resample_threshold=0.0)})
    return slam


def parents_of(slam: FastSlam, twin: FastSlam) -> IntArray:
    """Return (M,) which particle of a twin that has not resampled each particle of a filter is a copy of."""
    same = (slam.particles()[0][:, None] == twin.particles()[0]).all(axis=2)
    np.testing.assert_array_equal(same.sum(axis=1), 1)
    return same.argmax(axis=1)


@PROPOSALS
def test_accumulated_weights_follow_the_ancestral_line(proposal: Any) -> None:
    """Eq. 12: a resampled particle carries its ancestor's accumulated log-weight, not that of its index."""
    slam = filter_after(3, proposal=proposal, resample_threshold=1.0)
    strangers = 0
    for odometry, frames in inputs(30)[3:]:
        twin = without_resampling(slam.get_state())
        twin.step(odometry, frames)
        slam.step(odometry, frames)
        parents = parents_of(slam, twin)
        np.testing.assert_array_equal(slam.path_log_weights, twin.path_log_weights[parents])
        np.testing.assert_allclose(slam.weights, 1.0 / 11.0)
        strangers += int(np.sum(slam.path_log_weights != twin.path_log_weights))
    assert strangers > 10, "the indices have changed their meaning many times"


@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_a_resampled_particle_copies_all_of_its_parent(scheme: str) -> None:
    """Poses, starts, N(x^, P^), maps and counts are those of one and the same parent, in blocks of particles or not.

    Robot 1 sees nothing: its Gaussians are not sampled, and go along too.
    """
    slam = plain_filter(2, num_particles=70, camera=CAMERA, resampling=scheme, resample_threshold=1.0)
    slam.starts[1, :2, :70] += np.random.default_rng(1).normal(size=(2, 70))  # as after a merge
    copies = 0
    for odometry, frames in inputs(12, seed=2):
        twin = without_resampling(slam.get_state())
        for each in (twin, slam):
            each.step([*odometry, MOVE], [*frames, None])
        parents = parents_of(slam, twin)
        resampled, before = contents(slam), contents(twin)
        for name in ("poses", "starts", "means", "covariances"):
            np.testing.assert_array_equal(resampled[name], before[name][..., parents], err_msg=name)
        resampled, before = resampled["maps"], before["maps"]
        kept = np.isin(before["ids"], resampled["ids"])
        for name in ("means", "covariances", "counts"):
            np.testing.assert_array_equal(resampled[name], before[name][kept][..., parents], err_msg=name)
        assert not before["counts"][~kept][:, parents].any()
        copies += 70 - len(np.unique(parents))
    assert copies > 70


@PROPOSALS
@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_landmarks_out_of_view_follow_every_resampling(proposal: Any, scheme: str) -> None:
    """A filter whose maps are read after each resampling, and one left alone over many, hold the same in the end."""
    options: Any = {"proposal": proposal, "resampling": scheme, "resample_threshold": 1.0}
    read, alone = (plain_filter(1, num_particles=70, camera=CAMERA, **options) for _ in range(2))
    unseen = 0
    for odometry, frames in inputs(16, noise=2.0):
        for slam in (read, alone):
            report = slam.step(odometry, frames)
        contents(read)
        unseen += alone.map_size - len(frames[0])
        assert report.resampled
    assert unseen > 70
    assert len(np.unique(alone.maps.map_of)) > 4, "landmarks last seen before one, two, three and more resamplings"
    assert_same(contents(alone), contents(read))


@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_survivors_keep_their_places(scheme: str) -> None:
    """A particle with a copy stays; surplus copies, by ascending parent, fill the places of the dead, ascending."""
    slam = filter_after(3, 70, resampling=scheme, resample_threshold=1.0, proposal="fastslam1")
    moves = 0
    for odometry, frames in inputs(10)[3:]:
        twin = without_resampling(slam.get_state())
        twin.step(odometry, frames)
        slam.step(odometry, frames)
        parents, places = parents_of(slam, twin), np.arange(70)
        survivors = np.isin(places, parents)
        np.testing.assert_array_equal(parents[survivors], places[survivors])
        assert (np.diff(parents[~survivors]) >= 0).all()
        moves += np.count_nonzero(~survivors)
    assert moves > 70


def test_weights_are_kept_until_the_particles_are_resampled() -> None:
    """Without resampling a step multiplies the weights of before; with it they start from 1/M."""
    slam = filter_after(3, resample_threshold=0.0)
    before, paths = slam.particles()[1], slam.path_log_weights.copy()
    odometry, frames = inputs(4)[3]
    slam.step(odometry, frames)
    gained = slam.path_log_weights - paths
    expected = before + gained
    np.testing.assert_allclose(slam.particles()[1], expected - np.logaddexp.reduce(expected), atol=1e-12)


@PROPOSALS
@pytest.mark.parametrize("scheme", list(RESAMPLING))
@pytest.mark.parametrize("num_particles", [11, 70])
def test_writing_a_particle_changes_no_other_particle(proposal: Any, scheme: str, num_particles: int) -> None:
    """Where one of two siblings stands elsewhere, a step changes that particle alone, and no snapshot."""
    slam = filter_after(8, num_particles, resampling=scheme, resample_threshold=1.0, proposal=proposal)
    poses = slam.particles()[0]
    siblings = (poses[:, None] == poses).all(axis=2).sum(axis=1) > 1
    writer = int(np.flatnonzero(siblings)[0])
    before, state = contents(slam), slam.get_state()
    kept, other = copy.deepcopy(state), copy.deepcopy(state)
    other["poses"][0, :, writer] += [0.3, -0.2, 0.1]
    odometry, frames = inputs(9)[8]
    twins = [without_resampling(start) for start in (state, other)]
    for twin in twins:
        twin.step(odometry, frames)
    one, two = twins
    for m in range(num_particles):
        assert np.array_equal(one.particles()[0][m], two.particles()[0][m]) == (m != writer)
        assert np.array_equal(map_of(one, m), map_of(two, m)) == (m != writer)
    assert_same(state, kept)
    assert_same(contents(slam), before)


@PROPOSALS
@pytest.mark.parametrize("num_particles", [11, 70])
def test_a_landmark_is_updated_in_the_particle_that_holds_it_only(proposal: Any, num_particles: int) -> None:
    """Where one particle alone holds a landmark, its update leaves all that is kept for the others alone."""
    slam = filter_after(8, num_particles, resample_threshold=1.0, proposal=proposal)
    maps = slam.maps
    slots = maps.used_slots()
    values, counts = maps.dense(slots)
    row = int(np.flatnonzero((counts > 0).all(axis=1))[-1])  # the newest lies ahead of the robot
    holder = np.arange(num_particles) == 4
    counts[row] = 7 * holder
    names = np.where(np.arange(len(slots)) == row, 5, -1)
    load_landmarks(maps, values, counts, maps.descriptors[slots], maps.ids[slots], names, maps.next_id)
    slam = without_resampling(slam.get_state())
    ids, means, covariances, counts = dense(slam)
    poses = slam.particles()[0]
    look = slam.maps.descriptors[slam.maps.used_slots()[row]][None]
    report = slam.step([None], [Measurements([[-0.1, -0.2, 3.0]], look)], identities=[[5]])
    now_ids, now_means, now_covariances, now_counts = dense(slam)
    np.testing.assert_array_equal(now_ids, [*ids, report.created[0][0]])
    expected = np.zeros(counts.shape, dtype=bool)
    expected[row, 4] = True
    np.testing.assert_array_equal((now_means[:-1] != means).any(axis=1), expected)
    np.testing.assert_array_equal((now_covariances[:-1] != covariances).any(axis=1), expected)
    np.testing.assert_array_equal(now_counts[:-1] - counts, expected)
    np.testing.assert_array_equal(now_counts[-1], ~holder)
    np.testing.assert_array_equal(slam.particles()[0], poses)


def test_returned_arrays_are_copies() -> None:
    """Particles, weights, poses and start poses are copies."""
    slam = filter_after(2)
    for array in (*slam.particles(), slam.weights, slam.start_pose(), *slam.pose(), *slam.pose_from_start()):
        array += 1.0
    again = filter_after(2)
    np.testing.assert_array_equal(slam.particles()[0], again.particles()[0])
    np.testing.assert_array_equal(slam.weights, again.weights)
    np.testing.assert_array_equal(slam.start_pose(), again.start_pose())
    assert_same(slam.pose(), again.pose())
    assert_same(slam.pose_from_start(), again.pose_from_start())


@PROPOSALS
@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_a_restored_filter_continues_bit_for_bit(proposal: Any, scheme: str) -> None:
    """From a snapshot, pickled or not, the same inputs give the same bytes, whatever the filter did in between."""
    existence = ExistenceModel(delete_below=0.2) if scheme == "residual" else None
    slam = filter_after(5, proposal=proposal, resampling=scheme, resample_threshold=0.8, existence=existence)
    state = slam.get_state()
    pickled = pickle.dumps(state)
    later = inputs(12)[5:]
    reports = [slam.step(odometry, frames) for odometry, frames in later]
    expected, expected_state = contents(slam), slam.get_state()
    for snapshot, restored in ((state, slam), (pickle.loads(pickled), plain_filter(3, num_particles=2))):
        restored.set_state(snapshot)
        assert_same([restored.step(odometry, frames) for odometry, frames in later], reports)
        assert_same(contents(restored), expected)
        assert_same(restored.get_state(), expected_state)


@PROPOSALS
def test_a_filter_continues_bit_for_bit_through_many_snapshots(proposal: Any) -> None:
    """Restored at each step, and asked for its maps, a filter does what one does that is left alone.

    Noise beyond the gates lets landmarks come and go in several blocks of particles, one robot is blind at times and
    names are given at times, so that places are freed and used again in another order.
    """
    options: Any = {
        "proposal": proposal,
        "new_landmark_gate": 11.34,
        "new_landmark_radius": 0.0,
        "resample_threshold": 0.9,
    }
    slam, looks = (
        plain_filter(2, num_particles=70, camera=CAMERA, seed=3, **options),
        StereoWorld(np.random.default_rng(1)).descriptors,
    )
    restored = plain_filter()
    restored.set_state(slam.get_state())
    for step, (odometry, frames) in enumerate(inputs(40, seed=1, noise=3.0)):
        names = None if step % 3 else [(frames[0].descriptors @ looks.T).argmax(axis=1), None]
        arguments = ([*odometry, MOVE], [*frames, frames[0] if step % 4 == 0 else None], names)
        assert_same(restored.step(*arguments), slam.step(*arguments))
        state = restored.get_state()
        restored = plain_filter(1 + step % 2, num_particles=70)
        restored.set_state(state)
        if step % 2:
            restored.map("mixture")
    assert slam.maps.next_id - slam.num_landmarks > 10, "landmarks have been forgotten"
    assert_same(restored.map("mixture"), slam.map("mixture"))
    assert_same(contents(restored), contents(slam))


def arrays_in(nest: Any) -> list[Any]:
    """Return all arrays in nested dicts, sequences and records."""
    if isinstance(nest, np.ndarray):
        return [nest]
    if isinstance(nest, Mapping):
        nest = list(nest.values())
    elif hasattr(nest, "__dataclass_fields__"):
        nest = [getattr(nest, name) for name in nest.__dataclass_fields__]
    return [array for item in nest for array in arrays_in(item)] if isinstance(nest, (list, tuple)) else []


@PROPOSALS
def test_a_snapshot_shares_no_writable_array(proposal: Any) -> None:
    """Neither steps of the filter or of one restored from it, nor writing to what they hand out, reach a snapshot."""
    slam, other = filter_after(5, proposal=proposal), plain_filter()
    state = slam.get_state()
    kept = copy.deepcopy(state)
    other.set_state(state)
    in_use = [a for one in (slam, other) for a in [*arrays_of(one).values(), *arrays_in(one.estimates)]]
    for array in arrays_in(state):
        assert not any(held.flags.writeable and np.shares_memory(array, held) for held in in_use)
    for odometry, frames in inputs(8)[5:]:
        slam.step(odometry, frames)
        other.step(odometry, frames)
    assert_same(state, kept)


@pytest.mark.parametrize("stream", [np.random.PCG64, np.random.MT19937])
def test_a_restored_filter_draws_from_a_stream_of_its_own(stream: Any) -> None:
    """Restoring neither rewinds the generator that was given as a seed, nor lets draws of others disturb the filter."""
    rng = np.random.Generator(stream(7))
    slam = plain_filter(seed=rng)
    state = slam.get_state()
    slam.step([MOVE], [None])
    expected, drawn = contents(slam), copy.deepcopy(rng.bit_generator.state)
    for restored in (slam, plain_filter()):
        restored.set_state(state)
        assert_same(rng.bit_generator.state, drawn)
        rng.random()
        drawn = copy.deepcopy(rng.bit_generator.state)
        restored.step([MOVE], [None])
        assert_same(contents(restored), expected)


def test_landmarks_that_no_survivor_holds_are_deleted() -> None:
    """Ids are never used twice, and only landmarks that a particle holds are counted."""
    slam = filter_after(20, proposal="fastslam1", resample_threshold=1.0)
    held, _, _, counts = dense(slam)
    assert (held >= 0).all()
    assert (counts > 0).any(axis=1).all()
    assert len(np.unique(held)) == len(held) == slam.num_landmarks
    report = slam.step([None], [Measurements([[0.0, 0.0, 2.0]], -np.eye(1, 17))])
    assert report.created[0][0] > held.max()
    assert report.created[0][0] > len(held), "some had been forgotten"
