from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from slam_backend.core.validation import bad_argument, check_array, check_choice, check_float, check_int

CURE = "Do otherwise."


def test_an_error_says_argument_expected_got_and_cure() -> None:
    """The one form of all refusals, with long values shortened."""
    text = "gate: expected a number > 0, got -1.5. Do otherwise."
    assert str(bad_argument("gate", "a number > 0", -1.5, CURE)) == text
    long = str(bad_argument("gate", "a number", list(range(100)), CURE))
    assert len(long) < 140
    assert "..." in long


@pytest.mark.parametrize("value", [0, -3, 2.0, True, "two", None, np.float64(3.0)])
def test_what_is_not_a_count_is_refused(value: Any) -> None:
    """Bools, floats, strings and too small numbers are no counts."""
    with pytest.raises(ValueError, match=r"n: expected an int >= 1, got .*\. Do otherwise\."):
        check_int("n", value, 1, CURE)


@pytest.mark.parametrize("value", [9, np.uint64(2**63), pytest.param(10**5000, id="no digits")])
def test_counts_may_have_an_upper_bound(value: Any) -> None:
    """The message states the bound that is passed, and the greatest number is still taken."""
    with pytest.raises(ValueError, match=r"n: expected an int <= 8, got .*\. Do otherwise\."):
        check_int("n", value, 1, CURE, 8)
    assert check_int("n", 8, 1, CURE, 8) == 8


def test_counts_of_numpy_are_counts() -> None:
    """An integer of numpy becomes one of Python."""
    assert type(check_int("n", np.int32(4), 1, CURE)) is int


@pytest.mark.parametrize(
    ("value", "bounds", "expected"),
    [
        (0.0, {"above": 0.0}, "a finite number > 0"),
        (-1, {"at_least": 0.0}, "a finite number >= 0"),
        (1.5, {"at_least": 0.0, "at_most": 1.0}, "a finite number >= 0 and <= 1"),
        (1.5, {"at_most": 1.0}, "a finite number <= 1"),
        (np.inf, {}, "a finite number"),
        (np.nan, {"above": 0.0}, "a finite number > 0"),
        ("1", {}, "a finite number"),
        (True, {}, "a finite number"),
        ([1.0], {}, "a finite number"),
        (10**400, {}, "a finite number"),
        pytest.param(-(10**5000), {"at_most": 1.0}, "a finite number <= 1", id="no digits"),
    ],
)
def test_numbers_outside_their_bounds_are_refused(value: Any, bounds: dict[str, float], expected: str) -> None:
    """The message states the bounds."""
    with pytest.raises(ValueError, match=f"^x: expected {expected}, got "):
        check_float("x", value, CURE, **bounds)


def test_numbers_inside_their_bounds_become_floats() -> None:
    """Closed bounds belong to the interval."""
    assert check_float("x", 1, CURE, at_least=1.0, at_most=1.0) == 1.0
    assert type(check_float("x", np.float32(0.5), CURE, above=0.0)) is float


@pytest.mark.parametrize("value", ["ICP", "", None, 3])
def test_unknown_names_are_refused_with_the_known_ones(value: Any) -> None:
    """The message lists the choices."""
    with pytest.raises(ValueError, match=r"^method: expected one of 'ransac', 'icp', got .*\. Choose one of these"):
        check_choice("method", value, ("ransac", "icp"))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1.0, 2.0], r"x: expected an array of shape \(n, 2\), got shape \(2,\)\. Do otherwise\."),
        (np.zeros((4, 3)), r"x: expected an array of shape \(n, 2\), got shape \(4, 3\)"),
        ([[1.0, 2.0], [3.0]], r"x: expected an array of shape \(n, 2\), got \[\[1.0, 2.0\], \[3.0\]\]"),
        ([["a", "b"]], r"x: expected an array of shape \(n, 2\) of real numbers, got"),
        ([["1", "2"]], r"x: expected an array of shape \(n, 2\) of real numbers, got \[\['1', '2'\]\]"),
        ([[1.0, "2"]], r"x: expected an array of shape \(n, 2\) of real numbers, got \[\[1.0, '2'\]\]"),
        (np.array([[1.0, "2"]], object), r"x: expected an array of shape \(n, 2\) of real numbers"),
        (None, r"x: expected an array of shape \(n, 2\) of real numbers, got None"),
        ([[1j, 2.0]], r"x: expected an array of shape \(n, 2\) of real numbers, got an array of complex128"),
        ([[np.complex128(1), 2.0]], r"of real numbers, got an array of complex128"),
        ([np.zeros(2, complex)], r"of real numbers, got an array of complex128"),
        (np.array([[1j, 2.0]], object), r"x: expected an array of shape \(n, 2\) of real numbers"),
        (np.zeros((1, 2), complex), r"of real numbers, got an array of complex128"),
        (np.zeros((1, 2), "m8[s]"), r"x: expected an array of shape \(n, 2\) of real numbers"),
        (np.ma.masked_equal([[1.0, 2.0]], 2.0), r"x: expected an array .*, got a masked array with hidden entries"),
        ([[10**400, 2]], r"x: expected an array of shape \(n, 2\), got \[\[1000"),
        ([[10**5000, 2]], r"x: expected an array of shape \(n, 2\), got a list that cannot be shown"),
        ([[1.0, 2.0], [np.inf, 0.0]], r"x: expected finite numbers, got NaN or infinity at index \(1, 0\)"),
    ],
)
def test_arrays_of_another_shape_or_not_finite_are_refused(value: Any, message: str) -> None:
    """The message states both shapes, or where the bad number stands."""
    with pytest.raises(ValueError, match=message):
        check_array("x", value, (None, 2), CURE)


