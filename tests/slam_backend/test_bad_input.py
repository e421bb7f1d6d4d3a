"""Input that makes no sense is refused by name, in one form, and leaves no trace."""

import copy
import inspect
import tracemalloc
from collections.abc import Callable
from dataclasses import is_dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import known_alignment
from builders.refusals import check_complete, check_option, refused
from builders.teams import SimulatedTeam, hand_made, standing_team

import slam_backend
from slam_backend import metrics
from slam_backend.core.validation import (
    argument_error,
    check_array,
    check_choice,
    check_float,
    check_int,
    did_you_mean,
    is_built_in,
    known_names,
)
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrontEnd, usurf_descriptors
from slam_backend.geometry3d import fit_rigid
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.maps.fusion import fuse_landmarks, fuse_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.kitti import load_kitti
from slam_backend.readers.kitti_images import load_kitti_images
from slam_backend.readers.mrclam import SightingNoise, load_mrclam
from slam_backend.readers.victoria import TreeNoise, load_victoria
from slam_backend.reference.filter import ReferenceFastSlam
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.state import take
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam
from slam_backend.trajectory import Trajectory, dead_reckoning

NAN, INF = np.nan, np.inf
CURE = "Do otherwise."

# ---------------------------------------------------------------------- options

POSITIVE, COUNT, SHARE, SIGMA, OPTICS = "(0, inf)", "1..1e9", "[0, 1]", "[0, 1000]", "[1e-12, 1e6]"
BOUNDED, FROM_ZERO = "(0, 1e9]", "[0, inf)"
OPTIONS: dict[type[Any], tuple[str, dict[str, str | list[Any]]]] = {
    AlignmentOptions: ("options.", {
        "descriptor_gate": BOUNDED, "descriptor_ratio": "(0, 1]", "max_similar": "0..10000", "same_place": "[0, 1e9]",
        "position_gate": BOUNDED, "position_floor": BOUNDED, "min_inliers": "3..1e9", "max_ratio": "(0, 1]",
        "min_spread": "[0, 1e9]", "max_sigma_position": BOUNDED, "max_sigma_heading": BOUNDED,
        "success_probability": "(0, 1)", "max_samples": COUNT, "appearance": [1, None],
    }),
    AttemptOptions: ("attempts.", {"every": COUNT, "new_candidates": COUNT, "longest_wait": COUNT, "enabled": [1]}),
    ExistenceModel: ("existence.", {
        "detection": "(0.05, 1)", "false_alarm": "(0, 1)", "prior": "(0.01, 1)", "delete_below": "(0, 1)",
        "cap": "(0.5, 1)", "margin_px": FROM_ZERO, "range_share": "(0, 1]", "nearest": FROM_ZERO, "frame_limit": COUNT,
    }),
    FilterOptions: ("", {
        "num_particles": "1..1000000", "resample_threshold": SHARE, "position_gate": POSITIVE,
        "ambiguity_margin": FROM_ZERO,
        "descriptor_gate": "[1e-9, 2e6]", "new_landmark_gate": "[11.34, inf)", "new_landmark_radius": FROM_ZERO,
        "recovery_position": SIGMA, "recovery_heading": SIGMA, "descriptor_sigma": "[1e-9, 2e6]",
        "new_landmark_density": POSITIVE, "landmark_noise": SIGMA, "rejuvenate_every": COUNT, "camera": [320.0],
        "motion": [StereoCamera()], "proposal": ["fastslam3"], "resampling": ["wheel"], "one_to_one": [1],
        "existence": [0.5], "smoothing": [{"max_keys": 9}],
    }),
    MergeOptions: ("merging.", {
        "merged_particles": "1..1000000", "min_sigmas": FROM_ZERO,
        "watch_steps": "0..1e9",
        "watch_every": COUNT, "blocked_steps": "0..1e9", "max_deformed": SHARE, "smooth_first": [1],
    }),
    OdometryModel: ("motion.", dict.fromkeys(OdometryModel.__slots__, SIGMA)),
    SmoothingOptions: ("", {
        "max_keys": "2..1e9", "further_keys": "0..1e9", "recent_keys": COUNT, "kernel": FROM_ZERO,
        "noise_scale": POSITIVE, "closure_after": "0..1e9", "effort": POSITIVE, "free_sightings": "0..1e9",
        "least_ess": SHARE, "incremental": [1], "slice_share": POSITIVE, "steps_per_key": COUNT,
        "landmarks_per_key": COUNT, "rigid_within": FROM_ZERO,
        "max_iterations": COUNT, "tolerance": POSITIVE,
    }),
    StereoCamera: ("camera.", {
        "focal_px": OPTICS, "baseline": OPTICS, "width": "1..1048576", "height": "1..1048576", "max_range": OPTICS,
        "sigma_px": OPTICS, "sigma_disparity_px": OPTICS, "mount": [(0.0, 0.0), (NAN, 0.0, 0.0)],
    }),
    CornerOptions: ("corners.", {
        "most": COUNT, "block": "1..1000", "spacing": "1..1000", "relative": "[1e-30, 1e30]", "cell": COUNT,
        "absolute": "[1e-30, 1e30]", "border": "4..1e9",
    }),
    FrontEndOptions: ("front_end.", {
        "scale": "[0.1, 100]", "window": "[1e-6, 1e6]", "row_tolerance": POSITIVE, "patch_half": "1..15",
        "iterations": "1..1000", "least_correlation": SHARE, "row_difference": POSITIVE, "back_difference": POSITIVE,
        "nearest": "[0.06, inf)", "max_measurements": COUNT, "descriptor": ["surf"], "corners": [100],
    }),
    SightingNoise: ("sensor.", {
        "range_floor": POSITIVE, "range_share": FROM_ZERO, "bearing": POSITIVE, "height": POSITIVE,
    }),
    TreeNoise: ("sensor.", {"range": POSITIVE, "bearing": POSITIVE, "height": POSITIVE}),
}  # fmt: skip
ALL_OPTIONS = [(kind, name) for kind, (_, table) in OPTIONS.items() for name in table]


