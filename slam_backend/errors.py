"""The one form in which bad input is refused: argument, what was expected, what came, and the cure."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


def bad_argument(name: str, expected: str, got: object, cure: str) -> ValueError:
    """Build the error for a bad argument.

    Args:
        name: The argument as the caller wrote it, e.g. `"num_particles"`.
        expected: What is accepted, e.g. `"an int >= 1"`.
        got: What came; its `repr` is shown, shortened to 80 characters.
        cure: What to do about it, a full sentence.

    Returns:
        The exception, for the caller to raise.

    >>> print(bad_argument("num_particles", "an int >= 1", 0, "Use at least one particle."))
    num_particles: expected an int >= 1, got 0. Use at least one particle.
    """
    described = isinstance(got, str) and got.startswith(("shape ", "an array ", "a ", "'", "no ", "NaN"))
    text = str(got) if described else repr(got)
    if len(text) > 80:
        text = text[:77] + "..."
    return ValueError(f"{name}: expected {expected}, got {text}. {cure}")


def check_int(name: str, value: Any, minimum: int, cure: str) -> int:
    """Return `value` as an int, or raise if it is not an integer (bools are not) or below `minimum`.

    Args:
        name: The argument as the caller wrote it.
        value: What came.
        minimum: The least that is accepted.
        cure: What to do about another, a full sentence.

    Raises:
        ValueError: As `bad_argument` words it.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < minimum:
        raise bad_argument(name, f"an int >= {minimum}", value, cure)
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
        ValueError: As `bad_argument` words it.
    """
    expected = "a finite number"
    if above is not None:
        expected += f" > {above:g}"
    if at_least is not None:
        expected += f" >= {at_least:g}"
    if at_most is not None:
        expected += f" and <= {at_most:g}" if (above is not None or at_least is not None) else f" <= {at_most:g}"
    number_like = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if (
        not number_like
        or not np.isfinite(value)
        or (above is not None and value <= above)
        or (at_least is not None and value < at_least)
        or (at_most is not None and value > at_most)
    ):
        raise bad_argument(name, expected, value, cure)
    return float(value)


def check_seed(seed: Any) -> Any:
    """Return `seed` if it can seed a random stream: an int >= 0, a SeedSequence or a Generator; or raise."""
    if isinstance(seed, (np.random.SeedSequence, np.random.Generator)):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        cure = "Give an int, so that the run can be repeated."
        raise bad_argument("seed", "an int >= 0, a SeedSequence or a Generator", seed, cure)
    return int(seed)


def check_choice(name: str, value: Any, choices: tuple[str, ...], cure: str = "Choose one of these names.") -> str:
    """Return `value` if it is one of `choices`, or raise with the list of them.

    Args:
        name: The argument as the caller wrote it.
        value: What came.
        choices: All that are accepted.
        cure: What to do about another, a full sentence.

    Raises:
        ValueError: As `bad_argument` words it.
    """
    if not isinstance(value, str) or value not in choices:
        raise bad_argument(name, "one of " + ", ".join(repr(c) for c in choices), value, cure)
    return value


def check_array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    cure: str,
    *,
    dtype: Any = np.float64,
    finite: bool = True,
) -> NDArray[Any]:
    """Return `value` as a fresh C-ordered array of `dtype`, or raise if its shape or content is wrong.

    Args:
        name: The argument as the caller wrote it.
        value: Anything that numpy can read.
        shape: Expected shape, None for a free axis.
        cure: What to do about it.
        dtype: Of the result.
        finite: Refuse NaN and infinity.

    Returns:
        An array of that shape. Integer dtypes accept floats only if these are whole numbers.

    Raises:
        ValueError: As `bad_argument` words it.
    """
    if np.issubdtype(dtype, np.integer):
        _check_whole(name, value, cure)
    if isinstance(value, np.ndarray) and value.dtype.kind == "c":  # numpy would drop a part
        raise bad_argument(name, "real numbers", f"an array of {value.dtype}", cure)
    try:
        array = np.array(value, dtype=dtype, order="C")
    except (TypeError, ValueError) as error:
        raise bad_argument(name, f"an array of shape {_shape_text(shape)}", value, cure) from error
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        raise bad_argument(name, f"an array of shape {_shape_text(shape)}", f"shape {array.shape}", cure)
    if finite and array.size and not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise bad_argument(name, "finite numbers", f"NaN or infinity at index {where}", cure)
    return array


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """Write a shape with `n` for free axes."""
    return "(" + ", ".join("n" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"


def _check_whole(name: str, value: Any, cure: str) -> None:
    """Raise if `value` holds floats that are not whole; what is no array at all is left to the caller."""
    try:
        floats = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return
    if not np.array_equal(floats, np.rint(floats)):
        raise bad_argument(name, "whole numbers", value, cure)
