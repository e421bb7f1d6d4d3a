"""A small simulated team: robots that drive round a ring among scattered landmarks, and what they read."""

from dataclasses import dataclass, field

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.reports import TeamReport
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
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
        seed: Of everything.
        num_landmarks: Of each room.
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
        """Return a team that assumes the noise of this simulation, with few particles."""
        settings = {"seed": self.seed, "num_particles": 30, "camera": ASSUMED_CAMERA, "motion": MOTION} | options
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
