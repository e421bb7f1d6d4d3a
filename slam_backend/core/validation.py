"""Argument checks with one form of error: argument, expected value, value received, and hint."""

import math
from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from inspect import isbuiltin, signature
from itertools import islice
from numbers import Real
from pathlib import PurePath
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

P = ParamSpec("P")
T = TypeVar("T")

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
BoolArray = NDArray[np.bool_]

WRITTEN_IN_PYTHON = 1 << 9  # Py_TPFLAGS_HEAPTYPE of a class
MOST = 10**9  # limit of steps and other counts: kernels hold such numbers, and no run needs more
LONGEST_NAME = 100  # characters that are compared with known names; the time grows with the square
NUMBERS = "biuf"  # dtype kinds of real numbers
MOST_SHOWN = 80  # letters of a value in an error
MOST_SAID = 2000  # letters of each other part, which may name what a file contains
MOST_SHOWN_BYTES = 1 << 14  # of an array whose numbers are formatted
DEEPEST_SHOWN = 20  # levels of nested lists and dicts
NUMBERS_ALONE: Any = "1.25" if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else False  # 0.1, not np.float64(0.1)


def argument_error(name: str, expected: str, got: object, hint: str) -> ValueError:
    """Build the error for a bad argument.

    Args:
        name: The argument as the caller wrote it, e.g. `"num_particles"`.
        expected: Description of accepted values, e.g. `"an int >= 1"`.
        got: Value received; shown as its `repr`, of which no more than 80 characters are made, or as a whole path.
        hint: Advice, a full sentence.

    No part is longer than `MOST_SAID`, whatever a file contains.

    Returns:
        The exception, for the caller to raise.

    >>> print(argument_error("num_particles", "an int >= 1", np.int64(0), "Use at least one particle."))
    num_particles: expected an int >= 1, got 0. Use at least one particle.
    """
    name, expected, hint = (_cut(text, MOST_SAID) for text in (name, expected, hint))
    if isinstance(got, PurePath):
        return ValueError(f"{name}: expected {expected}, got {str(got)[:MOST_SAID]!r}. {hint}")
    described = isinstance(got, str) and got.startswith(("shape ", "an array ", "a ", "'", "no ", "NaN"))
    text = _cut(str(got) if described else _short_text(got), MOST_SHOWN)
    return ValueError(f"{name}: expected {expected}, got {text}. {hint}")


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def is_argument_error(error: Exception) -> bool:
    """Return whether an error is one of `argument_error`, meant for the user; all others are faults."""
    return isinstance(error, ValueError) and ": expected " in str(error)


def _short_text(got: object) -> str:
    """Return the beginning of the `repr` of something, or its type where that fails."""
    text = ""
    try:
        with np.printoptions(legacy=NUMBERS_ALONE):
            for piece in _pieces(got, 0):
                text += piece
                if len(text) > MOST_SHOWN:
                    break
            return text
    except Exception:  # an int of 5000 digits has none, and an object of the caller may raise anything
        return f"a {type(got).__name__} that cannot be shown"


def _pieces(value: object, depth: int) -> Iterator[str]:
    """Yield the parts of the `repr` of something, made one by one, so that none is made of what is not shown."""
    if isinstance(value, (str, bytes)):
        yield repr(value[: MOST_SHOWN + 1])
    elif isinstance(value, np.ndarray) and value.nbytes > MOST_SHOWN_BYTES:
        yield f"an array of {value.dtype} of shape {value.shape}"
    elif type(value) not in (list, tuple, set, dict) or not value:
        yield repr(value)
    elif depth == DEEPEST_SHOWN:
        yield "..."
    else:
        entries: Any = value
        begin, end = "[]" if isinstance(value, list) else "()" if isinstance(value, tuple) else "{}"
        yield begin
        for index, entry in enumerate(islice(entries, MOST_SHOWN)):
            yield ", " if index else ""
            yield from _pieces(entry, depth + 1)
            if isinstance(value, dict):
                yield ": "
                yield from _pieces(entries[entry], depth + 1)
        yield f",{end}" if isinstance(value, tuple) and len(value) == 1 else end


def check_kind(name: str, value: Any, kind: type[T], hint: str = "") -> T:
    """Return `value` if it is an instance of a class, or raise.

    Args:
        name: The argument as the caller wrote it.
        value: The value to check.
        kind: The class.
        hint: Advice, a full sentence; empty: to build one.

    Raises:
        ValueError: As `argument_error` words it.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise argument_error(name, f"{article} {kind.__name__}", value, hint or f"Build one: {kind.__name__}(...).")
    return value


def is_built_in(maker: object) -> bool:
    """Return whether a function or class belongs to Python or to an extension, and is thus none of the user's."""
    return isbuiltin(maker) or (isinstance(maker, type) and not maker.__flags__ & WRITTEN_IN_PYTHON)


