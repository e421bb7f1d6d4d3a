"""Diagnosis of a log's set-up: its odometry beside the motion that the sightings alone tell.

Two frames with common landmarks tell the motion between them, whatever the odometry says: the closed-form alignment of
their points. Over short windows of a log the ratios of both motions are the same for all windows if units, signs and
axes are right, and equal to one; a mistake in the set-up changes them in a way of its own.

No filter is needed, and none can be misled: matches are those of given identities, or of descriptors that are nearest
to each other in both frames. Of a filter that ran already, matches are those that it found; its map also tells whether
too few landmarks look different to find a lost robot by them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.packed_symmetric import OF_NINE, UNPACK_INDEX
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray, argument_error, check_array
from slam_backend.geometry import rotation
from slam_backend.maps.descriptor_matching import similar_pairs, similar_to_any
from slam_backend.maps.match_table import COLUMNS, planar_points, planar_variances
from slam_backend.maps.registration import MIN_VARIANCE, information, squared_distances
from slam_backend.metrics import align_se2
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.log_arrays import EXACT, LogArrays
from slam_backend.smoother.reassociation import LandmarkTable
from slam_backend.smoother.relocalisation import MIN_PAIRS, alignment_options, are_distinct

WINDOW = 10  # longest window [steps]
LEAST_WINDOWS = 20  # fewest windows for a diagnosis
ANY_HEIGHT = 1e12  # [m^2]; robots may pitch, so that heights tell nothing
LEAST_COMMON = 2  # landmarks of a window; two determine a planar motion
CLEAR = 0.8  # largest ratio of the distances to the nearest descriptor and to the second one
STILL = 0.02  # of the distance and turns that the sightings tell; less odometry in total is none
SURE = 4.0  # standard errors of a ratio beyond which it differs from one
NOTICED = 0.15  # of a ratio; smaller differences are no mistake of the set-up
UNITS = {"centimetres": 100.0, "millimetres": 1000.0}
DEGREES = 180.0 / math.pi
UNIT_WITHIN = math.log(1.5)  # of the ratio between two units
AGREED = 0.7  # length of the mean of unit vectors; below it directions do not agree
MOST_SPREAD = 0.2  # of a ratio, robust standard deviation of a window; beyond it a scale is not told
NOISY = 10.0  # times the assumed standard deviation of odometry
NOISY_POINTS = 14.0  # the same of points; drifting features of a car that pitches and rolls leave up to 13.5
FITTING = 5.0  # the same; points beyond it do not judge the odometry's noise
HALF_CHI_SQUARE, CHI_SQUARE_2 = 0.455, 1.386  # medians of chi-square with one degree of freedom and with two
LOOK_ALIKES = "look-alikes"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """Likely mistake in the set-up of a log, or what it cannot tell.

    Attributes:
        name: Key of `CAUSES`.
        text: Diagnosis and cure.
        ratio: Ratio of what was found to what is right [-].
    """

    name: str
    text: str
    ratio: float


CAUSES = {  # what is said of each cause; `{ratio}` is what was found
    "frozen odometry": "The odometry stands still while the sightings move: it is not read, or its column is wrong.",
    "mirrored x": "Landmarks move with the robot, not against it: the sign of the points' axis ahead is wrong.",
    "sign of turns": "Turns are opposite to those of the sightings: the odometry's turns, or the points' axis to the "
    "left, have the wrong sign.",
    "rotated axes": "The robot moves at {ratio:.0f} degrees to what the sightings tell: the axes of odometry and points"
    " differ.",
    "odometry in degrees": "Turns are {ratio:.1f} times those of the sightings: give radians, not degrees.",
    "odometry in centimetres": "Distances are {ratio:.0f} times those of the sightings: give the odometry in metres.",
    "odometry in millimetres": "Distances are {ratio:.0f} times those of the sightings: give the odometry in metres.",
    "points in centimetres": "The sightings move {ratio:.0f} times as far as the odometry: give the points in metres.",
    "points in millimetres": "The sightings move {ratio:.0f} times as far as the odometry: give the points in metres.",
    "scale": "The sightings move {ratio:.2f} times as far as the odometry: check baseline, focal length and the "
    "calibration of the wheels.",
    "scale of turns": "The sightings turn {ratio:.2f} times as far as the odometry: check the field of view or focal "
    "length, and the track of the wheels.",
    "delay": "The odometry's turns come {ratio:.0f} steps after those of the sightings (before them if negative): "
    "check the time stamps.",
    "measurement noise": "Points differ by {ratio:.0f} times their assumed standard deviation: assume more measurement "
    "noise, or check the association of the measurements.",
    "odometry noise": "Motions differ by {ratio:.0f} times their assumed standard deviation: assume more odometry "
    "noise, or check time stamps and units: turns are radians.",
    LOOK_ALIKES: "Nearly all landmarks look alike: that a robot is lost or was carried cannot be seen. Give distinct "
    "descriptors, or identities.",
}


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Motions over N windows, by the sightings and by the odometry.

    Attributes:
        sighted: (N, 3) float64 [m, m, rad]. Motion in the robot frame at the start of the window.
        covariances: (N, 3, 3) float64. Covariances of these motions by the assumed noise of the points.
        translations: (N, 2) float64 [m]. Sum of the odometry's translations, each in its own robot frame.
        turns: (N,) float64 [rad]. Sum of the odometry's turns.
        variances: (N, 2) float64 [m^2, rad^2]. Assumed variances of both sums, along the motion and of the turn.
        fits: (n,) float64 [-]. Squared residuals of the points of all windows, in units of their assumed noise; their
            median is one if this is right.
        windows: (N, 2) int64. First and last step of each window.
    """

    sighted: FloatArray
    covariances: FloatArray
    translations: FloatArray
    turns: FloatArray
    variances: FloatArray
    fits: FloatArray
    windows: IntArray


