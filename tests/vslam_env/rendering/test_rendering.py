from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vslam_env.rendering import MergeFlash, RobotView, Scene, draw_frame
from vslam_env.rendering.canvas import CHI_SQUARE_95, Viewport, dots, ellipse_outlines, translucent_fill
from vslam_env.rendering.merge_effect import FLASH_TICKS
from vslam_env.rendering.palette import robot_colour

WALLS = np.array([[0.0, 0.0, 13.0, 0.0], [13.0, 0.0, 13.0, 11.0], [4.0, 11.0, 4.0, 6.0]])


def make_robot(x: float, y: float, group: int = 0, landmarks: int = 17) -> RobotView:
    """Return a robot at (x, y) that believes to be 0.3 m further, with all sizes different."""
    rng = np.random.default_rng(int(10 * x + y))
    steps = np.linspace(0.0, 1.0, 23)[:, None]
    path = np.array([[2.0, 2.0]]) * (1.0 - steps) + np.array([[x, y]]) * steps
    pose = np.array([x, y, 0.7])
    return RobotView(
        true_pose=pose,
        true_path=path,
        estimated_pose=pose + np.array([0.3, 0.0, 0.1]),
        estimated_path=path + 0.1,
        particles=pose + rng.normal(0.0, 0.1, (31, 3)),
        landmark_means=rng.uniform(0.0, 11.0, (landmarks, 3)),
        landmark_covariances=np.tile(np.diag([0.04, 0.01, 0.02]), (landmarks, 1, 1)),
        sight_lines=rng.uniform(0.0, 11.0, (3, 2)),
        group=group,
    )


def make_scene(robots: tuple[RobotView, ...], walls: np.ndarray = WALLS, **others: object) -> Scene:
    """Return a scene of given robots."""
    landmarks = np.random.default_rng(5).uniform(0.0, 11.0, (41, 3))
    scene = Scene(walls, landmarks, robots, 300, 30.0, 0.2, (), tuple(0.1 * k for k in range(len(robots))), 0.6)
    return replace(scene, **others)


PAIR = (make_robot(3.0, 4.0, group=0), make_robot(9.0, 7.0, group=1))


@pytest.mark.parametrize("robots", range(9))
@pytest.mark.parametrize("walls", [WALLS, WALLS * [0.2, 3.0, 0.2, 3.0], WALLS * [9.0, 0.1, 9.0, 0.1], WALLS[:0]])
@pytest.mark.parametrize("size", [(960, 720), (161, 450), (400, 120)])
def test_any_team_in_any_world_gives_a_picture(robots: int, walls: np.ndarray, size: tuple[int, int]) -> None:
    """Tall, wide and empty worlds with 0 to 8 robots give an RGB picture of the size asked for, that is not blank."""
    team = tuple(make_robot(1.0 + k, 2.0 + 0.5 * k, group=k % 3, landmarks=7 * (k % 2)) for k in range(robots))
    frame = draw_frame(make_scene(team, walls, merges=(MergeFlash(4, (0,), (1,)),) if robots > 1 else ()), size)
    assert (frame.shape, frame.dtype) == ((size[1], size[0], 3), np.uint8)
    assert len(np.unique(frame[::3, ::5].astype(int) @ [1, 300, 90000])) > 3


def test_the_same_scene_gives_the_same_fresh_picture() -> None:
    """A picture depends on the scene alone, shares no memory with the next one, and leaves the scene as it was."""
    scene = make_scene(PAIR)
    before = scene.robots[0].landmark_means.copy()
    first, second = draw_frame(scene), draw_frame(scene)
    np.testing.assert_array_equal(first, second)
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(scene.robots[0].landmark_means, before)


