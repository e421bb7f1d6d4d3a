"""Which landmarks cameras see and detect, and which can be seen at all.

A camera at (x, y) with axis theta looks along its own x axis; `ahead` and `left` are coordinates in that frame.
"""

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.world._kernels.ray_casting import EPSILON, ray_to_disc, ray_to_wall, walls_in_wedge

GROUP = 16  # successive landmarks, which lie side by side, whose bounds are compared with the range at once
TOUCH = 1e-6  # [m] what a ray meets this close to its target does not hide the target


@device
@in_place
def _hidden(x: float, y: float, dx: float, dy: float, own_wall: int, walls: FloatArray, indices: IntArray) -> bool:
    """Tell whether a wall other than `own_wall` crosses the sight line from (x, y) to (x + dx, y + dy)."""
    length = np.sqrt(dx * dx + dy * dy)
    for i in range(len(walls)):
        if indices[i] != own_wall:
            t = ray_to_wall(dx, dy, walls[i, 0] - x, walls[i, 1] - y, walls[i, 2] - x, walls[i, 3] - y)
            if t * length < length - TOUCH:
                return True
    return False


@device
@in_place
def rows_in_view(
    x: float, y: float, cosine: float, sine: float, marks: FloatArray, bounds: FloatArray, limits: FloatArray,
    rows: IntArray,
) -> int:  # fmt: skip
    """List the landmarks in view of a camera at (x, y), ignoring occlusion, in ascending order.

    Args:
        x, y: Camera [m], world frame.
        cosine, sine: Direction of its axis.
        marks, bounds, limits: Landmarks, bounds of their groups, and limits of view, see `detect`.
        rows: (N,) int64. Written to: indices of these landmarks.

    Returns:
        Number of these landmarks.
    """
    _, _, height, max_range, tan_half, tan_vertical, cos_incidence = limits
    in_image = 0
    for group in range(len(bounds)):
        low_x, low_y, high_x, high_y = bounds[group]
        apart = max(low_x - x, x - high_x, low_y - y, y - high_y)
        if apart > max_range:
            continue
        first, end = group * GROUP, min((group + 1) * GROUP, marks.shape[1])
        for n in range(first, end):
            dx, dy, dz = marks[0, n] - x, marks[1, n] - y, marks[2, n] - height
            ahead, left = cosine * dx + sine * dy, cosine * dy - sine * dx
            rows[n] = (ahead > TOUCH) & (abs(left) <= tan_half * ahead) & (abs(dz) <= tan_vertical * ahead)
        for n in range(first, end):  # without branches, for none could be foreseen
            flag = rows[n]
            rows[in_image] = n
            in_image += flag
    count = 0
    for i in range(in_image):
        n = rows[i]
        dx, dy, dz = marks[0, n] - x, marks[1, n] - y, marks[2, n] - height
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        rows[count] = n
        count += not (distance > max_range or -(dx * marks[3, n] + dy * marks[4, n]) <= cos_incidence * distance)
    return count