def known_names(kind: type[T]) -> type[T]:
    """Make a class refuse unknown keyword arguments with a list of the known ones; a class decorator.

    Its attribute `GONE`, if it has one, gives advice by the names of arguments of earlier versions.

    >>> @known_names
    ... class Box:
    ...     def __init__(self, width: float = 1.0) -> None: ...
    >>> Box(widht=2.0)
    Traceback (most recent call last):
    ...
    ValueError: widht: expected a known argument, got a name that Box does not have. Did you mean 'width'? It has width.
    """
    begin: Any = kind.__init__
    known = tuple(signature(begin).parameters)[1:]  # without self

    @wraps(begin)
    def checked(self: Any, *values: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                got = f"a name that {kind.__name__} does not have"
                advice = getattr(kind, "GONE", {}).get(name, did_you_mean(name, known).rstrip())
                hint = f"{advice} It has {', '.join(known)}.".lstrip()
                raise argument_error(name, "a known argument", got, hint)
        begin(self, *values, **named)

    kind.__init__ = checked  # type: ignore[method-assign]
    return kind


def with_fields_of(kind: type) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Show the fields of a dataclass in the signature of a function in place of its `**options`; a decorator."""

    def shown(function: Callable[P, T]) -> Callable[P, T]:
        own = signature(function)
        fields = [each.replace(kind=each.KEYWORD_ONLY) for each in signature(kind).parameters.values()]
        named = [each for each in own.parameters.values() if each.kind != each.VAR_KEYWORD]
        function.__signature__ = own.replace(parameters=named + fields)  # type: ignore[attr-defined]
        return function

    return shown


def check_int(name: str, value: Any, minimum: int, hint: str, maximum: int | None = None) -> int:
    """Return `value` as an int, or raise if it is not an integer (bools are not) or out of bounds.

    Args:
        name: The argument as the caller wrote it.
        value: Value received.
        minimum: Least value accepted.
        hint: Advice, a full sentence.
        maximum: Largest value accepted; None: no limit.

    Raises:
        ValueError: As `argument_error` words it.
    """
    is_int = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_int or value < minimum:
        raise argument_error(name, f"an int >= {minimum}", value, hint)
    if maximum is not None and value > maximum:
        raise argument_error(name, f"an int <= {maximum}", value, hint)
    return int(value)


def check_float(
    name: str,
    value: Any,
    hint: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return `value` as a finite float inside the stated bounds, or raise.

    Args:
        name: The argument as the caller wrote it.
        value: Value received.
        hint: Advice, a full sentence.
        above: Exclusive lower bound.
        at_least: Inclusive lower bound.
        at_most: Inclusive upper bound.

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
    except OverflowError:  # an int too large for a float
        number = math.inf
    if (
        not math.isfinite(number)
        or (above is not None and number <= above)
        or (at_least is not None and number < at_least)
        or (at_most is not None and number > at_most)
    ):
        raise argument_error(name, expected, value, hint)
    return number


def check_seed(seed: Any) -> Any:
    """Return `seed` if it can seed a random stream: an int >= 0, a SeedSequence or a Generator; or raise."""
    if isinstance(seed, (np.random.SeedSequence, np.random.Generator)):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        hint = "Give an int, so that the run can be repeated."
        raise argument_error("seed", "an int >= 0, a SeedSequence or a Generator", seed, hint)
    return int(seed)


def check_choice(name: str, value: Any, choices: tuple[str, ...], hint: str = "Choose one of these names.") -> str:
    """Return `value` if it is one of `choices`, or raise with the list of them.

    Args:
        name: The argument as the caller wrote it.
        value: Value received.
        choices: Accepted values.
        hint: Advice, a full sentence.

    Raises:
        ValueError: As `argument_error` words it.
    """
    if not isinstance(value, str) or value not in choices:
        raise choice_error(name, value, choices, hint)
    return value


def choice_error(
    name: str, value: Any, choices: Iterable[str], hint: str = "Choose one of these names.", others: str = ""
) -> ValueError:
    """Build the error for a name that does not exist: it lists the names that do, and asks for the nearest one.

    Args:
        name: The argument as the caller wrote it.
        value: Value received.
        choices: Accepted names.
        hint: Advice, a full sentence.
        others: Values accepted besides, after a comma.

    >>> print(choice_error("world", "ofice", ("office", "maze")))
    world: expected one of 'office', 'maze', got 'ofice'. Did you mean 'office'? Choose one of these names.
    """
    known = tuple(choices)
    return argument_error(
        name, f"one of {', '.join(map(repr, known))}{others}", value, did_you_mean(value, known) + hint
    )


def did_you_mean(value: Any, names: Iterable[str]) -> str:
    """Return a question for the name nearest to a misspelt one, followed by a space; empty if none is near.

    >>> did_you_mean("Fronteir", ("frontier", "random_walk")), did_you_mean("teh_best", ("frontier", "random_walk"))
    ("Did you mean 'frontier'? ", '')
    """
    from difflib import get_close_matches  # only errors need it

    if not isinstance(value, str) or len(value) > LONGEST_NAME:
        return ""
    exact = {name.lower().replace("-", "_"): name for name in names}
    near = get_close_matches(value.lower().replace("-", "_"), exact, n=1, cutoff=0.65)
    return f"Did you mean {exact[near[0]]!r}? " if near else ""


def check_array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    hint: str,
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
        hint: Advice, a full sentence.
        dtype: Type of the result; None: unchanged.
        finite: Whether NaN and infinity are refused.
        within: Largest magnitude accepted.

    Returns:
        An array of that shape. Integer dtypes accept floats only if these are whole numbers.

    Raises:
        ValueError: As `argument_error` words it.
    """
    given = value if type(value) is np.ndarray and value.dtype.kind in NUMBERS else _read(name, value, shape, hint)
    is_ready = dtype is None or given.dtype == dtype
    array = np.array(given, order="C") if is_ready else _cast(name, value, given, dtype, hint)
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        raise argument_error(name, f"an array of shape {_shape_text(shape)}", f"shape {array.shape}", hint)
    if finite and array.size and not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        if np.isfinite(given[where]):
            raise argument_error(name, f"numbers that {array.dtype} can hold", given[where].item(), hint)
        raise argument_error(name, "finite numbers", f"NaN or infinity at index {where}", hint)
    if within is not None and array.size and (largest := float(np.abs(array).max())) > within:
        raise argument_error(name, f"numbers within +-{within:g}", largest, hint)
    return array


def _read(name: str, value: Any, shape: tuple[int | None, ...], hint: str) -> NDArray[Any]:
    """Return any other value as an array of real numbers, perhaps the caller's own array, or raise."""
    expected = f"an array of shape {_shape_text(shape)}"
    is_subclass = type(value) is not np.ndarray and isinstance(value, np.ndarray)
    if is_subclass and np.ma.is_masked(value):  # numpy would read the masked entries; its `ma` is imported at first use
        raise argument_error(name, expected, "a masked array with hidden entries", hint)
    try:
        given = np.asarray(value)
        if given.dtype.kind == "O" and all(isinstance(entry, Real) for entry in given.flat):
            given = np.asarray(given.tolist())  # converts to the numbers' own type
            given = given.astype(np.float64) if given.dtype.kind == "O" else given
    except (TypeError, ValueError, OverflowError) as error:
        raise argument_error(name, expected, value, hint) from error
    if given.dtype.kind not in NUMBERS:  # numpy would drop imaginary parts and parse texts
        got = f"an array of {given.dtype}" if given.dtype.kind == "c" else value
        raise argument_error(name, expected + " of real numbers", got, hint)
    return given


def _cast(name: str, value: Any, given: NDArray[Any], dtype: Any, hint: str) -> NDArray[Any]:
    """Return the numbers `given`, read from `value`, as a fresh array of `dtype`, or raise if it cannot hold them.

    Only integer types raise here; numbers too large for a float type become infinite.
    """
    if np.issubdtype(dtype, np.integer):
        if given.dtype.kind == "f" and not np.array_equal(given, np.rint(given)):
            raise argument_error(name, "whole numbers", value, hint)
        bounds = np.iinfo(dtype)
        if given.size and not bounds.min <= given.min().item() <= given.max().item() <= bounds.max:
            raise argument_error(name, f"whole numbers that {np.dtype(dtype)} can hold", value, hint)
    with np.errstate(over="ignore"):  # infinity is refused by the caller
        return np.array(given, dtype=dtype, order="C")


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """Write a shape with `n` for free axes."""
    return "(" + ", ".join("n" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
