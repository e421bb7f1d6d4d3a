"""What all robots read in a step is one table, and so is what became of it: each finds there what is its own."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.fastslam._kernels import EXACT_POSE, MOVED, NO_READING, STATIONARY
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import Associations, StepReport
from slam_backend.fastslam.step_input import StepInput, rows_of, validate_step
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.state import take
from slam_backend.team.team import TeamSlam

SIZE = 3  # of descriptors
Reading = tuple[Any, Any, Any, Any]  # odometry, frame, names, pose
NOTHING: Reading = (None, None, None, None)


def reading(seed: int) -> Reading:
    """Return what a robot may read: any of motion, frame, covariances, names (some of them -1) and pose, or nothing."""
    rng = np.random.default_rng(seed)
    move, seen, covered, named, placed = rng.random(5) < (0.5, 0.7, 0.4, 0.4, 0.2)
    n = int(rng.integers(0, 5))
    points = rng.uniform(1.0, 3.0, (n, 3))
    covariances = np.array([np.diag(row) for row in rng.uniform(0.01, 0.02, (n, 3))]).reshape(n, 3, 3)
    frame = Measurements(points, rng.normal(size=(n, SIZE)), covariances if covered else None)
    return (
        rng.normal(size=3) if move else None,
        frame if seen else None,
        rng.integers(-1, 3, n) if named and seen else None,
        rng.normal(size=3) if placed else None,
    )


def checked(readings: list[Reading]) -> StepInput:
    """Return the readings of some robots in one piece."""
    moves, frames, names, poses = map(list, zip(*readings, strict=True))
    return validate_step(len(readings), SIZE, StereoCamera(), moves, frames, names, poses)


def stepped(slam: FastSlam, inputs: StepInput, *rows: int) -> StepReport:
    """Let a filter take in what the robots in some rows have read."""
    return slam.step_checked(inputs, rows_of(rows), *Associations.allocate(inputs))


def said(report: StepReport) -> tuple[Any, ...]:
    """Return what a report says, wherever its robots stand in the table."""
    return report.associations, report.created, *report[2:]


@given(seeds=st.lists(st.integers(0, 10_000), min_size=1, max_size=4))
def test_each_robot_has_its_input_in_the_table(seeds: list[int]) -> None:
    """Points are turned into robot axes, with descriptors and names beside; what is named -1 is left out."""
    readings = list(map(reading, seeds))
    inputs = checked(readings)
    last = 0
    for robot, (move, frame, names, pose) in enumerate(readings):
        act, begin, end, covered, named, count = inputs.inputs[robot]
        assert inputs.inputs_table[robot].tolist() == list(inputs.inputs[robot])
        used = np.full(len(frame or ()), True) if names is None else names >= 0
        assert (begin, end, count) == (last, last + used.sum(), -1 if frame is None else len(frame))
        assert act == (
            EXACT_POSE if pose is not None else MOVED if move is not None else STATIONARY if end > begin else NO_READING
        )
        assert (covered, named) == (frame is not None and frame.covariances is not None, names is not None)
        assert (robot in inputs.inactive) == (frame is None and act == NO_READING)
        motion = move if pose is None else pose
        np.testing.assert_array_equal(inputs.moves[robot], 0.0 if motion is None else motion)
        assert (robot in inputs.masks) == (not used.all())
        last = end
        if frame is None or not len(frame):
            continue
        sightings = inputs.measurements[begin:end]
        np.testing.assert_array_equal(sightings[:, :3], frame.points[used] @ ROBOT_FROM_CAMERA.T)
        np.testing.assert_array_equal(inputs.descriptors[begin:end], frame.descriptors[used])
        if covered:
            turned = ROBOT_FROM_CAMERA @ frame.covariances[used] @ ROBOT_FROM_CAMERA.T
            np.testing.assert_array_equal(sightings[:, 3:], turned[:, *np.triu_indices(3)])
        if named:
            np.testing.assert_array_equal(inputs.names[begin:end], names[used])
    assert last == len(inputs.measurements) == len(inputs.descriptors)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda inputs: pickle.loads(pickle.dumps(inputs))])
@pytest.mark.parametrize("readings", [[NOTHING], [reading(0), reading(3), NOTHING, reading(8)]])
def test_copies_have_the_array_types_of_the_original(
    readings: list[Reading], copied: Callable[[StepInput], StepInput]
) -> None:
    """A copy holds the same, and all can be written to, as in the original: kernels are compiled for such arrays."""
    inputs = checked(readings)
    twin = copied(inputs)
    assert_same(tuple(twin), tuple(inputs))
    for each in (inputs, twin):
        for name in ("inputs_table", "moves", "measurements", "descriptors", "names"):
            assert getattr(each, name).flags.writeable, name


@given(counts=st.lists(st.integers(0, 4), min_size=1, max_size=4), spoilt=st.booleans(), seed=st.integers(0, 99))
def test_team_frames_equal_frames_per_robot(counts: list[int], spoilt: bool, seed: int) -> None:
    """A team's frames give the same table, or the same refusal, in one piece or robot by robot."""
    rng = np.random.default_rng(seed)
    points, ends = rng.uniform(1.0, 3.0, (sum(counts), 3)), np.cumsum(counts)
    if spoilt:
        points[-1:, 2] = 0.0
    team = TeamMeasurements(points, rng.normal(size=(sum(counts), SIZE)).astype(np.float32), ends)
    moves = rng.normal(size=(len(counts), 3))
    told = []
    for frames in (team, team.per_robot()):
        try:
            told.append(validate_step(len(counts), SIZE, StereoCamera(), moves, frames, None, None))
        except ValueError as refusal:
            told.append(str(refusal))
    assert isinstance(told[0], str) == (spoilt and len(points) > 0)
    if len(points):
        assert_same(told[0], told[1])


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_other_robots_in_the_table_change_nothing(proposal: Any) -> None:
    """A filter makes the same of what its robots read, bit for bit, whether others stand in the table or not."""
    alone, beside = (FastSlam(2, num_particles=12, proposal=proposal, seed=4, rejuvenate_every=7) for _ in range(2))
    for step in range(25):
        own, others = [reading(10 * step), reading(10 * step + 1)], [reading(10 * step + k) for k in range(2, 5)]
        if any(mine[3] is not None for mine in own):
            own = [NOTHING, NOTHING]
        table = [others[0], own[0], others[1], own[1], others[2]]
        assert_same(said(stepped(alone, checked(own), 0, 1)), said(stepped(beside, checked(table), 1, 3)))
    assert_same(contents(alone), contents(beside))


