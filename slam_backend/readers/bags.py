"""Reader of bags of ROS 1 and ROS 2 (extra `ros`): odometry, landmarks, true poses and a camera as steps of filters."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.files import MAX_BYTES
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_float
from slam_backend.geometry import between
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import LARGEST_CONDITION, LEAST_VARIANCE, Measurements
from slam_backend.readers.bag_files import Bag, open_bag
from slam_backend.readers.bag_messages import (
    CAMERAS,
    LANDMARKS,
    POSES,
    TAG_FRAMES,
    TWISTS,
    PoseReading,
    Sighting,
    check_type,
    transforms,
    uses,
)
from slam_backend.readers.conversions import HOLD, integrate_commands, points_from_polar
from slam_backend.readers.mrclam import SightingNoise
from slam_backend.readers.plausibility import check_rate, repetition_note
from slam_backend.readers.range_bearing import RobotReadings, by_step, even_times, first_of_each, motions, nearest_steps
from slam_backend.readers.tables import MOST_JITTER, sorted_note, steps_back, time_order
from slam_backend.trajectory import LEAST_NORM, MOST_NORM, Trajectory

MOST_TILT = 0.2  # [rad] of poses that count as planar
MOST_TRIED = 10_000  # messages of a topic that are searched for a first landmark
MOST_POINTS = 5_000_000  # landmarks seen in a topic
NEAREST = 0.1  # [m]; landmarks are assumed to be at least this far from the sensor where noise grows with distance
MOST_SQUINT = 0.2  # [rad] between the axis of a camera and x of the base
Kind = Literal["identities", "descriptors", "positions"]


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class BagRobot(RobotReadings):
    """Readings of one robot, and its true path.

    Attributes:
        truth: True poses; None: unknown.
    """

    truth: Trajectory | None


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class BagSteps:
    """Bag as steps at common times.

    Attributes:
        times: (T,) float64 [s]. Evenly spaced times by the stamps of the headers.
        robots: Steps of each robot, in the order of the topics.
        kind: Distinction of landmarks: by "identities", by "descriptors", or by "positions" alone.
        names: (N,) str. Identities, the columns of one-hot descriptors; empty without identities.
        camera: Camera of the robots; None: not given.
        notes: Lines about frames, sorted stamps, and what was dropped.
    """

    times: FloatArray
    robots: tuple[BagRobot, ...]
    kind: Kind
    names: NDArray[np.str_]
    camera: StereoCamera | None
    notes: tuple[str, ...]


class Motion(NamedTuple):
    """Rigid motion in space."""

    rotation: FloatArray  # (3, 3)
    translation: FloatArray  # (3,) [m]


class _Driven(NamedTuple):
    """Odometry of a robot."""

    pose_at: Callable[[FloatArray], FloatArray]  # Dead-reckoned poses (k, 3) at times (k,)
    first: float  # [s]
    last: float  # [s]
    base: str  # Frame of the robot
    fixed: frozenset[str]  # Frames in which its poses are


class _Seen(NamedTuple):
    """Landmarks of one topic, base frame, in order of time."""

    times: FloatArray  # (m,) [s]
    messages: IntArray  # (m,) Number of the message of each
    names: NDArray[np.str_] | None  # (m,)
    points: FloatArray  # (m, 3) [m]
    covariances: FloatArray  # (m, 3, 3) [m^2]
    descriptors: NDArray[np.float32]  # (m, d)


def bag_topics(path: str | Path, tag_frames: str = TAG_FRAMES) -> list[tuple[str, str, int, str]]:
    """Return the topics of a bag: name, type, number of messages, and what they can be.

    Topics of landmarks are read up to the first landmark: of those in `/tf` names must fit, and a map in the frame of
    all odometry is none that a sensor sees.

    Args:
        path: See `load_bag`.
        tag_frames: See `load_bag`.

    Raises:
        ValueError: If there is no bag at the path, or it is damaged, or rosbags is not installed.
    """
    with open_bag(path) as bag:
        topics = {name: uses(topic.kind) if topic.messages else [] for name, topic in bag.topics.items()}
        fixed = [_first_fixed(bag, name) for name, known in topics.items() if "odometry" in known]
        for name, known in topics.items():
            if "landmarks" in known and not _has_landmarks(bag, name, tag_frames, fixed):
                known.remove("landmarks")
        return [(name, *bag.topics[name], ", ".join(known)) for name, known in topics.items()]


def _first_fixed(bag: Bag, topic: str) -> set[str]:
    """Return the frame in which the first message of a topic of odometry has its pose; none for velocities."""
    if (parse := POSES.get(bag.topics[topic].kind)) is None:
        return set()
    try:
        with closing(bag.messages("odometry", topic)) as messages:
            pose = parse(next(messages))
    except ValueError:  # `load_bag` says what is wrong with the topic
        return set()
    return {pose.frame} - {pose.child, ""}


def _has_landmarks(bag: Bag, topic: str, tag_frames: str, fixed: Sequence[set[str]]) -> bool:
    """Return whether the first landmarks of a topic can be read with one of the topics of odometry, if there are any.

    Args:
        fixed: Frames in which each topic of odometry has its poses.
    """
    parse = LANDMARKS[bag.topics[topic].kind]
    try:
        with closing(bag.messages("landmarks", topic)) as messages:
            for message in islice(messages, MOST_TRIED):
                if frames := {each.frame for each in parse(message, tag_frames) if len(each.points)}:
                    return not fixed or any(frames.isdisjoint(each) for each in fixed)
    except ValueError:  # `load_bag` says what is wrong with the topic
        return False
    return bag.topics[topic].messages > MOST_TRIED


def load_bag(
    path: str | Path, odometry: Sequence[str], landmarks: Sequence[str], truth: Sequence[str] | None = None,
    camera: str | None = None, base: Sequence[str] | None = None, tag_frames: str = TAG_FRAMES, dt: float = 0.25,
    noise: SightingNoise | None = None,
) -> BagSteps:  # fmt: skip
    """Read a bag as steps of filters, one robot for each topic of odometry.

    Stamps are those of headers; up to `MOST_JITTER` back in time they are sorted. Points are moved from the frame of
    their sensor to that of the robot by `/tf_static`, then to the nearest step by the odometry in between. Only the
    first of several sightings of an identity in a step is used, and without identities the first message.

    Args:
        path: A `.bag` of ROS 1, or of ROS 2 an `.mcap`, a `.db3` or a folder.
        odometry: Topics of the odometry: poses, or velocities with a stamp.
        landmarks: Topics of the landmarks, one for each robot.
        truth: Topics of the true poses, one for each robot. None: unknown.
        camera: Topic of a `CameraInfo`, for all robots. None: none.
        base: Frame of the robots, one name or one for each robot. None: `child_frame_id` of the odometry.
        tag_frames: Pattern of the child frames that are landmarks, if the topic is /tf.
        dt: Time between steps [s].
        noise: Assumed noise of landmarks without covariance. None: `SightingNoise()`.

    Raises:
        ValueError: If the bag cannot be read, a topic is missing, empty or of another type, numbers of topics differ,
            stamps are missing, out of order or of two clocks, frames are not connected, poses are not planar, or there
            are too many points.
    """
    check_float("dt", dt, "Give seconds between steps.", above=0.0)
    count, noise = len(odometry), SightingNoise() if noise is None else noise
    for argument, given in (("landmarks", landmarks), ("truth", truth)):
        if given is not None and len(given) != count:
            hint = "Give one for each robot, in the same order."
            raise argument_error(
                argument, f"{count} topic{'s' if count > 1 else ''}, as of odometry", list(given), hint
            )
    if base is not None and len(base) not in (1, count):
        raise argument_error("base", f"one frame or {count}", list(base), "Give one for all robots, or one for each.")
    notes: list[str] = []
    driven: list[_Driven] = []
    seen: list[_Seen] = []
    truths: list[Trajectory | None] = []
    with open_bag(path) as bag:
        for robot, topic in enumerate(odometry):
            statics = _static_frames(bag, topic)
            named = None if base is None else base[robot if len(base) > 1 else 0].lstrip("/")
            own = _read_odometry(bag, topic, named, statics, notes)
            driven.append(own)
            seen.append(_read_landmarks(bag, landmarks[robot], own, statics, tag_frames, noise, notes))
            poses = None if truth is None else _read_poses(bag, "truth", truth[robot], own.base, statics, notes)[0]
            if truth is not None and poses is not None:
                _check_overlap("truth", truth[robot], poses.times, own)
            truths.append(poses)
            if robot == 0:
                lens = None if camera is None else _read_camera(bag, camera, own.base, statics, seen[0].points, notes)
    kind, names, columns = _identities(landmarks, seen)
    times = even_times(min(own.first for own in driven), max(own.last for own in driven), dt)
    frames = [
        _frames(times, own.pose_at, sighted, column, len(names), lens)
        for own, sighted, column in zip(driven, seen, columns, strict=True)
    ]
    robots = tuple(
        BagRobot(motions(own.pose_at(times)), each, poses)
        for own, each, poses in zip(driven, frames, truths, strict=True)
    )
    for topic, sighted in zip(landmarks, seen, strict=True):
        if sighted.names is not None:
            notes.extend(f"{topic}: {line}" for line in repetition_note(sighted.times, sighted.names))
    if kind == "positions":
        notes.append("No identities and no descriptors: positions alone distinguish the landmarks.")
    return BagSteps(times, robots, kind, names, lens, tuple(dict.fromkeys(notes)))


# ---- stamps


def _times(argument: str, topic: str, stamps: Sequence[int], notes: list[str]) -> tuple[FloatArray, IntArray]:
    """Return the times [s] of the messages with a stamp, in order, and their rows; append notes about them."""
    stamped = np.array(stamps, dtype=np.int64)
    kept = np.flatnonzero(stamped)
    if not len(kept):
        hint = "Times of arrival do not replace them: let the publisher stamp its headers."
        raise argument_error(argument, f"time stamps in the headers of {topic}", "no stamp but zero", hint)
    if len(kept) < len(stamped):
        notes.append(f"{topic}: {len(stamped) - len(kept)} of {len(stamped)} messages without a stamp were dropped.")
    times: FloatArray = np.asarray(stamped[kept] * 1e-9, np.float64)
    late = np.flatnonzero(steps_back(times) > MOST_JITTER)
    if len(late):
        row = int(late[0])
        got = f"a stamp {times[row]:.3f} s after {times[:row].max():.3f} s"
        expected = f"stamps of {topic} that go back by at most {MOST_JITTER:g} s"
        raise argument_error(argument, expected, got, "Cut the bag there, or correct the clock.")
    order, words = time_order(topic, times)
    notes.extend(sorted_note([words]))
    return times[order], kept[order].astype(np.int64)


def _check_overlap(argument: str, topic: str, times: FloatArray, driven: _Driven) -> None:
    """Refuse a topic whose times are all beyond those of the odometry."""
    if not ((times >= driven.first - MOST_JITTER) & (times <= driven.last + MOST_JITTER)).any():
        expected = f"stamps of {topic} among those of the odometry, {driven.first:.3f} to {driven.last:.3f} s"
        got = f"a log from {times[0]:.3f} to {times[-1]:.3f} s"
        raise argument_error(argument, expected, got, "Record both by one clock, as with use_sim_time for both.")


# ---- frames


def _static_frames(bag: Bag, topic: str) -> dict[str, tuple[str, Motion]]:
    """Return parent, and parent from child, of each child frame in `/tf_static` and those of the name space."""
    found: dict[str, tuple[str, Motion]] = {}
    spaces = [name for name in bag.topics if name == "tf_static" or name.endswith("/tf_static")]
    for name in sorted(spaces, key=len):
        about = bag.topics[name]
        if about.messages and about.kind == "tf2_msgs/TFMessage" and topic.startswith(name.removesuffix("tf_static")):
            for message in bag.messages("path", name):
                for each in transforms(message):
                    _, rotation = _rotations("path", name, np.array([each.quaternion]))
                    found[each.child] = each.frame, Motion(rotation[0], np.array(each.position))
    return found


def _chain(statics: Mapping[str, tuple[str, Motion]], frame: str) -> dict[str, Motion]:
    """Return the motions to a frame's ancestors from the frame, which is the first."""
    chain = {frame: Motion(np.eye(3), np.zeros(3))}
    while frame in statics:
        parent, step = statics[frame]
        if parent in chain:  # a loop
            break
        own = chain[frame]
        chain[parent] = Motion(step.rotation @ own.rotation, step.rotation @ own.translation + step.translation)
        frame = parent
    return chain


