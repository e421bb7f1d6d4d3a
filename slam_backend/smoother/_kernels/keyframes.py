"""Keyframes from a robot's new steps, and the landmarks that their measurements belong to."""

import math

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place, inline, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother.log_arrays import ODOMETRY, REJECTED


@in_place
def rename(names: IntArray, aliases: IntArray) -> None:
    """Give landmarks the names by which they go, in place: (n,) int64, and rows (name, name it goes by) in order."""
    for row in range(len(aliases)):
        old, new = aliases[row, 0], aliases[row, 1]
        for n in range(len(names)):
            if names[n] == old:
                names[n] = new


@device
@in_place
def number(names: IntArray, order: IntArray, ids: IntArray, first: IntArray) -> int:
    """Number the landmarks of measurements; those that are new come after the known ones.

    Args:
        names: (n,) int64. Of each measurement's landmark; changed: its row of `ids`.
        order: (l,) int64. Rows of the known landmarks by ascending name.
        ids: (l + n,) int64. Their names, each once; those of the new ones are written from row l on.
        first: (n,) int64, result, of which the first rows are written: the first measurement of each new one.

    Returns:
        How many landmarks there are then.
    """
    known, num = len(order), len(order)
    for n in range(len(names)):
        name, low, high = names[n], 0, known
        while low < high:
            middle = (low + high) // 2
            if ids[order[middle]] < name:
                low = middle + 1
            else:
                high = middle
        row = order[low] if low < known and ids[order[low]] == name else known
        if row == known:
            while row < num and ids[row] != name:
                row += 1
            if row == num:
                ids[num], first[num - known] = name, n
                num += 1
        names[n] = row
    return num


@device
@in_place
def place(
    poses: FloatArray, frame_keys: IntArray, offsets: FloatArray, frames: IntArray, points: FloatArray,
    chosen: IntArray, mount: FloatArray, places: FloatArray,
) -> None:  # fmt: skip
    """Write where some measured points lie in the map.

    Args:
        poses: (k, 3) float64 [m, m, rad]. Of the keys, map frame.
        frame_keys, offsets: (f,), (f, 3) key of each frame, and the frame seen from it.
        frames, points: (n,), (n, 3) [m] frame of each point, and the point, robot axes, from the camera centre.
        chosen: (m,) which of them.
        mount: (3,) [m] of the camera on the robot.
        places: (m, 3) [m], map frame, result.
    """
    for i in range(len(chosen)):
        point, frame = points[chosen[i]], frames[chosen[i]]
        pose, offset = poses[frame_keys[frame]], offsets[frame]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = pose[0] + c * offset[0] - s * offset[1], pose[1] + s * offset[0] + c * offset[1]
        c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
        ahead, left = point[0] + mount[0], point[1] + mount[1]
        places[i, 0], places[i, 1] = x + c * ahead - s * left, y + s * ahead + c * left
        places[i, 2] = point[2] + mount[2]


@device
@jit
def start_keyframe(
    condensed_landmarks: IntArray, counts: IntArray, point_landmarks: IntArray, new_landmarks: IntArray,
    names: IntArray,
    held: IntArray, means: FloatArray, landmarks: FloatArray,
) -> None:  # fmt: skip
    """Put those landmarks where a filter holds them to be that have more new measurements than old ones.

    Args:
        condensed_landmarks, counts: (s,) landmark of each frozen sighting, and the measurements in it.
        point_landmarks: (n,) of each old raw measurement.
        new_landmarks: (m,) of each new one.
        names: (l,) int64. Of the landmarks.
        held, means: (h,) int64, ascending, (h, 3) [m]. Names of those that the filter holds, and where.
        landmarks: (l, 3) float64 [m], map frame; changed.
    """
    more = np.zeros(len(names), dtype=np.int64)
    for n in range(len(condensed_landmarks)):
        more[condensed_landmarks[n]] -= counts[n]
    for landmark in point_landmarks:
        more[landmark] -= 1
    for landmark in new_landmarks:
        more[landmark] += 1
    for landmark in range(len(names)):
        if more[landmark] > 0:
            at = np.searchsorted(held, names[landmark])
            if at < len(held) and held[at] == names[landmark]:
                landmarks[landmark] = means[at]


