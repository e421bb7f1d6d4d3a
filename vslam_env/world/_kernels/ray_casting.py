"""What rays hit: walls in a wedge, other robots' discs, and whole scans."""

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import FloatArray, IntArray

EPSILON = 1e-9  # walls that share an end point leave no gap between them


@device
@in_place
def indices_of_set(rows: IntArray) -> int:
    """Write which of some flags (n,), 0 or 1, are up in their place, first of all, and return how many are.

    There are no branches, for none could be foreseen.
    """
    count = 0
    for i in range(len(rows)):
        flag = rows[i]
        rows[count] = i
        count += flag
    return count


@in_place
def walls_in_wedge(
    x: float,
    y: float,
    cosine: float,
    sine: float,
    walls: FloatArray,
    tan_half: float,
    reach: float,
    near: FloatArray,
    rows: IntArray,
) -> int:
    """Find the walls that may cut a wedge ahead.

    A wall is dropped only if both its ends lie beyond the same side of the wedge or of the circle's bounding box, so
    none that matters is lost.

    Args:
        x: Apex of the wedge [m], world frame.
        y: See `x`.
        cosine: Cosine of the direction of its axis.
        sine: Sine of the direction of its axis.
        walls: (4, S) float64 [m], world frame. Walls as rows of coordinates, for vector instructions.
        tan_half: The wedge opens by +-atan of this around its axis; <= 0 stands for all round.
        reach: Length of the wedge [m].
        near: (S, 4) float64 [m], in the frame of the wedge. Written to: the ends of these walls, one after the other.
        rows: (S,) int64. Written to: their indices.

    Returns:
        Number of these walls.
    """
    c, s = cosine, sine
    for i in range(walls.shape[1]):
        dx1, dy1, dx2, dy2 = walls[0, i] - x, walls[1, i] - y, walls[2, i] - x, walls[3, i] - y
        x1, y1 = c * dx1 + s * dy1, c * dy1 - s * dx1
        x2, y2 = c * dx2 + s * dy2, c * dy2 - s * dx2
        beyond = (x1 > reach) & (x2 > reach) | (x1 < -reach) & (x2 < -reach)
        beyond |= (y1 > reach) & (y2 > reach) | (y1 < -reach) & (y2 < -reach)
        beside = (y1 > tan_half * x1) & (y2 > tan_half * x2) | (-y1 > tan_half * x1) & (-y2 > tan_half * x2)
        rows[i] = not (beyond | ((tan_half > 0.0) & beside))
    count = indices_of_set(rows)
    for k in range(count):  # moving all of them before would take twice as long
        i = rows[k]
        for end in (0, 2):
            dx, dy = walls[end, i] - x, walls[end + 1, i] - y
            near[k, end], near[k, end + 1] = c * dx + s * dy, c * dy - s * dx
    return count


@device
@in_place
def ray_to_wall(dx: float, dy: float, x1: float, y1: float, x2: float, y2: float) -> float:
    """Solve t (dx, dy) = p1 + u (p2 - p1) for t >= 0 with u in [0, 1]; infinity when there is no such t."""
    ex, ey = x2 - x1, y2 - y1
    cross = dx * ey - dy * ex
    divisor = cross if cross != 0.0 else 1.0  # the compiler then sees that it needs no branch
    u, t = (x1 * dy - y1 * dx) / divisor, (x1 * ey - y1 * ex) / divisor
    meets = (cross != 0.0) & (u >= -EPSILON) & (u <= 1.0 + EPSILON) & (t >= 0.0)
    return t if meets else np.inf


@device
@in_place
def ray_to_disc(dx: float, dy: float, x: float, y: float, radius: float) -> float:
    """Return the distance along the unit vector (dx, dy) to a disc at (x, y) ahead; infinity if the ray misses it."""
    along = x * dx + y * dy
    inside = radius * radius - (x * x + y * y - along * along)
    if along <= 0.0 or inside <= 0.0:
        return np.inf
    return float(max(0.0, along - np.sqrt(inside)))


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
        rays, tan_half: (2, R) float64 and float. Results of `ray_fan`, the same for all robots.
        walls: (4, S) float64 [m], world frame. See `walls_in_wedge`.
        robot_radius: Radius of the other robots, which stop rays [m].
        max_range: Length of the rays [m]; a ray that hits nothing reads it without error.
        sigma: Standard deviation of a reading, as a share of the distance.
        ranges: (K, R) float64. Standard normal draws; the readings [m], from 0 to `max_range`, take their places.
    """
    others, nearest = np.empty((len(poses), 2)), np.empty(rays.shape[1])
    near, rows = np.empty((walls.shape[1], 4)), np.empty(walls.shape[1], np.int64)
    for k in range(len(poses)):
        x, y, theta = poses[k]
        c, s = np.cos(theta), np.sin(theta)
        num_near = walls_in_wedge(x, y, c, s, walls, tan_half, max_range, near, rows)
        num_others = 0
        for j in range(len(poses)):
            ox, oy = poses[j, 0] - x, poses[j, 1] - y
            if j != k and max(abs(ox), abs(oy)) <= max_range + robot_radius:
                others[num_others, 0], others[num_others, 1] = c * ox + s * oy, c * oy - s * ox
                num_others += 1
        nearest[:] = max_range
        for i in range(num_near):
            x1, y1, x2, y2 = near[i]
            for r in range(rays.shape[1]):
                nearest[r] = min(nearest[r], ray_to_wall(rays[0, r], rays[1, r], x1, y1, x2, y2))
        for j in range(num_others):
            for r in range(rays.shape[1]):
                hit = ray_to_disc(rays[0, r], rays[1, r], others[j, 0], others[j, 1], robot_radius)
                nearest[r] = min(nearest[r], hit)
        for r in range(rays.shape[1]):
            read = nearest[r]
            if read < max_range:
                read = min(max(read * (1.0 + sigma * ranges[k, r]), 0.0), max_range)
            ranges[k, r] = read
