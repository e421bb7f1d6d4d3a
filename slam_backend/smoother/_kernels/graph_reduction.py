"""Keyframe reduction in place: keys are joined, their measurements condensed, and what is unused is dropped."""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit, stack_array
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother._kernels.factors import _rotate_in_plane


@jit
def drop_unused(
    kept: BoolArray, condensed_landmarks: IntArray, points: FloatArray, point_noises: FloatArray, given: BoolArray,
    point_frames: IntArray, point_landmarks: IntArray, frame_keys: IntArray, frame_offsets: FloatArray,
    landmark_ids: IntArray, landmarks: FloatArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Leave some raw measurements, and those frames and landmarks of which anything is left that was measured.

    Args:
        kept: (n,) which raw measurements are left.
        condensed_landmarks: (s,) of the frozen sightings; changed: where these are then.
        points, point_noises, given, point_frames, point_landmarks, frame_keys, frame_offsets, landmark_ids, landmarks:
            Columns of `SlamGraph`. Changed: what is left are the first rows, which name each other by where they are.

    Returns:
        How many measurements, frames and landmarks are left.
    """
    num = 0
    frame_numbers, landmark_numbers = np.full(len(frame_keys), NONE), np.full(len(landmark_ids), NONE)
    for n in range(len(kept)):
        if kept[n]:
            frame_numbers[point_frames[n]], landmark_numbers[point_landmarks[n]] = 0, 0
            points[num], point_noises[num], given[num] = points[n], point_noises[n], given[n]
            point_frames[num], point_landmarks[num] = point_frames[n], point_landmarks[n]
            num += 1
    for landmark in condensed_landmarks:
        landmark_numbers[landmark] = 0
    frames = 0
    for f in range(len(frame_keys)):
        if frame_numbers[f] != NONE:
            frame_keys[frames], frame_offsets[frames], frame_numbers[f] = frame_keys[f], frame_offsets[f], frames
            frames += 1
    left = 0
    for row in range(len(landmark_ids)):
        if landmark_numbers[row] != NONE:
            landmark_ids[left], landmarks[left], landmark_numbers[row] = landmark_ids[row], landmarks[row], left
            left += 1
    for n in range(num):
        point_frames[n] = frame_numbers[point_frames[n]]
        point_landmarks[n] = landmark_numbers[point_landmarks[n]]
    for s in range(len(condensed_landmarks)):
        condensed_landmarks[s] = landmark_numbers[condensed_landmarks[s]]
    return num, frames, left


NONE = -1


@inline
def _wrapped_heading(angle: float) -> float:
    """Return an angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@inline
def _compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write the motion a followed by b, all (3,) [m, m, rad]; `out` may be b."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1]
    out[0], out[1], out[2] = x, y, _wrapped_heading(a[2] + b[2])


@inline
def _turned(c: float, s: float, a: FloatArray, out: FloatArray) -> None:
    """Write R A R^T for a symmetric A (3, 3) and the rotation (c, s) about the vertical; `out` may be A."""
    a00, a01, a02, a11, a12, a22 = a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2]
    out[0, 0] = c * c * a00 - 2.0 * c * s * a01 + s * s * a11
    out[0, 1] = c * s * (a00 - a11) + (c * c - s * s) * a01
    out[0, 2] = c * a02 - s * a12
    out[1, 1] = s * s * a00 + 2.0 * c * s * a01 + c * c * a11
    out[1, 2] = s * a02 + c * a12
    out[2, 2] = a22
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@device
@in_place
def chain(first: FloatArray, first_noise: FloatArray, motion: FloatArray, noise: FloatArray) -> None:
    """Put a motion before another, in place, and its covariance, to first order.

    Args:
        first, first_noise: (3,) [m, m, rad], (3, 3) in the frame in which it begins.
        motion, noise: (3,), (3, 3) of what follows, in the frame to which the first one leads; changed: both together.
    """
    c, s = math.cos(first[2]), math.sin(first[2])
    ahead, left = -(s * motion[0] + c * motion[1]), c * motion[0] - s * motion[1]
    _turned(c, s, noise, noise)
    n02, n12, n22 = first_noise[0, 2], first_noise[1, 2], first_noise[2, 2]
    noise[0, 0] += first_noise[0, 0] + 2.0 * ahead * n02 + ahead * ahead * n22
    noise[0, 1] += first_noise[0, 1] + left * n02 + ahead * n12 + ahead * left * n22
    noise[1, 1] += first_noise[1, 1] + 2.0 * left * n12 + left * left * n22
    noise[0, 2] += n02 + ahead * n22
    noise[1, 2] += n12 + left * n22
    noise[2, 2] += n22
    noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]
    _compose(first, motion, motion)


