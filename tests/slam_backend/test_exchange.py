import numpy as np
from mapped_once import looks
from simulated_team import SIZE, SimulatedTeam

from slam_backend.fastslam.reports import Findings, StepReport
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.communication import LANDMARK_BYTES, POSE_BYTES, ExchangeLedger
from slam_backend.team.options import MergeOptions

LOOK = 4 * 13  # bytes of a descriptor of `looks`


def map_of(counts: dict[int, int]) -> LandmarkMap:
    """A map of landmarks with given ids and counts."""
    ids = np.array(list(counts))
    n = len(ids)
    return LandmarkMap(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), looks(ids), list(counts.values()), ids)


def report_of(rows: tuple[int, ...], associations: list[list[int]], created: list[list[int]]) -> StepReport:
    """A report of a joint step of the robots in some rows; what each robot's measurements became, row by row."""
    findings = Findings.gathered(*([np.array(ids, np.int64) for ids in each] for each in (associations, created)))
    named, made = (np.concatenate([each[row] for row in rows if row >= 0]) for each in (associations, created))
    counts = np.sum(made >= 0), 0, np.sum(named >= 0), np.sum(named < 0)
    return StepReport(findings, rows, *counts, ess=1.0, nis=3.0, resampled=False)


def test_new_landmarks_are_sent_with_descriptors_and_changed_ones_without() -> None:
    """A first exchange costs whole landmarks; a second only what is new, and what changed without its descriptor."""
    ledger = ExchangeLedger(3)
    ledger.record_maps(0, 2, map_of({1: 4, 5: 2}), map_of({7: 1}))
    assert ledger.sent == [2 * (LANDMARK_BYTES + LOOK), 0, LANDMARK_BYTES + LOOK]
    ledger.record_maps(0, 2, map_of({1: 4, 5: 3, 6: 1}), map_of({7: 1}))
    assert ledger.sent == [3 * (LANDMARK_BYTES + LOOK) + LANDMARK_BYTES, 0, LANDMARK_BYTES + LOOK]


def test_what_one_robot_was_told_another_was_not() -> None:
    """Each pair of robots has its own record of what was sent."""
    ledger = ExchangeLedger(3)
    ledger.record_maps(0, 1, map_of({1: 4}), map_of({2: 1}))
    ledger.record_maps(0, 2, map_of({1: 4}), map_of({2: 1}))
    assert ledger.sent == [2 * (LANDMARK_BYTES + LOOK), LANDMARK_BYTES + LOOK, LANDMARK_BYTES + LOOK]


def test_members_of_a_group_send_poses_and_the_landmarks_they_touched() -> None:
    """Per step a robot sends its pose, each landmark it matched or made, and descriptors of those it made."""
    ledger = ExchangeLedger(4)
    ledger.record_step(report_of((1, 3), [[8], [4, -1, 9], [], [2]], [[8], [-1, -1, 9], [], [-1]]), 13)
    sent = np.array([0, POSE_BYTES + 2 * LANDMARK_BYTES + LOOK, 0, POSE_BYTES + LANDMARK_BYTES])
    np.testing.assert_array_equal(ledger.sent, sent)
    ledger.record_step(report_of((1, 3), [[8], [4, 9], [], [2]], [[8], [-1, -1], [], [-1]]), 13)
    sent += [0, POSE_BYTES + 2 * LANDMARK_BYTES, 0, POSE_BYTES + LANDMARK_BYTES]
    np.testing.assert_array_equal(ledger.sent, sent)


def test_a_robot_that_has_left_does_not_send() -> None:
    """The joint filter goes on with those that hear each other."""
    ledger = ExchangeLedger(3)
    ledger.record_step(report_of((0, -1, 2), [[4], [7], [2]], [[4], [-1], [-1]]), 13)
    assert ledger.sent == [POSE_BYTES + LANDMARK_BYTES + LOOK, 0, POSE_BYTES + LANDMARK_BYTES]


def test_a_ledger_goes_on_from_its_state() -> None:
    """A restored ledger counts on as the first one did, and shares nothing with it."""
    ledger, twin = ExchangeLedger(2), ExchangeLedger(2)
    ledger.record_maps(0, 1, map_of({1: 4}), map_of({2: 1}))
    twin.set_state(ledger.get_state())
    for one in (ledger, twin):
        one.record_maps(0, 1, map_of({1: 5}), map_of({2: 1}))
    assert twin.sent == ledger.sent == [2 * LANDMARK_BYTES + LOOK, LANDMARK_BYTES + LOOK]


def test_robots_that_never_meet_send_nothing() -> None:
    """Without contact no byte is counted."""
    simulation = SimulatedTeam(num_robots=2, seed=1)
    team = simulation.build()
    simulation.run(team, 30, np.eye(2, dtype=bool))
    assert team.bytes_sent.tolist() == [0, 0]


def test_robots_that_merge_send_maps_and_then_a_few_hundred_bytes_a_step() -> None:
    """The first attempt costs both whole maps; a step of the joint filter a pose and what was seen in it."""
    simulation = SimulatedTeam(num_robots=2, seed=1)
    team = simulation.build(merging=MergeOptions(straighten=False))
    for _ in range(110):
        if team.events:
            break
        assert team.bytes_sent.tolist() == [0, 0]
        simulation.run(team, 1)
    sent = team.bytes_sent
    assert (sent > 0).all()
    np.testing.assert_array_equal(sent % (LANDMARK_BYTES + 4 * SIZE), 0)
    assert team.groups == ((0, 1),)
    simulation.run(team, 1)
    largest = POSE_BYTES + 5 * (LANDMARK_BYTES + 4 * SIZE)
    assert ((team.bytes_sent - sent >= POSE_BYTES) & (team.bytes_sent - sent <= largest)).all()
    team.bytes_sent[:] = 0  # a copy
    assert (team.bytes_sent > 0).all()