def test_checked_arrays_are_fresh() -> None:
    """What comes back shares no memory with what was given."""
    given = np.zeros((3, 2))
    checked = check_array("x", given, (None, 2), CURE)
    assert not np.shares_memory(given, checked)
    assert check_array("x", [[np.nan, 1]], (1, 2), CURE, finite=False).dtype == np.float64


def test_whole_numbers_stay_whole() -> None:
    """An integer array is not made from numbers that are not integers."""
    for value in ([1.5, 2.0], np.array([1.0, np.nan])):
        with pytest.raises(ValueError, match=r"ids: expected whole numbers"):
            check_array("ids", value, (2,), CURE, dtype=np.int64)
    np.testing.assert_array_equal(check_array("ids", [1.0, 2.0], (2,), CURE, dtype=np.int64), [1, 2])
    odd = np.array([2**53 + 1, 2], object)  # a float would round it
    np.testing.assert_array_equal(check_array("ids", odd, (2,), CURE, dtype=np.int64), [2**53 + 1, 2])


@pytest.mark.parametrize(
    ("value", "dtype"),
    [([1e300, 0.0], np.int64), ([2.0**63, 0.0], np.int64), ([2**63, 0], np.int64), ([-(2**31) - 1, 0], np.int32)],
)
def test_whole_numbers_out_of_range_are_refused(value: Any, dtype: Any) -> None:
    """Numbers that the integers of an array cannot hold do not wrap around."""
    with pytest.raises(ValueError, match=r"ids: expected whole numbers that int\d\d can hold"):
        check_array("ids", value, (2,), CURE, dtype=dtype)


@pytest.mark.parametrize("value", [[1j, 2.0], [np.complex128(1), 2.0], ["1", "2"], [10**400, 1]])
def test_whole_numbers_are_real_ones(value: Any) -> None:
    """What is no real number is refused for an integer array without a warning."""
    with pytest.raises(ValueError, match=r"ids: expected an array of shape \(2,\)"):
        check_array("ids", value, (2,), CURE, dtype=np.int64)


def test_numbers_that_a_narrow_type_cannot_hold_are_refused() -> None:
    """What is finite in float64 and not in float32 is refused by its value."""
    with pytest.raises(ValueError, match=r"x: expected numbers that float32 can hold, got 1e\+39\. Do otherwise\."):
        check_array("x", [1.0, 1e39], (2,), CURE, dtype=np.float32)


def test_real_numbers_of_all_kinds_are_taken() -> None:
    """Fractions, Python's ints in object arrays, bools, and masked arrays that hide nothing are numbers."""
    for value in ([Fraction(1, 2), 2], np.array([0.5, 2], object), np.ma.array([0.5, 2.0]), [np.float32(0.5), 2]):
        checked = check_array("x", value, (2,), CURE)
        assert type(checked) is np.ndarray
        assert checked.tolist() == [0.5, 2.0]
    assert check_array("x", [True, 2], (2,), CURE).tolist() == [1.0, 2.0]
