"""Comparison of nested results bit for bit, and hashes of them."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np


def assert_same(one: Any, other: Any, where: str = "state") -> None:
    """Two nests of mappings, sequences, records and arrays agree bit for bit."""
    assert _kind(one) is _kind(other), where
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, err_msg=where)
    elif isinstance(one, Mapping):
        assert list(one) == list(other), where
        for key, value in one.items():
            assert_same(value, other[key], f"{where}.{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other), where
        for index, value in enumerate(one):
            assert_same(value, other[index], f"{where}[{index}]")
    elif hasattr(one, "__dataclass_fields__"):
        for name in one.__dataclass_fields__:
            assert_same(getattr(one, name), getattr(other, name), f"{where}.{name}")
    else:
        assert one == other or (one != one and other != other), where


def _kind(value: Any) -> type:
    """Return the type of a value; snapshots and dicts are alike, and so are tuples and lists."""
    return Mapping if isinstance(value, Mapping) else tuple if type(value) is list else type(value)


def digest(value: Any, into: "hashlib._Hash") -> None:
    """Feed nested dicts, sequences, arrays and numbers into a hash, types and shapes included."""
    if isinstance(value, Mapping):
        for key in value:
            into.update(repr(key).encode())
            digest(value[key], into)
    elif isinstance(value, (tuple, list)):
        for entry in value:
            digest(entry, into)
    else:
        array = np.asarray(value)
        into.update(f"{type(value)}{array.dtype}{array.shape}".encode())
        into.update(array.tobytes())
