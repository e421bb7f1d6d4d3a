"""The compact log of a run: nothing is lost, nothing finished is copied or written, and copies go their own way."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.kernels import python_entry
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.fastslam._kernels import EXACT_POSE, MOVED, NO_READING
from slam_backend.fastslam._kernels import STATIONARY as STOOD_STILL
from slam_backend.fastslam._kernels.layout import ESTIMATE, LOGGED, LOGGED_KIND, MOTION, NAME, NUM_MEASURED, NUM_NOTED
from slam_backend.fastslam._kernels.records import InputArrays, StepResults
from slam_backend.fastslam._kernels.run_log import initial_poses_of
from slam_backend.fastslam._kernels.step import log_step
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.pending_steps import LONGEST, ROOM
from slam_backend.fastslam.run_log import MEASUREMENTS, ROWS, RobotLog
from slam_backend.models.measurements import Measurements
from slam_backend.smoother.log_arrays import EXACT, ODOMETRY, STATIONARY
from slam_backend.state import accepted, restore, take

log_step = python_entry(log_step)

Step = dict[str, Any]


def random_steps(count: int, seed: int, most: int = 40, optional: float = 0.3) -> list[Step]:
    """Return steps as arguments of `append`: every kind of motion, frames of any size, columns that come and go."""
    rng = np.random.default_rng(seed)
    steps: list[Step] = []
    index = 0
    for _ in range(count):
        n = int(rng.integers(0, most)) if rng.random() < 0.8 else 0
        step: Step = {"step": index, "points": rng.normal(size=(n, 3)), "ids": rng.integers(-1, 50, n)}
        if rng.random() < 0.7:
            step["odometry"] = rng.normal(size=3)
        if rng.random() < 0.2:
            step["pose"] = rng.normal(size=3)
        if n and rng.random() < optional:
            step["covariances"] = rng.normal(size=(n, 6))
        steps.append(step)
        index += int(rng.integers(1, 4))
    return steps


def log_of(steps: list[Step]) -> RobotLog:
    """Return a log of these steps."""
    log = RobotLog()
    for step in steps:
        log.append(**step)
    return log


@pytest.mark.parametrize(("count", "most", "optional"), [(0, 5, 0.0), (1, 5, 1.0), (700, 5, 0.0), (300, 90, 0.02)])
def test_logged_steps_are_read_back(count: int, most: int, optional: float) -> None:
    """The loop over a log yields the very steps that were appended, over chunks and empty frames, in order."""
    steps = random_steps(count, 3, most, optional)
    log = log_of(steps)
    assert (len(log), log.num_measurements) == (count, sum(len(step["ids"]) for step in steps))
    for row, step in zip(log, steps, strict=True):
        assert row.step == step["step"]
        if "pose" in step:
            kind, motion = EXACT, step["pose"]
        else:
            kind, motion = (ODOMETRY, step["odometry"]) if "odometry" in step else (STATIONARY, np.zeros(3))
        assert row.kind == kind
        np.testing.assert_array_equal(row.motion, motion)
        np.testing.assert_array_equal(row.points, step["points"])
        np.testing.assert_array_equal(row.ids, step["ids"])
        assert (row.covariances is None) == ("covariances" not in step) or not len(row.ids)
        if "covariances" in step and row.covariances is not None:
            np.testing.assert_array_equal(row.covariances, step["covariances"])


@pytest.mark.parametrize("optional", [0.0, 0.01])
def test_flat_arrays_hold_the_same_as_the_loop(optional: float) -> None:
    """Row t of the arrays is step t of the loop; covariances that never came are None, else filled up with NaN."""
    log = log_of(random_steps(600, 5, 30, optional))
    arrays = log.arrays()
    assert len(arrays) == 600
    assert (arrays.covariances is None) == (optional == 0.0)
    for t, row in enumerate(log):
        again = arrays.row(t)
        for name, one, other in zip(row._fields, row, again, strict=True):
            assert_same(one, other, name)
    if arrays.covariances is not None:
        by_measurement = np.repeat(arrays.given, np.diff(arrays.starts))
        np.testing.assert_array_equal(np.isnan(arrays.covariances).all(axis=1), ~by_measurement)


def test_arrays_since_a_step_are_the_tail_of_all_arrays() -> None:
    """`arrays(since)` is the tail of `arrays()`, whatever the index: before, within, between steps and behind all."""
    log = log_of(random_steps(600, 6, 30))
    whole = log.arrays()
    last, border = int(whole.steps[-1]), int(whole.steps[ROWS])
    for since in [0, 1, last // 3, last // 2, last - 1, last, last + 1, border - 3, border - 2, border - 1, border]:
        tail = log.arrays(since)
        t = int(np.count_nonzero(whole.steps < since))
        first = whole.starts[t]
        np.testing.assert_array_equal(tail.steps, whole.steps[t:])
        np.testing.assert_array_equal(tail.starts, whole.starts[t:] - first)
        np.testing.assert_array_equal(tail.motions, whole.motions[t:])
        np.testing.assert_array_equal(tail.ids, whole.ids[first:])
        np.testing.assert_array_equal(tail.points, whole.points[first:])


@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 60), most=st.sampled_from([3, 90, 400]))
def test_a_restored_log_continues_bit_for_bit(seed: int, cut: int, most: int) -> None:
    """From a snapshot, pickled or not, and from any kind of copy, the same steps give the same bytes."""
    steps = random_steps(60, seed, most)
    log = log_of(steps[:cut])
    state = take(log)
    restored = RobotLog()
    restored.append(3, odometry=np.ones(3))
    restore(restored, accepted(RobotLog, "state", pickle.loads(pickle.dumps(state))))
    others = [restored, log.copy(), copy.copy(log), copy.deepcopy(log), pickle.loads(pickle.dumps(log))]
    for step in steps[cut:]:
        log.append(**step)
        for other in others:
            other.append(**step)
    for other in others:
        assert_same(take(other), take(log))
        assert other.nbytes == log.nbytes
    restore(log, state)
    assert_same(take(log), take(log_of(steps[:cut])))


def test_finished_chunks_are_shared_and_cannot_be_written() -> None:
    """Snapshots and copies hold the very chunks of the log, and they cannot be written."""
    log = log_of(random_steps(900, 8))
    chunks = take(log)["chunks"]
    assert len(chunks) > 3
    twin = log.copy()
    for one, other in zip(chunks, take(twin)["chunks"], strict=True):
        assert one is other
    assert copy.deepcopy(take(log))["chunks"][0] is chunks[0]
    for state in (take(log), accepted(RobotLog, "state", pickle.loads(pickle.dumps(take(log))))):
        for part in (*state["chunks"], state["unfinished"]):
            for name in ("steps", "kinds", "motions", "given", "starts", "points", "ids"):
                with pytest.raises(ValueError, match="read-only"):
                    getattr(part, name)[:1] = 0
    for array in (log.arrays().points, log.arrays(1500).ids, next(iter(log)).motion):
        with pytest.raises(ValueError, match="read-only"):
            array[:1] = 0


def test_appended_steps_are_copied() -> None:
    """The caller may reuse its buffers, and appending to a log does not change its snapshots."""
    points, ids, motion = np.ones((2, 3)), np.array([4, 5]), np.ones(3)
    log = RobotLog()
    log.append(0, odometry=motion, points=points, ids=ids)
    state, arrays = take(log), log.arrays()
    points[:], ids[:], motion[:] = 9.0, 9, 9.0
    log.append(1, odometry=motion, points=points, ids=ids)
    for held in (state["unfinished"], arrays):
        assert (len(held), held.points.max(), held.ids.max(), held.motions.max()) == (1, 1.0, 5, 1.0)


@pytest.mark.parametrize("others", ["reject", "keep"])
def test_renamed_is_a_dictionary_applied_to_each_id(others: Any) -> None:
    """Each id becomes what a plain dictionary says; the rest is shared, and the log itself keeps its names."""
    steps = random_steps(500, 9)
    log = log_of(steps)
    before = log.arrays()
    rng = np.random.default_rng(1)
    old = rng.permutation(50)[:30]
    new = rng.integers(-1, 1000, 30)
    names = dict(zip(old.tolist(), new.tolist(), strict=True))
    renamed = log.renamed(old, new, others)
    expected = [names.get(i, i if others == "keep" else -1) for i in before.ids.tolist()]
    np.testing.assert_array_equal(renamed.arrays().ids, expected)
    np.testing.assert_array_equal(renamed.arrays().points, before.points)
    assert take(renamed)["chunks"][0].points is take(log)["chunks"][0].points
    assert_same(take(log), take(log_of(steps)))
    log.append(10_000, odometry=np.zeros(3))
    renamed.append(10_000, odometry=np.ones(3))
    assert log.arrays().motions[-1].tolist() != renamed.arrays().motions[-1].tolist()


@pytest.mark.parametrize("before", [0, 1, ROWS - 1, ROWS])
def test_a_frame_larger_than_a_chunk(before: int) -> None:
    """Frames of any size fit, first of all, after motion alone, and where a chunk is full; what follows as well."""
    big = MEASUREMENTS + 7
    steps: list[Step] = [{"step": t, "odometry": np.full(3, t)} for t in range(before)]
    steps += [
        {"step": before + j, "points": np.full((n, 3), float(j)), "ids": np.full(n, j)}
        for j, n in enumerate([big, 2, big, 0, MEASUREMENTS, 1])
    ]
    log = log_of(steps)
    assert [len(row.ids) for row in log][before:] == [big, 2, big, 0, MEASUREMENTS, 1]
    for row, step in zip(log, steps, strict=True):
        np.testing.assert_array_equal(row.points, step.get("points", np.empty((0, 3))))
    assert_same(take(log.copy()), take(log))


@pytest.mark.parametrize(("most", "optional", "together"), [(5, 0.0, 32), (90, 0.0, 7), (300, 0.0, 32), (5, 0.1, 3)])
def test_steps_of_a_journal_equal_steps_appended_one_by_one(most: int, optional: float, together: int) -> None:
    """A log that takes many robots' steps, some at a time, holds those of its own, as if they were appended."""
    count, own, rng = 3, 1, np.random.default_rng(6)
    log, expected = RobotLog(), RobotLog()
    for first in range(0, 2 * ROWS, together):
        steps = np.arange(first, first + together)
        measured, noted = [np.empty((0, NUM_MEASURED))], np.zeros((together, count, NUM_NOTED))
        for k, step in enumerate(steps.tolist()):
            for robot in range(count):
                n, act = (
                    int(rng.integers(0, most)) * int(rng.random() < 0.8),
                    int(rng.choice([NO_READING, MOVED, EXACT_POSE])),
                )
                covered = n > 0 and rng.random() < optional
                act = STOOD_STILL if n and act == NO_READING else act
                motion, seen = rng.normal(size=3) * (act in (MOVED, EXACT_POSE)), rng.normal(size=(n, NUM_MEASURED))
                seen[:, NAME] = rng.integers(-1, 9, n)
                noted[k, robot, :MOTION] = act != NO_READING, act, covered, n
                noted[k, robot, MOTION:ESTIMATE] = motion
                measured.append(seen)
                if robot == own and act != NO_READING:
                    move, pose = motion if act in (MOVED, EXACT_POSE) else None, motion if act == EXACT_POSE else None
                    spreads, ids = seen[:, 3:NAME] if covered else None, seen[:, NAME].astype(np.int64)
                    expected.append(step, move, pose, seen[:, :3], ids, spreads)
        log.extend(own, steps, noted, np.concatenate(measured))
    assert len(log) > 1.5 * ROWS
    assert_same(take(log), take(expected))
    with pytest.raises(ValueError, match="Log steps in order"):
        log.extend(own, steps, noted, np.concatenate(measured))
    assert_same(take(log), take(expected))


