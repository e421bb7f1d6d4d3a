"""Simulated stereo runs: physically possible, repeatable, and with the stated noise."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from slam_backend.geometry import between, compose, inverse, transform_points
from training.stereo_runs.office import AISLE, MAX_INCIDENCE, Office, start_crossings
from training.stereo_runs.runs import FALSE_POINT, PRESETS, STEP, RunSpec, StereoRun, simulate_run

FALSE_ALARM = 1e-3


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 30 m, with unknown association."""
    return simulate_run(RunSpec(robots=2, length=30.0, measurements=11, association="unknown"), seed=3)


def test_a_path_keeps_its_length_and_never_jumps(run: StereoRun) -> None:
    """Poses are `STEP` apart along lines and arcs of 1 m radius: chords and turns are bounded, the number exact."""
    assert run.true_paths.shape == (2, 121, 3)
    moves = between(run.true_paths[:, :-1], run.true_paths[:, 1:])
    chords = np.hypot(moves[..., 0], moves[..., 1])
    assert chords.max() <= STEP + 1e-12
    assert chords.min() >= 2.0 * np.sin(0.5 * STEP) - 1e-12
    assert np.abs(moves[..., 2]).max() <= STEP + 1e-12
    assert moves[..., 0].min() > 0.0


def test_robots_keep_clear_of_walls_and_blocks(run: StereoRun) -> None:
    """Every pose is inside the building, at least a metre from each wall and block."""
    for x, y, _ in run.true_paths.reshape(-1, 3):
        assert 1.0 < x < run.office.size[0] - 1.0
        assert 1.0 < y < run.office.size[1] - 1.0
        for x1, y1, x2, y2 in run.office.blocks:
            assert max(x1 - x, x - x2, y1 - y, y - y2) > 1.0


def test_paths_close_loops() -> None:
    """On 100 m a robot returns to places that it left long ago, with the same heading."""
    path = simulate_run(RunSpec(length=100.0), seed=1).true_paths[0]
    gaps = np.hypot(*(path[:, None, :2] - path[None, :, :2]).transpose(2, 0, 1))
    turned = np.cos(path[:, None, 2] - path[None, :, 2])
    later = np.subtract.outer(np.arange(len(path)), np.arange(len(path))) > 20.0 / STEP
    assert np.count_nonzero((gaps < 0.3) & (turned > 0.9) & later) > 50


def test_visible_landmarks_satisfy_all_conditions(run: StereoRun) -> None:
    """No line of sight crosses a block (sampled densely), each meets its wall from the front, in image and range."""
    camera = run.spec.noise.camera
    shares = np.linspace(0.0, 1.0, 400)[:, None]
    for robot in range(2):
        for step in range(0, run.num_steps, 7):
            pose = run.true_paths[robot, step]
            names = run.names[step][robot]
            names = names[names != FALSE_POINT]
            assert run.office.visible(pose, camera)[names].all()
            local = transform_points(inverse(pose), run.landmarks[names])
            assert camera.sees(camera.camera_from_robot(local)).all()
            for name in names:
                sight = pose[:2] - run.landmarks[name, :2]
                cosine = sight @ run.office.normals[name] / np.linalg.norm(sight)
                assert cosine >= np.cos(MAX_INCIDENCE) - 1e-12
                line = run.landmarks[name, :2] + shares * sight
                for block in run.office.blocks:
                    assert not ((line > block[:2]) & (line < block[2:])).all(axis=1).any()


def test_a_block_hides_what_is_behind_it() -> None:
    """From an aisle along x, a landmark behind a block is invisible though in the image and in range."""
    office = Office.draw(2000, np.random.default_rng(0))
    camera = PRESETS["good"].camera
    x1, y1, x2, y2 = office.blocks[0]
    pose = np.array([0.5 * (x1 + x2), y1 - 0.5 * AISLE, 0.5 * np.pi])  # facing the block's lower side
    local = camera.camera_from_robot(transform_points(inverse(pose), office.landmarks))
    beyond = camera.sees(local) & (office.landmarks[:, 1] > y2) & (np.abs(office.landmarks[:, 0] - pose[0]) < 1.0)
    assert beyond.any()
    assert not office.visible(pose, camera)[beyond].any()
    assert office.visible(pose, camera).any()


