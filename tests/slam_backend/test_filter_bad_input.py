"""Input that makes no sense is refused with one clear error, and leaves no trace in the filter."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from same_bits import assert_same

from slam_backend.fastslam.filter import FastSlam
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements

FRAME = Measurements([[0.0, 0.0, 2.0], [0.5, 0.1, 3.0]], np.eye(2, 5))
MOVE = [0.1, 0.0, 0.02]
GOOD: dict[str, Any] = {"odometry": [MOVE, MOVE], "measurements": [FRAME, None]}

ARGUMENTS = [
    ({"num_robots": 0}, r"num_robots: expected an int >= 1, got 0\. Use at least one robot\."),
    ({"num_robots": 1.0}, r"num_robots: expected an int >= 1, got 1\.0"),
    ({"num_particles": 0}, r"num_particles: expected an int >= 1, got 0\. Use at least one particle"),
    ({"num_robots": 10**400}, r"num_robots: expected an int <= 1000, got 1000"),
    ({"num_particles": 2**62}, r"num_particles: expected an int <= 1000000, got 46116"),
    ({"num_particles": True}, r"num_particles: expected an int >= 1, got True"),
    ({"camera": 320.0}, r"camera: expected a StereoCamera, got 320\.0"),
    ({"motion": StereoCamera()}, r"motion: expected a OdometryModel, got StereoCamera"),
    ({"proposal": "fastslam3"}, r"proposal: expected one of 'fastslam2', 'fastslam1', got '?fastslam3"),
    ({"resampling": "wheel"}, r"resampling: expected one of 'systematic', .*'residual', got '?wheel"),
    ({"resample_threshold": 1.1}, r"resample_threshold: expected a finite number >= 0 and <= 1, got 1\.1"),
    ({"position_gate": 0.0}, r"position_gate: expected a finite number > 0, got 0\.0"),
    ({"position_gate": np.nan}, r"position_gate: expected a finite number > 0, got nan"),
    ({"descriptor_gate": -1.0}, r"descriptor_gate: expected a finite number >= .* and <= .*, got -1\.0"),
    ({"dead_zone": 5.0}, r"dead_zone: expected a finite number >= 11\.34, got 5\.0"),
    ({"descriptor_sigma": 0.0}, r"descriptor_sigma: expected a finite number >= .* and <= .*, got 0\.0"),
    ({"ambiguity": -1.0}, r"ambiguity: expected a finite number >= 0, got -1\.0"),
    ({"new_landmark_density": 0.0}, r"new_landmark_density: expected a finite number > 0, got 0\.0"),
    ({"seed": "a"}, r"seed: expected an int >= 0, a SeedSequence or a Generator, got 'a'"),
    ({"seed": -1}, r"seed: expected an int >= 0, a SeedSequence or a Generator, got -1"),
    ({"dead_radius": -1.0}, r"dead_radius: expected a finite number >= 0, got -1\.0"),
    ({"landmark_noise": -0.1}, r"landmark_noise: expected a finite number >= .* and <= .*, got -0\.1"),
    ({"recovery_position": np.inf}, r"recovery_position: expected a finite number >= .* and <= .*, got inf"),
    ({"one_to_one": 1}, r"one_to_one: expected a bool, got 1"),
    ({"initial_poses": [0.0, 0.0, 0.0]}, r"initial_poses: expected an array of shape \(1, 3\), got shape \(3,\)"),
    ({"initial_poses": [[1e308, 0.0, 0.0]]}, r"initial_poses: expected numbers within \+-1e\+06, got 1e\+308"),
    ({"initial_poses": [[0.0, 0.0, np.inf]]}, r"initial_poses: expected finite numbers, got NaN or infinity at"),
]

STEPS = [
    ({"odometry": [MOVE]}, r"odometry: expected a sequence with one entry per robot \(2\), got a sequence of 1"),
    ({"odometry": None}, r"odometry: expected a sequence with one entry per robot \(2\), got None"),
    ({"odometry": [MOVE, [0.1, 0.0]]}, r"odometry\[1\]: expected an array of shape \(3,\), got shape \(2,\)"),
    ({"odometry": [[0.1, np.nan, 0.0], None]}, r"odometry\[0\]: expected finite numbers, got NaN or infinity at index"),
    ({"odometry": ["ahead", None]}, r"odometry\[0\]: expected an array of shape \(3,\) of real numbers, got 'ahead"),
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
    ({"identities": [[1j, 2], None]}, r"identities\[0\]: expected an array of shape \(2,\) of real numbers, got an"),
    ({"identities": [[1e300, 2], None]}, r"identities\[0\]: expected whole numbers that int64 can hold, got \[1e\+300"),
    ({"odometry": [[10**400, 0, 0], None]}, r"odometry\[0\]: expected an array of shape \(3,\), got \[1000"),
    (
        {"odometry": [["0.1", 0, 0], None]},
        r"odometry\[0\]: expected an array of shape \(3,\) of real numbers, got \['0",
    ),
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
    for name in state:
        part = {key: value for key, value in state.items() if key != name}
        with pytest.raises(ValueError, match=rf"^state: expected a dict from get_state, got no '{name}'\."):
            slam.set_state(part)
    for other in (None, 3, [1]):
        with pytest.raises(ValueError, match="state: expected a dict from get_state, got a "):
            slam.set_state(other)
    for name in state["maps"]:
        maps = {key: value for key, value in state["maps"].items() if key != name}
        with pytest.raises(ValueError, match=rf"^state\['maps'\]: expected a dict from .*, got no '{name}'\."):
            slam.set_state(state | {"maps": maps})
    assert_same(slam.get_state(), state)
    smoothed = FastSlam(1, 3, rejuvenate_every=10)
    whole = smoothed.get_state()
    schedule = whole["rejuvenation"]["schedule"]
    for name in schedule:
        others = {key: value for key, value in schedule.items() if key != name}
        former = whole | {"rejuvenation": whole["rejuvenation"] | {"schedule": others}}
        with pytest.raises(ValueError, match=rf"^state\['rejuvenation'\]\['schedule'\]: .*, got no '{name}'\."):
            smoothed.set_state(former)
    assert_same(smoothed.get_state(), whole)


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


def bad_frame(points: Any = FRAME.points, looks: Any = FRAME.descriptors, noise: Any = None) -> dict[str, Any]:
    """Return a step in which the second robot reports this frame; the first one's is good."""
    return {"odometry": [MOVE, MOVE], "measurements": [FRAME, Measurements(points, looks, noise)]}


