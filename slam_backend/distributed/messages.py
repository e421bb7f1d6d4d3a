"""Messages between robots: the latest map of one, in parts of bounded size. Reading them runs none of their content."""

import hashlib
import hmac
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import inverse
from slam_backend.maps.landmark_map import FIELDS, LandmarkMap
from slam_backend.smoother.graph import SlamGraph
from slam_backend.state import (
    FLOAT32,
    FLOAT64,
    INT64,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Dict,
    Each,
    Int,
    Record,
    Sizes,
    State,
    Text,
)
from slam_backend.state.codec import decode, encode

VERSION = 1  # of messages
MAGIC = b"vslm"
HEADER = struct.Struct("<4sHHH16sQQ")  # magic, version, part, parts, seal, life of the sender, number of the map
MOST_BYTES = 16_384  # of the payload of a message; a message with its header fits into a datagram
MOST_PARTS = 256  # of a map
MOST_NAME = 64  # bytes of a name
MOST_PEERS = 32
ONE_ROBOT = {"K": 1}  # sizes of the state of one robot


@short_repr
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Link:
    """Alignment of the maps of two robots, as one of them found it.

    Attributes:
        other: Name of the other robot.
        life: Life of the other robot whose map it was.
        motion: (3,) float64 [m, m, rad]. Start of the other robot in the frame of the one that found it.
        pairs: (n, 2) int64 rows (own landmark, landmark of the other) of the common landmarks, by ids.
    """

    STATE: ClassVar = State(
        other=Text(), life=Int(), motion=Array(FLOAT64, "3", -MAX_DISTANCE, MAX_DISTANCE),
        pairs=Array(INT64, "pairs 2", 0, MAX_LANDMARKS),
    )  # fmt: skip
    other: str
    life: int
    motion: FloatArray
    pairs: IntArray

    def inverted(self, by: str, life: int) -> "Link":
        """Return the link as seen from the other robot, given who found it."""
        return Link(other=by, life=life, motion=inverse(self.motion), pairs=self.pairs[:, ::-1])