@jit
def recent_key_mask(
    robots: IntArray, frame_keys: IntArray, share: int, most_frames: int, fresh: BoolArray, raw: BoolArray
) -> None:
    """Say which keys are each robot's newest, and from which of these measurements stay raw.

    Args:
        robots: (k,) of the keys, in the order of time; negative: of none.
        frame_keys: (f,) key of each frame.
        share: So many keys of a robot are fresh.
        most_frames: So many frames a key may have if its measurements are to stay raw.
        fresh, raw: (k,), results.
    """
    frames = np.zeros(len(robots), dtype=np.int64)
    for key in frame_keys:
        frames[key] += 1
    newer = np.zeros(robots.max() + 1, dtype=np.int64)
    for b in range(len(robots) - 1, -1, -1):
        fresh[b] = raw[b] = False
        if robots[b] >= 0 and newer[robots[b]] < share:
            newer[robots[b]] += 1
            fresh[b], raw[b] = True, frames[b] <= most_frames


@device
@in_place
def condensed_mask(frozen: BoolArray, keys: IntArray, raw: BoolArray, rows: IntArray, sighted: BoolArray) -> int:
    """Say which sightings are frozen from now on: those that are, and those of keys that do not stay raw.

    Args:
        frozen, keys: (s,) whether each is by now, and its key.
        raw: (k,) of `recent_key_mask`.
        rows: (s,), result, of which the first rows are written.
        sighted: (k,), result: whether any of them is of a key.

    Returns:
        How many there are.
    """
    num = 0
    sighted[:] = False
    for row in range(len(keys)):
        if frozen[row] or not raw[keys[row]]:
            rows[num], sighted[keys[row]] = row, True
            num += 1
    return num


