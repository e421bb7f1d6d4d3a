"""Content of a picture: plain arrays in the world frame, independent of simulator and filters."""

from dataclasses import dataclass

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray
from vslam_env.rendering.palette import shared_by


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RobotView:
    """True and estimated poses and map of one robot.

    Estimates are moved by the robot's true start pose, so that drift appears as distance from the truth.

    Attributes:
        true_pose: (3,) float64 [m, m, rad]. True pose.
        true_path: (T, 2) float64 [m]. True positions so far, oldest first; may be empty.
        estimated_pose: (3,) float64 [m, m, rad]. Estimated pose.
        estimated_path: (T, 2) float64 [m]. Online position estimates, oldest first; may be empty.
        particles: (M, 3) float64 [m, m, rad]. Pose in each particle.
        landmark_means: (n, 3) float64 [m]. Means of the map's landmarks.
        landmark_covariances: (n, 3, 3) float64 [m^2]. Covariances of the map's landmarks.
        sight_lines: (k, 2) float64 [m]. True positions of the landmarks seen in the last tick.
        group: Label of the robot's group; robots with the same label share one map.
    """

    true_pose: FloatArray
    true_path: FloatArray
    estimated_pose: FloatArray
    estimated_path: FloatArray
    particles: FloatArray
    landmark_means: FloatArray
    landmark_covariances: FloatArray
    sight_lines: FloatArray
    group: int


@dataclass(frozen=True, slots=True)
class MergeFlash:
    """Recent merge of two groups.

    Attributes:
        age_ticks: Ticks since the merge, >= 0.
        robots_a: Indices of the robots of one group.
        robots_b: Indices of the robots of the other.
    """

    age_ticks: int
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Content of one frame.

    Attributes:
        walls: (S, 4) float64 [m]. Wall segments (x1, y1, x2, y2).
        landmarks: (N, 3) float64 [m]. True positions.
        robots: View of each robot.
        tick: Ticks since the reset.
        time: Simulated time since the reset [s].
        robot_radius: Radius of the robots [m].
        merges: Recent merges; a drawing may omit older ones.
        map_errors: Map error of each robot [m].
        coverage: Share of the reachable free area that has been seen, in [0, 1].
    """

    walls: FloatArray
    landmarks: FloatArray
    robots: tuple[RobotView, ...]
    tick: int
    time: float
    robot_radius: float
    merges: tuple[MergeFlash, ...]
    map_errors: tuple[float, ...]
    coverage: float

    @property
    def map_owners(self) -> tuple[int, ...]:
        """First robot of each robot's group, whose map is drawn, in its colour, for the group."""
        return shared_by([robot.group for robot in self.robots])