@short_repr
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SharedMap:
    """What one robot tells the others: its pose, its map, the graph of its smoother, and its links.

    Attributes:
        robot: Name of the robot.
        life: Number of its life: larger after each start with an empty memory.
        number: Number of this map in that life.
        step: Number of steps of its filter so far.
        pose, pose_covariance: (3,), (3, 3) float64 [m, m, rad], own start frame.
        means, covariances: (n, 3) float32 [m], (n, 3, 3) float64 [m^2], own start frame.
        descriptors: (n, d) float32.
        counts, ids: (n,) int64.
        graph: Condensed measurements of the path and the landmarks, whose ids are those of the map.
        links: Alignments that it found between its map and those of others.
    """

    STATE: ClassVar = State(
        robot=Text(), life=Int(), number=Int(), step=Int(),
        pose=Array(FLOAT64, "3", -MAX_DISTANCE, MAX_DISTANCE), pose_covariance=Array(FLOAT64, "3 3"),
        **LandmarkMap.STATE.parts | {"means": Array(FLOAT32, "n 3", -MAX_DISTANCE, MAX_DISTANCE)},
        graph=Record(SlamGraph), links=Each(Record(Link)),
    )  # fmt: skip
    robot: str
    life: int
    number: int
    step: int
    pose: FloatArray
    pose_covariance: FloatArray
    means: NDArray[np.float32]
    covariances: FloatArray
    descriptors: NDArray[np.float32]
    counts: NDArray[np.int64]
    ids: NDArray[np.int64]
    graph: SlamGraph
    links: Sequence[Link]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse repeated landmarks, and covariances and counts that are none."""
        LandmarkMap(*(parts[name] for name in FIELDS))

    @classmethod
    def of(
        cls, robot: str, life: int, number: int, step: int, pose: tuple[FloatArray, FloatArray], landmarks: LandmarkMap,
        graph: SlamGraph, links: Sequence[Link],
    ) -> "SharedMap":  # fmt: skip
        """Return what a robot tells about its map."""
        return cls(
            robot=robot, life=life, number=number, step=step, pose=pose[0], pose_covariance=pose[1],
            means=landmarks.means.astype(np.float32), covariances=landmarks.covariances,
            descriptors=landmarks.descriptors, counts=landmarks.counts, ids=landmarks.ids, graph=graph,
            links=tuple(links),
        )  # fmt: skip

    def landmarks(self) -> LandmarkMap:
        """Return the map, start frame of the robot."""
        return LandmarkMap(*(getattr(self, name) for name in FIELDS))


class Part(NamedTuple):
    """A part of a map, as it travels."""

    robot: str
    life: int
    number: int
    part: int
    parts: int
    payload: bytes


def messages_of(shared: SharedMap, key: bytes) -> list[bytes]:
    """Return a map as messages, sealed with the key of the team.

    Raises:
        ValueError: If it is too large for `MOST_PARTS` messages.
    """
    body = encode(shared)
    pieces = [body[begin : begin + MOST_BYTES] for begin in range(0, len(body), MOST_BYTES)]
    if len(pieces) > MOST_PARTS:
        hint = "Give the filter fewer landmarks."
        raise argument_error("map", f"at most {MOST_PARTS * MOST_BYTES:,} bytes", f"{len(body):,}", hint)
    return [
        _sealed(Part(shared.robot, shared.life, shared.number, part, len(pieces), piece), key)
        for part, piece in enumerate(pieces)
    ]


def _sealed(part: Part, key: bytes) -> bytes:
    """Return a part as a message: header, name of the sender and payload."""
    name = part.robot.encode()
    body = b"".join((struct.pack("<B", len(name)), name, part.payload))

    def header(seal: bytes) -> bytes:
        return HEADER.pack(MAGIC, VERSION, part.part, part.parts, seal, part.life, part.number)

    return header(_seal(header(bytes(16)) + body, key)) + body


def _seal(content: bytes, key: bytes) -> bytes:
    """Return what only those who know the key can compute of a message."""
    return hashlib.blake2b(content, key=key, digest_size=16).digest()


def read_message(message: bytes, key: bytes) -> Part | str:
    """Return the part in a message, or why it is refused: a line."""
    if len(message) > HEADER.size + 1 + MOST_NAME + MOST_BYTES:
        return f"expected a message of at most {MOST_BYTES:,} bytes, got one of {len(message):,}"
    if len(message) <= HEADER.size or message[:4] != MAGIC:
        return "expected a message of a robot, got other bytes"
    _, version, part, parts, seal, life, number = HEADER.unpack_from(message)
    if version != VERSION:
        return f"expected a message of version {VERSION}, got version {version}: use one version on all robots"
    blank = HEADER.pack(MAGIC, version, part, parts, bytes(16), life, number)
    if not hmac.compare_digest(seal, _seal(blank + message[HEADER.size :], key)):
        return "expected a message with the key of this team, got one of a stranger, or a damaged one"
    length = message[HEADER.size]
    begin = HEADER.size + 1 + length
    try:
        return Part(message[HEADER.size + 1 : begin].decode(), life, number, part, parts, message[begin:])
    except UnicodeDecodeError:
        return "expected a name in UTF-8"


class Inbox:
    """Maps of other robots: the latest one of each that is complete, and the parts of a later one.

    Attributes:
        maps: Latest complete map of each robot, by name.
    """

    STATE = State(maps=Dict(Text(), Record(SharedMap)))

    def __init__(self) -> None:
        self.maps: dict[str, SharedMap] = {}
        self._parts: dict[str, dict[int, Part]] = {}  # of the newest map of each robot, by number of the part

    def add(self, part: Part, descriptor_size: int = 0) -> str | None:
        """Add a part; return why it is refused, if it is: maps need descriptors of this length, if it is not 0."""
        known = {*self.maps, *self._parts}
        if part.robot not in known and len(known) >= MOST_PEERS:
            return f"expected at most {MOST_PEERS} robots, got one more, {part.robot!r}"
        if not 0 <= part.part < part.parts <= MOST_PARTS:
            return f"expected one of at most {MOST_PARTS} parts, got part {part.part} of {part.parts}"
        held, waiting = self.maps.get(part.robot), self._parts.get(part.robot, {})
        age = part.life, part.number
        if held is not None and age <= (held.life, held.number):
            return None  # late or repeated
        newest = next(iter(waiting.values()), None)
        if newest is not None and age < (newest.life, newest.number):
            return None
        if newest is None or age > (newest.life, newest.number):
            waiting = self._parts[part.robot] = {}
        elif newest.parts != part.parts:
            return f"expected one of {newest.parts} parts of {part.robot!r}, got one of {part.parts}"
        waiting[part.part] = part
        if len(waiting) < part.parts:
            return None
        del self._parts[part.robot]
        return self._complete([waiting[k] for k in range(part.parts)], descriptor_size)

    def keep(self, descriptor_size: int) -> None:
        """Drop maps with descriptors of another length, received before the own length was known."""
        lengths = {name: shared.descriptors.shape[1] for name, shared in self.maps.items() if len(shared.ids)}
        for name in [name for name, length in lengths.items() if length != descriptor_size]:
            del self.maps[name]

    def _complete(self, parts: Sequence[Part], descriptor_size: int) -> str | None:
        """Read a map of which all parts are there."""
        first = parts[0]
        try:
            tree = decode(b"".join(part.payload for part in parts))
            shared: SharedMap = Record(SharedMap).check("message", tree, dict(ONE_ROBOT))
        except Exception as error:  # of any kind: the tree may hold anything
            return " ".join(str(error).split()) or type(error).__name__
        if (shared.robot, shared.life, shared.number) != (first.robot, first.life, first.number):
            return f"expected a map of {first.robot!r}, got one of {shared.robot!r}"
        length = shared.descriptors.shape[1]
        if descriptor_size and len(shared.ids) and length != descriptor_size:
            return (
                f"expected descriptors of length {descriptor_size}, got {length} of {first.robot!r}: use one front end"
            )
        self.maps[first.robot] = shared
        return None
