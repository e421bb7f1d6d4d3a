"""Compiled geometry of sight: what rays hit, which landmarks a camera sees, and whether they can be seen at all.

All kernels live in this one module because they call each other. A camera at (x, y) with axis theta looks along its
own x axis; `ahead` and `left` are coordinates in that frame.
"""

import numpy as np

from slam_backend._jit import jit
from slam_backend.camera import StereoCamera
from slam_backend.errors import BoolArray, FloatArray, IntArray

EPSILON = 1e-9  # walls that share an end point leave no gap between them
TOUCH = 1e-6  # [m] what a ray meets this close to its target does not hide the target


def view_limits(camera: StereoCamera, max_incidence: float) -> FloatArray:
    """Return what a camera can see in the order that `see` expects it.

    Args:
        camera: The robots'.
        max_incidence: Between the line of sight and a face's normal [rad]; more oblique faces show nothing.

    Returns:
        (4,) float64: its range [m], tangents of half its fields of view across and upright, cosine of `max_incidence`.
    """
    return np.array(
        [
            camera.max_range,
            np.tan(camera.half_fov),
            np.tan(camera.half_vertical_fov),
            np.cos(max_incidence),
        ]
    )


@jit
def walls_in_wedge(pose: FloatArray, walls: FloatArray, tan_half: float, reach: float) -> tuple[FloatArray, IntArray]:
    """Return the walls that may cut a wedge ahead.

    A wall is dropped only if both its ends lie beyond the same side of the wedge or of the circle's bounding box, so
    none that matters is lost.

    Args:
        pose: (3,) float64 [m, m, rad], world frame. Where the wedge begins; its axis is the pose's x axis.
        walls: (S, 4) float64 [m], world frame.
        tan_half: The wedge opens by +-atan of this around its axis; <= 0 stands for all round.
        reach: Its length [m].

    Returns:
        Walls (n, 4) float64 [m], in the frame of `pose`, and their indices (n,) int64.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    local = np.empty((len(walls), 4))
    indices = np.empty(len(walls), dtype=np.int64)
    n = 0
    for i in range(len(walls)):
        dx1, dy1 = walls[i, 0] - pose[0], walls[i, 1] - pose[1]
        dx2, dy2 = walls[i, 2] - pose[0], walls[i, 3] - pose[1]
        x1, y1 = c * dx1 + s * dy1, c * dy1 - s * dx1
        x2, y2 = c * dx2 + s * dy2, c * dy2 - s * dx2
        if min(x1, x2) > reach or max(x1, x2) < -reach or min(y1, y2) > reach or max(y1, y2) < -reach:
            continue
        if tan_half > 0.0:
            if y1 > tan_half * x1 and y2 > tan_half * x2:
                continue
            if -y1 > tan_half * x1 and -y2 > tan_half * x2:
                continue
        local[n, 0], local[n, 1], local[n, 2], local[n, 3] = x1, y1, x2, y2
        indices[n] = i
        n += 1
    return local[:n], indices[:n]


@jit
def _ray_to_wall(dx: float, dy: float, x1: float, y1: float, x2: float, y2: float) -> float:
    """Solve t (dx, dy) = p1 + u (p2 - p1) for t >= 0 with u in [0, 1]; infinity when there is no such t."""
    ex, ey = x2 - x1, y2 - y1
    cross = dx * ey - dy * ex
    if cross == 0.0:
        return np.inf
    u = (x1 * dy - y1 * dx) / cross
    if u < -EPSILON or u > 1.0 + EPSILON:
        return np.inf
    t = (x1 * ey - y1 * ex) / cross
    return t if t >= 0.0 else np.inf


@jit
def _ray_to_disc(dx: float, dy: float, x: float, y: float, radius: float) -> float:
    """Return the distance along the unit vector (dx, dy) to a disc at (x, y) ahead; infinity if the ray misses it."""
    along = x * dx + y * dy
    inside = radius * radius - (x * x + y * y - along * along)
    if along <= 0.0 or inside <= 0.0:
        return np.inf
    return float(max(0.0, along - np.sqrt(inside)))


@jit
def rays_at(angles: FloatArray) -> tuple[FloatArray, float]:
    """Return unit vectors (R, 2) at angles (R,) [rad], and the tangent of the wedge that holds them all.

    The wedge is that of `walls_in_wedge`; the tangent is 0, for all round, where it is not much less than a half plane.
    """
    rays = np.empty((len(angles), 2))
    for r in range(len(angles)):
        rays[r, 0], rays[r, 1] = np.cos(angles[r]), np.sin(angles[r])
    widest = np.max(np.abs(angles))
    return rays, np.tan(widest) + EPSILON if widest < 1.5 else 0.0


@jit
def cast_scans(
    poses: FloatArray,
    rays: FloatArray,
    tan_half: float,
    walls: FloatArray,
    robot_radius: float,
    max_range: float,
    sigma: float,
    ranges: FloatArray,
) -> None:
    """Read how far each robot can look along each of its rays.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame.
        rays, tan_half: Of `rays_at`, robot frame. The same for all robots.
        walls: (S, 4) float64 [m], world frame.
        robot_radius: Of the other robots, which stop rays [m].
        max_range: Where rays end [m]; what ends there is read without error.
        sigma: Standard deviation of a reading, as a share of the distance.
        ranges: (K, R) float64. Standard normal draws; the readings [m], from 0 to `max_range`, take their places.
    """
    others = np.empty((len(poses), 2))
    for k in range(len(poses)):
        near, _ = walls_in_wedge(poses[k], walls, tan_half, max_range)
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        num_others = 0
        for j in range(len(poses)):
            ox, oy = poses[j, 0] - poses[k, 0], poses[j, 1] - poses[k, 1]
            if j != k and max(abs(ox), abs(oy)) <= max_range + robot_radius:
                others[num_others, 0], others[num_others, 1] = c * ox + s * oy, c * oy - s * ox
                num_others += 1
        for r in range(len(rays)):
            dx, dy = rays[r]
            nearest = max_range
            for i in range(len(near)):
                nearest = min(nearest, _ray_to_wall(dx, dy, near[i, 0], near[i, 1], near[i, 2], near[i, 3]))
            for j in range(num_others):
                nearest = min(nearest, _ray_to_disc(dx, dy, others[j, 0], others[j, 1], robot_radius))
            if nearest < max_range:
                nearest = min(max(nearest * (1.0 + sigma * ranges[k, r]), 0.0), max_range)
            ranges[k, r] = nearest


@jit
def _hidden(x: float, y: float, dx: float, dy: float, own_wall: int, walls: FloatArray, indices: IntArray) -> bool:
    """Tell whether a wall other than `own_wall` crosses the sight line from (x, y) to (x + dx, y + dy)."""
    length = np.sqrt(dx * dx + dy * dy)
    for i in range(len(walls)):
        if indices[i] != own_wall:
            t = _ray_to_wall(dx, dy, walls[i, 0] - x, walls[i, 1] - y, walls[i, 2] - x, walls[i, 3] - y)
            if t * length < length - TOUCH:
                return True
    return False


def visible_landmarks(
    poses: FloatArray,
    positions: FloatArray,
    normals: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    robot_radius: float,
    mount: FloatArray,
    view: FloatArray,
) -> BoolArray:
    """Tell which landmarks (K, N) each robot's camera sees; arguments as of `see`."""
    seen = np.empty((len(poses), len(positions)), dtype=np.bool_)
    see(poses, positions, normals, own_walls, walls, robot_radius, mount, view, seen)
    return seen


