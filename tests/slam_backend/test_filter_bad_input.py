"""Input that makes no sense is refused with one clear error, and leaves no trace in the filter."""

from typing import Any

import numpy as np
import pytest
from same_bits import assert_same

from slam_backend.camera import StereoCamera
from slam_backend.filter import FastSlam
from slam_backend.measurements import Measurements

FRAME = Measurements([[0.0, 0.0, 2.0], [0.5, 0.1, 3.0]], np.eye(2, 5))
MOVE = [0.1, 0.0, 0.02]
GOOD: dict[str, Any] = {"odometry": [MOVE, MOVE], "measurements": [FRAME, None]}

ARGUMENTS = [
    ({"num_robots": 0}, r"num_robots: expected an int >= 1, got 0\. Use at least one robot\."),
    ({"num_robots": 1.0}, r"num_robots: expected an int >= 1, got 1\.0"),
    ({"num_particles": 0}, r"num_particles: expected an int >= 1, got 0\. Use at least one particle"),
    ({"num_particles": True}, r"num_particles: expected an int >= 1, got True"),
    ({"camera": 320.0}, r"camera: expected a StereoCamera, got 320\.0"),
    ({"motion": StereoCamera()}, r"motion: expected a OdometryModel, got StereoCamera"),
    ({"proposal": "fastslam3"}, r"proposal: expected one of 'fastslam2', 'fastslam1', got '?fastslam3"),
    ({"resampling": "wheel"}, r"resampling: expected one of 'systematic', .*'residual', got '?wheel"),
    ({"resample_threshold": 1.1}, r"resample_threshold: expected a finite number >= 0 and <= 1, got 1\.1"),
    ({"position_gate": 0.0}, r"position_gate: expected a finite number > 0, got 0\.0"),
    ({"position_gate": np.nan}, r"position_gate: expected a finite number > 0, got nan"),
    ({"descriptor_gate": -1.0}, r"descriptor_gate: expected a finite number > 0, got -1\.0"),
    ({"dead_zone": 5.0}, r"dead_zone: expected a finite number >= 11\.34, got 5\.0"),
    ({"descriptor_sigma": 0.0}, r"descriptor_sigma: expected a finite number > 0, got 0\.0"),
    ({"ambiguity": -1.0}, r"ambiguity: expected a finite number >= 0, got -1\.0"),
    ({"new_landmark_density": 0.0}, r"new_landmark_density: expected a finite number > 0, got 0\.0"),
    ({"seed": "a"}, r"seed: expected an int >= 0, a SeedSequence or a Generator, got 'a'"),
    ({"seed": -1}, r"seed: expected an int >= 0, a SeedSequence or a Generator, got -1"),
    ({"dead_radius": -1.0}, r"dead_radius: expected a finite number >= 0, got -1\.0"),
    ({"recovery_position": np.inf}, r"recovery_position: expected a finite number >= 0, got inf"),
    ({"one_to_one": 1}, r"one_to_one: expected a bool, got 1"),
    ({"initial_poses": [0.0, 0.0, 0.0]}, r"initial_poses: expected an array of shape \(1, 3\), got shape \(3,\)"),
    ({"initial_poses": [[0.0, 0.0, np.inf]]}, r"initial_poses: expected finite numbers, got NaN or infinity at"),
]