@pytest.mark.parametrize(("kind", "name"), ALL_OPTIONS, ids=[f"{kind.__name__}.{name}" for kind, name in ALL_OPTIONS])
def test_options_take_the_numbers_of_their_intervals_alone(kind: type[Any], name: str) -> None:
    """The ends of an interval are taken, and what lies outside, bools, texts and other kinds are refused by name."""
    called, table = OPTIONS[kind]
    check_option(kind, called, name, table[name], {"border": 3000} if name in ("spacing", "block") else {})


def test_all_options_have_their_intervals() -> None:
    """Whatever class of options the package offers, and whatever number it has, stands in the table."""
    offered = [getattr(slam_backend, name) for name in slam_backend.__all__]
    for kind in offered:
        if isinstance(kind, type) and is_dataclass(kind):
            has_defaults = all(p.default is not p.empty for p in inspect.signature(kind).parameters.values())
            assert kind in OPTIONS or not has_defaults
    for kind, (_, table) in OPTIONS.items():
        check_complete(kind, table)


@pytest.mark.parametrize("kind", [FastSlam, *OPTIONS], ids=lambda kind: kind.__name__)
def test_unknown_options_are_refused_with_those_that_there_are(kind: type[Any]) -> None:
    """The line names what is unknown, and lists what there is; a team takes the options of its filters too."""
    refused(lambda: TeamSlam(2, foo=1), "foo: expected a known argument")
    if kind in (SightingNoise, TreeNoise):
        return
    refused(lambda: kind(foo=1), f"foo: expected a known argument, got a name that {kind.__name__} does not")
    first = next(iter(inspect.signature(kind).parameters))
    with pytest.raises(ValueError, match=rf"It has (.*, )?{first}(,|\.)"):
        kind(foo=1)


@pytest.mark.parametrize("kind", [FastSlam, *OPTIONS], ids=lambda kind: kind.__name__)
def test_misspelt_options_get_the_nearest_one(kind: type[Any]) -> None:
    """Whatever option lacks a letter, the error asks whether it was meant."""
    for name in inspect.signature(kind).parameters:
        if kind not in (SightingNoise, TreeNoise) and len(name) > 3:
            with pytest.raises(ValueError, match=rf"Did you mean '{name}'\? It has "):
                kind(**{name[:-2] + name[-1]: 1})


def test_only_near_names_are_suggested() -> None:
    """Case and hyphens do not matter; other names, values of other types and long texts get no suggestion."""
    names = ("random_goals", "frontier", "Office")
    assert did_you_mean("Random-Gaols", names) == "Did you mean 'random_goals'? "
    assert did_you_mean("office", names) == "Did you mean 'Office'? "
    for other in ("maze", "", 3, None, "frontier" * 1000):
        assert did_you_mean(other, names) == ""


def test_valid_values_pass() -> None:
    """Names, places and defaults are as without the check."""

    @known_names
    class Gate:
        def __init__(self, width: float, *, height: float = 2.0) -> None:
            self.area = width * height

    assert (Gate(3.0).area, Gate(width=3.0, height=1.0).area) == (6.0, 3.0)
    with pytest.raises(TypeError, match="width"):
        Gate()  # type: ignore[call-arg]


# ---------------------------------------------------------------------- functions and constructors

