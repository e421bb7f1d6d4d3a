"""Range finder: distances along a fan of rays in the field of view of a robot's camera."""

from dataclasses import dataclass, field

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, check_array, check_float, check_int
from slam_backend.models.camera import StereoCamera
from vslam_env.world._kernels import cast_scans
from vslam_env.world.visibility import as_coordinate_rows, ray_fan

MOST_RAYS = 100_000  # limit per robot


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class ScanConfig:
    """Field of view, range and true noise of the range finder.

    Attributes:
        num_rays: Number of rays (R), evenly spaced over the field of view from right to left, including its edges.
        half_fov: Half of the field of view [rad]; by default the same as for the camera.
        max_range: Range of a ray without a hit [m].
        sigma: Standard deviation of a reading, as a share of the distance.
    """

    num_rays: int = 32
    half_fov: float = field(default=StereoCamera().half_fov)
    max_range: float = 8.0
    sigma: float = 0.01

    def __post_init__(self) -> None:
        check_int("scan.num_rays", self.num_rays, 2, "Use at least two rays; 32 are a good start.", MOST_RAYS)
        check_float("scan.half_fov", self.half_fov, "Give radians.", at_least=1e-3, at_most=np.pi)
        check_float("scan.max_range", self.max_range, "Give metres.", at_least=1e-3, at_most=1e6)
        check_float("scan.sigma", self.sigma, "Give a share of the distance.", at_least=0.0, at_most=1e6)

    @property
    def ray_angles(self) -> FloatArray:
        """Directions of the rays (R,) [rad], robot frame, increasing to the left."""
        return np.linspace(-self.half_fov, self.half_fov, self.num_rays)


class RangeFinder:
    """Range finders of all robots in one world, which detect walls and other robots.

    Attributes:
        config: Field of view, range and true noise.
        ray_angles: (R,) float64 [rad], robot frame. Directions of the rays; read-only.
    """

    def __init__(self, config: ScanConfig, walls: FloatArray, robot_radius: float = 0.2) -> None:
        self.config = config
        self.ray_angles = as_read_only(config.ray_angles)
        walls = check_array("walls", walls, (None, 4), "Give rows x1 y1 x2 y2 in metres.")
        robot_radius = check_float("robot_radius", robot_radius, "Give metres.", at_least=0.0)
        fan = *ray_fan(config.ray_angles), as_coordinate_rows(walls)
        self._sight = *fan, robot_radius, config.max_range, config.sigma  # in the order of the kernel's arguments

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Read all rays of all robots.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of the draws, always K R of them.

        Returns:
            (K, R) float64 [m] in [0, max_range]. A ray without a hit reads exactly `max_range`.
        """
        ranges = rng.standard_normal((len(poses), len(self.ray_angles)))
        cast_scans(poses, *self._sight, ranges)
        return ranges
