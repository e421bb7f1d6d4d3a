"""Simulated teams, teams that stand at known places, merges by hand, and contacts."""

import copy
import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from builders.comparison import assert_same
from builders.filters import LANDMARKS, frame_of

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.geometry import between, compose, inverse, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.reports import TeamReport
from slam_backend.team.team import TeamSlam

TRUE_CAMERA = StereoCamera()
ASSUMED_CAMERA = StereoCamera(sigma_px=0.4, sigma_disparity_px=0.2)  # twice the true noise
MOTION = OdometryModel()
RADIUS = 5.0  # of the ring [m]
SPEED = 0.2  # along it [m] per step
SEEN = 5  # landmarks per frame
SIZE = 16  # of a descriptor


@dataclass
class SimulatedTeam:
    """Robots at equal angles of a ring, driving round it counter-clockwise.

    Attributes:
        num_robots: K.
        seed: Seed of all random streams.
        num_landmarks: Number of landmarks of each room.
        separate: Each robot has a room of its own, so that no map overlaps another.
        aliased: Separate rooms repeat the same appearances at other places.
    """

    num_robots: int = 3
    seed: int = 0
    num_landmarks: int = 110
    separate: bool = False
    aliased: bool = False
    starts: FloatArray = field(init=False)
    poses: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        angles = 2.1 * np.arange(self.num_robots)
        self.starts = np.column_stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), angles + 0.5 * np.pi])
        self.poses = self.starts.copy()
        rooms = self.num_robots if self.separate else 1
        spread = self.rng.uniform([-10.0, -10.0, -0.8], [10.0, 10.0, 1.0], (rooms, self.num_landmarks, 3))
        looks = self.rng.normal(size=(rooms, self.num_landmarks, SIZE))
        if self.aliased:
            looks[:] = looks[0]
        self.landmarks = spread
        self.descriptors = looks / np.linalg.norm(looks, axis=-1, keepdims=True)
        self._moved = False

    def read(self) -> tuple[list[FloatArray | None], list[Measurements]]:
        """Drive one step (the first time: stand) and return odometry and frames of all robots."""
        odometry: list[FloatArray | None] = [None] * self.num_robots
        frames = []
        for robot in range(self.num_robots):
            if self._moved:
                motion = np.array([SPEED, 0.0, SPEED / RADIUS])
                self.poses[robot] = compose(self.poses[robot], motion)
                odometry[robot] = motion + self.rng.normal(size=3) * MOTION.sigmas(motion)
            frames.append(self._look(robot))
        self._moved = True
        return odometry, frames

    def _look(self, robot: int) -> Measurements:
        """Return a frame of at most `SEEN` of the landmarks in view."""
        room = robot if self.separate else 0
        points = TRUE_CAMERA.camera_from_robot(transform_points(inverse(self.poses[robot]), self.landmarks[room]))
        chosen = self.rng.permutation(np.flatnonzero(TRUE_CAMERA.sees(points)))[:SEEN]
        noise = self.rng.normal(size=(len(chosen), 3)) * [0.2, 0.2, 0.1]
        pixels = TRUE_CAMERA.project(points[chosen]) + noise
        pixels[:, 2] = np.maximum(pixels[:, 2], 0.5)
        looks = self.descriptors[room, chosen] + 0.17 / np.sqrt(SIZE) * self.rng.normal(size=(len(chosen), SIZE))
        return Measurements(TRUE_CAMERA.triangulate(pixels), looks / np.linalg.norm(looks, axis=1, keepdims=True))

    def build(self, **options: object) -> TeamSlam:
        """Return a team that assumes the noise of this simulation, with few particles, not rejuvenated."""
        settings = {
            "seed": self.seed,
            "num_particles": 30,
            "camera": ASSUMED_CAMERA,
            "motion": MOTION,
            "rejuvenate_every": None,
        } | options
        return TeamSlam(self.num_robots, **settings)  # type: ignore[arg-type]

    def run(self, team: TeamSlam, steps: int, contacts: object = None) -> list[TeamReport]:
        """Drive and let the team listen."""
        return [team.step(*self.read(), contacts) for _ in range(steps)]  # type: ignore[arg-type]

    def true_motion(self, robot_a: int, robot_b: int) -> FloatArray:
        """Return (3,) where robot b started, seen from where robot a started."""
        return compose(inverse(self.starts[robot_a]), self.starts[robot_b])

    def position_errors(self, team: TeamSlam) -> FloatArray:
        """Return (K,) distances [m] of believed from true positions, each believed in the robot's own start frame."""
        believed = [
            compose(self.starts[robot], compose(team.start_from_group(robot), team.pose(robot).mean))
            for robot in range(self.num_robots)
        ]
        return np.hypot(*(np.array(believed) - self.poses)[:, :2].T)


NEVER = AttemptOptions(enabled=False)
NO_PAIRS = np.empty((0, 2), np.int64)