MAP = LandmarkMap(np.eye(3), [np.eye(3)] * 3, np.eye(3, 7))
EMPTY = LandmarkMap.empty(7)
THREE = {"means": np.zeros((3, 3)), "covariances": [np.eye(3)] * 3, "descriptors": np.eye(3, 7)}
LOPSIDED = np.eye(3) + np.diag([0.5, 0.0], 1)
TWO = (np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
FLAT = np.diag([1.0, 1.0, 0.0])
POINTS, LOOKS = [[0.0, 0.1, 2.0], [1.0, 0.0, 3.0]], np.eye(2, 5, dtype=np.float32)
GRID = np.arange(36.0).reshape(12, 3)
GREY = np.zeros((30, 30), np.uint8)
PLAIN = FilterOptions(rejuvenate_every=None)
NO_PAIRS = np.empty((0, 2), np.int64)
aligned = partial(Alignment, True, "", 1.0, 0.0, 0.0, np.eye(3))
CALLS: dict[str, list[Callable[[], Any]]] = {
    "camera: expected": [lambda: StereoFrontEnd(None), lambda: TeamSlam(2, camera="wide")],  # type: ignore[arg-type]
    "pixels: expected disparities > 0 px": [lambda: StereoCamera().triangulate(np.array([[1.0, 2.0, 0.0]]))],
    "existence.margin_px: expected a number < 120": [
        lambda: ExistenceModel(margin_px=120.0).view(StereoCamera()),
        lambda: FastSlam(existence=ExistenceModel(margin_px=120.0)),
    ],
    "existence.nearest: expected a number < 0.18": [lambda: ExistenceModel().view(StereoCamera(max_range=0.2))],
    "existence: expected a filter that estimates it": [lambda: FastSlam().existence()],
    "num_robots: expected an int >= 1": [
        *(partial(FastSlam, bad) for bad in (0, 1.0, True)),
        *(partial(TeamSlam, bad) for bad in (0, -2, 2.5, True, None)),
        lambda: ReferenceFastSlam(0, PLAIN),
    ],
    "options.rejuvenate_every: expected None, got 50. The reference has no smoother": [
        lambda: ReferenceFastSlam(1, FilterOptions())
    ],
    "num_robots: expected an int <= 1000": [partial(kind, 10**400) for kind in (FastSlam, TeamSlam)],
    "seed: expected an int >= 0": [
        *(partial(kind, 1, seed=bad) for kind in (FastSlam, TeamSlam) for bad in ("a", -1)),
        partial(TeamSlam, 1, seed=np.random.default_rng(0)),
    ],
    "initial_poses: expected": [
        partial(FastSlam, initial_poses=bad)
        for bad in ([0.0, 0.0, 0.0], [[1e308, 0.0, 0.0]], [[0.0, 0.0, INF]])
    ] + [partial(TeamSlam, 2, initial_poses=7)],
    "proposal: expected one of": [partial(TeamSlam, 2, proposal="fastslam3")],
    "alignment: expected AlignmentOptions": [partial(TeamSlam, 2, alignment={"min_inliers": 9})],
    "attempts: expected AttemptOptions": [partial(TeamSlam, 2, attempts=25)],
    "merging: expected MergeOptions": [partial(TeamSlam, 2, merging=200)],
    "estimate: expected one of 'best', 'mixture'": [
        lambda: FastSlam().map("mean"),
        lambda: ReferenceFastSlam(1, PLAIN).map("worst"),  # type: ignore[arg-type]
    ],
    "odometry: expected": [
        lambda: ReferenceFastSlam(2, PLAIN).step([None], [None, None]),
        lambda: dead_reckoning(np.zeros(3), np.zeros((4, 2))),
    ],
    "rng: expected": [lambda: align_maps(MAP, MAP, rng=7)],  # type: ignore[arg-type]
    "method: expected one of 'ransac', 'svd'": [lambda: align_maps(MAP, MAP, "magic")],
    "map_b: expected descriptors of size 7, as in map_a": [
        lambda: align_maps(MAP, LandmarkMap.empty(5)),
        lambda: fuse_maps(MAP, LandmarkMap.empty(5), aligned(NO_PAIRS, 0.0)),
    ],
    "tx, ty, theta: expected finite numbers": [lambda: Alignment(True, "", 0.0, NAN, 0.0, np.eye(3), NO_PAIRS, 0.0)],
    "reason: expected": [lambda: Alignment(False, "bad luck", 0.0, 0.0, 0.0, np.eye(3), NO_PAIRS, 0.0)],
    "covariance: expected an array": [lambda: Alignment(True, "", 0.0, 0.0, 0.0, np.eye(2), NO_PAIRS, 0.0)],
    "alignment: expected a successful alignment": [lambda: fuse_maps(MAP, MAP, Alignment.refused("ambiguous"))],
    "alignment.inliers: expected": [
        lambda: fuse_maps(MAP, MAP, aligned([[0, 4]], 0.0)),
        lambda: fuse_maps(MAP, MAP, aligned([[0, 1], [2, 1]], 0.0)),
    ],
    "cov1 + cov2: expected positive definite": [lambda: fuse_landmarks(TWO[0], FLAT, TWO[2], FLAT)],
    "means: expected": [partial(LandmarkMap, **THREE | {"means": bad}) for bad in (np.eye(3, 2), NAN * np.eye(3))],
    "covariances: expected": [
        *(partial(LandmarkMap, **THREE | {"covariances": [bad] * 3}) for bad in (np.eye(2), LOPSIDED, -np.eye(3))),
        *(partial(Measurements, POINTS, LOOKS, [bad] * 2) for bad in (
            -np.eye(3), np.diag([1.0, 1.0, -1e-3]), LOPSIDED, 1e-13 * LOPSIDED, FLAT, np.zeros((3, 3)),
            np.diag([1.0, 1.0, 5e-9]), 1e-30 * np.eye(3), 1e30 * np.eye(3), NAN * np.eye(3), np.eye(3)[0],
        )),
        lambda: metrics.nees([[1.0, 0.0]], [np.diag([1.0, 0.0])]),
    ],
    "descriptors: expected": [
        lambda: LandmarkMap(**THREE | {"descriptors": np.eye(4, 7)}),
        *(partial(Measurements, POINTS, bad)
          for bad in (1e39 * LOOKS.astype(float), LOOKS[:1], LOOKS + INF, 1e30 * LOOKS)),
    ],
    "counts: expected": [partial(LandmarkMap, **THREE, counts=bad) for bad in ([1, 0, 1], [1, 1.5, 1], "many")],
    "ids: expected": [partial(LandmarkMap, **THREE, ids=bad) for bad in ([0, 1, 1], [0, -1, 2])],
    "indices: expected": [partial(MAP.subset, bad) for bad in ([5], [-1], [0, 0], [0.5], [[0]], np.ones(2, bool))],
    "points: expected": [
        partial(Measurements, bad, LOOKS[:1]) for bad in ([[0.0, 1.0]], [0.0, 1.0, 2.0], [[0.0, NAN, 1.0]], "far")
    ],
    "means: expected an array of shape (2, 3)": [lambda: metrics.map_error(GRID[:3], [0, 1], GRID)],
    "means: expected finite": [lambda: metrics.map_error(NAN * GRID[:2], [0, 1], GRID)],
    "claims: expected indices below 12": [
        partial(metrics.map_error, GRID[:2], np.array(bad), GRID) for bad in ([0, 12], [-3, 1])
    ],
    "cutoff: expected": [
        lambda: metrics.map_error(GRID[:2], [0, 1], GRID, 0.0), lambda: metrics.gospa(GRID, GRID, cutoff=-1.0),
    ],
    "true_positions: expected": [
        lambda: metrics.map_error(GRID[:0], NO_PAIRS[:, 0], GRID[:0]),
        lambda: metrics.map_error(GRID[:1], [0], GRID[:, :2]),
    ],
    "order: expected": [lambda: metrics.ospa(GRID, GRID, order=0.5)],
    "alpha: expected": [lambda: metrics.gospa(GRID, GRID, alpha=3.0)],
    "truths: expected": [lambda: metrics.ospa(GRID[:, :2], GRID)],
    "estimates: expected": [lambda: metrics.map_rmse(NAN * GRID, GRID)],
    "truth: expected": [lambda: metrics.ate(GRID[:2], GRID)],
    "estimated: expected": [lambda: metrics.ate(GRID[:0], GRID[:0]), lambda: metrics.rpe(GRID, GRID, delta=12)],
    "delta: expected": [lambda: metrics.rpe(GRID, GRID, delta=0)],
    "errors: expected": [lambda: metrics.anees(GRID[:0], np.empty((0, 3, 3)))],
    "points_a: expected": [
        lambda: metrics.align_se2(GRID[:0, :2], GRID[:0, :2]), lambda: fit_rigid(GRID[:2], GRID[:2]),
    ],
    "points_b: expected": [lambda: fit_rigid(GRID[:4], GRID[:5])],
    "weights: expected": [
        lambda: metrics.align_se2(GRID[:2, :2], GRID[:2, :2], [1.0, -1.0]),
        lambda: fit_rigid(GRID[:4], GRID[:4], [1, 1, 0, 1]),
    ],
    "times: expected": [
        *(partial(Trajectory([1.0, 4.0], np.zeros((2, 3))).at, [2.0, bad]) for bad in (0.74, 4.26, NAN)),
        lambda: Trajectory([0.0, 1.0, 1.0], np.zeros((3, 3))),
    ],
    "poses: expected": [lambda: Trajectory([0.0, 1.0], np.zeros((3, 3))), lambda: Trajectory([0.0], [[0.0, NAN, 0.0]])],
    "image: expected": [
        partial(usurf_descriptors, bad, [[9, 9]], 2.0)
        for bad in (np.zeros((30, 30, 3), np.uint8), np.zeros((30, 30)), GREY[:, :5], GREY[0])
    ],
    "points_xy: expected": [partial(usurf_descriptors, GREY, bad, 2.0) for bad in ([9, 9], [[9, NAN]])],
    "scales: expected": [partial(usurf_descriptors, GREY, [[9, 9]], bad) for bad in (0.0, [1.0, 2.0])],
    "right: expected": [
        partial(StereoFrontEnd(StereoCamera()).measure, np.zeros((240, 320), np.uint8), bad)
        for bad in (np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320)), np.zeros((320, 240), np.uint8))
    ],
    "new_ids: expected": [lambda: RobotLog().renamed([1, 2], [3]), lambda: RobotLog().renamed([1], [-2])],
    "old_ids: expected": [lambda: RobotLog().renamed([1, 1], [3, 4]), lambda: RobotLog().renamed([-1], [3])],
    "others: expected": [lambda: RobotLog().renamed([1], [2], "drop")],  # type: ignore[arg-type]
    "since: expected": [lambda: RobotLog().arrays(-1)],
}  # fmt: skip


