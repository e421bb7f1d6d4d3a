"""Bags of ROS 1 and ROS 2: topics and messages, read by the package rosbags (extra `ros`).

A bag has the definitions of its messages, from which rosbags makes classes. Only names and types of fields are taken
from a definition, and only such as are words, so that no text of a bag becomes code.
"""

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from slam_backend.core.files import MAX_BYTES, checked_path, missing_error
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import argument_error, did_you_mean, is_argument_error

MOST_MESSAGES = 1_000_000  # of a topic that is read
BAGS = "a bag (.bag, .mcap, .db3, or a folder with metadata.yaml)"
NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)  # of a type or field

# For bags of ROS 2 without definitions, as those of Humble and earlier: types that no distribution of rosbags has.
UNLISTED = {
    "vision_msgs/msg/Detection3DArray": """std_msgs/Header header
Detection3D[] detections
================================================================================
MSG: vision_msgs/Detection3D
std_msgs/Header header
ObjectHypothesisWithPose[] results
BoundingBox3D bbox
string id
================================================================================
MSG: vision_msgs/ObjectHypothesisWithPose
ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
================================================================================
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
================================================================================
MSG: vision_msgs/BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size
""",
}


class Topic(NamedTuple):
    """Topic of a bag: its type, such as `nav_msgs/Odometry`, and its number of messages."""

    kind: str
    messages: int


@short_repr
class Bag:
    """An open bag; `open_bag` makes it.

    Attributes:
        path: The file or folder.
        topics: Topics by name, in alphabetical order.
    """

    def __init__(self, path: Path, reader: Any, is_ros2: bool) -> None:
        self.path, self._reader, self._is_ros2 = path, reader, is_ros2
        found = sorted(reader.topics.items())
        self.topics = {name: Topic(_short(about.msgtype or ""), about.msgcount) for name, about in found}

    def check_topic(self, argument: str, name: str) -> Topic:
        """Return a topic that has messages, at most `MOST_MESSAGES`.

        Args:
            argument: The argument that names it, for errors.
            name: Name of the topic, with or without the leading slash.

        Raises:
            ValueError: If there is no such topic, it is empty or too long, or has messages of several types.
        """
        if (topic := self.topics.get(name)) is None:
            hint = f"{did_you_mean(name, self.topics)}The bag has {', '.join(self.topics) or 'no topic'}."
            raise argument_error(argument, "a topic of the bag", name, hint)
        if not topic.messages:
            raise argument_error(argument, f"messages of {name}", "no message", "Record the topic while it is sent.")
        if topic.messages > MOST_MESSAGES:
            hint = "Cut the bag into parts."
            raise argument_error(argument, f"at most {MOST_MESSAGES:,} messages of {name}", topic.messages, hint)
        if not topic.kind:
            raise argument_error(argument, f"one type of messages of {name}", "a topic of several", "Record it alone.")
        return topic

    def messages(self, argument: str, name: str) -> Generator[Any, None, None]:
        """Yield the messages of a topic, in order of arrival.

        Args:
            argument: The argument that names it, for errors.
            name: Name of the topic.

        Raises:
            ValueError: As `check_topic`, or if the bag is damaged.
        """
        self.check_topic(argument, name)
        with _intact(self.path):
            connections = [each for each in self._reader.connections if each.topic == name]
            kind = connections[0].msgtype
            store = self._types(connections[0])
            decode = store.deserialize_cdr if self._is_ros2 else store.deserialize_ros1
            for number, (_, _, data) in enumerate(self._reader.messages(connections=connections), start=1):
                if number > MOST_MESSAGES:
                    raise ValueError(f"{name} has more than {MOST_MESSAGES:,} messages")
                if len(data) > MAX_BYTES:
                    raise ValueError(f"a message of {name} has {len(data):,} bytes")
                yield decode(data, kind)

    def _types(self, connection: Any) -> Any:
        """Return the types of a connection, as the bag defines them, or else of the latest ROS 2."""
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        kind, (form, text) = connection.msgtype, connection.msgdef
        store = get_typestore(Stores.EMPTY)
        if form is MessageDefinitionFormat.NONE:
            store = get_typestore(Stores.LATEST)
            if kind in UNLISTED:
                store.register(get_types_from_msg(UNLISTED[kind], kind))
            if kind not in store.fielddefs:
                hint = "Convert it with a ROS that has the type: ros2 bag convert, to MCAP."
                raise argument_error("path", f"a bag with the definition of {_short(kind)}", "no definition", hint)
            return store
        if form is MessageDefinitionFormat.IDL:
            parts = [part.partition("\n") for part in text.split("=" * 80 + "\n") if part]
            types: dict[str, Any] = {}
            for head, _, body in parts:
                types.update(get_types_from_idl(body if head.startswith("IDL: ") else f"{head}\n{body}"))
        else:
            types = get_types_from_msg(text, kind)
        for owner, (_, fields) in types.items():
            for word in (owner, *(field for field, _ in fields)):
                if NAME.fullmatch(word) is None:
                    raise ValueError(f"a name {word[:40]!r} in the definition of {_short(kind)}")
        store.register({owner: ([], fields) for owner, (_, fields) in types.items()})  # without constants
        return store


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Open a bag: a `.bag` of ROS 1, or of ROS 2 an `.mcap`, a `.db3` or a folder with `metadata.yaml`.

    Raises:
        ValueError: If rosbags is not installed, or there is no bag at the path, or it is damaged.
    """
    if find_spec("rosbags") is None:
        raise argument_error(
            "path", "the package rosbags for bags", "no such package", "Install it: pip install rosbags."
        )
    file = checked_path(path)
    if not file.exists():
        raise missing_error("path", BAGS, path)
    is_bag = (file / "metadata.yaml").is_file() if file.is_dir() else file.suffix in (".bag", ".mcap", ".db3")
    if not is_bag:
        inside = [each.name for each in sorted(file.glob("*")) if each.suffix in (".bag", ".mcap", ".db3")][:3]
        hint = f"Name a file in it: {', '.join(inside)}." if inside else f"Check {str(path)!r}."
        raise argument_error("path", BAGS, "a folder without it" if file.is_dir() else file, hint)
    from rosbags import rosbag1, rosbag2

    is_ros2 = file.suffix != ".bag" or file.is_dir()
    with _intact(file):
        reader: Any = rosbag2.Reader(file) if is_ros2 else rosbag1.Reader(file)
        reader.open()
    try:
        with _intact(file):
            _check_chunks(reader)
            bag = Bag(file, reader, is_ros2)
        yield bag
    finally:
        reader.close()


def _check_chunks(reader: Any) -> None:
    """Refuse chunks of MCAP that unpack to more than `MAX_BYTES`, before any is unpacked."""
    storage = getattr(reader, "storage", None)
    for part in getattr(storage, "storages", [storage]):
        for chunk in getattr(part, "chunks", ()):
            if chunk.uncompressed_size > MAX_BYTES:
                raise ValueError(f"a chunk unpacks to {chunk.uncompressed_size:,} bytes")


@contextmanager
def _intact(path: Path) -> Iterator[None]:
    """Turn any error of rosbags into one line: damaged bytes may raise whatever their parsers do."""
    try:
        yield
    except Exception as error:
        if is_argument_error(error):
            raise
        words = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        hint = f"Repair {str(path)!r} with rosbag reindex, ros2 bag reindex or mcap recover, or record it again."
        raise argument_error("path", "an intact bag", f"a damaged one: {words}", hint) from error


def _short(kind: str) -> str:
    """Return the name of a type without `/msg/`."""
    return kind.replace("/msg/", "/")