@device
@jit
def merge_keys(
    fresh: BoolArray, sighted: BoolArray, most_keys: int, roots: IntArray, numbers: IntArray, offsets: FloatArray,
    robots: IntArray, poses: FloatArray, previous: IntArray, motions: FloatArray, noises: FloatArray,
    costs: FloatArray, slack: FloatArray,
) -> int:  # fmt: skip
    """Leave few enough keys, and say where the others stand to them; odometry is carried there.

    Old keys from which nothing was measured are chained away if they have a successor. Then, as long as there are too
    many, the old key goes whose motion from the key before costs least with what either has cost already: it stands
    rigidly to the key before from then on.

    Args:
        fresh: (k,) whether a key stays in any case.
        sighted: (k,) whether anything was measured from it.
        most_keys: So many may be left.
        roots: (k,), result: the key to which each stands rigidly, itself if it is left, `NONE` if it was chained away.
        numbers: (k,), result: new number of each that is left, `NONE` of the others.
        offsets: (k, 3), result: pose of each seen from its root.
        robots, poses, previous, motions, noises, costs, slack: (k, ...) columns of `SlamGraph`, keys in the order of
            time; `costs` [m^2], its `spreads`, is what joining a key to the one before costs, `slack` what each has
            cost. Changed: the first rows are those of the keys that are left, whose odometry begins at another one that
            is left, by its new number.

    Returns:
        How many are left.
    """
    k = len(robots)
    following = np.full(k, NONE)
    linked = np.empty(k, dtype=np.bool_)  # whether a key comes after another of the same robot
    for b in range(k):
        linked[b] = previous[b] >= 0 and robots[previous[b]] == robots[b]
    for b in range(k):
        if linked[b]:
            a = previous[b]
            while linked[a] and not sighted[a] and not fresh[a]:
                chain(motions[a], noises[a], motions[b], noises[b])
                a = previous[a]
            previous[b] = a
            following[a] = b
    before, left = previous.copy(), 0
    for b in range(k):
        roots[b] = b if not linked[b] or following[previous[b]] == b else NONE
        left += roots[b] == b
    while left > most_keys:
        best, least = NONE, np.inf
        for b in range(k):
            if linked[b] and roots[b] == b and not fresh[b]:
                price = costs[b] + slack[before[b]] + slack[b]
                if price < least:
                    best, least = b, price
        if best == NONE:
            break
        a, after = before[best], following[best]
        roots[best] = a
        slack[a] += slack[best] + costs[best]
        following[a] = after
        if after >= 0:
            before[after] = a
        left -= 1
    number = 0
    for b in range(k):
        numbers[b] = NONE
        if roots[b] == b:
            numbers[b] = number
            number += 1
    for b in range(k):
        offsets[b] = 0.0
        if roots[b] == b or roots[b] == NONE:
            continue
        while roots[roots[b]] != roots[b]:
            roots[b] = roots[roots[b]]
        a = roots[b]
        c, s = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        offsets[b, 0], offsets[b, 1] = c * dx + s * dy, -s * dx + c * dy
        offsets[b, 2] = _wrapped_heading(poses[b, 2] - poses[a, 2])
    for b in range(k):
        if roots[b] != b:
            continue
        a = previous[b]
        if a >= 0:
            previous[b] = numbers[roots[a]]
            if roots[a] != a:
                _compose(offsets[a], motions[b], motions[b])
                _turned(math.cos(offsets[a, 2]), math.sin(offsets[a, 2]), noises[b], noises[b])
        n = numbers[b]
        robots[n], poses[n], previous[n] = robots[b], poses[b], previous[b]
        motions[n], noises[n], costs[n], slack[n] = motions[b], noises[b], costs[b], slack[b]
    return number