@pytest.mark.parametrize("begins", CALLS)
def test_arguments_that_make_no_sense_are_refused_by_name(begins: str) -> None:
    """The error names the argument, says what it should be and what it was, and ends with a cure."""
    for call in CALLS[begins]:
        refused(call, begins)


WRONG = [None, 3, "x", [None], object()]
KINDS: dict[str, Callable[[Any], Any]] = {
    "alignment": lambda wrong: fuse_maps(EMPTY, EMPTY, wrong),
    "map_a": lambda wrong: fuse_maps(wrong, EMPTY, None),  # type: ignore[arg-type]
    "map_b": lambda wrong: fuse_maps(EMPTY, wrong, None),  # type: ignore[arg-type]
    "mean1": lambda wrong: fuse_landmarks(wrong, *TWO[1:]),
    "cov1": lambda wrong: fuse_landmarks(TWO[0], wrong, *TWO[2:]),
    "mean2": lambda wrong: fuse_landmarks(*TWO[:2], wrong, TWO[3]),
    "cov2": lambda wrong: fuse_landmarks(*TWO[:3], wrong),
    "options, plain": lambda wrong: ReferenceFastSlam(1, wrong),
    "merge": lambda wrong: TeamSlam(2, num_particles=2).merged_maps(wrong),
    "descriptor_size": lambda wrong: LandmarkMap.empty(-7 if wrong == 3 else wrong),
    "path, map": LandmarkMap.load,
    "path, saved map": lambda wrong: EMPTY.save(3 if wrong == "x" else wrong),
    "path, tum": Trajectory.load_tum,
    "path, mrclam": load_mrclam,
    "path, victoria": load_victoria,
    "path, kitti": load_kitti,
    "path, images": load_kitti_images,
    "times": lambda wrong: Trajectory([0.0, 1.0], np.zeros((2, 3))).at(3.5 if wrong == 3 else wrong),
}


