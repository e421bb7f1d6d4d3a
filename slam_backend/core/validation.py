"""The one form in which bad input is refused: argument, what was expected, what came, and the cure."""

import math
from functools import wraps
from inspect import isbuiltin, signature
from numbers import Real
from pathlib import PurePath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
BoolArray = NDArray[np.bool_]

WRITTEN_IN_PYTHON = 1 << 9  # Py_TPFLAGS_HEAPTYPE of a class
MOST = 10**9  # of steps and the like: kernels hold such numbers, and no run takes more
NUMBERS = "biuf"  # kinds of dtypes that are real numbers


def argument_error(name: str, expected: str, got: object, cure: str) -> ValueError:
    """Build the error for a bad argument.

    Args:
        name: The argument as the caller wrote it, e.g. `"num_particles"`.
        expected: What is accepted, e.g. `"an int >= 1"`.
        got: What came; its `repr` is shown, shortened to 80 characters, or a whole path.
        cure: What to do about it, a full sentence.

    Returns:
        The exception, for the caller to raise.

    >>> print(argument_error("num_particles", "an int >= 1", 0, "Use at least one particle."))
    num_particles: expected an int >= 1, got 0. Use at least one particle.
    """
    if isinstance(got, PurePath):
        return ValueError(f"{name}: expected {expected}, got {str(got)!r}. {cure}")
    described = isinstance(got, str) and got.startswith(("shape ", "an array ", "a ", "'", "no ", "NaN"))
    text = str(got) if described else _short_text(got)
    if len(text) > 80:
        text = text[:77] + "..."
    return ValueError(f"{name}: expected {expected}, got {text}. {cure}")


def _short_text(got: object) -> str:
    """Return the `repr` of something, or its type where that fails."""
    try:
        return repr(got)
    except Exception:  # an int of 5000 digits has none, and an object of the caller's may raise anything
        return f"a {type(got).__name__} that cannot be shown"


def check_kind(name: str, value: Any, kind: type[T], cure: str = "") -> T:
    """Return `value` if it is an instance of a class, or raise.

    Args:
        name: The argument as the caller wrote it.
        value: The value to check.
        kind: The class.
        cure: Advice for another, a full sentence; empty: to build one.

    Raises:
        ValueError: As `argument_error` words it.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise argument_error(name, f"{article} {kind.__name__}", value, cure or f"Build one: {kind.__name__}(...).")
    return value


def is_built_in(maker: object) -> bool:
    """Tell whether a function or class is one of Python or of an extension, which nothing of the user's ever is."""
    return isbuiltin(maker) or (isinstance(maker, type) and not maker.__flags__ & WRITTEN_IN_PYTHON)