def _static_motion(statics: Mapping[str, tuple[str, Motion]], to: str, frame: str) -> Motion | None:
    """Return the static motion to a frame from another; None if they are not connected."""
    ours, theirs = _chain(statics, to), _chain(statics, frame)
    common = next((name for name in theirs if name in ours), None)
    if common is None:
        return None
    a, b = ours[common], theirs[common]
    return Motion(a.rotation.T @ b.rotation, a.rotation.T @ (b.translation - a.translation))


def _mounting(
    argument: str, topic: str, statics: Mapping[str, tuple[str, Motion]], base: str, sensor: str, notes: list[str]
) -> Motion:
    """Return the motion to the base from the frame of a sensor; the identity, with a note, if frames are not named."""
    if base == sensor or not base or not sensor:
        where = f"in the frame {sensor!r} of the robot" if base == sensor and base else "in the frame of the robot"
        if not base and "optical" in sensor:
            hint = "Give --base, and record /tf_static."
            raise argument_error("base", f"the frame of the robot, for {topic} in {sensor!r}", "no name", hint)
        notes.append(f"{topic}: taken to be {where} (x ahead, z up).")
        return Motion(np.eye(3), np.zeros(3))
    found = _static_motion(statics, base, sensor)
    if found is None:
        known = ", ".join(sorted({*statics, *(parent for parent, _ in statics.values())}))
        hint = f"/tf_static has {known}: name the robot's frame by --base." if known else "Record /tf_static."
        raise argument_error(argument, f"static frames from {sensor!r} of {topic} to {base!r}", "no such chain", hint)
    return found