@pytest.mark.parametrize("call", KINDS)
def test_arguments_of_another_kind_are_refused_by_name(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`None`, a number, a text, a list and an object in the place of something else: the line names the argument."""
    monkeypatch.chdir(tmp_path)
    for wrong in WRONG:
        refused(lambda wrong=wrong: KINDS[call](wrong), f"{call.split(',')[0]}: expected ")


# ---------------------------------------------------------------------- steps of filters and teams

FRAME = Measurements([[0.0, 0.0, 2.0], [0.5, 0.1, 3.0]], np.eye(2, 5))
MOVE = [0.1, 0.0, 0.02]
GOOD: dict[str, Any] = {"odometry": [MOVE, MOVE], "measurements": [FRAME, None]}


def seen(points: Any = FRAME.points, looks: Any = FRAME.descriptors, noise: Any = None) -> dict[str, Any]:
    """Return a step in which the second robot reports this frame; the first one's is good."""
    return {"measurements": [FRAME, Measurements(points, looks, noise)]}


def together(
    points: Any = FRAME.points, looks: Any = FRAME.descriptors, ends: Any = (1, 2), **moves: Any
) -> dict[str, Any]:
    """Return a step in which both robots' frames come in one piece, unchecked."""
    return {
        "measurements": TeamMeasurements(points, looks, np.array(ends, np.int64) if ends is not None else [1, 2])
    } | moves


BEHIND, SPOILT = FRAME.points * [[1.0], [-1.0]], FRAME.points * [[1.0], [NAN]]
AT_ONCE = {"odometry": np.zeros((2, 3))}
STEPS: dict[str, list[dict[str, Any]]] = {
    "odometry: expected a sequence with one entry per robot (2)": [{"odometry": [MOVE]}, {"odometry": None}],
    "odometry[1]: expected": [
        *({"odometry": [MOVE, bad]} for bad in (
            [0.1, 0.0], [0.1, NAN, 0.0], "ahead", [1e300, 0.0, 0.0], [10**400, 0, 0], ["0.1", 0, 0],
        )),
        *({"odometry": np.diag([0.0, bad, 0.0])[:2]} | more for bad in (NAN, 2e4, -2e4) for more in ({}, together())),
    ],
    "odometry[0]: expected an array of shape (3,)": [{"odometry": np.zeros((2, 2))}],
    "measurements: expected a sequence with one entry": [{"measurements": FRAME}, {"measurements": [FRAME] * 3}],
    "measurements[1]: expected Measurements or None": [
        {"measurements": [None, bad]} for bad in (FRAME.points, "a wall")
    ],
    "measurements[1].descriptors: expected vectors of size 5": [seen(looks=np.eye(2, n)) for n in (0, 2, 6)],
    "measurements[1].points: expected": [
        *(seen([[0.0, 0.0, 2.0], bad]) for bad in ([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 2500.0])),
        seen([[0.0, 0.0, 2.0], [-1e150, 0.0, 1.0]], noise=[np.eye(3)] * 2),
        *({"measurements": together(bad)["measurements"].per_robot()} for bad in (BEHIND, SPOILT)),
        *(together(bad, **more) for bad in (BEHIND, SPOILT) for more in ({}, AT_ONCE)),
    ],
    "measurements: expected a descriptor per po": [
        together(ends=ends, looks=FRAME.descriptors[:rows], **more)
        for ends, rows in (([1, 9], 2), ([1, 1], 2), ([2, 1], 2), ([-1, 2], 2), ([1, 2], 1), ([], 2))
        for more in ({}, AT_ONCE)
    ],
    "measurements: expected points (n, 3) float64": [
        together(FRAME.points[:, :2], **AT_ONCE), together(FRAME.points.astype(np.float32), **AT_ONCE),
        together(looks=FRAME.descriptors.astype(float), **AT_ONCE), together(ends=None, **AT_ONCE),
    ],
    "measurements.descriptors: expected numbers within": [
        together(looks=FRAME.descriptors * np.float32(bad), **more) for bad in (NAN, 1e20) for more in ({}, AT_ONCE)
    ],
    "identities: expected a sequence with one entry": [{"identities": [[1, 2]]}],
    "identities[0]: expected": [
        {"identities": [bad, None]} for bad in ([1], [1, 2.5], [1j, 2], [1e300, 2], [1, NAN])
    ],
    "identities[1]: expected an array of shape (0,)": [{"identities": [None, [1]]}],
    "poses[1]: expected": [{"poses": [None, bad]} for bad in ([0.0, 0.0], [0.0, INF, 0.0], [0.0, 1e9, 0.0])],
}  # fmt: skip
CONTACTS = {
    "contacts: expected an array of shape (2, 2)": [np.ones((3, 3), bool), [[True], [True, False]]],
    "contacts: expected a symmetric array of bools": [np.eye(2), np.array([[True, True], [False, True]])],
}
SUBJECTS: dict[str, Callable[[], FastSlam | TeamSlam]] = {
    **{
        proposal: partial(FastSlam, 2, num_particles=5, proposal=proposal, seed=1, resample_threshold=1.0)
        for proposal in ("fastslam2", "fastslam1")
    },
    "team": partial(TeamSlam, 2, num_particles=5, seed=1),
    "merged team": partial(TeamSlam, 2, num_particles=5, seed=1),
}


@pytest.mark.parametrize("begins", [*STEPS, *CONTACTS])
@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_refused_step_leaves_no_trace(subject: str, begins: str) -> None:
    """One bad entry, be it the last robot's, and all is as before, bit for bit; so are the next good steps."""
    one, twin = (SUBJECTS[subject]() for _ in range(2))
    for each in (one, twin):
        each.step(**GOOD)
        if subject == "merged team":
            each.merge(0, 1, known_alignment())
        each.step(**GOOD | {"measurements": [FRAME, FRAME]})
    if begins in CONTACTS and isinstance(one, FastSlam):
        return
    for change in STEPS.get(begins) or [{"contacts": bad} for bad in CONTACTS[begins]]:
        refused(lambda change=change: one.step(**GOOD | change), begins)
    assert_same(one.get_state(), twin.get_state())
    moves = np.array([MOVE, MOVE])
    assert_same(one.step(**GOOD | {"odometry": moves}), twin.step(**GOOD))
    moves[:] = 7.0  # of no matter any more
    assert_same(one.get_state(), twin.get_state())


def test_the_first_frames_of_two_robots_have_to_agree_on_descriptors() -> None:
    """The size of the descriptors is checked within a step, too."""
    other = Measurements([[0.0, 0.0, 1.0]], [[1.0, 0.0]])
    refused(
        lambda: FastSlam(2, num_particles=3).step([None, None], [FRAME, other]),
        "measurements[1].descriptors: expected vectors of",
    )


def test_empty_input_is_no_error() -> None:
    """Robots that neither moved nor saw anything, frames without points, and frames rejected whole, are accepted."""
    slam = FastSlam(2, num_particles=3)
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


def test_a_refused_step_of_a_log_leaves_no_trace() -> None:
    """A step out of order or out of shape is refused by name, and the log is as before."""
    good: dict[str, Any] = {"step": 5, "points": np.zeros((2, 3)), "ids": np.array([1, 2])}
    log = RobotLog()
    log.append(**good | {"step": 4})
    before = take(log)
    for name, bad in (
        ("step", 4), ("points", np.zeros((3, 3))), ("points", np.zeros(3)), ("odometry", np.zeros(2)),
        ("pose", np.zeros(4)), ("covariances", np.zeros((2, 3))),
    ):  # fmt: skip
        refused(lambda change=(name, bad): log.append(**good | dict([change])), f"{name}: expected")
    assert_same(take(log), before)


@pytest.mark.parametrize("robot", [3, -1, 1.0, True, np.True_, None, "0", np.array([0, 1])])
def test_robots_that_are_not_there_are_refused(robot: Any) -> None:
    """Robots are counted from 0 to K - 1, in every question; an index that numpy made is an index."""
    slam, team = FastSlam(3, num_particles=3), TeamSlam(3, num_particles=3)
    for ask in (slam.pose, slam.particles, slam.start_pose, team.pose, team.particles, team.map, team.start_from_group):
        refused(lambda ask=ask: ask(robot), "robot: expected an index from 0 to 2, got")
    assert team.pose(np.int64(2)).mean.shape == slam.pose(np.int64(2)).mean.shape == (3,)


MERGES: dict[str, list[tuple[Any, ...]]] = {
    "robot_b: expected a robot outside the group": [(0, 2, aligned([(0, 0)], 0.0)), (1, 1, aligned([(0, 0)], 0.0))],
    "robot: expected an index from 0 to 2": [(0, 3, aligned([(0, 0)], 0.0)), (-1, 0, aligned([(0, 0)], 0.0))],
    "alignment: expected a successful Alignment": [(0, 1, Alignment.refused("ambiguous")), (0, 1, None)],
    "alignment.inliers: expected one-to-one pairs of rows below 7 and 6": [
        (0, 1, aligned([(0, 6)], 0.0)), (1, 0, aligned([(-1, 0)], 0.0)), (0, 1, aligned([(0, 1), (2, 1)], 0.0)),
    ],
}  # fmt: skip


@pytest.mark.parametrize("begins", MERGES)
def test_a_refused_merge_leaves_the_team_as_it_was(begins: str) -> None:
    """Merges of robots that are together or do not exist, and of refused or foreign alignments, change nothing."""
    team = standing_team()
    team.merge(0, 2, hand_made(team, 0, 2))
    before = copy.deepcopy(team.get_state())
    for arguments in MERGES[begins]:
        refused(lambda arguments=arguments: team.merge(*arguments), begins)
    assert_same(team.get_state(), before)


def test_a_state_of_nothing_is_refused() -> None:
    """`set_state` takes what `get_state` gave, and else leaves a filter as it is."""
    slam = FastSlam(1, num_particles=3)
    state = slam.get_state()
    for other in (None, 3, [1]):
        refused(lambda other=other: slam.set_state(other), "state: expected what get_state returned, got a ")
    assert_same(slam.get_state(), state)


def test_foreign_snapshots_are_refused() -> None:
    """A state of something else, or of a team of another size, is refused, and the team is as before."""
    team = TeamSlam(3, num_particles=7)
    before = copy.deepcopy(team.get_state())
    refused(lambda: team.set_state({}), "state: expected what get_state returned, got a mapping without 'n")
    refused(lambda: team.set_state(None), "state: expected what get_state returned, got a NoneType")
    other = SimulatedTeam(2).build().get_state()
    for state in (other, dict(other)):
        refused(lambda state=state: team.set_state(state), "state: expected one of 3 robots, got 2")
    assert_same(team.get_state(), before)


# ---------------------------------------------------------------------- the checks themselves


def test_an_error_says_argument_expected_got_and_cure() -> None:
    """The one form of all refusals, with long values shortened."""
    assert (
        str(argument_error("gate", "a number > 0", -1.5, CURE))
        == "gate: expected a number > 0, got -1.5. Do otherwise."
    )
    long = str(argument_error("gate", "a number", list(range(100)), CURE))
    assert len(long) < 140
    assert "..." in long


@pytest.mark.parametrize(
    ("got", "shown"),
    [
        (np.float64(0.1), "0.1"), (np.float32(0.1), "0.1"), (np.int8(3), "3"), (np.bool_(True), "True"),
        ([np.float64(0.5), 2], "[0.5, 2]"), ({"x": (np.int64(1),)}, "{'x': (1,)}"),
    ],
)  # fmt: skip
def test_numbers_are_shown_without_their_type(got: object, shown: str) -> None:
    """Numbers of NumPy, also within containers, look like those of Python."""
    assert f", got {shown}. " in str(argument_error("gate", "a number", got, CURE))


def test_built_in_callables_are_known() -> None:
    """What Python or an extension brings is distinguished from what is written in Python."""

    class Mine:
        """A class."""

    assert all(map(is_built_in, (print, int, np.zeros, dict)))
    assert not any(map(is_built_in, (Mine, lambda: None, inspect.signature, Mine())))


def test_counts_are_whole_numbers_within_their_bounds() -> None:
    """Bools, floats, texts and numbers outside are no counts; an integer of numpy becomes one of Python."""
    for value in (0, -3, 2.0, True, "two", None, np.float64(3.0)):
        refused(lambda value=value: check_int("n", value, 1, CURE), "n: expected an int >= 1, got ")
    for value in (9, np.uint64(2**63), 10**5000):
        refused(lambda value=value: check_int("n", value, 1, CURE, 8), "n: expected an int <= 8, got ")
    assert check_int("n", 8, 1, CURE, 8) == 8
    assert type(check_int("n", np.int32(4), 1, CURE)) is int


def test_numbers_are_finite_and_within_their_bounds() -> None:
    """The message states the bounds, closed ones belong to the interval, and what is taken becomes a float."""
    for value, bounds, expected in (
        (0.0, {"above": 0.0}, " > 0"), (-1, {"at_least": 0.0}, " >= 0"), (1.5, {"at_most": 1.0}, " <= 1"),
        (1.5, {"at_least": 0.0, "at_most": 1.0}, " >= 0 and <= 1"), (np.inf, {}, ""), (np.nan, {"above": 0.0}, " > 0"),
        ("1", {}, ""), (True, {}, ""), ([1.0], {}, ""), (10**400, {}, ""), (-(10**5000), {"at_most": 1.0}, " <= 1"),
    ):  # fmt: skip
        refused(partial(check_float, "x", value, CURE, **bounds), f"x: expected a finite number{expected}, got ")
    assert check_float("x", 1, CURE, at_least=1.0, at_most=1.0) == 1.0
    assert type(check_float("x", np.float32(0.5), CURE, above=0.0)) is float


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    """The message lists the choices."""
    for value in ("ICP", "", None, 3):
        refused(
            partial(check_choice, "method", value, ("ransac", "icp")), "method: expected one of 'ransac', 'icp', got "
        )


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ([1.0, 2.0], ", got shape (2,)"),
        (np.zeros((4, 3)), ", got shape (4, 3)"),
        ([[1.0, 2.0], [3.0]], ", got [[1.0, 2.0], [3.0]]"),
        *((bad, " of real numbers, got") for bad in (
            [["a", "b"]], [["1", "2"]], [[1.0, "2"]], np.array([[1.0, "2"]], object), None, [[1j, 2.0]],
            [[np.complex128(1), 2.0]], [np.zeros(2, complex)], np.array([[1j, 2.0]], object),
            np.zeros((1, 2), complex), np.zeros((1, 2), "m8[s]"),
        )),
        (np.ma.masked_equal([[1.0, 2.0]], 2.0), ", got a masked array with hidden entries"),
        ([[10**400, 2]], ", got [[1000"),
        ([[10**5000, 2]], ", got a list that cannot be shown"),
    ],
)  # fmt: skip
def test_arrays_of_another_shape_or_kind_are_refused(value: Any, says: str) -> None:
    """The message states both shapes, or that there are other things than real numbers."""
    refused(lambda: check_array("x", value, (None, 2), CURE), f"x: expected an array of shape (n, 2){says}")


