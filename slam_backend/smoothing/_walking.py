"""A robot's new steps, compiled: which of them become keys, where the others stand to these, what was measured."""

import math

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import inlined, jit
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.log_arrays import ODOMETRY, REJECTED


@inlined
def _wrapped(angle: float) -> float:
    """Return an angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@inlined
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


@jit
def walk(
    kinds: NDArray[np.int8],
    motions: FloatArray,
    variances: FloatArray,
    counts: IntArray,
    guessed: BoolArray,
    guesses: FloatArray,
    start: FloatArray,
    rigid_within: float,
    lever: float,
    poses: FloatArray,
    key_motions: FloatArray,
    key_noises: FloatArray,
    slack: FloatArray,
    frame_keys: IntArray,
    offsets: FloatArray,
) -> tuple[int, int]:
    """Walk through the steps of a log, T of them.

    Args:
        kinds: (T,) int8. STOOD or ODOMETRY.
        motions: (T, 3) float64 [m, m, rad]. Odometry of each step, in the frame of the pose before.
        variances: (T, 3) float64. Of its parts.
        counts: (T,) int64. Measurements of each step.
        guessed, guesses: (T,) and (T, 3) [m, m, rad]. Whether, and where, the robot is thought to be, map frame; else
            odometry says.
        start: (3,) float64 [m, m, rad]. The pose before, that of the robot's newest key.
        rigid_within: [m]. A step that measured something becomes a key unless odometry since the last key scatters
            less; see `SmoothingOptions`.
        lever: [m]. Where an error of the heading is felt.
        poses, key_motions, key_noises: (T, 3), (T, 3), (T, 3, 3); the first rows are written: the new keys, map frame,
            and the odometry to each from the key before.
        slack: (T + 1,) float64 [m^2]. Written: the largest scatter of a frame against its key, first that of the newest
            old key, then those of the new ones.
        frame_keys, offsets: (T,), (T, 3); the first rows are written: new key of each frame, -1 for the newest old
            one, and where the frame stands seen from it.

    Returns:
        The number of new keys and of frames.
    """
    keys, frames = 0, 0
    moved = False
    pose, chain, noise = start.copy(), np.zeros(3), np.zeros((3, 3))
    slack[0] = 0.0
    last = len(kinds) - 1
    for t in range(len(kinds)):
        if kinds[t] == ODOMETRY:
            _chain(chain, noise, motions[t], variances[t])
            c, s = math.cos(pose[2]), math.sin(pose[2])
            pose[0] += c * motions[t, 0] - s * motions[t, 1]
            pose[1] += s * motions[t, 0] + c * motions[t, 1]
            pose[2] = _wrapped(pose[2] + motions[t, 2])
            moved = True
        if guessed[t]:
            pose[:] = guesses[t]
        scatter = noise[0, 0] + noise[1, 1] + lever * lever * noise[2, 2]
        far = counts[t] > 0 and scatter >= rigid_within * rigid_within
        if moved and (far or t == last):
            poses[keys], key_motions[keys], key_noises[keys] = pose, chain, noise
            chain[:] = 0.0
            noise[:] = 0.0
            scatter, moved = 0.0, False
            keys += 1
            slack[keys] = 0.0
        if counts[t] > 0:
            slack[keys] = max(slack[keys], scatter)
            frame_keys[frames] = keys - 1
            offsets[frames] = chain
            frames += 1
    return keys, frames


@jit
def choose(ids: IntArray, starts: IntArray, counts: IntArray, rows: IntArray, frames: IntArray) -> int:
    """Say which measurements of a log of T steps are taken: those that bear a name.

    Args:
        ids: (n,) int64. Names of the measurements, `REJECTED` for none.
        starts: (T + 1,) int64. Those of step t are starts[t] to starts[t + 1].
        counts: (T,) int64, result: how many of each step are taken.
        rows, frames: (n,) int64, results, of which the first rows are written: those measurements, and their frames; a
            step of which any is taken makes one.

    Returns:
        How many there are.
    """
    num, frame = 0, 0
    for t in range(len(counts)):
        first = num
        for row in range(starts[t], starts[t + 1]):
            if ids[row] != REJECTED:
                rows[num], frames[num] = row, frame
                num += 1
        counts[t] = num - first
        frame += num > first
    return num


@jit
def place(
    poses: FloatArray, frame_keys: IntArray, offsets: FloatArray, frames: IntArray, points: FloatArray,
    mount: FloatArray, places: FloatArray,
) -> None:  # fmt: skip
    """Write where measured points lie in the map.

    Args:
        poses: (k, 3) float64 [m, m, rad]. Of the keys, map frame.
        frame_keys, offsets: (f,), (f, 3) key of each frame, and the frame seen from it.
        frames, points: (n,), (n, 3) [m] frame of each point, and the point, robot axes, from the camera centre.
        mount: (3,) [m] of the camera on the robot.
        places: (n, 3) [m], map frame, result.
    """
    for n in range(len(points)):
        pose, offset = poses[frame_keys[frames[n]]], offsets[frames[n]]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = pose[0] + c * offset[0] - s * offset[1], pose[1] + s * offset[0] + c * offset[1]
        c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
        ahead, left = points[n, 0] + mount[0], points[n, 1] + mount[1]
        places[n, 0], places[n, 1] = x + c * ahead - s * left, y + s * ahead + c * left
        places[n, 2] = points[n, 2] + mount[2]


@jit
def mostly_new(
    frozen_landmarks: IntArray, counts: IntArray, point_landmarks: IntArray, new_landmarks: IntArray, num: int
) -> BoolArray:
    """Return (num,) which landmarks have more new measurements than old ones.

    Args:
        frozen_landmarks, counts: (s,) landmark of each frozen sighting, and the measurements in it.
        point_landmarks: (n,) of each old raw measurement.
        new_landmarks: (m,) of each new one.
        num: Of landmarks.
    """
    more = np.zeros(num, dtype=np.int64)
    for n in range(len(frozen_landmarks)):
        more[frozen_landmarks[n]] -= counts[n]
    for landmark in point_landmarks:
        more[landmark] -= 1
    for landmark in new_landmarks:
        more[landmark] += 1
    return more > 0
