"""Read-only views and copies of arrays that are handed out or shared."""

from collections.abc import Callable
from operator import is_
from typing import Any, TypeVar

import numpy as np
from numpy import ndarray
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
Tree = TypeVar("Tree")

Act = Callable[[NDArray[Any]], NDArray[Any]]

PLAIN = frozenset((int, float, bool, str, type(None)))  # checked first: most parts of states are of these types


def is_read_only(array: NDArray[Any]) -> bool:
    """Return whether an array lies on a read-only buffer, so that numpy refuses to make it writable.

    >>> frozen = np.zeros(2)
    >>> frozen.setflags(write=False)  # can be reverted
    >>> is_read_only(frozen), is_read_only(as_read_only(frozen)), is_read_only(as_read_only(frozen)[1:])
    (False, True, True)
    """
    if array.flags.writeable:  # perhaps on bytes, as pickles leave it
        return False
    base: Any = array.base
    while type(base) is ndarray:
        base = base.base
    return type(base) is bytes or (type(base) is memoryview and base.readonly)


def as_read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a view that follows the array's changes and refuses `flags.writeable = True`.

    numpy lets a view become writable if the owner of its memory is writable. This view lies on a read-only buffer.

    >>> view = as_read_only(np.zeros(2))
    >>> view.flags.writeable = True
    Traceback (most recent call last):
    ValueError: cannot set WRITEABLE flag to True of this array
    """
    return array if is_read_only(array) else np.asarray(array.data.toreadonly())


def as_constant(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return an array with the same numbers that cannot change: a copy unless it is read-only already."""
    return array if is_read_only(array) else constant_copy(array)


def constant_copy(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a copy that cannot change, faster than `as_read_only(array.copy())`."""
    return np.ndarray(array.shape, array.dtype, array.tobytes())


def with_read_only(tree: Tree) -> Tree:
    """Return a tree of tuples, lists and dicts with read-only views of its arrays; all other parts are shared.

    A part without writable arrays is returned itself. Objects that hold arrays have a method `with_arrays(act)`, which
    returns the object with `act` applied to each array.
    """
    result: Tree = map_arrays(tree, as_read_only)
    return result


def map_arrays(tree: Any, act: Act) -> Any:
    """Return a tree with `act` applied to all its arrays; parts that do not change are returned themselves."""
    cls = type(tree)
    if cls in PLAIN:
        return tree
    if cls is ndarray:
        return act(tree)
    if hasattr(cls, "with_arrays"):
        return tree.with_arrays(act)
    if isinstance(tree, tuple) or cls is list:
        parts = [map_arrays(part, act) for part in tree]
        if all(map(is_, parts, tree)):
            return tree
        return parts if cls is list else tuple.__new__(cls, parts)
    if cls is dict:
        values = [map_arrays(part, act) for part in tree.values()]
        return tree if all(map(is_, values, tree.values())) else dict(zip(tree, values, strict=True))
    return tree
