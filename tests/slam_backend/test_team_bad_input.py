"""What a team refuses, in the one form of all errors; and a refused call leaves no trace."""

import copy
from typing import Any

import numpy as np
import pytest
from same_bits import assert_same
from simulated_team import SimulatedTeam
from standing_team import hand_made, standing_team

from slam_backend.maps.alignment import Alignment
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

GOOD = Measurements(np.array([[0.1, 0.2, 2.0]]), np.eye(1, 13))
STILL = [None] * 3
FRAMES = [GOOD] * 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_robots": 0}, r"num_robots: expected an int >= 1, got 0\. A team has at least one robot\."),
        ({"num_robots": -2}, r"num_robots: expected an int >= 1, got -2"),
        ({"num_robots": 10**400}, r"num_robots: expected an int <= 1000, got 1000"),
        ({"num_robots": 2.5}, r"num_robots: expected an int >= 1, got 2\.5"),
        ({"num_robots": True}, r"num_robots: expected an int >= 1, got True"),
        ({"num_robots": None}, r"num_robots: expected an int >= 1, got None"),
        ({"particles": 7}, r"particles: expected a known argument, got a name that no option has\. Options"),
        ({"seed": -1}, r"seed: expected an int >= 0, a SeedSequence or a Generator, got -1\. Give an int"),
        ({"seed": np.random.default_rng(0)}, r"seed: expected an int >= 0 or a SeedSequence, got Generator"),
        ({"initial_poses": 7}, r"initial_poses: expected a known argument"),
        ({"num_particles": 0}, r"num_particles: expected an int >= 1, got 0"),
        ({"proposal": "fastslam3"}, r"proposal: expected one of 'fastslam2', 'fastslam1', got 'fastslam3'"),
        ({"resampling": "wheel"}, r"resampling: expected one of 'systematic'.*got 'wheel'"),
        ({"camera": "wide"}, r"camera: expected a StereoCamera, got 'wide'\. Build one"),
        ({"alignment": {"min_inliers": 9}}, r"alignment: expected AlignmentOptions or None, got \{'min_inliers': 9\}"),
        ({"attempts": 25}, r"attempts: expected AttemptOptions or None, got 25\. Build one: AttemptOptions"),
        ({"merging": 200}, r"merging: expected MergeOptions or None, got 200\. Build one: MergeOptions"),
    ],
)
def test_a_team_that_cannot_be_built_says_why(arguments: dict[str, Any], message: str) -> None:
    """The error names the argument, what was expected, what came, and the cure."""
    with pytest.raises(ValueError, match=message):
        TeamSlam(**({"num_robots": 3} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"merged_particles": 0}, r"merging\.merged_particles: expected an int >= 1, got 0\. Use None for the larger"),
        ({"merged_particles": 10**9}, r"merging\.merged_particles: expected an int <= 1000000, got 1000000000"),
        ({"watch_steps": -1}, r"merging\.watch_steps: expected an int >= 0, got -1\. Use 0 to make merges final"),
        ({"watch_every": 0}, r"merging\.watch_every: expected an int >= 1, got 0"),
        ({"barred_steps": 1.5}, r"merging\.barred_steps: expected an int >= 0, got 1\.5"),
        ({"max_moved": 1.2}, r"merging\.max_moved: expected a finite number >= 0 and <= 1, got 1\.2\. Give a share"),
    ],
)
def test_merge_options_that_make_no_sense_are_refused(arguments: dict[str, Any], message: str) -> None:
    """The error names the option, what was expected, what came, and the cure."""
    with pytest.raises(ValueError, match=message):
        MergeOptions(**arguments)


def in_one_piece(points: list[np.ndarray], ends: list[int], descriptors: int = 3) -> TeamMeasurements:
    """A team's frames, unchecked."""
    looks = np.tile(GOOD.descriptors, (descriptors, 1))
    return TeamMeasurements(np.concatenate(points), looks, np.array(ends, np.int64))