def test_numbers_of_an_array_are_those_that_its_type_can_hold() -> None:
    """NaN has its place told; whole numbers stay whole and do not wrap around; what comes back is fresh."""
    refused(lambda: check_array("x", [[1.0, 2.0], [INF, 0.0]], (None, 2), CURE), "x: expected finite numbers, got NaN")
    for value, dtype in (
        ([1.5, 2.0], np.int64), (np.array([1.0, NAN]), np.int64), ([1e300, 0.0], np.int64), ([2.0**63, 0.0], np.int64),
        ([2**63, 0], np.int64), ([-(2**31) - 1, 0], np.int32),
    ):  # fmt: skip
        refused(partial(check_array, "x", value, (2,), CURE, dtype=dtype), "x: expected whole numbers")
    for value in ([1j, 2.0], [np.complex128(1), 2.0], ["1", "2"], [10**400, 1]):
        refused(partial(check_array, "x", value, (2,), CURE, dtype=np.int64), "x: expected an array of shape (2,)")
    refused(
        lambda: check_array("x", [1.0, 1e39], (2,), CURE, dtype=np.float32), "x: expected numbers that float32 can hold"
    )
    for value in ([Fraction(1, 2), 2], np.array([0.5, 2], object), np.ma.array([0.5, 2.0]), [np.float32(0.5), 2]):
        checked = check_array("x", value, (2,), CURE)
        assert type(checked) is np.ndarray
        assert checked.tolist() == [0.5, 2.0]
    assert check_array("x", [True, 2], (2,), CURE).tolist() == [1.0, 2.0]
    odd = np.array([2**53 + 1, 2], object)  # a float would round it
    np.testing.assert_array_equal(check_array("ids", odd, (2,), CURE, dtype=np.int64), [2**53 + 1, 2])
    given = np.zeros((3, 2))
    assert not np.shares_memory(given, check_array("x", given, (None, 2), CURE))
    assert np.isnan(check_array("x", [[NAN, 1]], (1, 2), CURE, finite=False)).any()