@jit
def see(
    poses: FloatArray,
    positions: FloatArray,
    normals: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    robot_radius: float,
    mount: FloatArray,
    view: FloatArray,
    seen: BoolArray,
) -> None:
    """Write down which landmarks each robot's camera sees.

    A landmark is seen if it lies in range and in the image, if its face is seen at less than the largest incidence,
    and if neither another wall nor another robot stands between. Its own wall does not hide it.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        positions: (N, 3) float64 [m], world frame.
        normals: (N, 2) float64 [-], world frame.
        own_walls: (N,) int64. Index of the wall that carries each landmark.
        walls: (S, 4) float64 [m], world frame.
        robot_radius: Of the other robots [m]; robots are as tall as their cameras.
        mount: (3,) float64 [m], robot frame. Place of the camera.
        view: (4,) float64. Range [m], tangents of half the horizontal and vertical field of view, and the cosine of
            the largest incidence.
        seen: (K, N) bool. Written to.
    """
    max_range, tan_half, tan_vertical, cos_incidence = view
    seen[:] = False
    camera = np.empty(3)
    for k in range(len(poses)):
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        camera[0] = poses[k, 0] + c * mount[0] - s * mount[1]
        camera[1] = poses[k, 1] + s * mount[0] + c * mount[1]
        camera[2] = poses[k, 2]
        near, indices = walls_in_wedge(camera, walls, tan_half + EPSILON, max_range)
        for n in range(len(positions)):
            dx, dy, dz = positions[n, 0] - camera[0], positions[n, 1] - camera[1], positions[n, 2] - mount[2]
            ahead, left = c * dx + s * dy, c * dy - s * dx
            if ahead <= TOUCH or abs(left) > tan_half * ahead or abs(dz) > tan_vertical * ahead:
                continue
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if distance > max_range or -(dx * normals[n, 0] + dy * normals[n, 1]) <= cos_incidence * distance:
                continue
            if _hidden(0.0, 0.0, ahead, left, own_walls[n], near, indices):
                continue
            length = np.sqrt(ahead * ahead + left * left)
            free = True
            for j in range(len(poses)):
                if j != k and free:
                    ox, oy = poses[j, 0] - camera[0], poses[j, 1] - camera[1]
                    forward, side = c * ox + s * oy, c * oy - s * ox
                    free = _ray_to_disc(ahead / length, left / length, forward, side, robot_radius) >= length
            seen[k, n] = free