ONE_BEHIND = in_one_piece([GOOD.points, GOOD.points, -GOOD.points], [1, 2, 3]).of_each()
TOGETHER = in_one_piece([GOOD.points] * 3, [1, 2, 3])
NO_NUMBER = in_one_piece([GOOD.points, GOOD.points, GOOD.points * np.nan], [1, 2, 3])
ASYMMETRIC = np.array([[True, True, False], [False, True, False], [False, False, True]])
BAD_STEPS: list[tuple[dict[str, Any], str]] = [
    ({"odometry": STILL[:2]}, r"odometry: expected a sequence with one entry per robot \(3\), got .*2"),
    ({"odometry": None}, r"odometry: expected a sequence with one entry per robot \(3\), got .*None"),
    ({"odometry": [None, None, [0.1, 0.0]]}, r"odometry\[2\]: expected an array of shape \(3,\), got shape \(2,\)"),
    ({"odometry": [None, None, [0.1, np.nan, 0.0]]}, r"odometry\[2\]: expected finite numbers, got NaN or infinity at"),
    ({"odometry": np.diag([0.0, 0.0, np.nan])}, r"odometry\[2\]: expected finite numbers, got"),
    ({"odometry": np.diag([0.0, 0.0, 2e4])}, r"odometry\[2\]: expected numbers within \+-10000, got"),
    ({"odometry": np.zeros((3, 2))}, r"odometry\[0\]: expected an array of shape \(3,\), got shape \(2,\)"),
    (
        {"odometry": np.diag([0.0, 0.0, np.nan]), "measurements": TOGETHER},
        r"odometry\[2\]: expected finite numbers, got",
    ),
    ({"odometry": np.diag([0.0, 0.0, -2e4]), "measurements": TOGETHER}, r"odometry\[2\]: expected numbers within \+-1"),
    ({"odometry": np.zeros((3, 3)), "measurements": NO_NUMBER}, r"measurements\[2\]\.points: expected numbers within"),
    (
        {"odometry": np.zeros((3, 3)), "measurements": in_one_piece([GOOD.points] * 2 + [-GOOD.points], [1, 2, 3])},
        r"measurements\[2\]\.points: expected depths Z >= .* m, got -2\.0\. Drop points at",
    ),
    (
        {"odometry": [None, None, "ahead"]},
        r"odometry\[2\]: expected an array of shape \(3,\) of real numbers, got",
    ),
    ({"measurements": [GOOD, GOOD]}, r"measurements: expected a sequence with one entry per robot \(3\), got .*2"),
    ({"measurements": GOOD}, r"measurements: expected a sequence with one entry per robot \(3\)"),
    ({"measurements": [GOOD, GOOD, "a wall"]}, r"measurements\[2\]: expected Measurements or None, got .*a wall"),
    (
        {"measurements": [GOOD, GOOD, Measurements(GOOD.points, np.eye(1, 12))]},
        r"measurements\[2\]\.descriptors: expected vectors of size 13 as in the map, got shape \(1, 12\)",
    ),
    (
        {"measurements": [GOOD, GOOD, Measurements(-GOOD.points, GOOD.descriptors)]},
        r"measurements\[2\]\.points: expected depths Z >= .* m, got -2\.0\. Drop points at or behind the camera",
    ),
    ({"measurements": ONE_BEHIND}, r"measurements\[2\]\.points: expected depths Z >= .* m, got -2\.0\. Drop points at"),
    ({"measurements": NO_NUMBER}, r"measurements\[2\]\.points: expected numbers within .*, got nan"),
    ({"measurements": NO_NUMBER.of_each()}, r"measurements\[2\]\.points: expected numbers within .*, got nan"),
    *(
        (
            {"measurements": in_one_piece([GOOD.points] * 3, ends, count), "odometry": moves},
            r"measurements: expected a descriptor per po",
        )
        for moves in (STILL, np.zeros((3, 3)))
        for ends, count in (([1, 2, 9], 3), ([1, 2, 2], 3), ([2, 1, 3], 3), ([-1, 2, 3], 3), ([1, 2, 3], 2), ([], 3))
    ),
    *(
        (
            {"measurements": TOGETHER._replace(**changed), "odometry": np.zeros((3, 3))},
            r"measurements: expected points \(n, 3\) float64, descriptors \(n, d\) float32 and ends \(K,\) int64, got",
        )
        for changed in (
            {"points": TOGETHER.points[:, :2]},
            {"points": TOGETHER.points.astype(np.float32)},
            {"ends": [1, 2, 3]},
            {"descriptors": TOGETHER.descriptors.astype(np.float64)},
            {"ends": np.array([1.0, 2.0, 3.0])},
        )
    ),
    *(
        (
            {"measurements": TOGETHER._replace(descriptors=TOGETHER.descriptors * factor), "odometry": moves},
            r"measurements\.descriptors: expected numbers within \+-1e\+06, got",
        )
        for factor in (np.float32(np.nan), np.float32(1e20))
        for moves in (STILL, np.zeros((3, 3)))
    ),
    ({"identities": [[1], [1]]}, r"identities: expected a sequence with one entry per robot \(3\)"),
    ({"identities": [[1], [1], [1, 2]]}, r"identities\[2\]: expected an array of shape"),
    ({"poses": [None, None, [0.0, np.inf, 0.0]]}, r"poses\[2\]: expected finite numbers, got NaN or infinity at"),
    ({"contacts": np.ones((2, 2), bool)}, r"contacts: expected an array of shape \(3, 3\), got shape \(2, 2\)"),
    ({"contacts": [[True], [True, False]]}, r"contacts: expected an array of shape \(3, 3\), got \[\[True\]"),
    ({"contacts": np.eye(3)}, r"contacts: expected a symmetric array of bools, got an array of float64\. Say for each"),
    ({"contacts": ASYMMETRIC}, r"contacts: expected a symmetric array of bools, got a matrix that is not symmetric"),
]


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize(("arguments", "message"), BAD_STEPS)
def test_a_refused_step_leaves_every_robot_as_it_was(arguments: dict[str, Any], message: str, together: bool) -> None:
    """One bad entry, be it the last robot's, and no filter has moved; the next good step gives what it would have."""
    team, twin = standing_team(), standing_team()
    if together:
        for each in (team, twin):
            each.merge(0, 2, hand_made(each, 0, 2))
    with pytest.raises(ValueError, match=message):
        team.step(**({"odometry": STILL, "measurements": FRAMES} | arguments))
    assert_same(team.get_state(), twin.get_state())
    moves = np.array([[0.1, 0.0, 0.05]] * 3)
    assert_same(team.step(list(moves.copy()), FRAMES), twin.step(moves, FRAMES))
    moves[:] = 7.0  # of no matter any more
    assert_same(team.get_state(), twin.get_state())