def test_logs_do_not_depend_on_when_they_are_read() -> None:
    """What a filter did is the same whether it is asked after each step or once in the end, and stays as it was.

    In some steps one of its robots is not heard, and in others there is one more robot in the table.
    """
    watched, unwatched = (FastSlam(2, num_particles=12, seed=4, rejuvenate_every=50) for _ in range(2))
    for step in range(80):
        heard, num_robots = (0, 1 if step % 7 else -1), 2 if step % 5 else 3
        rows = checked([reading(10 * step + k) for k in range(num_robots)])
        report = stepped(watched, rows, *heard)
        assert_same(stepped(unwatched, rows, *heard), report)
        if (reads := [robot for robot in (0, 1) if watched.log(robot).last_step == step]) and step % 3 == 0:
            for robot in reads:
                *_, last = watched.log(robot)
                used = report.associations[robot][rows.masks.get(robot, slice(None))]
                np.testing.assert_array_equal(last.ids, used)
                report.associations[robot][:] = 77  # the caller's own
    for robot in (0, 1):
        assert_same(take(unwatched.log(robot)), take(watched.log(robot)))
    assert_same(contents(unwatched), contents(watched))


rows_of_ids = st.lists(st.lists(st.integers(-1, 9), max_size=4), min_size=1, max_size=4)


@given(ids=rows_of_ids, offset=st.integers(0, 5))
def test_each_robot_has_its_associations_in_the_table(ids: list[list[int]], offset: int) -> None:
    """What was gathered robot by robot is cut out as it was, or only the names in it; robot -1 has nothing."""
    found, made = ([np.array(row, np.int64) + k for row in ids] for k in (0, offset))
    findings = Associations.from_arrays(found, made)
    rows = (-1, *reversed(range(len(ids))))
    report = StepReport(findings, rows, 0, 0, 0, 0, 1.0, 3.0, False)
    for row, associated, created in zip(rows, report.associations, report.created, strict=True):
        np.testing.assert_array_equal(associated, [] if row < 0 else found[row])
        np.testing.assert_array_equal(created, [] if row < 0 else made[row])
        assert row < 0 or findings.num_measurements(row) == len(found[row])
        associated[:], created[:] = 77, 77  # copies
    for row, (own, new) in enumerate(zip(found, made, strict=True)):
        np.testing.assert_array_equal(findings.associated(row), own)
        assert findings.associated_ids(row) == own[own >= 0].tolist()
        assert findings.created_ids(row) == new[new >= 0].tolist()


@given(seeds=st.lists(st.integers(0, 10_000), min_size=1, max_size=4))
def test_measurements_that_were_not_used_are_rejected(seeds: list[int]) -> None:
    """Each robot has a finding for all that it was given: of the used ones what was written, of the others -1."""
    inputs = checked(list(map(reading, seeds)))
    findings, told = Associations.allocate(inputs)
    assert (findings.ids == -1).all()
    told[:] = np.arange(2 * len(inputs.measurements)).reshape(2, -1)
    for robot, turn in enumerate(inputs.inputs):
        _, begin, end, _, _, count = turn
        mask = inputs.masks.get(robot, np.full(max(count, 0), True))
        assert findings.num_measurements(robot) == len(mask)
        for kind, cut in enumerate((findings.associated(robot), findings.created(robot))):
            np.testing.assert_array_equal(cut[mask], findings.ids[kind, begin:end])
            np.testing.assert_array_equal(cut[~mask], -1)


def test_arrays_shared_by_reports_and_journals_are_read_only() -> None:
    """Otherwise a caller could change the input of the smoother."""
    frame = Measurements(np.array([[0.0, 0.0, 3.0]]), np.eye(1, 8))
    for slam in (FastSlam(num_particles=3), TeamSlam(1, num_particles=3)):
        report = slam.step([None], [frame])
        assert report.associations[0].tolist() == [0]
        with pytest.raises(ValueError, match="read-only"):
            report.all_associations.ids[:] = 77