def links(num_robots: int, *pairs: tuple[int, int]) -> BoolArray:
    """Return contacts (K, K) between these pairs only."""
    contacts = np.eye(num_robots, dtype=np.bool_)
    for one, other in pairs:
        contacts[one, other] = contacts[other, one] = True
    return contacts


def true_alignment(simulation: SimulatedTeam, team: TeamSlam, robot_a: int, robot_b: int) -> Alignment:
    """Return the true motion between the map frames of two robots' groups, without pairs."""
    motion = simulation.true_motion(team.known_robots(robot_a)[0], team.known_robots(robot_b)[0])
    return Alignment(True, "", *motion, np.diag([1e-4, 1e-4, 1e-6]), NO_PAIRS, 0.0)


def driven(num_robots: int, seed: int, steps: int = 80, **options: object) -> tuple[SimulatedTeam, TeamSlam]:
    """Return a simulation and its team after some steps; the robots do not try to merge unless the options say so."""
    simulation = SimulatedTeam(num_robots, seed)
    team = simulation.build(**({"attempts": NEVER} | options))
    simulation.run(team, steps)
    return simulation, team


def merged_team(simulation: SimulatedTeam, steps: int = 30, **options: object) -> TeamSlam:
    """Return a team whose robots have all been merged, one after the other, by the true motions after some steps."""
    team = simulation.build(**({"attempts": NEVER, "num_particles": 13} | options))
    simulation.run(team, steps)
    for robot in range(1, simulation.num_robots):
        team.merge(0, robot, true_alignment(simulation, team, 0, robot))
    return team


def false_alignment(simulation: SimulatedTeam, team: TeamSlam, offset: FloatArray) -> Alignment:
    """Return the true motion between the maps of robots 0 and 1 plus an offset (3,), with the eight nearest pairs."""
    motion = simulation.true_motion(0, 1) + offset
    points_a, points_b = team.map(0).means[:, :2], team.map(1).means
    moved = compose(motion, np.column_stack([points_b[:, :2], np.zeros(len(points_b))]))[:, :2]
    distances = np.linalg.norm(points_a[:, None] - moved, axis=2)
    pairs = []
    for _ in range(8):
        row, column = np.unravel_index(distances.argmin(), distances.shape)
        pairs.append((row, column))
        distances[row] = distances[:, column] = np.inf
    return Alignment(True, "", *motion, 1e-3 * np.eye(3), np.array(pairs), 0.0)


def begin_undo(team: TeamSlam) -> None:
    """Begin to undo the oldest merge of the first group."""
    group = team._groups[0]
    process = team._merges.joined[group.merge_numbers[0]]
    assert process.joined is not None
    process.phase = team._merges.rollback(process.joined, group)


STARTS = np.array([[0.5, -1.0, 0.3], [4.0, 3.0, 2.0], [9.0, 1.0, -2.5], [2.0, 6.0, -1.2]])  # world
COMMON = np.arange(5)  # names of the landmarks that all robots see first, so that these have ids 0 to 4 in every map
SIGMA = 1e-4


def standing_team(num_robots: int = 3, seed: int = 0) -> TeamSlam:
    """Robots at `STARTS` that have seen the common landmarks, and one more each, from where they stand."""
    rng = np.random.default_rng(seed)
    team = TeamSlam(num_robots, seed=seed, num_particles=7, rejuvenate_every=None)
    names = [np.append(COMMON, 5 + robot) for robot in range(num_robots)]
    frames = []
    for robot, seen in enumerate(names):
        points = transform_points(inverse(STARTS[robot]), LANDMARKS[seen])
        frames.append(frame_of(points + SIGMA * rng.normal(size=points.shape), seen, SIGMA))
    team.step([None] * num_robots, frames, identities=names)
    return team


def hand_made(team: TeamSlam, robot_a: int, robot_b: int) -> Alignment:
    """Return the true alignment of two robots' groups: of the start frames of their lowest robots."""
    first = {robot: group[0] for group in team.groups for robot in group}
    motion = between(STARTS[first[robot_a]], STARTS[first[robot_b]])
    return Alignment(True, "", *motion, 1e-6 * np.eye(3), np.column_stack([COMMON, COMMON]), 0.0)


def check_snapshot(simulation: SimulatedTeam, team: TeamSlam, contacts: Iterable[object]) -> list[TeamReport]:
    """Check that a team restored from a snapshot does, bit for bit, what the team does, and return the reports.

    Args:
        simulation: Goes on by a step for each entry of `contacts`.
        team: Team whose snapshot is taken and pickled; later steps do not change it.
        contacts: Contacts at each step.
    """
    state = pickle.loads(pickle.dumps(team.get_state()))
    kept, restored = copy.deepcopy(state), TeamSlam(simulation.num_robots, seed=99)
    restored.set_state(state)
    reports = []
    for links_now in contacts:
        read = simulation.read()
        reports.append(team.step(*read, links_now))  # type: ignore[arg-type]
        assert_same(restored.step(*read, links_now), reports[-1])  # type: ignore[arg-type]
    assert_same(restored.get_state(), team.get_state())
    assert_same(state, kept)
    return reports