def with_entry(array: Any, value: float) -> Any:
    """Return a copy with its last number replaced."""
    changed = np.array(array, dtype=np.float64)
    changed.flat[-1] = value
    return changed


def turned(variances: list[float]) -> Any:
    """Return two equal covariances with these eigenvalues, along no axis."""
    axes = np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0]
    covariance = axes @ np.diag(variances) @ axes.T
    return np.array([0.5 * (covariance + covariance.T)] * 2)


REFUSED: dict[str, tuple[Callable[[], dict[str, Any]], str]] = {
    "covariance indefinite": (lambda: bad_frame(noise=turned([1.0, 1.0, -1e-3])), r"covariances: .*positive definite"),
    "covariance singular": (lambda: bad_frame(noise=turned([1.0, 1.0, 0.0])), r"covariances: expected"),
    "covariance zero": (lambda: bad_frame(noise=np.zeros((2, 3, 3))), r"covariances: .*positive definite"),
    "covariance too flat": (lambda: bad_frame(noise=turned([1.0, 1.0, 1e-10])), r"covariances: .*ratios of eigenv"),
    "covariance too small": (lambda: bad_frame(noise=turned([1e-200] * 3)), r"covariances: .*eigenvalues from 1e-14"),
    "covariance too large": (lambda: bad_frame(noise=turned([1e200] * 3)), r"covariances: .*eigenvalues from 1e-14"),
    "covariance lopsided": (lambda: bad_frame(noise=[with_entry(np.eye(3), 1.0) + np.tri(3)] * 2), r".*symmetric"),
    "covariance of one point": (lambda: bad_frame(noise=np.eye(3)[None]), r"covariances: expected an array of shape"),
    "covariance NaN": (lambda: bad_frame(noise=with_entry([np.eye(3)] * 2, np.nan)), r"covariances: .*finite numbers"),
    "point NaN": (lambda: bad_frame(with_entry(FRAME.points, np.nan)), r"points: expected finite numbers"),
    "point infinite": (lambda: bad_frame(with_entry(FRAME.points, np.inf)), r"points: expected finite numbers"),
    "descriptor NaN": (lambda: bad_frame(looks=with_entry(np.eye(2, 5), np.nan)), r"descriptors: .*finite numbers"),
    "descriptor infinite": (lambda: bad_frame(looks=with_entry(np.eye(2, 5), -np.inf)), r"descriptors: .*finite"),
    "descriptor huge": (lambda: bad_frame(looks=1e20 * np.eye(2, 5)), r"descriptors: .*numbers within \+-1e\+06"),
    "descriptors longer": (
        lambda: bad_frame(looks=np.eye(2, 6)),
        r"measurements\[1\]\.descriptors: expected vectors of size 5 as in the map, got shape \(2, 6\)",
    ),
    "descriptors without length": (
        lambda: bad_frame(looks=np.zeros((2, 0))),
        r"measurements\[1\]\.descriptors: expected vectors of size 5 as in the map, got shape \(2, 0\)",
    ),
    "point at the camera centre": (
        lambda: bad_frame([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]),
        r"measurements\[1\]\.points: expected depths Z >= 0\.05 m, got 0\.0\. Drop points at or behind the camera",
    ),
    "point at the horizon": (
        lambda: bad_frame([[0.0, 0.0, 2.0], [0.0, 0.0, 2500.0]]),  # its covariance would be 1e4 times as deep as broad
        r"measurements\[1\]\.points: expected numbers within \+-2400, got 2500\.0\. Check the units",
    ),
    "point at the horizon with covariances": (
        lambda: bad_frame([[0.0, 0.0, 2.0], [-1e150, 0.0, 1.0]], noise=turned([1.0] * 3)),
        r"measurements\[1\]\.points: expected numbers within \+-10000, got",
    ),
    "pose out of this world": (
        lambda: GOOD | {"poses": [None, [0.0, 1e9, 0.0]]},
        r"poses\[1\]: expected numbers within \+-1e\+06, got",
    ),
    "identity NaN": (lambda: GOOD | {"identities": [[1, np.nan], None]}, r"identities\[0\]: expected whole numbers"),
}


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
@pytest.mark.parametrize("case", list(REFUSED))
def test_a_refused_frame_leaves_no_trace_in_a_running_filter(case: str, proposal: Any) -> None:
    """Three refusals in a row leave a filter that has resampled as it was; later steps are the same, bit for bit."""
    make, message = REFUSED[case]
    slam, untouched = (FastSlam(2, 5, proposal=proposal, seed=1, resample_threshold=1.0) for _ in range(2))
    for one in (slam, untouched):
        for _ in range(3):
            one.step(**GOOD)
    for _ in range(3):
        with pytest.raises(ValueError, match="^" + message) as caught:
            slam.step(**make())
        assert str(caught.value).endswith(".")
    assert_same(slam.get_state(), untouched.get_state())
    for _ in range(2):
        assert_same(slam.step(**GOOD), untouched.step(**GOOD))
    assert_same(slam.get_state(), untouched.get_state())


