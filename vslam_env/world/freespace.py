"""Free space of a world: reachable places, observable landmarks and start poses."""

from typing import Any

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_array, check_float, check_int
from slam_backend.geometry import wrap_angle
from slam_backend.models.camera import StereoCamera
from vslam_env.world._kernels import cast_scans, observable_anywhere
from vslam_env.world.clearance import clearance_raster, distances_to_walls
from vslam_env.world.spec import FARTHEST_PLACE, Landmarks, World
from vslam_env.world.visibility import as_coordinate_rows, ray_fan, view_limits, visible_landmarks

CELL = 0.1  # [m] side of a raster cell
AREA_STEP = 2  # [cells] side of the squares that measure free area
VIEW_AHEAD = 1.5  # [m] preferred free distance ahead of a start pose
MAX_INCIDENCE = np.radians(60.0)


class FreeSpace:
    """Reachable part of a world on a raster of 0.1 m.

    It is the connected part that contains the first start pose of the world, or else the largest enclosed one. A cell
    is reachable if the robot's disc fits at every position of its centre in the cell.

    Attributes:
        world: World of the walls.
        radius: Radius of the robots [m].
        origin: (2,) float64 [m], world frame. Lower left corner of cell (0, 0).
        reachable: (H, W) bool, row = y upwards. Cells that can contain a robot's centre.
        open_space: (H, W) bool. Cells connected to the reachable ones, including gaps too narrow for a robot.
        free_area_cells: (n, 2) float64 [m], world frame. Centres of the 0.2 m squares in the open space that no wall
            touches: the area to explore.

    Raises:
        ValueError: If the walls enclose no space large enough for a robot.
    """

    def __init__(self, world: World, radius: float = 0.2) -> None:
        self.world = world
        self.radius = check_float("robot_radius", radius, "Give the radius of a robot in metres.", above=0.0)
        x_min, y_min, x_max, y_max = world.bounds
        padding = 3 * CELL
        self.origin = np.array([x_min - padding, y_min - padding])
        rows, columns = (int(np.ceil((span + 2 * padding) / CELL)) for span in (y_max - y_min, x_max - x_min))
        half_diagonal = 0.5 * np.sqrt(2.0) * CELL
        margin = radius + half_diagonal
        clearance = clearance_raster(world.walls, self.origin, CELL, rows, columns, margin + CELL)
        # Cells more than half a cell from any wall: no step between edge neighbours crosses a wall.
        labels = _label(clearance > 0.5 * CELL + 1e-6)
        fits = _label(clearance >= margin)
        outside = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        fits[np.isin(labels, outside)] = 0
        if not fits.any():
            raise argument_error(
                "world",
                f"walls that enclose free space for a disc of radius {radius:g} m anywhere in a {CELL:g} m cell",
                f"no such cell in {world.name!r}",
                f"Close the outer walls, make rooms {2 * radius + 0.3:g} m wide, or check that the unit is metres.",
            )
        self.reachable: BoolArray = fits == self._main_part(fits)
        self.open_space: BoolArray = labels == labels[self.reachable][0]
        squares = self.open_space & (clearance > 0.5 * AREA_STEP * CELL)
        every_second = np.zeros_like(squares)
        every_second[::AREA_STEP, ::AREA_STEP] = True
        self.free_area_cells: FloatArray = self._centres(squares & every_second)

    def _main_part(self, fits: Any) -> int:
        """Return the label of the part with the first start pose, or else of the largest part."""
        if self.world.start_poses is not None and len(self.world.start_poses):
            distances = np.linalg.norm(self._centres(fits > 0) - self.world.start_poses[0, :2], axis=1)
            return int(fits[fits > 0][np.argmin(distances)])
        return int(np.argmax(np.bincount(fits[fits > 0])))

    def _centres(self, mask: BoolArray) -> FloatArray:
        """Return the centres (n, 2) [m], world frame, of the cells of a mask (H, W)."""
        rows, columns = np.nonzero(mask)
        return np.asarray(self.origin + CELL * (np.stack([columns, rows], axis=1) + 0.5))

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which points (n, 2) [m], world frame, lie in the open space."""
        columns, rows = np.floor((np.asarray(points) - self.origin) / CELL).astype(np.int64).T
        height, width = self.open_space.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return np.asarray(inside & self.open_space[rows.clip(0, height - 1), columns.clip(0, width - 1)])

    def visible_landmarks(
        self, landmarks: Landmarks, camera: StereoCamera, max_incidence: float = MAX_INCIDENCE
    ) -> BoolArray:
        """Return which landmarks are observable: visible from some reachable place at some heading.

        Args:
            landmarks: Landmarks of the world.
            camera: Camera; its range, height and vertical field of view matter.
            max_incidence: Largest angle between line of sight and face normal at which landmarks are visible [rad].

        Returns:
            (N,) bool. True for observable landmarks, whose number is N in the map error.
        """
        return observable_anywhere(
            landmarks.positions,
            landmarks.normals,
            landmarks.walls,
            self.world.walls,
            self.reachable,
            self.origin,
            CELL,
            view_limits(camera, max_incidence),
        )

    def draw_starts(
        self,
        num_robots: int,
        rng: np.random.Generator,
        min_distance: float = 5.0,
        no_shared_view: StereoCamera | None = None,
        landmarks: Landmarks | None = None,
        max_incidence: float = MAX_INCIDENCE,
    ) -> FloatArray:
        """Draw start poses in the reachable part of the world.

        Args:
            num_robots: Number of robots K.
            rng: Source of the draws.
            min_distance: Least distance between any two robots [m].
            no_shared_view: Camera with which no two robots may see a common landmark; None: views may overlap.
            landmarks: Landmarks to see; None: those of the world, if any.
            max_incidence: Largest angle of incidence, see `visible_landmarks` [rad].

        Returns:
            (K, 3) float64 [m, m, rad], world frame. Start poses.

        Raises:
            ValueError: If 30 rounds of 100 draws find no start poses for all robots.
        """
        num_robots = check_int("num_robots", num_robots, 1, "Use at least one robot.")
        min_distance = check_float("min_distance", min_distance, "Give metres.", at_least=0.0)
        landmarks = self.world.landmarks if landmarks is None else landmarks
        centres = self._centres(self.reachable)
        spacing = max(min_distance, 2.0 * self.radius)
        for _ in range(30):
            starts = np.empty((0, 3))
            claimed = np.zeros(0 if landmarks is None else len(landmarks), dtype=np.bool_)
            for _ in range(100):
                position = centres[rng.integers(len(centres))] + rng.uniform(-0.5 * CELL, 0.5 * CELL, 2)
                if len(starts) and np.linalg.norm(starts[:, :2] - position, axis=1).min() < spacing:
                    continue
                pose = np.array([*position, self._draw_heading(position, rng)])
                if landmarks is not None and no_shared_view is not None:
                    view = view_limits(no_shared_view, max_incidence)
                    seen = visible_landmarks(pose[None], landmarks, self.world.walls, self.radius, view)[0]
                    if np.any(seen & claimed):
                        continue
                    claimed |= seen
                starts = np.vstack([starts, pose])
                if len(starts) == num_robots:
                    return starts
        unshared = " with no shared view" if no_shared_view is not None else ""
        raise argument_error(
            "num_robots",
            f"at most as many as fit {min_distance:g} m apart{unshared} in {self.world.name!r}",
            num_robots,
            "Use fewer robots, a smaller start distance, shared start views, or a larger world.",
        )

    def _draw_heading(self, position: FloatArray, rng: np.random.Generator) -> float:
        """Draw a heading [rad] with free space ahead, or any if eight draws find none."""
        headings = rng.uniform(-np.pi, np.pi, 8)
        poses, free = np.empty((len(headings), 3)), np.zeros((len(headings), 1))
        poses[:, :2], poses[:, 2] = position, headings
        cast_scans(poses, *ray_fan(np.zeros(1)), as_coordinate_rows(self.world.walls), 0.0, VIEW_AHEAD, 0.0, free)
        return float(headings[int(np.argmax(free[:, 0] >= VIEW_AHEAD))])

    def check_starts(self, start_poses: Any, num_robots: int | None = None) -> FloatArray:
        """Validate start poses; return them as (K, 3) float64 [m, m, rad], theta in [-pi, pi).

        Args:
            start_poses: (K, 3) [m, m, rad], world frame. Start poses.
            num_robots: Expected number of robots K; None: any.

        Raises:
            ValueError: If a shape is wrong, or a robot touches a wall, is outside the reachable space, or overlaps
                another. The message names the robot.
        """
        hint = "Give one row x y theta, in metres and radians, for each robot."
        starts = check_array("start_poses", start_poses, (num_robots, 3), hint, within=FARTHEST_PLACE)
        starts[:, 2] = wrap_angle(starts[:, 2])
        gaps = distances_to_walls(starts[:, :2], self.world.walls)
        near = self._near_reachable(starts[:, :2])
        for robot, (gap, inside) in enumerate(zip(gaps, near, strict=True)):
            name = f"start_poses[{robot}]"
            if not inside:
                raise argument_error(
                    name, "a reachable place", starts[robot].tolist(), "Move the robot inside the walls."
                )
            if gap < self.radius:
                raise argument_error(
                    name,
                    f"a place at least {self.radius:g} m (the robot's radius) from any wall",
                    f"a distance of {gap:.3f} m",
                    "Move the robot away from the wall.",
                )
            others = np.linalg.norm(starts[:robot, :2] - starts[robot, :2], axis=1)
            if robot and others.min() < 2.0 * self.radius:
                raise argument_error(
                    name,
                    f"a place at least {2 * self.radius:g} m from the other robots",
                    f"a distance of {others.min():.3f} m to robot {int(np.argmin(others))}",
                    "Move the robots apart.",
                )
        return starts

    def _near_reachable(self, points: FloatArray) -> BoolArray:
        """Return which points (n, 2) [m] lie in the open space within two cells of a reachable cell."""
        import cv2  # slow import, needed only to make worlds

        grown = cv2.dilate(self.reachable.astype(np.uint8), np.ones((5, 5), dtype=np.uint8)) > 0
        columns, rows = np.floor((points - self.origin) / CELL).astype(np.int64).T
        height, width = grown.shape
        return np.asarray(self.contains(points) & grown[rows.clip(0, height - 1), columns.clip(0, width - 1)])


def _label(mask: BoolArray) -> Any:
    """Label the 4-connected components of a mask: (H, W) int32, 0 where False."""
    import cv2

    return cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