@jit
def close_keyframe(
    aliases: IntArray, known: int, names: IntArray, points: FloatArray, frames: IntArray, poses: FloatArray,
    frame_keys: IntArray, offsets: FloatArray, mount: FloatArray, anew: bool, condensed_landmarks: IntArray,
    counts: IntArray, point_landmarks: IntArray, held: IntArray, means: FloatArray, ids: IntArray,
    landmarks: FloatArray,
) -> int:  # fmt: skip
    """Number the landmarks of new measurements, and say where those are that are new, or have more new ones than old.

    Args:
        aliases: As of `rename`.
        known: How many landmarks there are before.
        names, points, frames: (n,), (n, 3), (n,) of the new measurements, as of `number` and `place`; names change.
        poses, frame_keys, offsets, mount: As of `place`.
        anew: Whether landmarks `start_keyframe`.
        condensed_landmarks, counts, point_landmarks, held, means: As of that.
        ids, landmarks: (l + n,), (l + n, 3) names and places; those of the new ones are written from row l on.

    Returns:
        How many landmarks there are then.
    """
    rename(names, aliases)
    first = np.empty(len(names), dtype=np.int64)
    num = number(names, np.argsort(ids[:known]), ids, first)
    place(poses, frame_keys, offsets, frames, points, first[: num - known], mount, landmarks[known:num])
    if anew:
        start_keyframe(condensed_landmarks, counts, point_landmarks, names, ids[:num], held, means, landmarks[:num])
    return num