def test_a_robot_is_drawn_where_it_is() -> None:
    """The pixel at a true pose has the robot's colour, y pointing up; elsewhere only the robot's picture differs."""
    size = (650, 550)
    scene = make_scene((make_robot(3.0, 4.0, landmarks=0), replace(make_robot(9.0, 7.0), particles=np.zeros((0, 3)))))
    frame = draw_frame(scene, size)
    strips = [round(h * max(min(650 / 960, 550 / 720), 0.4)) for h in (46, 64)]
    view = Viewport.around(np.array([[0.0, 0.0], [13.0, 11.0]]), 650, 550 - sum(strips))
    for robot, x, y in ((0, 3.0, 4.0), (1, 9.0, 7.0)):
        behind = np.array([[x, y]]) - 0.09 * np.array([[np.cos(0.7), np.sin(0.7)]])
        column, row = view.pixels(behind)[0].astype(int)
        np.testing.assert_allclose(frame[row + strips[0], column], robot_colour(robot), atol=2)


@given(arrays(np.float64, (5, 2), elements=st.floats(-50.0, 50.0)), st.integers(100, 900), st.integers(100, 900))
def test_a_viewport_keeps_proportions_and_holds_all(points: np.ndarray, width: int, height: int) -> None:
    """All points fall inside the image, and distances are scaled alike in x and y, with y turned around."""
    view = Viewport.around(points, width, height)
    pixels = view.pixels(points)
    assert (pixels > 0.0).all()
    assert (pixels < [width, height]).all()
    expected = (points - points[0]) * [view.scale, -view.scale]
    np.testing.assert_allclose(pixels - pixels[0], expected, atol=1e-6)


@given(arrays(np.float64, (3, 2, 2), elements=st.floats(-2.0, 2.0)))
def test_ellipses_are_the_95_per_cent_regions(roots: np.ndarray) -> None:
    """Every corner of an outline has the squared Mahalanobis distance inside which 95 % of a Gaussian lie."""
    covariances = roots @ roots.swapaxes(-1, -2) + 0.01 * np.eye(2)
    means = np.array([[1.0, 2.0], [-3.0, 4.0], [5.0, -6.0]])
    outlines = ellipse_outlines(means, covariances, Viewport(7.0, 0.0, 0.0), 0.0)
    assert len(outlines) == 3
    offsets = outlines * [1.0 / 7.0, -1.0 / 7.0] - means[:, None]
    solved = np.linalg.solve(covariances[:, None], offsets[..., None])[..., 0]
    np.testing.assert_allclose((offsets * solved).sum(axis=-1), CHI_SQUARE_95, rtol=1e-6)


@pytest.mark.parametrize(
    "covariance",
    [np.zeros((3, 3)), np.diag([1.0, 0.0, 0.0]), -np.eye(3), np.diag([1e12, 1e-12, 1.0]), np.full((3, 3), np.nan)],
)
def test_degenerate_estimates_do_no_harm(covariance: np.ndarray) -> None:
    """Singular, negative, huge and undefined covariances, lost particles and poses far away still give a picture."""
    covariances = PAIR[0].landmark_covariances.copy()
    covariances[5] = covariance
    means = PAIR[0].landmark_means.copy()
    means[2], means[3] = 1e9, np.nan
    particles = PAIR[0].particles.copy()
    particles[0], particles[1] = np.nan, -1e9
    lost = replace(
        PAIR[0],
        landmark_covariances=covariances,
        landmark_means=means,
        particles=particles,
        estimated_pose=np.array([1e9, -1e9, 0.0]),
        estimated_path=np.array([[0.0, 0.0], [1e9, -1e9]]),
    )
    draw_frame(make_scene((lost, PAIR[1])))


