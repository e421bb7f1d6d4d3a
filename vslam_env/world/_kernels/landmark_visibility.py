"""Which landmarks cameras see and detect, and which can be seen at all.

A camera at (x, y) with axis theta looks along its own x axis; `ahead` and `left` are coordinates in that frame.
"""

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.world._kernels.ray_casting import EPSILON, indices_of_set, ray_to_disc, ray_to_wall, walls_in_wedge

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
def _find_visible(
    robot: int,
    poses: FloatArray,
    marks: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    robot_radius: float,
    view: FloatArray,
    near: FloatArray,
    near_rows: IntArray,
    rows: IntArray,
) -> int:
    """Find the landmarks that a robot's camera sees.

    Args:
        robot: Its row of the poses.
        poses: As of `visible`, as what follows.
        marks: (5, N) float64.
        own_walls: (N,) int64.
        walls: (4, S) float64.
        robot_radius: [m].
        view: (7,) float64.
        near: (S, 4) float64. Room for the walls ahead.
        near_rows: (S,) int64. Room for which they are.
        rows: (N,) int64. Written to: their indices, in rising order.

    Returns:
        How many they are.
    """
    forward, aside, height, max_range, tan_half, tan_vertical, cos_incidence = view
    c, s = np.cos(poses[robot, 2]), np.sin(poses[robot, 2])
    eye_x, eye_y = poses[robot, 0] + c * forward - s * aside, poses[robot, 1] + s * forward + c * aside
    num_near = walls_in_wedge(eye_x, eye_y, c, s, walls, tan_half + EPSILON, max_range, near, near_rows)
    for n in range(marks.shape[1]):
        dx, dy, dz = marks[0, n] - eye_x, marks[1, n] - eye_y, marks[2, n] - height
        ahead, left = c * dx + s * dy, c * dy - s * dx
        rows[n] = (ahead > TOUCH) & (abs(left) <= tan_half * ahead) & (abs(dz) <= tan_vertical * ahead)
    count = 0
    for n in rows[: indices_of_set(rows)]:
        dx, dy, dz = marks[0, n] - eye_x, marks[1, n] - eye_y, marks[2, n] - height
        ahead, left = c * dx + s * dy, c * dy - s * dx
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if distance > max_range or -(dx * marks[3, n] + dy * marks[4, n]) <= cos_incidence * distance:
            continue
        if _hidden(0.0, 0.0, ahead, left, own_walls[n], near[:num_near], near_rows):
            continue
        length = np.sqrt(ahead * ahead + left * left)
        free = True
        for j in range(len(poses)):
            if j != robot and free:
                ox, oy = poses[j, 0] - eye_x, poses[j, 1] - eye_y
                x, y = c * ox + s * oy, c * oy - s * ox
                free = ray_to_disc(ahead / length, left / length, x, y, robot_radius) >= length
        if free:
            rows[count] = n
            count += 1
    return count


@device
@jit
def _visibility_workspace(num_walls: int, num_landmarks: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Return what `_find_visible` works in and writes to."""
    return np.empty((num_walls, 4)), np.empty(num_walls, np.int64), np.empty(num_landmarks, np.int64)


@jit
def visible(
    poses: FloatArray,
    marks: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    robot_radius: float,
    view: FloatArray,
    seen: BoolArray,
) -> None:
    """Write down which landmarks each robot's camera sees.

    A landmark is seen if it lies in range and in the image, if its face is seen at less than the largest incidence,
    and if neither another wall nor another robot stands between. Its own wall does not hide it.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        marks: (5, N) float64, world frame. Positions [m] and normals [-] of the landmarks; by rows, for vector
            instructions.
        own_walls: (N,) int64. Index of the wall that carries each landmark.
        walls: (4, S) float64 [m], world frame. By rows as well.
        robot_radius: Of the other robots [m]; robots are as tall as their cameras.
        view: (7,) float64. See `view_limits`.
        seen: (K, N) bool. Written to.
    """
    seen[:] = False
    near, near_rows, rows = _visibility_workspace(walls.shape[1], marks.shape[1])
    for k in range(len(poses)):
        count = _find_visible(k, poses, marks, own_walls, walls, robot_radius, view, near, near_rows, rows)
        for n in rows[:count]:
            seen[k, n] = True


@device
@in_place
def choose_detected(
    visible: IntArray, keys: FloatArray, detection_probability: float, places: int, chosen: IntArray
) -> int:
    """Detect landmarks and choose among the detected ones.

    A landmark with a uniform key in [0, 1) is detected if the key is below the probability. The detected ones with the
    smallest keys are then a uniform choice in uniformly random order.

    Args:
        visible: (n,) int64. Indices of visible landmarks.
        keys: (N,) float64, uniform. Of all landmarks.
        detection_probability: Of a visible landmark.
        places: How many may be chosen.
        chosen: (at least places,) int64. Written to: the chosen landmarks.

    Returns:
        How many are chosen.
    """
    count = 0
    for n in visible:
        if keys[n] >= detection_probability:
            continue
        if count < places:
            at = count
            count += 1
        elif count > 0 and keys[n] < keys[chosen[count - 1]]:
            at = count - 1
        else:
            continue
        while at > 0 and keys[chosen[at - 1]] > keys[n]:
            chosen[at] = chosen[at - 1]
            at -= 1
        chosen[at] = n
    return count


@jit
def detect(
    poses: FloatArray,
    marks: FloatArray,
    own_walls: IntArray,
    walls: FloatArray,
    robot_radius: float,
    view: FloatArray,
    keys: FloatArray,
    detection_probability: float,
    num_false: IntArray,
    chosen: IntArray,
    counts: IntArray,
) -> tuple[int, int]:
    """Choose among the landmarks that each camera sees and detects.

    Args:
        poses: (K, 3) float64. As of `visible`, as what follows.
        marks: (5, N) float64.
        own_walls: (N,) int64.
        walls: (4, S) float64.
        robot_radius: [m].
        view: (7,) float64.
        keys: (K, N) float64, uniform. See `choose`.
        detection_probability: Likewise.
        num_false: (K,) int64. Places that false points take in the frame of each robot; changed to B where larger.
        chosen: (K, B) int64. Written to: the chosen landmarks of each robot.
        counts: (K,) int64. Written to: how many they are.

    Returns:
        How many are chosen in all, and how many false points there are.
    """
    near, near_rows, rows = _visibility_workspace(walls.shape[1], marks.shape[1])
    total = extra = 0
    for k in range(len(poses)):
        count = _find_visible(k, poses, marks, own_walls, walls, robot_radius, view, near, near_rows, rows)
        num_false[k] = min(num_false[k], chosen.shape[1])
        places = chosen.shape[1] - num_false[k]
        counts[k] = choose_detected(rows[:count], keys[k], detection_probability, places, chosen[k])
        total, extra = total + counts[k], extra + num_false[k]
    return total, extra


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
        view: As in `visible`.

    Returns:
        (N,) bool.
    """
    spacing = 0.2
    _, _, height, max_range, _, tan_vertical, cos_incidence = view
    seen = np.zeros(len(positions), dtype=np.bool_)
    indices = np.arange(len(walls))
    for n in range(len(positions)):
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
                    if reachable[row, column] and not _hidden(x + dx, y + dy, -dx, -dy, own_walls[n], walls, indices):
                        seen[n] = True
                        break
            radius += spacing
    return seen