@inline
def _wrapped(angle: float) -> float:
    """Return an angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@inline
def _chain(chain: FloatArray, noise: FloatArray, move: FloatArray, variances: FloatArray) -> None:
    """Append a motion, whose parts err independently, to a chain (3,) and its covariance (3, 3), to first order."""
    c, s = math.cos(chain[2]), math.sin(chain[2])
    dx, dy = c * move[0] - s * move[1], s * move[0] + c * move[1]
    n02, n12, n22 = noise[0, 2], noise[1, 2], noise[2, 2]
    noise[0, 0] += -2.0 * dy * n02 + dy * dy * n22 + c * c * variances[0] + s * s * variances[1]
    noise[0, 1] += dx * n02 - dy * n12 - dx * dy * n22 + c * s * (variances[0] - variances[1])
    noise[1, 1] += 2.0 * dx * n12 + dx * dx * n22 + s * s * variances[0] + c * c * variances[1]
    noise[0, 2] -= dy * n22
    noise[1, 2] += dx * n22
    noise[2, 2] += variances[2]
    noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]
    chain[0] += dx
    chain[1] += dy
    chain[2] = _wrapped(chain[2] + move[2])


@device
@jit
def add_keyframes(
    kinds: NDArray[np.int8],
    motions: FloatArray,
    variances: FloatArray,
    counts: IntArray,
    guesses: FloatArray,
    robot: int,
    rigid_within: float,
    lever: float,
    keys: int,
    frames: int,
    tips: IntArray,
    robots: IntArray,
    poses: FloatArray,
    previous: IntArray,
    key_motions: FloatArray,
    key_noises: FloatArray,
    spreads: FloatArray,
    slack: FloatArray,
    frame_keys: IntArray,
    offsets: FloatArray,
) -> tuple[int, int]:
    """Walk through the steps of a robot's log, T of them.

    Args:
        kinds: (T,) int8. STOOD or ODOMETRY.
        motions: (T, 3) float64 [m, m, rad]. Odometry of each step, in the frame of the pose before.
        variances: (T, 3) float64. Of its parts.
        counts: (T,) int64. Measurements of each step.
        guesses: (T, 3) float64 [m, m, rad]. Where the robot is thought to be, map frame; NaN where odometry says.
        robot: Whose log it is.
        rigid_within: [m]. A step that measured something becomes a key unless odometry since the last key scatters
            less; see `SmoothingOptions`.
        lever: [m]. Where an error of the heading is felt.
        keys, frames: How many there are before.
        tips: (K,) int64. The newest key of each robot, changed.
        robots, poses, previous, key_motions, key_noises, spreads, slack: (k, ...) columns of `SlamGraph` with room for
            the new keys. Written from row `keys` on; and the slack of the newest old key, where frames stand to it.
        frame_keys, offsets: (f,), (f, 3) columns of `SlamGraph`, likewise from row `frames` on.

    Returns:
        The number of keys and of frames.
    """
    tip = tips[robot]
    moved = False
    pose, chain, noise = poses[tip].copy(), np.zeros(3), np.zeros((3, 3))
    last = len(kinds) - 1
    for t in range(len(kinds)):
        if kinds[t] == ODOMETRY:
            _chain(chain, noise, motions[t], variances[t])
            c, s = math.cos(pose[2]), math.sin(pose[2])
            pose[0] += c * motions[t, 0] - s * motions[t, 1]
            pose[1] += s * motions[t, 0] + c * motions[t, 1]
            pose[2] = _wrapped(pose[2] + motions[t, 2])
            moved = True
        if not math.isnan(guesses[t, 0]):
            pose[:] = guesses[t]
        scatter = noise[0, 0] + noise[1, 1] + lever * lever * noise[2, 2]
        far = counts[t] > 0 and scatter >= rigid_within * rigid_within
        if moved and (far or t == last):
            robots[keys], previous[keys], poses[keys] = robot, tip, pose
            key_motions[keys], key_noises[keys], spreads[keys] = chain, noise, scatter
            chain[:] = 0.0
            noise[:] = 0.0
            scatter, moved = 0.0, False
            tip, slack[keys] = keys, 0.0
            keys += 1
        if counts[t] > 0:
            slack[tip] = max(slack[tip], scatter)
            frame_keys[frames], offsets[frames] = tip, chain
            frames += 1
    tips[robot] = tip
    return keys, frames


@device
@jit
def select_measurements(
    ids: IntArray, points: FloatArray, given: BoolArray, covariances: FloatArray, starts: IntArray, num: int,
    frame: int, counts: IntArray, taken: FloatArray, noises: FloatArray, taken_given: BoolArray, frames: IntArray,
    names: IntArray,
) -> int:  # fmt: skip
    """Take the measurements of a log of T steps that bear a name.

    Args:
        ids, points: (n,) int64, (n, 3) [m]. Names of the measurements, `REJECTED` for none; and where they lie.
        given: (T,) whether those of a step came with covariances.
        covariances: (n, 6) [m^2], (0, 6) where there are none at all.
        starts: (T + 1,) int64. Those of step t are starts[t] to starts[t + 1].
        num, frame: How many measurements and frames there are before.
        counts: (T,) int64, result: how many of each step are taken.
        taken, noises, taken_given, frames, names: (m, ...), written from row `num` on: point of each that is taken, its
            covariance, zeros without, whether it was given, its frame, and its name; a step of which any is taken makes
            one frame.

    Returns:
        How many measurements there are then.
    """
    for t in range(len(counts)):
        first = num
        for row in range(starts[t], starts[t + 1]):
            if ids[row] != REJECTED:
                taken[num], taken_given[num], frames[num], names[num] = points[row], given[t], frame, ids[row]
                if len(covariances) > 0:
                    noises[num] = covariances[row]
                else:
                    noises[num] = 0.0
                num += 1
        counts[t] = num - first
        frame += num > first
    return num


@in_place
def find_initial_poses(known: IntArray, poses: FloatArray, steps: IntArray, found: FloatArray) -> None:
    """Write the pose of each step, NaN if it is not known.

    Args:
        known, poses: (n,) ascending, (n, 3).
        steps: (m,) ascending.
        found: (m, 3), result.
    """
    at = 0
    for t in range(len(steps)):
        while at < len(known) and known[at] < steps[t]:
            at += 1
        if at < len(known) and known[at] == steps[t]:
            for axis in range(3):
                found[t, axis] = poses[at, axis]
        else:
            found[t] = math.nan


@jit
def add_log(
    steps: IntArray, kinds: NDArray[np.int8], motions: FloatArray, given: BoolArray, starts: IntArray,
    measured: FloatArray, ids: IntArray, covariances: FloatArray, variances: FloatArray, known: IntArray,
    known_poses: FloatArray, robot: int, rigid_within: float, lever: float, keys: int, frames: int, num: int,
    tips: IntArray, robots: IntArray, poses: FloatArray, previous: IntArray, key_motions: FloatArray,
    key_noises: FloatArray, spreads: FloatArray, slack: FloatArray, frame_keys: IntArray, offsets: FloatArray,
    points: FloatArray, noises: FloatArray, taken_given: BoolArray, point_frames: IntArray, names: IntArray,
) -> tuple[int, int, int, bool]:  # fmt: skip
    """Take in a robot's log of T steps: where it is supposed to be, what was measured, and what becomes a key.

    Args:
        steps, kinds, motions, given, starts, measured, ids, covariances: Of the log, as of `walk` and `choose`.
        variances: As of `walk`.
        known, known_poses: Poses after some steps, as of `find_initial_poses`.
        robot, rigid_within, lever, keys, frames, tips: As of `walk`.
        num: How many measurements there are before.
        robots, poses, previous, key_motions, key_noises, spreads, slack, frame_keys, offsets: As of `walk`, written.
        points, noises, taken_given, point_frames, names: As of `choose`, written.

    Returns:
        How many keys, frames and measurements there are then; and whether it is supposed to be anywhere after the first
        step that measured something, and so after all of these.
    """
    count = len(steps)
    supposed, counts = np.empty((count, 3)), np.empty(count, dtype=np.int64)
    find_initial_poses(known, known_poses, steps, supposed)
    num = select_measurements(
        ids, measured, given, covariances, starts, num, frames, counts, points, noises, taken_given, point_frames, names
    )
    keys, frames = add_keyframes(
        kinds, motions, variances, counts, supposed, robot, rigid_within, lever, keys, frames, tips, robots, poses,
        previous, key_motions, key_noises, spreads, slack, frame_keys, offsets,
    )  # fmt: skip
    first = 0
    while first < count and starts[first + 1] == 0:
        first += 1
    return keys, frames, num, first == count or not math.isnan(supposed[first, 0])