def test_measurements_are_divided_among_robots(run: StereoRun) -> None:
    """Of B = 11 the first robot has up to 6, the second up to 5; in open view they use all of them."""
    sizes = np.array([[len(frame) for frame in frames] for frames in run.frames])
    assert sizes.max(axis=0).tolist() == [6, 5]
    assert (sizes[:, 0] == 6).mean() > 0.6
    for frames, names in zip(run.frames, run.names, strict=True):
        for frame, name in zip(frames, names, strict=True):
            assert len(frame) == len(name)
            assert len(np.unique(name[name != FALSE_POINT])) == np.count_nonzero(name != FALSE_POINT)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_noise_is_as_stated(preset: str) -> None:
    """Pixels, disparities and odometry have the preset's variances (chi-square, false alarm 1e-3 each)."""
    run = simulate_run(RunSpec(robots=2, length=25.0, preset=preset), seed=5)
    noise = PRESETS[preset]
    pixels: list[Any] = []
    for step, (frames, names) in enumerate(zip(run.frames, run.names, strict=True)):
        for robot, (frame, name) in enumerate(zip(frames, names, strict=True)):
            local = transform_points(inverse(run.true_paths[robot, step]), run.landmarks[name])
            truth = noise.camera.project(noise.camera.camera_from_robot(local))
            pixels.extend(noise.camera.project(frame.points) - truth)
    sigmas = [noise.sigma_px, noise.sigma_px, noise.sigma_disparity_px]
    moves = between(run.true_paths[:, :-1], run.true_paths[:, 1:]).transpose(1, 0, 2)
    wheel_sigmas = np.array([[noise.motion.sigmas(move) for move in step] for step in moves])
    for squares in (
        *((np.array(pixels) / sigmas) ** 2).T,
        *(((run.odometry[1:] - moves) / wheel_sigmas) ** 2).reshape(-1, 3).T,
    ):
        low, high = stats.chi2.interval(1.0 - FALSE_ALARM, squares.size)
        assert low < squares.sum() < high
    assert not run.odometry[0].any()


def test_unknown_association_has_the_stated_errors() -> None:
    """2 % false points and 3 % wrong descriptors (binomial, false alarm 1e-3 each); classes of three landmarks."""
    run = simulate_run(RunSpec(association="unknown", length=100.0), seed=7)
    names = np.concatenate([name for step in run.names for name in step])
    looks = np.concatenate([frame.descriptors for step in run.frames for frame in step])
    false = names == FALSE_POINT
    assert stats.binomtest(int(false.sum()), len(names), 0.02).pvalue > FALSE_ALARM
    wrong = np.linalg.norm(looks[~false] - run.descriptors[names[~false]], axis=1) > 0.6
    assert stats.binomtest(int(wrong.sum()), int((~false).sum()), 0.03 * 0.99).pvalue > FALSE_ALARM
    _, sizes = np.unique(run.descriptors, axis=0, return_counts=True)
    assert (sizes == 3).all()


def test_the_first_frame_is_at_the_start(run: StereoRun) -> None:
    """Readings start with measurements without odometry; identities are given only if the association is known."""
    first, second, *_ = run.readings()
    assert first["odometry"] == [None, None]
    assert len(first["measurements"][0]) > 0
    assert second["odometry"][0] is not None
    assert second["identities"] is None
    known = simulate_run(RunSpec(length=2.0), seed=3)
    assert next(known.readings())["identities"][0] is known.names[0][0]


def test_runs_repeat_and_do_not_depend_on_added_robots() -> None:
    """The same seed gives the same bytes, another seed another run; robot 0 is equal for K = 1 and 3."""
    first, again = (simulate_run(RunSpec(length=5.0), seed=2) for _ in range(2))
    np.testing.assert_array_equal(first.odometry, again.odometry)
    for a, b in zip(first.frames, again.frames, strict=True):
        np.testing.assert_array_equal(a[0].points, b[0].points)
        np.testing.assert_array_equal(a[0].descriptors, b[0].descriptors)
    assert not np.array_equal(first.landmarks, simulate_run(RunSpec(length=5.0), seed=4).landmarks)
    three = simulate_run(RunSpec(robots=3, length=5.0), seed=2)
    np.testing.assert_array_equal(three.landmarks, first.landmarks)
    np.testing.assert_array_equal(three.true_paths[0], first.true_paths[0])
    np.testing.assert_array_equal(three.odometry[:, 0], first.odometry[:, 0])
    assert len(np.unique(three.true_paths[:, 0, :2], axis=0)) == 3


def test_filters_of_a_run_start_at_the_true_poses(run: StereoRun) -> None:
    """The filter's map frame is the world frame, and it accepts all readings."""
    slam = run.build_filter(7, seed=1)
    for reading in run.readings():
        slam.step(**reading)
    for robot in range(2):
        np.testing.assert_allclose(slam.start_pose(robot), run.true_paths[robot, 0])
        assert np.hypot(*compose(inverse(run.true_paths[robot, -1]), slam.pose(robot).mean)[:2]) < 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": 0}, "robots: expected an int >= 1, got 0"),
        ({"robots": 3, "measurements": 2}, "measurements: expected an int >= 3, got 2"),
        ({"length": 0.0}, "length: expected a finite number >= 0.25, got 0.0"),
        ({"preset": "best"}, "preset: expected one of 'good', 'coarse', 'paper', got 'best'"),
        ({"association": "half"}, "association: expected one of 'known', 'unknown', got 'half'"),
        ({"outliers": 1.5}, "outliers: expected a finite number >= 0 and <= 1, got 1.5"),
        ({"descriptor_size": 1}, "descriptor_size: expected an int >= 2, got 1"),
    ],
)
def test_impossible_runs_are_refused(arguments: dict[str, Any], message: str) -> None:
    """The error has the argument, the expected and the actual value."""
    with pytest.raises(ValueError, match=message):
        RunSpec(**arguments)


def test_starts_are_at_different_crossings() -> None:
    """More robots than crossings cannot have different starts."""
    with pytest.raises(ValueError, match="robots: expected at most 9, got 10"):
        start_crossings(10, np.random.default_rng(0))