def test_a_flash_fades_and_ends() -> None:
    """The younger a merge, the more of the picture it changes; after `FLASH_TICKS` it has left no trace."""
    plain = draw_frame(make_scene(PAIR)).astype(int)

    def trace(age: int) -> float:
        frame = draw_frame(make_scene(PAIR, merges=(MergeFlash(age, (0,), (1,)),)))
        along = frame[250:600].astype(int) - plain[250:600]  # below the caption
        return float(np.abs(along).max())

    traces = [trace(age) for age in (1, FLASH_TICKS // 2, FLASH_TICKS - 1, FLASH_TICKS, 10 * FLASH_TICKS)]
    assert traces[0] > traces[1] > traces[2] > 0.0
    assert traces[3:] == [0.0, 0.0]


def test_only_the_grouping_counts_not_its_labels() -> None:
    """Renaming groups changes nothing; joining two robots does."""
    apart, renamed, joined = (
        draw_frame(make_scene(tuple(replace(r, group=g) for r, g in zip(PAIR, labels, strict=True))))
        for labels in ((0, 1), (7, 3), (0, 0))
    )
    np.testing.assert_array_equal(apart, renamed)
    assert (apart != joined).any()


def test_a_shared_map_is_drawn_once_in_the_colour_of_its_first_robot() -> None:
    """Of a group only the map of the first robot counts; a robot with a map of its own has its own colour."""
    team = tuple(make_robot(3.0 + 2.0 * k, 4.0, group, landmarks=1) for k, group in enumerate((5, 5, 1)))
    team = tuple(
        replace(robot, landmark_means=np.array([[2.0, 8.0 + k, 0.0]]), landmark_covariances=np.zeros((1, 3, 3)))
        for k, robot in enumerate(team)
    )
    scene = make_scene(team)
    assert scene.map_owners == (0, 0, 2)
    size = (650, 550)
    frame = draw_frame(scene, size)
    strips = [round(h * max(min(650 / 960, 550 / 720), 0.4)) for h in (46, 64)]
    view = Viewport.around(np.array([[0.0, 0.0], [13.0, 11.0]]), 650, 550 - sum(strips))
    for robot, is_drawn in ((0, True), (1, False), (2, True)):
        column, row = view.pixels(team[robot].landmark_means)[0].astype(int)
        assert np.allclose(frame[row + strips[0], column], robot_colour(robot), atol=25) is is_drawn
    moved = replace(team[1], landmark_means=np.array([[9.0, 9.0, 0.0]]))
    np.testing.assert_array_equal(draw_frame(make_scene((team[0], moved, team[2])), size), frame)


@given(st.floats(20.0, 40.0), st.floats(20.0, 40.0), st.floats(1.5, 9.0), st.floats(0.1, 0.9))
def test_a_translucent_disc_covers_its_area(x: float, y: float, radius: float, opacity: float) -> None:
    """A translucent disc takes away, summed over pixels, its area times its opacity, wherever it lies."""
    image = np.full((61, 67, 3), 200, np.uint8)
    translucent_fill(image, np.array([[x, y]]), radius, (0, 0, 0), opacity)
    taken = (200.0 - image[..., 0]).sum() / 200.0
    assert taken == pytest.approx(np.pi * radius**2 * opacity, rel=0.08, abs=1.5)


def test_translucent_discs_add_up_and_are_clipped() -> None:
    """Two veils on one spot let through the square of what one does; those outside the image leave it alone."""
    once, twice, outside = (np.full((31, 37, 3), 250, np.uint8) for _ in range(3))
    translucent_fill(once, np.array([[15.0, 15.0]]), 4.0, (0, 0, 0), 0.4)
    translucent_fill(twice, np.array([[15.0, 15.0], [15.0, 15.0]]), 4.0, (0, 0, 0), 0.4)
    translucent_fill(outside, np.array([[-9.0, 15.0], [15.0, 99.0], [1e9, -1e9]]), 4.0, (0, 0, 0), 0.4)
    assert (once[15, 15, 0], twice[15, 15, 0]) == (150, 90)
    assert (outside == 250).all()
    translucent_fill(outside, np.array([[0.0, 15.0], [37.0, 31.0]]), 4.0, (0, 0, 0), 0.4)
    assert 0 < (outside[..., 0] < 250).sum() < 60


def test_dots_have_the_requested_size() -> None:
    """The ink of a dot is about its area."""
    for radius in (1.5, 2.2, 5.0):
        image = np.full((40, 40, 3), 255, np.uint8)
        dots(image, np.array([[20.3, 19.6]]), radius, (0, 0, 0))
        ink = (255.0 - image[..., 0]).sum() / 255.0
        assert ink == pytest.approx(np.pi * radius**2, rel=0.3)