def diagnose(
    odometry: FloatArray, measurements: Sequence[Measurements | None], identities: Sequence[Any] | None = None,
    camera: StereoCamera | None = None, motion: OdometryModel | None = None,
) -> tuple[Cause, ...]:  # fmt: skip
    """Return the likely mistakes in the set-up of one robot's log, the most certain first; none if all looks right.

    Nothing is said of logs in which fewer than 20 windows of ten steps have two common landmarks that differ, such
    as those of landmarks that all look alike and have no identities.

    Args:
        odometry: (T, 3) float64 [m, m, rad]. Motion since the previous step, previous robot frame; the first is unused.
        measurements: T frames; None for a step without.
        identities: T entries; (n,) int, the landmark of each measurement, negative if unknown. None: by descriptors.
        camera: Camera, with mount and assumed noise of points without covariances. None: the default one.
        motion: Assumed noise of the odometry. None: the default one.

    Raises:
        ValueError: If lengths or shapes disagree.
    """
    odometry = check_array("odometry", odometry, (None, 3), "Give a motion (dx, dy, dtheta) for each step.")
    for name, values in (("measurements", measurements), ("identities", identities)):
        if values is not None and len(values) != len(odometry):
            got = f"a list of {len(values)}"
            raise argument_error(name, f"a list of {len(odometry)} entries, one for each step", got, "Give them all.")
    camera = StereoCamera() if camera is None else camera
    found = find_motions(odometry, measurements, identities, camera, OdometryModel() if motion is None else motion)
    if len(found.turns) < LEAST_WINDOWS:
        return ()
    late = find_delay(odometry[:, 2], found)
    return (_cause("delay", late),) if late else name_causes(found)


def diagnose_run(
    log: LogArrays, camera: StereoCamera, motion: OdometryModel, known: LandmarkTable | None = None,
    descriptor_gate: float = 0.0,
) -> tuple[Cause, ...]:  # fmt: skip
    """Return the likely mistakes in the set-up of a filter's log of one robot, see `diagnose`; none of exact poses.

    Args:
        log: Log of the robot.
        camera, motion: See `diagnose`.
        known: Landmarks of the filter, to see whether the robot's look alike. None: they have identities.
        descriptor_gate: Largest L2 distance of similar descriptors.
    """
    if not len(log) or (log.kinds == EXACT).any():
        return ()
    odometry = np.zeros((int(log.steps[-1]) + 1, 3))
    odometry[log.steps] = log.motions
    frames: list[Measurements | None] = [None] * len(odometry)
    names: list[IntArray | None] = [None] * len(odometry)
    for row in np.flatnonzero(np.diff(log.starts)).tolist():
        step, own = int(log.steps[row]), slice(log.starts[row], log.starts[row + 1])
        spreads = None
        if log.covariances is not None and log.given[row]:
            spreads = ROBOT_FROM_CAMERA.T @ log.covariances[own][:, UNPACK_INDEX] @ ROBOT_FROM_CAMERA
        points = log.points[own] @ ROBOT_FROM_CAMERA
        frames[step], names[step] = Measurements(points, np.zeros((len(points), 1), np.float32), spreads), log.ids[own]
    found = diagnose(odometry, frames, names, camera, motion)
    return found if known is None else found + find_look_alikes(log, known, descriptor_gate)


