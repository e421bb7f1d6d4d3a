"""Hashes of everything that an environment returns."""

import hashlib
from typing import Any

import numpy as np


def digest(value: Any, into: "hashlib._Hash") -> None:
    """Feed nested dicts, sequences, arrays and numbers into a hash, types and shapes included."""
    if isinstance(value, dict):
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