# ---- poses


def _rotations(argument: str, topic: str, quaternions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return quaternions (n, 4) x, y, z, w scaled to unit length, and their rotations (n, 3, 3)."""
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = ~((lengths >= LEAST_NORM) & (lengths <= MOST_NORM))
    if wrong.any():
        hint = "Correct the publisher: a rotation by nothing is 0, 0, 0, 1."
        raise argument_error(argument, f"unit quaternions of {topic}", quaternions[wrong][0].tolist(), hint)
    unit = quaternions / lengths[:, None]
    x, y, z, w = unit.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return unit, np.moveaxis(np.array(rows), -1, 0)


def _read_poses(
    bag: Bag, argument: str, topic: str, base: str | None, statics: Mapping[str, tuple[str, Motion]], notes: list[str]
) -> tuple[Trajectory, str, frozenset[str]]:
    """Return the planar poses of a topic, of the base if it is known, the name of the base, and frames of the poses."""
    parse = POSES[check_type(argument, topic, bag.check_topic(argument, topic).kind, POSES)]
    readings: list[PoseReading] = [parse(message) for message in bag.messages(argument, topic)]
    times, rows = _times(argument, topic, [each.stamp for each in readings], notes)
    positions = np.array([readings[row].position for row in rows])
    if not np.isfinite(positions).all():
        raise argument_error(argument, f"finite positions of {topic}", "NaN or infinity", "Drop such messages.")
    _, rotations = _rotations(argument, topic, np.array([readings[row].quaternion for row in rows]))
    child = readings[int(rows[0])].child
    base = child if base is None else base
    mount = _static_motion(statics, child, base) if child and base != child else None
    if mount is not None:
        positions = positions + rotations @ mount.translation
        rotations = rotations @ mount.rotation
    elif child and base and child != base:
        notes.append(f"{topic}: poses of {child!r}, taken for those of {base!r}.")
    frames = frozenset(each.frame for each in readings if each.frame)
    tilts = np.arccos(np.clip(rotations[:, 2, 2], -1.0, 1.0))
    if (tilted := np.flatnonzero(tilts > MOST_TILT)).size:
        row = int(tilted[0])
        got = f"a tilt of {tilts[row]:.2f} rad at {times[row]:.3f} s"
        hint = "Give poses of a frame whose z axis points up, of a robot on a floor."
        raise argument_error(argument, f"poses of {topic} tilted by at most {MOST_TILT:g} rad", got, hint)
    kept = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0.0)  # drops repeated stamps
    headings = np.arctan2(rotations[kept, 1, 0], rotations[kept, 0, 0])
    if len(kept) < 2:
        raise argument_error(argument, f"two poses of {topic} or more", "a single one", "Record for a longer time.")
    return Trajectory(times[kept], np.column_stack([positions[kept, :2], headings])), base, frames


def _read_odometry(
    bag: Bag, topic: str, base: str | None, statics: Mapping[str, tuple[str, Motion]], notes: list[str]
) -> _Driven:
    """Return the odometry of a topic of poses or of velocities."""
    kind = check_type("odometry", topic, bag.check_topic("odometry", topic).kind, (*POSES, *TWISTS))
    if kind in POSES:
        path, child, frames = _read_poses(bag, "odometry", topic, base, statics, notes)
        gaps = np.diff(path.times)
        if gaps.max() > HOLD:
            count = int(np.count_nonzero(gaps > HOLD))
            notes.append(f"{topic}: {count} gaps of more than {HOLD:g} s, up to {gaps.max():.1f} s, are interpolated.")

        def pose_at(wanted: FloatArray) -> FloatArray:
            return path.at(np.clip(wanted, path.times[0], path.times[-1]))

        return _Driven(pose_at, float(path.times[0]), float(path.times[-1]), child, frames)
    twists = [TWISTS[kind](message) for message in bag.messages("odometry", topic)]
    times, rows = _times("odometry", topic, [each.stamp for each in twists], notes)
    commands = np.column_stack([times, [(twists[row].forward, twists[row].turn) for row in rows]])
    if not np.isfinite(commands).all():
        raise argument_error("odometry", f"finite velocities of {topic}", "NaN or infinity", "Drop such messages.")
    check_rate("odometry", times, HOLD, f"Record {topic} more often.")
    if (sideways := max(abs(each.sideways) for each in twists)) > 0.0:
        notes.append(f"{topic}: velocities to the side, up to {sideways:.3g} m/s, are not used.")

    def integrated(wanted: FloatArray) -> FloatArray:
        return integrate_commands(commands, wanted)

    frame = twists[0].frame if base is None else base
    return _Driven(integrated, float(times[0]), float(times[-1]), frame, frozenset())


# ---- landmarks


def _read_landmarks(
    bag: Bag, topic: str, driven: _Driven, statics: Mapping[str, tuple[str, Motion]], tag_frames: str,
    noise: SightingNoise, notes: list[str],
) -> _Seen:  # fmt: skip
    """Return the landmarks of a topic in the frame of the robot, with covariances."""
    parse = LANDMARKS[check_type("landmarks", topic, bag.check_topic("landmarks", topic).kind, LANDMARKS)]
    sightings: list[Sighting] = []
    owners: list[int] = []
    total = taken = 0
    for number, message in enumerate(bag.messages("landmarks", topic)):
        for each in parse(message, tag_frames):
            total += len(each.points)
            taken += 0 if each.descriptors is None else each.descriptors.nbytes
            if total > MOST_POINTS or taken > MAX_BYTES:
                expected = f"at most {MOST_POINTS:,} points and {MAX_BYTES >> 20} MiB of descriptors in {topic}"
                raise argument_error("landmarks", expected, "a longer topic", "Cut the bag into parts.")
            sightings.append(each)
            owners.append(number)
    if not total:
        hint = f"Give the pattern of their frames: --tag-frames, now {tag_frames!r}." if topic.endswith("tf") else ""
        raise argument_error("landmarks", f"landmarks in {topic}", "no landmark", hint or "Give another topic.")
    widths = {-1 if each.descriptors is None else each.descriptors.shape[1] for each in sightings}
    if len(widths) > 1:
        raise argument_error("landmarks", f"one set of fields of {topic}", "a topic of several", "Record them alone.")
    stamps, rows = _times("landmarks", topic, [each.stamp for each in sightings], notes)
    _check_overlap("landmarks", topic, stamps, driven)
    parts = [sightings[row] for row in rows]
    if fixed := sorted({each.frame for each in parts} & driven.fixed - {driven.base}):
        hint = "Give what a sensor of the robot reads, not a map."
        raise argument_error("landmarks", f"landmarks of {topic} in a frame of the robot", fixed[0], hint)
    mounts = {
        sensor: _mounting("landmarks", topic, statics, driven.base, sensor, notes)
        for sensor in dict.fromkeys(each.frame for each in parts)
    }
    sizes = [len(each.points) for each in parts]
    times, messages = np.repeat(stamps, sizes), np.repeat(np.array(owners, np.int64)[rows], sizes)
    local = np.concatenate([np.asarray(each.points, np.float64).reshape(-1, 3) for each in parts])
    rotations = np.repeat([mounts[each.frame].rotation for each in parts], sizes, axis=0)
    origins = np.repeat([mounts[each.frame].translation for each in parts], sizes, axis=0)
    points = (rotations @ local[:, :, None])[:, :, 0] + origins
    given = np.concatenate([
        np.zeros((len(each.points), 3, 3)) if each.covariances is None else np.asarray(each.covariances, np.float64)
        for each in parts
    ])  # fmt: skip
    covariances = _covariances(points - origins, rotations @ given @ rotations.transpose(0, 2, 1), noise, topic, notes)
    names = None if parts[0].names is None else np.array([name for each in parts for name in each.names or ()])
    described = np.zeros((total, 0), np.float32)
    if parts[0].descriptors is not None:
        described = _scaled(np.concatenate([each.descriptors for each in parts if each.descriptors is not None]))
    finite = np.isfinite(points).all(axis=1) & np.isfinite(described).all(axis=1)
    during = (times >= driven.first - MOST_JITTER) & (times <= driven.last + MOST_JITTER)
    for kept, words in ((finite, "that are not finite"), (during, "before or after the odometry")):
        if dropped := int(np.count_nonzero(~kept)):
            notes.append(f"{topic}: {dropped} of {total} landmarks {words} were dropped.")
    kept = finite & during
    if not kept.any():
        raise argument_error("landmarks", f"finite points in {topic}", "no such point", "Give another topic.")
    return _Seen(
        times[kept], messages[kept], None if names is None else names[kept], points[kept], covariances[kept],
        described[kept],
    )  # fmt: skip


def _scaled(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return descriptors (m, d) scaled to unit length; (m, 0) where they have less than two numbers."""
    if descriptors.shape[1] < 2:
        return descriptors[:, :0]
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.where(lengths > 0.0, lengths, 1.0), np.float32)