@jit
def detect(
    poses: FloatArray,
    sight: tuple[FloatArray, FloatArray, IntArray, FloatArray, float, FloatArray],
    keys: FloatArray,
    detection_probability: float,
    num_false: IntArray,
    chosen: IntArray,
    counts: IntArray,
) -> tuple[int, int]:
    """Choose among the landmarks that each robot's camera sees and detects.

    A landmark is seen if it lies in range and in the image, if its face is seen at less than the largest incidence,
    and if neither another wall nor another robot stands between. Its own wall does not hide it. With a uniform key in
    [0, 1) it is detected if the key is below the probability. The detected landmarks with the smallest keys are then a
    uniform choice in uniformly random order.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        sight: Arrays that determine which landmarks cameras see from any pose:
            (5, N) float64, world frame. Positions [m] and normals [-] of the landmarks; by rows, for vector
            instructions.
            (n, 4) float64 [m]. Bounds x, y, x, y of each `GROUP` successive landmarks; distant ones are skipped.
            (N,) int64. Index of the wall that carries each landmark.
            (4, S) float64 [m], world frame. Walls, by rows as well.
            Radius of the robots [m]; they are as tall as their cameras.
            (7,) float64. See `view_limits`.
        keys: (K, N) float64, uniform. Key of each landmark for each robot; those out of view are not read.
        detection_probability: Probability that a visible landmark is detected.
        num_false: (K,) int64. Places that false points take in the frame of each robot; changed to B where larger.
        chosen: (K, B) int64. Written to: the chosen landmarks of each robot.
        counts: (K,) int64. Written to: how many they are.

    Returns:
        Number of chosen landmarks, and number of false points.
    """
    marks, bounds, own_walls, walls, robot_radius, limits = sight
    forward, aside, _, max_range, tan_half, _, _ = limits
    near, near_rows = np.empty((walls.shape[1], 4)), np.empty(walls.shape[1], np.int64)
    rows = np.empty(marks.shape[1], np.int64)
    total = extra = 0
    for k in range(len(poses)):
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        eye_x, eye_y = poses[k, 0] + c * forward - s * aside, poses[k, 1] + s * forward + c * aside
        num_near = walls_in_wedge(eye_x, eye_y, c, s, walls, tan_half + EPSILON, max_range, near, near_rows)
        num_rows = rows_in_view(eye_x, eye_y, c, s, marks, bounds, limits, rows)

        num_false[k] = min(num_false[k], chosen.shape[1])
        places, count, own_keys, own = chosen.shape[1] - num_false[k], 0, keys[k], chosen[k]
        for n in rows[:num_rows]:
            is_worse = count == places and (count == 0 or own_keys[n] >= own_keys[own[count - 1]])
            if own_keys[n] >= detection_probability or is_worse:
                continue
            dx, dy = marks[0, n] - eye_x, marks[1, n] - eye_y
            ahead, left = c * dx + s * dy, c * dy - s * dx
            if _hidden(0.0, 0.0, ahead, left, own_walls[n], near[:num_near], near_rows):
                continue
            length, free = np.sqrt(ahead * ahead + left * left), True
            for j in range(len(poses)):
                if j != k and free:
                    ox, oy = poses[j, 0] - eye_x, poses[j, 1] - eye_y
                    x, y = c * ox + s * oy, c * oy - s * ox
                    free = ray_to_disc(ahead / length, left / length, x, y, robot_radius) >= length
            if free:
                count = min(count + 1, places)
                at = count - 1
                while at > 0 and own_keys[own[at - 1]] > own_keys[n]:
                    own[at] = own[at - 1]
                    at -= 1
                own[at] = n
        counts[k] = count
        total, extra = total + count, extra + num_false[k]
    return total, extra


@device
@in_place
def _walls_around(x: float, y: float, walls: FloatArray, reach: float, near: FloatArray, rows: IntArray) -> int:
    """Copy the walls (S, 4) that may come within reach of (x, y) and their indices; return their number."""
    count = 0
    for i in range(len(walls)):
        x1, y1, x2, y2 = walls[i]
        if max(x1, x2) < x - reach or min(x1, x2) > x + reach or max(y1, y2) < y - reach or min(y1, y2) > y + reach:
            continue
        for k in range(4):
            near[count, k] = walls[i, k]
        rows[count] = i
        count += 1
    return count


@jit
def observable_anywhere(
    positions: FloatArray,
    normals: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    reachable: BoolArray,
    origin: FloatArray,
    cell: float,
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
        view: (7,) float64. See `view_limits`.

    Returns:
        (N,) bool.
    """
    spacing = 0.2
    _, _, height, max_range, _, tan_vertical, cos_incidence = view
    seen = np.zeros(len(positions), dtype=np.bool_)
    near, near_rows = np.empty((len(walls), 4)), np.empty(len(walls), np.int64)
    for n in range(len(positions)):
        count = _walls_around(positions[n, 0], positions[n, 1], walls, max_range + spacing, near, near_rows)
        dz = abs(positions[n, 2] - height)
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
                    if not reachable[row, column]:
                        continue
                    if not _hidden(x + dx, y + dy, -dx, -dy, own_walls[n], near[:count], near_rows):
                        seen[n] = True
                        break
            radius += spacing
    return seen