@jit
def seen_from_somewhere(
    positions: FloatArray,
    normals: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    reachable: BoolArray,
    origin: FloatArray,
    cell: float,
    camera_height: float,
    view: FloatArray,
) -> BoolArray:
    """Tell which landmarks a camera sees from at least one reachable place, turned towards them.

    Places are tried on circles around each landmark, 0.2 m apart and from near to far, so that the search ends early
    for nearly all.

    Args:
        positions: (N, 3) float64 [m], world frame.
        normals: (N, 2) float64 [-], world frame.
        own_walls: (N,) int64.
        walls: (S, 4) float64 [m], world frame.
        reachable: (H, W) bool, row = y upwards. Cells in which a robot can stand.
        origin: (2,) float64 [m], world frame. Lower left corner of cell (0, 0).
        cell: Side of a cell [m].
        camera_height: z of the camera [m].
        view: As in `see`.

    Returns:
        (N,) bool.
    """
    spacing = 0.2
    max_range, _, tan_vertical, cos_incidence = view
    seen = np.zeros(len(positions), dtype=np.bool_)
    indices = np.arange(len(walls))
    for n in range(len(positions)):
        dz = abs(positions[n, 2] - camera_height)
        facing = np.arctan2(normals[n, 1], normals[n, 0])
        radius = spacing
        while radius <= max_range and not seen[n]:
            distance = np.sqrt(radius * radius + dz * dz)
            widest = np.arccos(min(1.0, cos_incidence * distance / radius))  # incidence counts the height, too
            if distance <= max_range and dz <= tan_vertical * radius and widest > 0.0:
                half = int(np.ceil(widest * radius / spacing))
                for i in range(-half + 1, half):
                    bearing = facing + i * widest / half
                    dx, dy = radius * np.cos(bearing), radius * np.sin(bearing)
                    column = int(np.floor((positions[n, 0] + dx - origin[0]) / cell))
                    row = int(np.floor((positions[n, 1] + dy - origin[1]) / cell))
                    if row < 0 or column < 0 or row >= reachable.shape[0] or column >= reachable.shape[1]:
                        continue
                    x, y = positions[n, 0], positions[n, 1]
                    if reachable[row, column] and not _hidden(x + dx, y + dy, -dx, -dy, own_walls[n], walls, indices):
                        seen[n] = True
                        break
            radius += spacing
    return seen