def _covariances(rays: FloatArray, given: FloatArray, noise: SightingNoise, topic: str, notes: list[str]) -> FloatArray:
    """Return the covariances (m, 3, 3) [m^2], base axes, of points at these places (m, 3) from their sensor.

    Those given are kept if they are positive definite; others are of the assumed noise.
    """
    rays = np.where(np.isfinite(rays), rays, 1.0)
    ranges, bearings = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), NEAREST), np.arctan2(rays[:, 1], rays[:, 0])
    _, assumed = points_from_polar(ranges, bearings, noise.variances(ranges))
    covariances = np.asarray(ROBOT_FROM_CAMERA @ assumed @ ROBOT_FROM_CAMERA.T)
    stated = np.flatnonzero(np.isfinite(given).all(axis=(1, 2)) & given.any(axis=(1, 2)))
    symmetric = 0.5 * (given[stated] + given[stated].transpose(0, 2, 1))
    spread = np.linalg.eigvalsh(symmetric)
    usable = (spread[:, 0] > LEAST_VARIANCE) & (spread[:, 2] < 0.1 * LARGEST_CONDITION * spread[:, 0])
    covariances[stated[usable]] = symmetric[usable]
    if wrong := int(np.count_nonzero(~usable)):
        notes.append(f"{topic}: {wrong} covariances are not positive definite; the assumed noise replaces them.")
    return covariances


