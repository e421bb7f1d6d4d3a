"""Arrays that are handed out or shared: who holds one can neither write to it nor make it writable."""

from collections.abc import Callable
from operator import is_
from typing import Any, TypeVar

import numpy as np
from numpy import ndarray
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
Tree = TypeVar("Tree")

Act = Callable[[NDArray[Any]], NDArray[Any]]

PLAIN = frozenset((int, float, bool, str, type(None)))  # looked up first, for most parts of states are such


def is_read_only(array: NDArray[Any]) -> bool:
    """Tell whether an array lies on a read-only buffer, so that numpy refuses to make it writable.

    >>> frozen = np.zeros(2)
    >>> frozen.setflags(write=False)  # which can be taken back
    >>> is_read_only(frozen), is_read_only(as_read_only(frozen)), is_read_only(as_read_only(frozen)[1:])
    (False, True, True)
    """
    base: Any = array.base
    while type(base) is ndarray:
        base = base.base
    return type(base) is memoryview and base.readonly


def as_read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a view that follows the array's changes and refuses `flags.writeable = True`.

    numpy makes a view writable if the array that owns its memory is. The view lies on a read-only buffer, which is not.

    >>> view = as_read_only(np.zeros(2))
    >>> view.flags.writeable = True
    Traceback (most recent call last):
    ValueError: cannot set WRITEABLE flag to True of this array
    """
    return array if is_read_only(array) else np.asarray(array.data.toreadonly())


def as_constant(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return an array with the same numbers that no other holder can change: a copy unless it is read-only already."""
    return array if is_read_only(array) else as_read_only(array.copy())


def with_read_only(tree: Tree) -> Tree:
    """Return a tree of tuples, lists and dicts with read-only views of the arrays in it; all else is shared.

    A part in which nothing can be written comes back itself. Objects that hold arrays take part by a method
    `with_arrays(act)`, which returns the same with `act` done to each array.
    """
    result: Tree = map_arrays(tree, as_read_only)
    return result


def with_constants(tree: Tree) -> Tree:
    """Return such a tree whose arrays no other holder can change: copies unless they are read-only already."""
    result: Tree = map_arrays(tree, as_constant)
    return result


def map_arrays(tree: Any, act: Act) -> Any:
    """Return a tree with `act` done to all arrays in it; parts in which that changes nothing come back themselves."""
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