def find_look_alikes(log: LogArrays, known: LandmarkTable, descriptor_gate: float) -> tuple[Cause, ...]:
    """Return whether too few landmarks tell where a robot is; nothing is said of small maps. See `diagnose_run`."""
    seen = np.isin(known.ids, log.ids)
    ids, looks = known.ids[seen], known.descriptors[seen]
    distinct = are_distinct(looks, alignment_options(descriptor_gate))
    if len(ids) < 2 * MIN_PAIRS or distinct.sum() >= MIN_PAIRS:
        return ()
    distinct |= ~similar_to_any(looks, looks[_seen_with_look_alikes(log, ids, looks, descriptor_gate)], descriptor_gate)
    share = float(distinct.mean())
    return () if distinct.sum() >= MIN_PAIRS else (_cause(LOOK_ALIKES, share),)


def _seen_with_look_alikes(log: LogArrays, ids: IntArray, looks: Float32Array, gate: float) -> BoolArray:
    """Return which landmarks (l,) one frame shows beside one that looks alike: that is no copy of the same one."""
    result = np.zeros(len(ids), np.bool_)
    for frame in np.split(log.ids, log.starts[1:-1]):
        rows = np.flatnonzero(np.isin(ids, frame))
        pairs = similar_pairs(looks[rows], looks[rows], gate, len(rows))
        result[rows[pairs[pairs[:, 0] != pairs[:, 1], 0]]] = True
    return result


def find_delay(turns: FloatArray, found: Motions) -> int:
    """Return the steps by which the odometry's turns (T,) lag behind those of the sightings; 0 if none are clear.

    With the right delay both agree as well as is assumed, and without one they do not.
    """
    heading = np.cumsum(turns)
    variances = found.variances[:, 1] + found.covariances[:, 2, 2]
    misfits = {}
    for late in range(-WINDOW, WINDOW + 1):
        first, last = found.windows.T + late
        held = (first >= 0) & (last < len(turns))
        off = found.sighted[held, 2] - (heading[last[held]] - heading[first[held]])
        misfits[late] = (
            math.sqrt(float(np.median(off**2 / variances[held])) / HALF_CHI_SQUARE) if held.any() else np.inf
        )
    best = min(misfits, key=lambda late: (misfits[late], abs(late)))
    return best if 2.0 * misfits[best] < FITTING < misfits[0] else 0


def find_motions(
    odometry: FloatArray, measurements: Sequence[Measurements | None], identities: Sequence[Any] | None,
    camera: StereoCamera, motion: OdometryModel,
) -> Motions:  # fmt: skip
    """Return the motions over windows that follow each other, each as long as it has enough common landmarks."""
    seen = [step for step, frame in enumerate(measurements) if frame is not None and len(frame) >= LEAST_COMMON]
    bias = np.diag(motion.bias_covariance)
    distances = np.hypot(*odometry[:, :2].T)
    rows, place = [], 0
    while place < len(seen):
        begun, first = place, seen[place]
        later = [step for step in seen[begun + 1 : begun + 1 + WINDOW] if step <= first + WINDOW]
        place += 1
        for count, last in reversed(list(enumerate(later, 1))):
            pairs = match(measurements, identities, first, last)
            if len(pairs) < LEAST_COMMON:
                continue
            between = slice(first + 1, last + 1)
            noise = motion.variances(odometry[between]).sum(axis=0)[[0, 2]] + bias[:2] * distances[between].sum() ** 2
            before, after = (_in_robot(measurements[step], camera) for step in (first, last))
            told = sighted_motion(before, after, pairs)
            rows.append((*told, odometry[between, :2].sum(axis=0), odometry[between, 2].sum(), noise, (first, last)))
            place = begun + count
            break
    sighted, covariances, fits, translations, turns, variances, windows = zip(*rows, strict=True) if rows else ((),) * 7
    return Motions(
        np.reshape(sighted, (-1, 3)), np.reshape(covariances, (-1, 3, 3)), np.reshape(translations, (-1, 2)),
        np.array(turns, np.float64), np.reshape(variances, (-1, 2)), np.concatenate([np.empty(0), *fits]),
        np.reshape(np.array(windows, np.int64), (-1, 2)),
    )  # fmt: skip


