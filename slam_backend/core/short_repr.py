"""One-line `repr` of objects with arrays or many settings."""

from collections.abc import Iterable, Iterator
from dataclasses import MISSING, Field, fields
from reprlib import Repr
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

FEW = 6  # entries of an array that are shown
LONGEST_PART = 80  # characters of an object within a record; a longer one is shown by class and length


def short_repr(kind: type[T]) -> type[T]:
    """Give a dataclass or named tuple a short `repr`, without fields that have their defaults; a class decorator.

    Settings are written so that Python can evaluate them. In records, objects with arrays, large arrays are shown by
    shape and type, and numbers with four significant digits.

    >>> from dataclasses import dataclass
    >>> @short_repr
    ... @dataclass
    ... class Path:
    ...     times: np.ndarray
    ...     poses: np.ndarray
    ...     frame: str = "map"
    >>> Path(np.array([0.0, 1.23456]), np.zeros((2, 3)))
    Path(times=[0, 1.235], poses=<(2, 3) float64>)
    """
    kind.__repr__ = _of_fields  # type: ignore[method-assign]
    return kind


def described(value: object, names: Iterable[str]) -> str:
    """Return the short `repr` of an object by the names of some attributes."""
    return _text(value, {name: getattr(value, name) for name in names})


def _of_fields(self: Any) -> str:
    shown = {name: getattr(self, name) for name, default in _defaults(self) if not _is(getattr(self, name), default)}
    return _text(self, shown)


def _text(value: object, parts: dict[str, Any]) -> str:
    short = _RECORDS if any(isinstance(part, np.ndarray) for part in parts.values()) else _SETTINGS
    texts = (f"{name}={short.brief(part, short.repr(part))}" for name, part in parts.items())
    return f"{type(value).__name__}({', '.join(texts)})"


def _defaults(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the shown fields of a dataclass or named tuple and their defaults; `MISSING`: none."""
    if isinstance(value, tuple):
        kind: Any = type(value)
        for name in kind._fields:
            yield name, kind._field_defaults.get(name, MISSING)
        return
    field: Field[Any]
    for field in fields(value):
        if field.repr:
            yield field.name, field.default if field.default_factory is MISSING else field.default_factory()


def _is(value: Any, default: Any) -> bool:
    if value is default:  # also NaN
        return True
    return type(value) is type(default) and not isinstance(value, np.ndarray) and bool(value == default)


class _Short(Repr):
    """Texts of the values of fields."""

    def __init__(self, is_exact: bool) -> None:
        super().__init__()
        self._is_exact = is_exact
        self.maxtuple = self.maxlist = self.maxdict = 16
        self.maxstring = self.maxlong = 200

    def brief(self, x: Any, text: str) -> str:
        """Return the text of a part, or class and length where it is too long."""
        if self._is_exact or (len(text) <= LONGEST_PART and "\n" not in text):
            return text
        is_sized = hasattr(x, "__len__") and not hasattr(x, "_fields")
        return f"<{type(x).__name__} of {len(x)}>" if is_sized else f"<{type(x).__name__}>"

    def repr1(self, x: Any, level: int) -> str:
        if isinstance(x, np.ndarray):
            if x.ndim != 1 or x.size > FEW or x.dtype.kind not in "biuf":
                return f"<{x.shape} {x.dtype}>"
            return f"[{', '.join(self.repr1(entry, level) for entry in x.tolist())}]"
        return super().repr1(x.item() if isinstance(x, np.generic) else x, level)

    def repr_float(self, x: float, level: int) -> str:
        return repr(x) if self._is_exact else f"{x + 0.0:.4g}"  # no -0

    def repr_instance(self, x: Any, level: int) -> str:
        return self.brief(x, repr(x))


_SETTINGS, _RECORDS = _Short(is_exact=True), _Short(is_exact=False)