def _identities(topics: Sequence[str], seen: Sequence[_Seen]) -> tuple[Kind, NDArray[np.str_], list[IntArray]]:
    """Return what distinguishes the landmarks of all robots, their names, and the name's index for each sighting."""
    kinds = {"identities" if each.names is not None else each.descriptors.shape[1] for each in seen}
    if len(kinds) > 1:
        hint = "Give topics of one kind, with descriptors of one length."
        raise argument_error("landmarks", "one kind of landmarks", list(topics), hint)
    if seen[0].names is None:
        return "descriptors" if seen[0].descriptors.shape[1] else "positions", np.array([], np.str_), [
            np.arange(len(each.times)) for each in seen
        ]  # fmt: skip
    every = {str(name) for each in seen for name in np.unique(np.asarray(each.names))}
    names = sorted(every, key=_by_numbers)
    index = {name: column for column, name in enumerate(names)}
    columns = [np.array([index[str(name)] for name in np.asarray(each.names)], np.int64) for each in seen]
    return "identities", np.array(names), columns


def _by_numbers(name: str) -> list[Any]:
    """Return what sorts names by the numbers in them: a2 before a10."""
    return [int(part) if number % 2 else part for number, part in enumerate(re.split(r"(\d+)", name))]


def _frames(
    times: FloatArray, pose_at: Callable[[FloatArray], FloatArray], seen: _Seen, columns: IntArray, names: int,
    camera: StereoCamera | None,
) -> tuple[Measurements | None, ...]:  # fmt: skip
    """Return the measurements of each step, moved there by the odometry in between."""
    step = nearest_steps(times, seen.times)
    if names:
        first = first_of_each(step, columns)
        if len(first) * names * 4 > MAX_BYTES:
            hint = "Cut the bag into parts."
            raise argument_error("landmarks", f"descriptors of at most {MAX_BYTES >> 20} MiB", f"{names} names", hint)
        described = np.eye(names, dtype=np.float32)[columns[first]]
    else:  # the first message of each step
        used, where = np.unique(step, return_index=True)
        message = np.zeros(len(times), np.int64)
        message[used] = seen.messages[where]
        first = np.flatnonzero(seen.messages == message[step])
        described = seen.descriptors[first] if seen.descriptors.shape[1] else np.ones((len(first), 1), np.float32)
    step = step[first]
    offset = between(pose_at(times)[step], pose_at(seen.times[first]))
    turned = np.zeros((len(first), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(offset[:, 2])
    turned[:, 1, 0] = np.sin(offset[:, 2])
    turned[:, 0, 1], turned[:, 2, 2] = -turned[:, 1, 0], 1.0
    points = (turned @ seen.points[first][:, :, None])[:, :, 0]
    points[:, :2] += offset[:, :2]
    mount = np.zeros(3) if camera is None else np.asarray(camera.mount)
    covariances = turned @ seen.covariances[first] @ turned.transpose(0, 2, 1)
    covariances = ROBOT_FROM_CAMERA.T @ covariances @ ROBOT_FROM_CAMERA
    return by_step(len(times), step, (points - mount) @ ROBOT_FROM_CAMERA, described, covariances)


# ---- camera


def _read_camera(
    bag: Bag, topic: str, base: str, statics: Mapping[str, tuple[str, Motion]], points: FloatArray, notes: list[str]
) -> StereoCamera:
    """Return the camera of the first message of a topic of `CameraInfo`, which looks along x of the base.

    Its image is the part around the principal point, since a `StereoCamera` has this in the middle.
    """
    check_type("camera", topic, bag.check_topic("camera", topic).kind, CAMERAS)
    with closing(bag.messages("camera", topic)) as messages:
        message = next(messages)
    projection = np.asarray(message.p if hasattr(message, "p") else message.P, np.float64)
    matrix = np.asarray(message.k if hasattr(message, "k") else message.K, np.float64)
    rectified = bool(projection[0] > 0.0)
    fx, cx, fy, cy = projection[[0, 2, 5, 6]] if rectified else matrix[[0, 2, 4, 5]]
    width, height = int(message.width), int(message.height)
    hint = "Calibrate the camera, or omit --camera: landmarks with positions do not need it."
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0):
        raise argument_error("camera", f"focal lengths > 0 in K or P of {topic}", [float(fx), float(fy)], hint)
    if not (0.0 < cx < width and 0.0 < cy < height):
        got = f"a centre ({cx:g}, {cy:g}) of an image of {width} x {height}"
        raise argument_error("camera", f"a principal point in the image of {topic}", got, hint)
    baseline = float(-projection[3] / projection[0]) if rectified else 0.0
    mount = _mounting("camera", topic, statics, base, str(message.header.frame_id).lstrip("/"), notes)
    if not np.array_equal(mount.rotation, np.eye(3)):  # optical axes
        squint = float(np.arccos(np.clip(mount.rotation[0, 2], -1.0, 1.0)))
        if squint > MOST_SQUINT:
            expected = f"a camera that looks along x of {base!r}, to {MOST_SQUINT:g} rad"
            got = f"a camera turned by {squint:.2f} rad"
            raise argument_error("camera", expected, got, "Omit --camera: landmarks with positions do not need it.")
    usual = StereoCamera()
    return StereoCamera(
        focal_px=float(fx), baseline=baseline if baseline > 0.0 else usual.baseline,
        width=max(1, int(2.0 * min(cx, width - cx))), height=max(1, int(2.0 * min(cy, height - cy) * fx / fy)),
        max_range=max(usual.max_range, float(np.linalg.norm(points, axis=1).max())),
        mount=tuple(mount.translation.tolist()),
    )  # fmt: skip