def assert_sound(slam: FastSlam) -> None:
    """All that a filter tells is finite, weights sum to one, and covariances are positive definite."""
    assert slam.weights.sum() == pytest.approx(1.0, abs=1e-9)
    for robot in range(slam.num_robots):
        assert np.isfinite(slam.particles(robot)[0]).all()
        assert np.isfinite(slam.pose(robot).covariance).all()
    for estimate in ("best", "mixture"):
        result = slam.map(estimate)  # type: ignore[arg-type]
        assert np.isfinite(result.means).all()
        np.linalg.cholesky(result.covariances)  # raises where one is not positive definite


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
@pytest.mark.parametrize("given", [False, True])
def test_thousands_of_measurements_in_a_step(proposal: Any, given: bool) -> None:
    """A frame of 3,000 points makes 3,000 landmarks, and the same frame again finds each of them."""
    rng = np.random.default_rng(2)
    looks = rng.normal(size=(3000, 64))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    points = rng.uniform([-4.0, -3.0, 1.0], [4.0, 3.0, 8.0], (3000, 3))
    frame = Measurements(points, looks, np.array([1e-4 * np.eye(3)] * 3000) if given else None)
    slam = FastSlam(2, 3, proposal=proposal)
    first = slam.step([None, None], [frame, None], poses=[np.zeros(3), None])
    assert (first.num_new, slam.map_size) == (3000, 3000)
    again = slam.step([None, MOVE], [frame, frame], poses=[np.zeros(3), np.zeros(3)])
    for found in again.associations:
        np.testing.assert_array_equal(found, first.associations[0])
    assert (again.num_new, slam.map_size) == (0, 3000)
    assert_sound(slam)


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
@pytest.mark.parametrize("named", [False, True])
def test_a_landmark_at_the_camera_centre_is_one_like_others_with_given_covariances(proposal: Any, named: bool) -> None:
    """Seen from ahead, from its very place and from beyond, it is the mean of what was measured."""
    camera = StereoCamera(mount=(0.2, -0.1, 0.3))
    rng = np.random.default_rng(3)
    slam = FastSlam(1, 4, camera, proposal=proposal)
    seen = []
    for ahead in (2.0, 1.0, 0.0, 0.0, -0.5, -2.0):
        point = np.array([0.0, 0.0, ahead]) + (0.05 * rng.standard_normal(3) if ahead else 0.0)
        frame = Measurements([point], np.eye(1, 5), 0.0025 * np.eye(3)[None])
        slam.step([None], [frame], identities=[[9]] if named else None, poses=[[-ahead, 0.0, 0.0]])
        seen.append(camera.robot_from_camera(point) - [ahead, 0.0, 0.0])
    result = slam.map()
    assert len(result) == 1
    np.testing.assert_allclose(result.means[0], np.mean(seen, axis=0), atol=1e-12)
    np.testing.assert_allclose(result.covariances[0], 0.0025 / 6.0 * np.eye(3), atol=1e-15)
    assert_sound(slam)


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_driving_through_a_landmark(proposal: Any) -> None:
    """A robot with noisy odometry that passes through a landmark holds one landmark, near where it is."""
    rng = np.random.default_rng(4)
    slam = FastSlam(1, 50, proposal=proposal, seed=2)
    for step in range(21):
        point = np.array([0.0, 0.0, 1.0 - 0.1 * step]) + 0.02 * rng.standard_normal(3)
        frame = Measurements([point], np.eye(1, 5), 4e-4 * np.eye(3)[None])
        slam.step([[0.1, 0.0, 0.0] if step else None], [frame])
        assert_sound(slam)
    assert len(slam.map()) == 1
    np.testing.assert_allclose(slam.map("mixture").means[0], [1.0, 0.0, 0.0], atol=0.1)


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_a_landmark_at_the_camera_centre_cannot_be_seen_by_the_camera(proposal: Any) -> None:
    """What the camera model says of it is undefined: a stereo frame leaves it alone, even if the caller names it."""
    slam = FastSlam(1, 4, proposal=proposal)
    noise = 0.0025 * np.eye(3)[None]
    slam.step([None], [Measurements(np.zeros((1, 3)), np.eye(1, 5), noise)], identities=[[9]])
    before = slam.map()
    for names in ([[9]], None):
        slam.step([None], [Measurements([[0.0, 0.0, 2.0]], np.eye(1, 5))], identities=names)
        assert_sound(slam)
    after = slam.map()
    at = int(np.flatnonzero(after.ids == before.ids[0])[0])  # type: ignore[index]
    np.testing.assert_array_equal(after.means[at], before.means[0])
    np.testing.assert_array_equal(after.covariances[at], before.covariances[0])


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
@pytest.mark.parametrize(
    ("point", "noise", "move"),
    [
        ([0.0, 0.0, 0.05], None, MOVE),
        ([500.0, -300.0, 990.0], None, MOVE),
        ([9000.0, 9000.0, 9000.0], 1e12, MOVE),
        ([0.1, 0.2, 3.0], 1.1e-14, MOVE),
        ([0.1, 0.2, 3.0], None, [100.0, -100.0, 0.0]),
        ([0.1, 0.2, 3.0], None, [0.0, 0.0, 3000.0]),
        ([0.1, 0.2, 3.0], 0.01, [100.0, -100.0, 3000.0]),
    ],
)
def test_extreme_readings_do_no_harm(proposal: Any, point: Any, noise: float | None, move: Any) -> None:
    """Far points, tiny and huge covariances and long jumps, among ordinary readings, leave the filter sound."""
    covariances = None if noise is None else noise * np.eye(3)[None]
    extreme = Measurements([point], np.eye(1, 5), covariances)
    slam = FastSlam(2, 6, proposal=proposal, seed=3)
    for step in range(40):
        odd = step % 4 == 3
        slam.step([move if odd else MOVE, MOVE], [extreme if odd else FRAME, FRAME if odd else extreme])
        assert_sound(slam)