def known_names(kind: type[T]) -> type[T]:
    """Let a class refuse keyword arguments that it does not have, with a list of those it has; to decorate a class.

    >>> @known_names
    ... class Gate:
    ...     def __init__(self, width: float = 1.0) -> None: ...
    >>> Gate(widht=2.0)
    Traceback (most recent call last):
    ...
    ValueError: widht: expected a known argument, got a name that Gate does not have. It has width.
    """
    begin: Any = kind.__init__
    known = tuple(signature(begin).parameters)[1:]  # without self

    @wraps(begin)
    def checked(self: Any, *values: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                got, cure = f"a name that {kind.__name__} does not have", f"It has {', '.join(known)}."
                raise argument_error(name, "a known argument", got, cure)
        begin(self, *values, **named)

    kind.__init__ = checked  # type: ignore[method-assign]
    return kind


def check_int(name: str, value: Any, minimum: int, cure: str, maximum: int | None = None) -> int:
    """Return `value` as an int, or raise if it is not an integer (bools are not) or out of bounds.

    Args:
        name: The argument as the caller wrote it.
        value: What came.
        minimum: The least that is accepted.
        cure: What to do about another, a full sentence.
        maximum: The most that is accepted; None: any.

    Raises:
        ValueError: As `argument_error` words it.
    """
    is_int = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_int or value < minimum:
        raise argument_error(name, f"an int >= {minimum}", value, cure)
    if maximum is not None and value > maximum:
        raise argument_error(name, f"an int <= {maximum}", value, cure)
    return int(value)


def check_float(
    name: str,
    value: Any,
    cure: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return `value` as a finite float inside the stated bounds, or raise.

    Args:
        name: The argument as the caller wrote it.
        value: What came.
        cure: What to do about one outside, a full sentence.
        above: It must be greater than this.
        at_least: It must not be less than this.
        at_most: It must not be greater than this.

    Raises:
        ValueError: As `argument_error` words it.
    """
    expected = "a finite number"
    if above is not None:
        expected += f" > {above:g}"
    if at_least is not None:
        expected += f" >= {at_least:g}"
    if at_most is not None:
        expected += f" and <= {at_most:g}" if (above is not None or at_least is not None) else f" <= {at_most:g}"
    try:
        is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
        number = float(value) if is_number else math.nan
    except OverflowError:  # an int beyond all floats
        number = math.inf
    if (
        not math.isfinite(number)
        or (above is not None and number <= above)
        or (at_least is not None and number < at_least)
        or (at_most is not None and number > at_most)
    ):
        raise argument_error(name, expected, value, cure)
    return number


def check_seed(seed: Any) -> Any:
    """Return `seed` if it can seed a random stream: an int >= 0, a SeedSequence or a Generator; or raise."""
    if isinstance(seed, (np.random.SeedSequence, np.random.Generator)):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        cure = "Give an int, so that the run can be repeated."
        raise argument_error("seed", "an int >= 0, a SeedSequence or a Generator", seed, cure)
    return int(seed)


def check_choice(name: str, value: Any, choices: tuple[str, ...], cure: str = "Choose one of these names.") -> str:
    """Return `value` if it is one of `choices`, or raise with the list of them.

    Args:
        name: The argument as the caller wrote it.
        value: What came.
        choices: All that are accepted.
        cure: What to do about another, a full sentence.

    Raises:
        ValueError: As `argument_error` words it.
    """
    if not isinstance(value, str) or value not in choices:
        raise argument_error(name, "one of " + ", ".join(repr(c) for c in choices), value, cure)
    return value


def check_array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    cure: str,
    *,
    dtype: Any = np.float64,
    finite: bool = True,
    within: float | None = None,
) -> NDArray[Any]:
    """Return `value` as a fresh C-ordered array of `dtype`, or raise if its shape or content is wrong.

    Args:
        name: The argument as the caller wrote it.
        value: Anything that numpy can read.
        shape: Expected shape, None for a free axis.
        cure: What to do about it.
        dtype: Of the result; None: as it comes.
        finite: Refuse NaN and infinity.
        within: Refuse larger numbers, by magnitude.

    Returns:
        An array of that shape. Integer dtypes accept floats only if these are whole numbers.

    Raises:
        ValueError: As `argument_error` words it.
    """
    given = value if type(value) is np.ndarray and value.dtype.kind in NUMBERS else _read(name, value, shape, cure)
    is_ready = dtype is None or given.dtype == dtype
    array = np.array(given, order="C") if is_ready else _cast(name, value, given, dtype, cure)
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        raise argument_error(name, f"an array of shape {_shape_text(shape)}", f"shape {array.shape}", cure)
    if finite and array.size and not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        if np.isfinite(given[where]):
            raise argument_error(name, f"numbers that {array.dtype} can hold", given[where].item(), cure)
        raise argument_error(name, "finite numbers", f"NaN or infinity at index {where}", cure)
    if within is not None and array.size and (largest := float(np.abs(array).max())) > within:
        raise argument_error(name, f"numbers within +-{within:g}", largest, cure)
    return array


def _read(name: str, value: Any, shape: tuple[int | None, ...], cure: str) -> NDArray[Any]:
    """Return what is not plainly an array of real numbers as one, perhaps the caller's own, or raise."""
    expected = f"an array of shape {_shape_text(shape)}"
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):  # numpy would take what the mask hides
        raise argument_error(name, expected, "a masked array with hidden entries", cure)
    try:
        given = np.asarray(value)
        if given.dtype.kind == "O" and all(isinstance(entry, Real) for entry in given.flat):
            given = np.asarray(given.tolist())  # of the kind that the numbers have
            given = given.astype(np.float64) if given.dtype.kind == "O" else given
    except (TypeError, ValueError, OverflowError) as error:
        raise argument_error(name, expected, value, cure) from error
    if given.dtype.kind not in NUMBERS:  # of complex numbers numpy would drop a part, and it would read texts
        got = f"an array of {given.dtype}" if given.dtype.kind == "c" else value
        raise argument_error(name, expected + " of real numbers", got, cure)
    return given


def _cast(name: str, value: Any, given: NDArray[Any], dtype: Any, cure: str) -> NDArray[Any]:
    """Return the numbers `given`, read from `value`, as a fresh array of `dtype`, or raise if they are none of these.

    Only integers are asked for that here; what is too large for floats becomes infinite.
    """
    if np.issubdtype(dtype, np.integer):
        if given.dtype.kind == "f" and not np.array_equal(given, np.rint(given)):
            raise argument_error(name, "whole numbers", value, cure)
        bounds = np.iinfo(dtype)
        if given.size and not bounds.min <= given.min().item() <= given.max().item() <= bounds.max:
            raise argument_error(name, f"whole numbers that {np.dtype(dtype)} can hold", value, cure)
    with np.errstate(over="ignore"):  # infinity is refused by the caller
        return np.array(given, dtype=dtype, order="C")


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """Write a shape with `n` for free axes."""
    return "(" + ", ".join("n" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
