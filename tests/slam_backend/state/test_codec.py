import json
import pickle
import resource
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.files import read_file
from slam_backend.fastslam.filter import FastSlam
from slam_backend.state.codec import ForeignObjectError, decode, encode
from slam_backend.team.team import TeamSlam


@dataclass(frozen=True)
class Point:
    """A record of the caller's."""

    x: Any
    y: Any


FLOATS = [np.float64(2.5), float("nan"), -float("inf"), -0.0, 5e-324, struct.unpack("<d", b"\1\0\0\0\0\0\xf0\x7f")[0]]
ARRAYS = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6).reshape(2, 3)),
    np.zeros((0, 4), np.float32),
    np.array(7, np.int32),
    np.array([True, False]),
    np.array([np.nan, -0.0, np.inf]),
    np.arange(12)[::3],
    np.float16([1.5]),
]


def same(a: Any, b: Any) -> None:
    """Assert that two values have the same type and the same bits."""
    assert type(a) is type(b)
    if isinstance(a, (np.ndarray, np.generic)):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, float):
        assert struct.pack("<d", a) == struct.pack("<d", b)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, (tuple, list)):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            same(one, other)
    else:
        assert a == b


def plain_values() -> st.SearchStrategy[Any]:
    """Return trees of all that can be written."""
    keys = st.one_of(st.text(), st.integers(), st.tuples(st.integers(), st.text()))
    leaves = st.one_of(
        st.none(), st.booleans(), st.integers(-(2**200), 2**200), st.floats(), st.text(), st.binary(),
        st.sampled_from([*FLOATS, *ARRAYS, np.int8(-3), np.bool_(True), frozenset({1, "a"}), {(1, 2)}]),
    )  # fmt: skip
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4),
            st.lists(inner, max_size=4).map(tuple),
            st.dictionaries(keys, inner, max_size=4),
        ),
        max_leaves=20,
    )


@given(plain_values())
def test_trees_round_trip_bit_for_bit(tree: Any) -> None:
    """Containers, types, order and all bits of the numbers are preserved."""
    same(decode(encode(tree)), tree)


def test_shared_parts_stay_shared() -> None:
    """A part that stands in two places is one part afterwards; a tree that doubles at each level stays small."""
    shared = np.arange(3.0)
    first, second = decode(encode([shared, Point(shared, None)]))
    assert list(second) == ["class", "x", "y"]
    assert second["x"] is first
    tree: Any = [1]
    for _ in range(60):
        tree = (tree, tree)
    assert len(encode(tree)) < 5000


def test_arrays_keep_their_layout_and_whether_they_can_be_written() -> None:
    """Kernels are compiled for either, and numpy gives other bytes for sums in another order."""
    fixed = np.arange(4.0)
    fixed.setflags(write=False)
    columns, back = decode(encode([np.asfortranarray(np.ones((2, 3))), fixed]))
    assert columns.flags.f_contiguous
    assert columns.flags.writeable
    assert not back.flags.writeable


class Stranger:
    """Of this class nothing can be written."""


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        ({"a": {"b": [Stranger()]}}, "a test_codec.Stranger in 'b' in 'a'"),
        (lambda: None, "a builtins.function"),
        (np.array([object()]), "an array of object"),
        (np.array(["text"]), "an array of <U4"),
        (type("Longer", (dict,), {})(), r"Longer"),
    ],
)
def test_objects_of_other_classes_are_refused(tree: Any, says: str) -> None:
    """The error names the place of the object."""
    with pytest.raises(ForeignObjectError, match=says):
        encode(tree)


def test_cyclic_containers_are_refused() -> None:
    """A container that contains itself cannot be written."""
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(ForeignObjectError, match="a part that holds itself"):
        encode(loop)


def body(rows: Any, root: Any = None, blobs: bytes = b"") -> bytes:
    """Return bytes of a table that somebody made up."""
    table = json.dumps([rows, [len(rows) - 1] if root is None else root]).encode()
    head = f"{len(table)}\n".encode() + table
    return head + bytes(-len(head) % 64) + blobs if blobs else head


@pytest.mark.parametrize(
    "forged",
    [
        b"",
        b"5\n",
        b"99999999999999\n[]",
        b"2\n[]",
        pickle.dumps({"a": 1}),
        body([["object", "os.system", "true"]]),
        body([["call", "x"]]),
        body([["tuple", [0]]]),
        body([["tuple", [-1]]]),
        body([["tuple", [1]], ["list"]]),
        body([["dict", "a"]]),
        body([["list"], ["dict", [0], 1]]),
        body([["array", "<f8", [1 << 39, 1 << 39], 0, 1]]),
        body([["array", "<f8", [1 << 50], 0, 1]]),
        body([["array", "<f8", [-1], 0, 1]]),
        body([["array", "|O", [1], 0, 1]], blobs=bytes(8)),
        body([["array", "<f8", [2.0], 0, 1]], blobs=bytes(16)),
        body([["array", "|b1", [1], 0, 1]], blobs=b"\2"),
        body([["array", "<f8", [1], 0, 1]], blobs=bytes(9)),
        body([["bytes", 1 << 60]]),
        body([["bytes", -1]]),
        body([["float", "00"]]),
        body([["number", "<f8", "00"]]),
        body([["int", "x"]]),
        b"200000\n" + b"[" * 200000,
    ],
)
def test_forged_bytes_are_refused(forged: bytes) -> None:
    """Whatever somebody made up is a ValueError, without code that runs and without much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"."):
        decode(forged)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


@pytest.mark.parametrize("last", [["set", [60]], ["dict", [60], 1], ["list", [60]]])
def test_parts_that_are_shared_too_often_are_refused(last: list[Any]) -> None:
    """A pair of a pair of ..., sixty deep, is 61 rows and 2^60 parts: it is refused before it is hashed or checked."""
    rows = [["tuple", 1], *(["tuple", [i], [i]] for i in range(60)), last]
    table = json.dumps([rows, [61]]).encode()
    with pytest.raises(ValueError, match="shared too often"):
        decode(f"{len(table)}\n".encode() + table)


def test_flipped_bytes_are_refused_or_read() -> None:
    """Each flipped byte of a filter's state raises a ValueError, or gives a state that is refused or accepted."""
    content = encode(FastSlam(1, num_particles=4).get_state())
    rng = np.random.default_rng(0)
    for _ in range(300):
        changed = bytearray(content)
        changed[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
        try:
            FastSlam(1, num_particles=4).set_state(decode(bytes(changed)))
        except ValueError:
            continue
    for cut in range(0, len(content), 97):
        with pytest.raises(ValueError, match=r"."):
            decode(content[:cut])


def test_states_of_teams_round_trip_through_bytes() -> None:
    """A team that is set to what bytes hold gives the same state again."""
    team = TeamSlam(2, num_particles=4)
    content = encode(team.get_state())
    other = TeamSlam(2, num_particles=4, seed=7)
    other.set_state(decode(content))
    assert encode(other.get_state()) == content


def test_only_bounded_regular_files_are_read(tmp_path: Path) -> None:
    """A folder, a device without end, and a file of a terabyte that takes no room are refused before they are read."""
    huge = tmp_path / "huge"
    with huge.open("wb") as file:
        file.truncate(1 << 40)
    for path in (tmp_path, Path("/dev/zero"), huge):
        with pytest.raises(OSError, match=r"not a regular file|more than 1024 MiB"):
            read_file(path)
