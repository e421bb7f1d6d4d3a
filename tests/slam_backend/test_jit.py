from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba.core.errors import NumbaError
from python_entry import python_entry

from slam_backend.core import jit as _jit
from slam_backend.core.kernel_cache import CheckedFile


def test_this_version_of_numba_can_leave_references_uncounted() -> None:
    """The option is numba's own: where it has gone, all works as before, but slower."""
    assert _jit.CAN_LEAVE_UNCOUNTED


@pytest.mark.parametrize("compiled", [_jit.in_place, _jit.inlined, _jit.lanes, _jit.lanes_inlined, _jit.any_order])
def test_kernels_that_work_in_place_can_make_no_array(compiled: Callable[[Any], Any]) -> None:
    """Its counter would be missing: numba refuses to compile them."""

    def makes_one(x: float) -> float:
        row = np.zeros(3)
        row[0] = x
        return float(row[0])

    with pytest.raises(NumbaError, match=r"zeros|NRT"):
        python_entry(compiled(makes_one))(1.0)


def test_kernels_that_count_may_call_those_that_do_not_and_the_other_way_round() -> None:
    """What is not counted by one is none of the other's business."""

    def add_one(row: Any) -> None:
        for i in range(len(row)):
            row[i] += 1.0

    def total_of_new(size: int) -> float:
        row = np.zeros(size)
        in_place(row[1:])
        return float(row.sum())

    def twice(size: int, row: Any) -> None:
        row[:] = 2.0 * counted(size)

    in_place, counted = _jit.in_place(add_one), _jit.jit(total_of_new)
    row = np.zeros(2)
    _jit.in_place(twice)(5, row)
    assert row.tolist() == [8.0, 8.0]


def test_references_are_counted_everywhere_where_numba_does_not_know_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels then work as before, and may do more."""
    monkeypatch.setattr(_jit, "CAN_LEAVE_UNCOUNTED", False)

    def makes_one(x: float) -> float:
        return float(np.full(3, x).sum())

    assert _jit.in_place(makes_one)(2.0) == 6.0


def test_rooms_of_a_kernel_are_apart_and_stay_through_its_loops() -> None:
    """A loop does not take room anew in each turn, and what it wrote last time is still there."""

    def fill(out: Any) -> None:
        one, other = _jit.room(5), _jit.room(3)
        for turn in range(4):
            if turn == 0:
                one[:] = 0.0
            other[:] = float(turn)
            for i in range(len(one)):
                one[i] += other[i % len(other)] + 10.0 * i
        for i in range(5):
            out[i] = one[i]

    out = np.empty(5)
    _jit.in_place(fill)(out)
    assert out.tolist() == [6.0 + 40.0 * i for i in range(5)]


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64, np.float32, np.float64])
def test_rooms_hold_numbers_of_any_type(dtype: Any) -> None:
    """They are laid out one behind the other, and wrap around as numbers of that type do."""

    def fill(out: Any) -> None:
        row = _jit.room_of(7, dtype)
        for i in range(len(row)):
            row[i] = out[i]
        for i in range(len(row)):
            out[i] = row[len(row) - 1 - i] + row[i]

    out = np.arange(7).astype(dtype) * dtype(40)
    expected = out + out[::-1]
    _jit.in_place(fill)(out)
    assert out.tolist() == expected.tolist()


def test_the_size_of_a_room_is_a_constant() -> None:
    """The stack has no room for what nobody has foreseen."""

    def fill(size: int) -> float:
        return float(_jit.room(size)[0])

    with pytest.raises(NumbaError):
        _jit.in_place(fill)(3)


def test_the_result_of_a_kernel_does_not_depend_on_which_kernel_asks_for_it_first() -> None:
    """A division by zero raises in a strict kernel, even if a lane kernel, where it gives inf, called it first."""

    def quotient(x: float, y: float) -> float:
        return x / y

    for decorated in (_jit.jit, _jit.in_place):
        strict = decorated(quotient)

        assert _called_first_by_a_lane_kernel(strict)
        with pytest.raises(ZeroDivisionError):
            strict(1.0, 0.0)


def _called_first_by_a_lane_kernel(strict: Any) -> bool:
    def lane(x: float) -> float:
        return strict(x, 2.0) * x

    return bool(_jit.lanes(lane)(3.0) == 4.5)


def test_a_device_kernel_refuses_a_call_from_python_and_serves_other_kernels() -> None:
    """It has no wrapper for Python, without which a call would end the process."""

    def double(x: float) -> float:
        return 2.0 * x

    def outer(x: float) -> float:
        return kernel(x) + 1.0

    kernel = _jit.device(_jit.in_place(double))
    assert _jit.in_place(outer)(3.0) == 7.0
    with pytest.raises(TypeError, match=r"double can be called by kernels only: remove @device"):
        kernel(3.0)


def test_entries_of_two_processes_that_save_at_the_same_time_are_never_mixed_up(tmp_path: Any) -> None:
    """Whatever the order of their writes, an entry holds what was compiled for it, or is missing."""
    one, other = (CheckedFile(str(tmp_path), "kernel-1", "stamp") for _ in range(2))
    one._load_index = lambda: {}  # both have read the index before either wrote
    other._load_index = lambda: {}
    one.save("float64", "code of float64")
    other.save("int64", "code of int64")
    reader = CheckedFile(str(tmp_path), "kernel-1", "stamp")
    assert reader.load("int64") == "code of int64"
    assert reader.load("float64") in (None, "code of float64")
    assert CheckedFile(str(tmp_path), "kernel-1", "another stamp").load("int64") is None


def test_options_are_part_of_what_an_entry_of_the_cache_is_checked_for() -> None:
    """A kernel that is compiled in another way is not loaded from the entry of before."""

    def double(x: float) -> float:
        return 2.0 * x

    stamps = [kind(double)._cache._cache_file._source_stamp for kind in (_jit.jit, _jit.fused, _jit.in_place)]
    stamps.append(_jit.device(_jit.jit(double))._cache._cache_file._source_stamp)
    assert all(stamps.count(stamp) == 1 for stamp in stamps)
    assert stamps[0] == _jit.jit(double)._cache._cache_file._source_stamp