@device
@in_place
def add_sightings(
    rows: IntArray, keys: IntArray, landmarks: IntArray, centres: FloatArray, infos: FloatArray, slopes: FloatArray,
    counts: IntArray, roots: IntArray, numbers: IntArray, offsets: FloatArray, new_keys: IntArray,
    new_landmarks: IntArray, new_centres: FloatArray, new_infos: FloatArray, new_slopes: FloatArray,
    new_counts: IntArray,
) -> int:  # fmt: skip
    """Move sightings to the keys to which theirs stand rigidly, and add up the forms of each pair.

    Args:
        rows: (n,) which sightings, those of a landmark one after the other; reordered: by key in each landmark.
        keys, landmarks, centres, infos, slopes, counts: Of all sightings.
        roots, numbers, offsets: As `merge_keys` wrote them.
        new_keys, new_landmarks, new_centres, new_infos, new_slopes, new_counts: (n, ...), results, of which the first
            rows are written; keys by their new numbers. A sum lies about the centre of its first part.

    Returns:
        How many there are.
    """
    for n in range(1, len(rows)):
        row, at = rows[n], n
        while at > 0 and landmarks[rows[at - 1]] == landmarks[row] and roots[keys[rows[at - 1]]] > roots[keys[row]]:
            rows[at] = rows[at - 1]
            at -= 1
        rows[at] = row
    num = 0
    info = stack_array(6)
    for row in rows:
        key, landmark, offset = numbers[roots[keys[row]]], landmarks[row], offsets[keys[row]]
        x, y, z = centres[row, 0], centres[row, 1], centres[row, 2]
        g0, g1, g2 = slopes[row, 0], slopes[row, 1], slopes[row, 2]
        for i in range(6):
            info[i] = infos[row, i]
        if roots[keys[row]] != keys[row]:
            c, s = math.cos(offset[2]), math.sin(offset[2])
            x, y = c * x - s * y + offset[0], s * x + c * y + offset[1]
            g0, g1 = c * g0 - s * g1, s * g0 + c * g1
            _rotate_in_plane(c, s, infos[row], info)
        if num > 0 and new_keys[num - 1] == key and new_landmarks[num - 1] == landmark:
            d0, d1, d2 = new_centres[num - 1, 0] - x, new_centres[num - 1, 1] - y, new_centres[num - 1, 2] - z
            new_slopes[num - 1, 0] += g0 - (info[0] * d0 + info[1] * d1 + info[2] * d2)
            new_slopes[num - 1, 1] += g1 - (info[1] * d0 + info[3] * d1 + info[4] * d2)
            new_slopes[num - 1, 2] += g2 - (info[2] * d0 + info[4] * d1 + info[5] * d2)
            for i in range(6):
                new_infos[num - 1, i] += info[i]
            new_counts[num - 1] += counts[row]
            continue
        new_keys[num], new_landmarks[num], new_counts[num] = key, landmark, counts[row]
        new_centres[num, 0], new_centres[num, 1], new_centres[num, 2] = x, y, z
        new_slopes[num, 0], new_slopes[num, 1], new_slopes[num, 2] = g0, g1, g2
        for i in range(6):
            new_infos[num, i] = info[i]
        num += 1
    return num


@jit
def reduce_keyframes(
    share: int, most_frames: int, most_keys: int, frame_keys: IntArray, keys: IntArray, landmarks: IntArray,
    frozen: BoolArray, centres: FloatArray, infos: FloatArray, slopes: FloatArray, counts: IntArray, raw: BoolArray,
    numbers: IntArray, new_keys: IntArray, new_landmarks: IntArray, new_centres: FloatArray, new_infos: FloatArray,
    new_slopes: FloatArray, new_counts: IntArray, robots: IntArray, poses: FloatArray, previous: IntArray,
    motions: FloatArray, noises: FloatArray, costs: FloatArray, slack: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Leave few enough keys, and freeze what was seen from old ones.

    Args:
        share, most_frames, frame_keys: As of `recent_key_mask`.
        most_keys: As of `merge_keys`.
        keys, landmarks, frozen, centres, infos, slopes, counts: (s, ...) of all sightings.
        raw: (k,), result of `recent_key_mask`.
        numbers: (k,), result of `merge_keys`.
        new_keys, new_landmarks, new_centres, new_infos, new_slopes, new_counts: (s, ...), results of `add_sightings`.
        robots, poses, previous, motions, noises, costs, slack: (k, ...) as of `merge_keys`, changed likewise.

    Returns:
        How many keys are left, and how many frozen sightings there are.
    """
    k = len(robots)
    fresh, sighted, rows = np.empty(k, np.bool_), np.empty(k, np.bool_), np.empty(len(keys), np.int64)
    roots, offsets = np.empty(k, np.int64), np.empty((k, 3))
    recent_key_mask(robots, frame_keys, share, most_frames, fresh, raw)
    rows = rows[: condensed_mask(frozen, keys, raw, rows, sighted)]
    left = merge_keys(
        fresh, sighted, most_keys, roots, numbers, offsets, robots, poses, previous, motions, noises, costs, slack
    )
    num = add_sightings(
        rows, keys, landmarks, centres, infos, slopes, counts, roots, numbers, offsets, new_keys, new_landmarks,
        new_centres, new_infos, new_slopes, new_counts,
    )  # fmt: skip
    return left, num
