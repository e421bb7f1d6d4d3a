"""Ids given by the caller are unique in a map: in a filter, after merges, undos and returns."""

from typing import Any

import numpy as np
import pytest
from builders.filters import dense, names_of
from builders.teams import NEVER, links
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.alignment import Alignment, AlignmentOptions
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.reference import ReferenceFastSlam
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

CAMERA = StereoCamera()
COVARIANCE = np.diag([0.05, 0.05, 0.05]) ** 2
MOVE = np.array([0.3, 0.0, 0.2])


class Hall:
    """Robots in one hall whose landmarks have names, seen all around, with noise."""

    def __init__(self, num_robots: int, seed: int, num_landmarks: int = 9) -> None:
        self.rng = np.random.default_rng(seed)
        spread = self.rng.uniform([-3.0, -3.0, -0.3], [3.0, 3.0, 0.3], (num_landmarks, 3))
        self.landmarks = spread
        self.poses = self.rng.uniform([-1.0, -1.0, -3.0], [1.0, 1.0, 3.0], (num_robots, 3))
        self.starts = self.poses.copy()

    def read(self) -> tuple[list[np.ndarray], list[Measurements], list[np.ndarray]]:
        """Move all robots, and return odometry, frames, and the names in these."""
        moves, frames, names = [], [], []
        for robot in range(len(self.poses)):
            self.poses[robot] = compose(self.poses[robot], MOVE)
            moves.append(MOVE + self.rng.normal(size=3) * 0.01)
            seen = self.rng.permutation(len(self.landmarks))[: self.rng.integers(1, 5)]
            points = transform_points(inverse(self.poses[robot]), self.landmarks[seen])
            points = CAMERA.camera_from_robot(points) + 0.05 * self.rng.normal(size=points.shape)
            looks = np.ones((len(seen), 4), dtype=np.float32)
            frames.append(Measurements(points, looks, [COVARIANCE] * len(seen)))
            names.append(seen)
        return moves, frames, names

    def alignment(self, team: TeamSlam, one: int, other: int, pairs: list[tuple[int, int]], off: float) -> Alignment:
        """Return the motion between the maps of two robots' groups, off by so much, with these rows in common."""
        first, second = (self.starts[team.known_robots(robot)[0]] for robot in (one, other))
        motion = compose(inverse(first), second) + np.array([off, 0.0, 0.0])
        return Alignment(True, "", *motion, 1e-2 * np.eye(3), np.array(pairs, np.int64).reshape(-1, 2), 0.0)


def check_unique(slam: FastSlam) -> None:
    """Fail if any particle of a filter, or its map, holds two landmarks of one name."""
    ids, _, _, counts = dense(slam)
    names = names_of(slam)
    for held in (counts > 0).T:
        told = [names[name] for name in ids[held].tolist() if names[name] >= 0]
        assert len(told) == len(set(told))


def build(num_robots: int, seed: int, **options: object) -> TeamSlam:
    """Return a team that merges only where it is asked to."""
    motion = OdometryModel(floor_position=0.02, floor_heading=0.02)
    return TeamSlam(num_robots, attempts=NEVER, seed=seed, num_particles=7, motion=motion, **options)


@pytest.mark.parametrize("existence", [None, ExistenceModel()])
@given(seed=st.integers(0, 10_000), data=st.data())
@settings(max_examples=12)
def test_ids_are_unique_after_every_merge_undo_and_return(
    existence: ExistenceModel | None, seed: int, data: st.DataObject
) -> None:
    """Robots lose and find each other, merge with right or wrong pairs, and merges are undone: names stay unique."""
    hall = Hall(3, seed)
    team = build(3, seed, existence=existence, rejuvenate_every=5)
    for _ in range(12):
        parted = data.draw(st.sampled_from([None, links(3, (0, 1)), links(3, (1, 2)), links(3)]))
        for _ in range(3):
            moves, frames, names = hall.read()
            team.step(moves, frames, parted, identities=names)
        one, other = data.draw(st.permutations(range(3)))[:2]
        alone = one in team.trunk_robots(one) and other in team.trunk_robots(other)
        if alone and team.known_robots(one) != team.known_robots(other) and data.draw(st.booleans()):
            sizes = len(team.map(one)), len(team.map(other))
            some = data.draw(st.integers(0, min(sizes)))
            rows = [data.draw(st.permutations(range(size)))[:some] for size in sizes]
            off = data.draw(st.sampled_from([0.0, 0.1, 3.0]))
            team.merge(one, other, hall.alignment(team, one, other, list(zip(*rows, strict=True)), off))
        for group in team._groups:
            for branch in group.branches:
                check_unique(branch.filter)


def test_a_false_merge_of_landmarks_with_ids_is_undone_with_all_ids_unique() -> None:
    """Maps merged three metres off hold each name once, while the merge stands and when it is undone."""
    hall = Hall(2, 0)
    undone_soon = MergeOptions(watch_every=5, max_deformed=0.0)
    team = build(2, 0, merging=undone_soon, alignment=AlignmentOptions(min_inliers=3))
    kinds: list[str] = []
    for step in range(80):
        moves, frames, names = hall.read()
        kinds += [event.kind for event in team.step(moves, frames, identities=names).events]
        if step == 20:
            team.merge(0, 1, hall.alignment(team, 0, 1, [(0, 0), (1, 1), (2, 2)], 3.0))
            assert len(team.map(0)) == len(hall.landmarks)
        for group in team._groups:
            for branch in group.branches:
                check_unique(branch.filter)
    assert kinds == ["undo"]


def filter_of(kind: Any, proposal: Any) -> Any:
    """Return a filter of three particles, compiled or plain."""
    options = FilterOptions(num_particles=3, proposal=proposal, rejuvenate_every=None)
    return kind.from_options(1, options, 0) if kind is FastSlam else kind(1, options, 0)


@pytest.mark.parametrize("proposal", ["fastslam1", "fastslam2"])
@pytest.mark.parametrize("kind", [FastSlam, ReferenceFastSlam])
def test_a_named_landmark_predicted_behind_the_camera_starts_no_second_one(kind: Any, proposal: str) -> None:
    """What a particle predicts where no camera sees is not matched; nor does its name begin another landmark."""
    slam = filter_of(kind, proposal)
    frame = Measurements([[0.0, 0.0, 2.0]], np.eye(1, 4, dtype=np.float32))
    slam.step([None], [frame], identities=[[4]])
    report = slam.step([[5.0, 0.0, 0.0]], [frame], identities=[[4]])
    assert (report.num_created, report.num_rejected) == (0, 1)


@pytest.mark.parametrize("proposal", ["fastslam1", "fastslam2"])
@pytest.mark.parametrize("kind", [FastSlam, ReferenceFastSlam])
def test_an_id_given_twice_in_a_frame_starts_one_landmark(kind: Any, proposal: str) -> None:
    """Of two measurements of one name that no landmark has yet, the first begins it and the other is rejected."""
    slam = filter_of(kind, proposal)
    frame = Measurements([[0.0, 0.0, 2.0], [0.5, 0.0, 3.0]], np.eye(2, 4, dtype=np.float32))
    report = slam.step([None], [frame], identities=[[4, 4]])
    assert (report.num_created, report.num_rejected) == (1, 1)
    report = slam.step([None], [frame], identities=[[4, 4]])
    assert report.num_created == 0
