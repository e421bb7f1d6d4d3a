"""What became of all robots' measurements in one step lies in one piece, and is cut out for who asks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_step_input import checked, reading

from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import Findings, StepReport
from slam_backend.models.measurements import Measurements
from slam_backend.team.team import TeamSlam

rows_of_ids = st.lists(st.lists(st.integers(-1, 9), max_size=4), min_size=1, max_size=4)


@given(ids=rows_of_ids, offset=st.integers(0, 5))
def test_each_robot_finds_what_became_of_what_it_measured(ids: list[list[int]], offset: int) -> None:
    """What was gathered robot by robot is cut out as it was, or only the names in it; nobody is told of robot -1."""
    found, made = ([np.array(row, np.int64) + k for row in ids] for k in (0, offset))
    findings = Findings.gathered(found, made)
    rows = (-1, *reversed(range(len(ids))))
    report = StepReport(findings, rows, 0, 0, 0, 0, 1.0, 3.0, False)
    for row, associated, created in zip(rows, report.associations, report.created, strict=True):
        np.testing.assert_array_equal(associated, [] if row < 0 else found[row])
        np.testing.assert_array_equal(created, [] if row < 0 else made[row])
        assert row < 0 or findings.num_given(row) == len(found[row])
        associated[:], created[:] = 77, 77  # copies
    for row, (own, new) in enumerate(zip(found, made, strict=True)):
        np.testing.assert_array_equal(findings.associated(row), own)
        assert findings.names_associated(row) == own[own >= 0].tolist()
        assert findings.names_created(row) == new[new >= 0].tolist()


@given(seeds=st.lists(st.integers(0, 10_000), min_size=1, max_size=4))
def test_measurements_that_were_not_used_are_rejected(seeds: list[int]) -> None:
    """Each robot is told of all that it was given: of the used ones what was written, of the others -1."""
    inputs = checked(list(map(reading, seeds)))
    findings, room = Findings.none_yet(inputs)
    assert (findings.told == -1).all()
    room[:] = np.arange(2 * len(inputs.sightings)).reshape(2, -1)
    for robot, turn in enumerate(inputs.turns):
        _, begin, end, _, _, count = turn
        mask = inputs.masks.get(robot, np.full(max(count, 0), True))
        assert findings.num_given(robot) == len(mask)
        for kind, cut in enumerate((findings.associated(robot), findings.created(robot))):
            np.testing.assert_array_equal(cut[mask], findings.told[kind, begin:end])
            np.testing.assert_array_equal(cut[~mask], -1)


def test_nobody_writes_into_what_reports_and_journals_share() -> None:
    """Whoever could would change what a smoother makes of the run."""
    frame = Measurements(np.array([[0.0, 0.0, 3.0]]), np.eye(1, 8))
    for slam in (FastSlam(num_particles=3), TeamSlam(1, num_particles=3)):
        report = slam.step([None], [frame])
        assert report.associations[0].tolist() == [0]
        with pytest.raises(ValueError, match="read-only"):
            report.findings.told[:] = 77
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            report.findings.told.setflags(write=True)