def sighted_motion(
    before: tuple[FloatArray, FloatArray], after: tuple[FloatArray, FloatArray], pairs: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the motion (3,) that fits the points of two frames, its covariance, and the squared residuals (n,)."""
    table = np.empty((len(pairs), COLUMNS))
    for frame, (points, covariances), rows in zip((0, 1), (before, after), pairs.T, strict=True):
        table[:, 3 * frame : 3 * frame + 3] = points[rows]
        table[:, 6 * frame + 6 : 6 * frame + 12] = covariances[rows].reshape(-1, 9).take(OF_NINE, axis=1)
    table[:, 11] += ANY_HEIGHT
    motion = align_se2(*planar_points(table), 1.0 / planar_variances(table))  # no unit enters, unlike in a closer fit
    every = np.ones(len(pairs), np.bool_)
    covariance = np.linalg.pinv(information(table, every, motion, MIN_VARIANCE)[0], hermitian=True)
    distances = squared_distances(table, motion, MIN_VARIANCE)
    freedom = 1.0 - 3.0 / (2.0 * len(pairs))  # the fit of three numbers takes its share of the residuals
    return motion, np.asarray(covariance, np.float64), distances / (freedom * CHI_SQUARE_2)


def match(
    measurements: Sequence[Measurements | None], identities: Sequence[Any] | None, first: int, last: int
) -> IntArray:
    """Return the rows (n, 2) of measurements of the same landmark in two frames."""
    a, b = measurements[first], measurements[last]
    assert a is not None
    assert b is not None
    if identities is not None:
        one, other = (np.asarray(identities[step], np.int64).ravel() for step in (first, last))
        _, left, right = np.intersect1d(one, other, return_indices=True)
        known = one[left] >= 0
        return np.column_stack([left[known], right[known]])
    apart = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(a)))
    clear = []
    for row in rows:
        others = np.concatenate([np.delete(apart[row], nearest[row]), np.delete(apart[:, nearest[row]], row)])
        own = float(apart[row, nearest[row]])
        clear.append(len(others) > 0 and own < CLEAR * float(others.min()))
    rows = rows[np.array(clear, np.bool_)]
    return np.column_stack([rows, nearest[rows]])


def _in_robot(frame: Measurements | None, camera: StereoCamera) -> tuple[FloatArray, FloatArray]:
    """Return the points (n, 3) [m] of a frame, robot frame, and their covariances (n, 3, 3) [m^2]."""
    assert frame is not None
    covariances = camera.covariance(frame.points) if frame.covariances is None else frame.covariances
    return camera.robot_from_camera(frame.points), np.asarray(ROBOT_FROM_CAMERA @ covariances @ ROBOT_FROM_CAMERA.T)


def name_causes(found: Motions) -> tuple[Cause, ...]:
    """Return what the motions over windows tell of the set-up."""
    distances, turns, sighted_turns = np.hypot(*found.translations.T), found.turns, found.sighted[:, 2]
    told = np.array([np.hypot(*found.sighted[:, :2].T).sum(), np.abs(sighted_turns).sum()])
    if (np.array([distances.sum(), np.abs(turns).sum()]) <= STILL * told).all():
        return (_cause("frozen odometry", 0.0),)
    causes = []
    turn, turn_error, turn_spread = _ratio(turns, sighted_turns, found.variances[:, 1] + found.covariances[:, 2, 2])
    axes = np.arctan2(found.translations[:, 1], found.translations[:, 0]) + 0.5 * sighted_turns  # of the chord's middle
    along = np.column_stack([np.cos(axes), np.sin(axes)])
    chords = found.sighted[:, :2]
    off = np.arctan2(chords[:, 1], chords[:, 0]) - axes
    weights = distances * np.hypot(*chords.T)
    mean = np.sum(weights * np.exp(1j * off)) / max(weights.sum(), 1e-12)
    turned = float(np.angle(mean)) if abs(mean) > AGREED else 0.0
    direction, opposite = abs(turned), turn < 0.0 and abs(turn) > SURE * turn_error
    along = along @ rotation(turned).T
    spread = np.einsum("ni,nij,nj->n", along, found.covariances[:, :2, :2], along)
    length, length_error, length_spread = _ratio(
        distances, (chords * along).sum(axis=1), found.variances[:, 0] + spread
    )
    if direction > 0.75 * math.pi:
        causes.append(_cause("mirrored x" if opposite else "rotated axes", 180.0))
    elif direction > 0.25 * math.pi:
        causes.append(_cause("rotated axes", math.degrees(direction)))
    elif opposite:
        causes.append(_cause("sign of turns", -1.0))
    causes += _of_turns(abs(turn), turn_error, turn_spread)
    if max(np.abs(np.exp(1j * (turns - sign * sighted_turns)).mean()) for sign in (1.0, -1.0)) < AGREED:
        causes = [cause for cause in causes if cause.name == "odometry in degrees"]  # turns tell of no axis
    fit = math.sqrt(float(np.median(found.fits)))
    variances = turn**2 * found.variances[:, 1] + max(1.0, fit**2) * found.covariances[:, 2, 2]
    rest = (sighted_turns - turn * turns) ** 2 / variances
    noise = math.sqrt(float(np.median(rest)) / HALF_CHI_SQUARE)
    causes += _of_distances(length, length_error, length_spread)
    if fit > NOISY_POINTS or noise > NOISY:  # readings that say little tell no scale
        causes = [cause for cause in causes if not cause.name.startswith("scale")]
    if fit > NOISY_POINTS and not causes:
        causes.append(_cause("measurement noise", fit))
    elif fit < FITTING and noise > NOISY and not causes:
        causes.append(_cause("odometry noise", noise))
    return tuple(causes)


def _of_turns(ratio: float, error: float, spread: float) -> list[Cause]:
    """Return the cause of a ratio of turns, sightings over odometry."""
    if not _differs(ratio, error):
        return []
    if abs(math.log(max(ratio, 1e-9) * DEGREES)) < UNIT_WITHIN:
        return [_cause("odometry in degrees", 1.0 / ratio)]
    return [_cause("scale of turns", ratio)] if spread < MOST_SPREAD * ratio else []


def _of_distances(ratio: float, error: float, spread: float) -> list[Cause]:
    """Return the cause of a ratio of distances, sightings over odometry."""
    if not _differs(ratio, error):
        return []
    for unit, size in UNITS.items():
        if abs(math.log(ratio / size)) < UNIT_WITHIN:
            return [_cause(f"points in {unit}", ratio)]
        if abs(math.log(ratio * size)) < UNIT_WITHIN:
            return [_cause(f"odometry in {unit}", 1.0 / ratio)]
    return [_cause("scale", ratio)] if spread < MOST_SPREAD * ratio else []


def _differs(ratio: float, error: float) -> bool:
    """Return whether a positive ratio differs from one, by what is noticed and by what is sure."""
    return 0.0 < error < ratio and abs(ratio - 1.0) > max(NOTICED, SURE * error)


def _cause(name: str, ratio: float) -> Cause:
    return Cause(name=name, text=CAUSES[name].format(ratio=ratio), ratio=ratio)


def _ratio(assumed: FloatArray, told: FloatArray, variances: FloatArray) -> tuple[float, float, float]:
    """Return the median ratio told / assumed, weighted by signal over noise, its standard error, and the spread."""
    used = assumed != 0.0
    if used.sum() < LEAST_WINDOWS:
        return 1.0, math.inf, math.inf
    ratios, weights = told[used] / assumed[used], np.abs(assumed[used]) / np.sqrt(variances[used])
    middle = _weighted_median(ratios, weights)
    spread = 1.4826 * _weighted_median(np.abs(ratios - middle), weights)
    effective = weights.sum() ** 2 / (weights**2).sum()
    return middle, 1.2533 * spread / math.sqrt(effective) + 1e-12, spread


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """Return the value below and above which lies half of the weight."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