@given(st.lists(st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 3), st.booleans()), min_size=4, max_size=4)))
def test_a_journal_holds_what_robots_of_a_filter_did_and_measured(steps: list[list[tuple[int, int, bool]]]) -> None:
    """Of four robots two, in the other order, and one that is nowhere; what else was measured is left out."""
    rows, rng = np.array([2, -1, 0]), np.random.default_rng(4)
    measured, expected, first = np.empty((12 * len(steps), NUM_MEASURED)), [], 0
    for step in steps:
        turns, end = np.zeros((4, 6), np.int64), 0
        for robot, (act, count, covered) in enumerate(step):
            turns[robot] = act, end, end + max(count, 0), covered, False, count
            end += max(count, 0)
        moves, sightings, told = rng.normal(size=(4, 3)), rng.normal(size=(end, 9)), rng.integers(-1, 50, (2, end))
        means, noted = rng.normal(size=(3, 3)), np.empty((3, NUM_NOTED))
        nothing = np.empty((0, 0))
        inputs = InputArrays(rows, turns, moves, nothing, sightings, np.empty((0, 0), np.float32), rows)
        log_step(inputs, means, StepResults(np.empty((0, 0), np.int32), nothing, told, noted, measured), first)
        assert not noted[1].any()
        for robot in (0, 2):
            act, begin, last, covered, _, count = turns[rows[robot]].tolist()
            logged = act != NO_READING or count > 0
            assert noted[robot, :MOTION].tolist() == [logged, act, covered and count > 0, last - begin]
            np.testing.assert_array_equal(noted[robot, MOTION:ESTIMATE], moves[rows[robot]])
            np.testing.assert_array_equal(noted[robot, ESTIMATE:], means[robot])
            columns = NAME if covered else 3
            expected += [(*sightings[b, :columns], told[0, b]) for b in range(begin, last)]
            first += last - begin
    assert len(expected) == first
    for seen, known in zip(measured[:first], expected, strict=True):
        assert (*seen[: len(known) - 1], seen[NAME]) == known