STEPS = [
    ({"odometry": [MOVE]}, r"odometry: expected a sequence with one entry per robot \(2\), got a sequence of 1"),
    ({"odometry": None}, r"odometry: expected a sequence with one entry per robot \(2\), got None"),
    ({"odometry": [MOVE, [0.1, 0.0]]}, r"odometry\[1\]: expected an array of shape \(3,\), got shape \(2,\)"),
    ({"odometry": [[0.1, np.nan, 0.0], None]}, r"odometry\[0\]: expected finite numbers, got NaN or infinity at index"),
    ({"odometry": ["ahead", None]}, r"odometry\[0\]: expected an array of shape \(3,\), got '?ahead"),
    ({"measurements": FRAME}, r"measurements: expected a sequence with one entry per robot \(2\), got a bare frame"),
    ({"odometry": [[1e300, 0.0, 0.0], None]}, r"odometry\[0\]: expected numbers within \+-10000, got \[1e"),
    ({"measurements": [FRAME] * 3}, r"measurements: expected a sequence with one entry .* got a sequence of 3"),
    ({"measurements": [FRAME.points, None]}, r"measurements\[0\]: expected Measurements or None, got array"),
    (
        {"measurements": [FRAME, Measurements([[0.0, 0.0, 1.0]], [[1.0, 0.0]])]},
        r"measurements\[1\]\.descriptors: expected vectors of size 5 as in the map, got shape \(1, 2\)",
    ),
    (
        {"measurements": [Measurements([[0.0, 0.0, -1.0]], np.eye(1, 5)), None]},
        r"measurements\[0\]\.points: expected depths Z >= 0\.05 m, got -1\.0",
    ),
    ({"identities": [[1, 2]]}, r"identities: expected a sequence with one entry per robot \(2\), got a sequence of 1"),
    ({"identities": [[1], None]}, r"identities\[0\]: expected an array of shape \(2,\), got shape \(1,\)"),
    ({"identities": [[1, 2.5], None]}, r"identities\[0\]: expected whole numbers, got \[1, 2\.5\]"),
    ({"identities": [None, [1]]}, r"identities\[1\]: expected an array of shape \(0,\), got shape \(1,\)"),
    ({"poses": [[0.0, 0.0], None]}, r"poses\[0\]: expected an array of shape \(3,\), got shape \(2,\)"),
    ({"poses": [None, [0.0, np.inf, 0.0]]}, r"poses\[1\]: expected finite numbers, got NaN or infinity at index"),
]


@pytest.mark.parametrize(("change", "message"), ARGUMENTS)
def test_arguments_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the argument, what it should be, what it was, and the cure."""
    with pytest.raises(ValueError, match="^" + message) as caught:
        FastSlam(**change)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
@pytest.mark.parametrize(("change", "message"), STEPS)
def test_a_refused_step_leaves_no_trace(change: dict[str, Any], message: str, proposal: Any) -> None:
    """After the error the filter is as before, bit for bit, and so is the next good step."""
    slam, untouched = (FastSlam(2, 5, proposal=proposal, seed=1) for _ in range(2))
    for one in (slam, untouched):
        one.step(**GOOD)
    with pytest.raises(ValueError, match="^" + message) as caught:
        slam.step(**(GOOD | change))
    assert str(caught.value).endswith(".")
    assert_same(slam.get_state(), untouched.get_state())
    assert_same(slam.step(**GOOD), untouched.step(**GOOD))
    assert_same(slam.get_state(), untouched.get_state())


def test_the_first_frame_of_two_robots_has_to_agree_on_descriptors() -> None:
    """The size of the descriptors is checked within a step, too."""
    with pytest.raises(ValueError, match=r"^measurements\[1\]\.descriptors: expected vectors of size 5"):
        FastSlam(2, 3).step([None, None], [FRAME, Measurements([[0.0, 0.0, 1.0]], [[1.0, 0.0]])])


@pytest.mark.parametrize("robot", [2, -1, True, 0.0, "robot_0"])
def test_robots_that_are_not_there_are_refused(robot: Any) -> None:
    """Robots are counted from 0 to K - 1."""
    slam = FastSlam(2, 3)
    for ask in (slam.pose, slam.particles, slam.start_pose):
        with pytest.raises(ValueError, match=r"^robot: expected an index from 0 to 1, got"):
            ask(robot)


def test_unknown_estimates_and_states_are_refused() -> None:
    """`map` knows two estimates; `set_state` takes what `get_state` gave."""
    slam = FastSlam(1, 3)
    with pytest.raises(ValueError, match=r"^estimate: expected one of 'best', 'mixture', got '?mean"):
        slam.map("mean")  # type: ignore[arg-type]
    state = slam.get_state()
    del state["_ids"]
    with pytest.raises(ValueError, match=r"^state: expected a dict from FastSlam.get_state, got no '_ids'\. Pass it"):
        slam.set_state(state)


def test_nothing_to_do_is_no_error() -> None:
    """Robots that neither moved nor saw anything, frames without points, and frames rejected whole, are accepted."""
    slam = FastSlam(2, 3)
    for frames, names in (
        ([None, None], None),
        ([Measurements.empty(5), Measurements.empty(7)], None),
        ([FRAME, None], [[-1, -1], None]),
        ([FRAME, None], [[-1, 4], None]),
    ):
        report = slam.step([None, None], frames, names)
        assert report.ess == pytest.approx(3.0)
    np.testing.assert_array_equal(report.associations[0], [-1, 0])
    assert (slam.num_landmarks, report.num_new) == (1, 1)