class _Unshown(str):
    """Text of which only a beginning may be shown."""

    def __repr__(self) -> str:
        raise AssertionError("the whole text was shown")

    def __getitem__(self, part: Any) -> str:
        return str.__getitem__(self, part)


HUGE = "x" * 5_000_000


@pytest.mark.parametrize(
    "got",
    [
        HUGE, HUGE.encode(), _Unshown(HUGE), [HUGE], (HUGE,), {HUGE: 1}, {"a": {HUGE: HUGE}}, {HUGE},
        list(range(10**6)),
        dict.fromkeys(range(10**6)), np.zeros(10**6), np.array([HUGE]), "'" + HUGE, 10**5000,
    ],
    ids=lambda got: type(got).__name__,
)  # fmt: skip
def test_errors_are_short_whatever_came(got: object) -> None:
    """The text of an error has a limit, and no more is made of a value than is shown."""
    tracemalloc.start()
    text = str(argument_error("gate", "a number", got, CURE))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(text) < 250
    assert "\n" not in text
    if not (isinstance(got, str) and got.startswith("'")):
        assert most < 1_000_000
    for parts in ((HUGE, "a number", CURE), ("gate", HUGE, CURE), ("gate", "a number", HUGE)):
        assert len(str(argument_error(parts[0], parts[1], 3, parts[2]))) < 2500


@pytest.mark.parametrize(
    "got", [(1,), (), [], {}, set(), {"a": [1, (2, {3})]}, {1}, "it's", b"b", None, [[[]]], np.eye(2)]
)
def test_short_values_are_shown_as_they_are(got: object) -> None:
    """Values with a short `repr` are shown by it."""
    assert f"got {got!r}. " in str(argument_error("gate", "a number", got, CURE))