def test_a_filter_logs_all_of_its_input() -> None:
    """Far more than a journal has room for at first, in more steps than wait; distances say which points they are."""
    slam, rng, size = FastSlam(num_particles=2), np.random.default_rng(5), ROOM // 8
    points = rng.uniform(1.0, 9.0, (LONGEST + 8, size, 3))
    for frame in points:
        slam.step([np.array([0.1, 0.0, 0.0])], [Measurements(frame, rng.normal(size=(size, 4)))])
    logged = slam.log().arrays()
    np.testing.assert_array_equal(logged.steps, np.arange(len(points)))
    np.testing.assert_array_equal(np.diff(logged.starts), size)
    np.testing.assert_array_equal(logged.motions, np.tile([0.1, 0.0, 0.0], (len(points), 1)))
    np.testing.assert_allclose(
        np.linalg.norm(logged.points, axis=1), np.linalg.norm(points, axis=2).ravel(), rtol=1e-12
    )


def test_initial_poses_are_of_the_steps_in_which_a_robot_did_or_measured_anything() -> None:
    """One row for each of these, of one robot of the filter; and whether its pose was given."""
    num_steps, rng = 40, np.random.default_rng(8)
    numbers, noted = np.arange(7, 7 + num_steps), rng.normal(size=(num_steps, 3, NUM_NOTED))
    for robot, acts in ((0, [NO_READING, MOVED]), (2, [NO_READING, STOOD_STILL, EXACT_POSE])):
        did = noted[:, robot, LOGGED_KIND] = rng.choice(acts, num_steps)
        kept = did != NO_READING
        noted[:, robot, LOGGED] = kept
        steps, poses, is_placed = initial_poses_of(robot, numbers, noted)
        np.testing.assert_array_equal(steps, numbers[kept])
        np.testing.assert_array_equal(poses, noted[kept, robot, ESTIMATE:])
        assert 0 < len(steps) < num_steps
        assert is_placed == (EXACT_POSE in acts)


def test_memory_of_a_long_run() -> None:
    """10,000 steps of 15 measurements take less than 6 MB, nine tenths of it numbers and not room to spare."""
    points, ids, move = np.zeros((15, 3)), np.arange(15), np.zeros(3)
    log = RobotLog()
    for t in range(10_000):
        log.append(t, odometry=move, points=points, ids=ids)
    needed = 10_000 * (8 + 1 + 24 + 1 + 8) + 150_000 * (24 + 8)
    assert needed <= log.nbytes < min(6e6, needed / 0.9)
    assert log.arrays().nbytes == needed + 8
