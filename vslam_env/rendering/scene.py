"""What a picture shows: plain frozen arrays in the world frame, free of simulator and filter."""

from dataclasses import dataclass

from slam_backend.core.validation import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RobotView:
    """One robot: where it is, where it believes to be, and the map it holds.

    Estimates are moved by the robot's true start pose, so that drift shows as distance from the truth.

    Attributes:
        true_pose: (3,) float64 [m, m, rad].
        true_path: (T, 2) float64 [m]. Positions up to now, oldest first; may be empty.
        estimated_pose: (3,) float64 [m, m, rad].
        estimated_path: (T, 2) float64 [m]. The pose estimates as they were made, oldest first; may be empty.
        particles: (M, 3) float64 [m, m, rad].
        landmark_means: (n, 3) float64 [m].
        landmark_covariances: (n, 3, 3) float64 [m^2].
        sight_lines: (k, 2) float64 [m]. Where the lines from the true position to the landmarks seen now end.
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
    """A merge that has just happened.

    Attributes:
        age_ticks: Ticks since then, >= 0.
        robots_a: Indices of the robots of one group.
        robots_b: Indices of the robots of the other.
    """

    age_ticks: int
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that one frame shows.

    Attributes:
        walls: (S, 4) float64 [m]. Segments (x1, y1, x2, y2).
        landmarks: (N, 3) float64 [m]. True positions.
        robots: One view per robot.
        tick: Ticks since the reset.
        time: Simulated time since the reset [s].
        robot_radius: [m].
        merges: Recent merges; a drawing may leave out old ones.
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