def with_inliers(rows: list[tuple[int, int]]) -> Alignment:
    """A successful alignment with these inliers."""
    return Alignment(True, "", 1.0, 0.0, 0.0, np.eye(3), np.array(rows), 0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 2, with_inliers([(0, 0)])), r"robot_b: expected a robot outside the group \(0, 2\), got 2\. They share"),
        ((1, 1, with_inliers([(0, 0)])), r"robot_b: expected a robot outside the group \(1,\), got 1"),
        ((0, 3, with_inliers([(0, 0)])), r"robot: expected an index from 0 to 2, got 3\. Count robots from 0\."),
        ((-1, 0, with_inliers([(0, 0)])), r"robot: expected an index from 0 to 2, got -1"),
        ((0, 1, Alignment.refused("ambiguous")), r"alignment: expected a successful Alignment, got a refusal \(amb"),
        ((0, 1, None), r"alignment: expected a successful Alignment, got None\. Align the two maps first\."),
        ((0, 1, with_inliers([(0, 6)])), r"alignment\.inliers: expected one-to-one pairs of rows below 7 and 6, got"),
        ((1, 0, with_inliers([(-1, 0)])), r"alignment\.inliers: expected one-to-one pairs of rows below 7 and 6, got"),
        ((0, 1, with_inliers([(0, 1), (2, 1)])), r"alignment\.inliers: expected one-to-one pairs .*a row that repeats"),
    ],
)
def test_a_refused_merge_leaves_the_team_as_it_was(arguments: Any, message: str) -> None:
    """Merges of robots that are together or do not exist, and of refused or foreign alignments, change nothing."""
    team = standing_team()
    team.merge(0, 2, hand_made(team, 0, 2))
    before = copy.deepcopy(team.get_state())
    with pytest.raises(ValueError, match=message):
        team.merge(*arguments)
    assert_same(team.get_state(), before)


@pytest.mark.parametrize("robot", [3, -1, 1.0, True, np.True_, None, "0", np.array([0, 1])])
@pytest.mark.parametrize("method", ["pose", "particles", "map", "start_from_group"])
def test_a_robot_that_does_not_exist_is_named(method: str, robot: Any) -> None:
    """Each method that takes a robot refuses what is not an index of one."""
    with pytest.raises(ValueError, match=r"robot: expected an index from 0 to 2, got .*Count robots from 0\."):
        getattr(TeamSlam(3, num_particles=7), method)(robot)


def test_robots_may_be_numbered_by_numpy() -> None:
    """An index that numpy made is an index."""
    assert TeamSlam(3, num_particles=7).pose(np.int64(2)).mean.shape == (3,)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, r"state: expected a dict from get_state, got no 'step'\. Pass it unchanged\."),
        (None, "state: expected a dict from get_state, got a NoneType"),
        (SimulatedTeam(num_robots=2).build().get_state(), r"state: expected one of 3 robots, got 2\. Build a team of"),
    ],
)
def test_a_foreign_snapshot_is_refused(state: Any, message: str) -> None:
    """A state of something else, or of a team of another size, is refused, and the team is as before."""
    team = TeamSlam(3, num_particles=7)
    before = copy.deepcopy(team.get_state())
    with pytest.raises(ValueError, match=message):
        team.set_state(state)
    assert_same(team.get_state(), before)
