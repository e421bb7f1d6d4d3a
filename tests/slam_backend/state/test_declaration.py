"""Laws of declared states, for a class with parts of all types."""

import copy
import pickle
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from slam_backend.core.read_only import as_constant
from slam_backend.state import (
    BOOL,
    FLOAT64,
    INT64,
    Array,
    Child,
    ChildOf,
    Dict,
    Each,
    Flag,
    Float,
    Generator,
    Int,
    Maybe,
    OneOf,
    Options,
    Record,
    Row,
    Saved,
    Seed,
    Snapshot,
    State,
    Text,
    accepted,
    restore,
    take,
)
from slam_backend.state.format import equal, format_of


@dataclass(frozen=True)
class Inner:
    """Options in others."""

    width: float = 1.5


@dataclass(frozen=True)
class Outer:
    """Options."""

    inner: Inner = Inner()
    limit: int | None = None

    def __post_init__(self) -> None:
        if self.limit == 13:
            raise ValueError("not thirteen")


class Sighting(NamedTuple):
    """Record with an array."""

    STATE = State(step=Int(), points=Array(FLOAT64, "n 2", -100.0, 100.0), rows=Array(INT64, "n", 0, "M"))
    step: int
    points: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True)
class Ended:
    """Another record."""

    STATE = State(number=Int())
    number: int


class Wheel:
    """Child."""

    STATE = State(turns=Array(FLOAT64, "K", nan=True), saved=Maybe(Saved(lambda: Wheel)))

    def __init__(self) -> None:
        self.turns = np.array([1.0, np.nan, 3.0])
        self._saved: Snapshot | None = None


class Axle:
    """Another child, made without a constructor."""

    STATE = State(length=Float())

    def __init__(self, length: float) -> None:
        self.length = length

    def rebuild(self) -> None:
        """Compute what is not part of the state."""
        self.half = 0.5 * self.length


class Everything:
    """Object with a part of each type."""

    STATE = State(
        options=Options(Outer), counts=Array(INT64, "K"), table=Array(FLOAT64, "M K+1"), mask=Array(BOOL, "M"),
        goal=Maybe(Array(FLOAT64, "2", renewed=True)), steps=Int(), share=Float(0.0, 1.0), done=Flag(),
        mode=Text(("slow", "fast")), rng=Generator(), root=Seed(), num_wheels=Int(size="wheels"),
        wheels=Each(Child(Wheel), "wheels", list),
        history=Each(Record(Sighting), kind=deque), changes=Each(OneOf(Sighting, Ended), kind=list),
        groups=Each(Each(Int(high="K"))), pairs=Dict(Row(Int(), Text()), Each(Int(), kind=set)),
        row_of=Dict(Int(), Int(high="M")), front=ChildOf(lambda: Axle, Wheel), ends=Each(Float(), "2"),
    )  # fmt: skip

    def __init__(self) -> None:
        self.options, self.rebuilt = Outer(), 0
        self.counts, self._table, self.mask = np.arange(3), np.linspace(0.0, 1.0, 20).reshape(5, 4), np.arange(5) > 2
        self.goal: np.ndarray | None = np.array([1.0, 2.0])
        self.steps, self.share, self.done, self.mode = 4, 0.25, True, "slow"
        self.rng, self.root = np.random.default_rng(3), np.random.SeedSequence(5)
        self.wheels = [Wheel(), Wheel()]
        self.num_wheels, self.ends = 2, (0.5, 1.5)
        self.front: Axle | Wheel = Axle(3.0)
        one = Sighting(2, as_constant(np.ones((2, 2))), as_constant(np.array([4, 0])))
        self.wheels[0]._saved = take(self.wheels[1])
        self.history, self.changes = deque([one]), [one, Ended(7)]
        self.groups, self.pairs, self.row_of = ((0, 1), (2,)), {(1, "a"): {3, 4}}, {7: 4}

    def rebuild(self) -> None:
        """Count the calls."""
        self.rebuilt += 1

    def go_on(self) -> None:
        """Change all that can be changed."""
        self.counts += 1
        self._table *= 2.0
        self.goal, self.steps, self.done, self.mode = None, 9, False, "fast"
        self.rng.random(3), self.root.spawn(2)
        self.wheels[0].turns[:], self.front = 0.0, Wheel()
        self.history.clear(), self.changes.clear(), self.pairs[1, "a"].add(9)


SIZES = {"K": 3, "M": 5}


def test_an_object_returns_to_a_snapshot() -> None:
    """All parts are as before, arrays in place and the random stream included."""
    subject = Everything()
    before, table = take(subject), subject._table
    draws = np.random.default_rng(3).random(3)
    for _ in range(2):
        subject.go_on()
        assert not equal(before, take(subject))
        restore(subject, before)
        assert before == take(subject)
        assert subject._table is table
        assert subject.root.spawn(1)[0].spawn_key == (0,)
        restore(subject, before)
        assert subject.rng.random(3).tolist() == draws.tolist()
        restore(subject, before)
    assert subject.rebuilt == 6
    assert isinstance(subject.front, Axle)
    assert subject.front.half == 1.5
    assert subject.history[0] is before["history"][0]


COPIES: dict[str, Callable[[Any], Any]] = {
    "dict": dict,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda state: pickle.loads(pickle.dumps(state)),
    "edited": lambda state: state | {"steps": 4},
}


@pytest.mark.parametrize("way", COPIES)
def test_copies_are_plain_dicts_that_are_accepted_after_checks(way: str) -> None:
    """What was taken is accepted as it is; its copies become equal snapshots, whose parts are shared as before."""
    subject = Everything()
    state = take(subject)
    assert accepted(Everything, "state", state) is state
    other = COPIES[way](state)
    assert type(other) is dict
    again = accepted(Everything, "state", other, SIZES)
    assert again is not state
    assert again == state
    assert again["history"][0] is again["changes"][0]
    subject.go_on()
    restore(subject, again)
    assert take(subject) == state


def test_snapshots_cannot_be_changed() -> None:
    """Neither parts nor arrays, at any depth."""
    state = take(Everything())
    with pytest.raises(TypeError, match="does not support item assignment"):
        state["steps"] = 3  # type: ignore[index]
    with pytest.raises(AttributeError, match=r"of: expected a copy to change, got a snapshot. Make one with dict"):
        state.of = None
    for array in (state["counts"], state["goal"], state["wheels"][0]["turns"], state["history"][0].points):
        with pytest.raises(ValueError, match="cannot set WRITEABLE flag"):
            array.setflags(write=True)


BAD: dict[str, tuple[Any, str]] = {
    "options": (Inner(), r"state\['options'\]: expected Outer that can be built"),
    "counts": (np.arange(4), r"state\['counts'\]: expected an array of shape \(3\), got shape \(4,\)"),
    "table": (np.full((5, 4), np.nan), r"state\['table'\]: expected numbers from -1e\+12 to 1e\+12, got a value out"),
    "mask": (np.zeros(5), "expected an array of bool, got an array of float64"),
    "goal": (np.zeros(3), r"expected an array of shape \(2\)"),
    "steps": (True, r"state\['steps'\]: expected an int from 0"),
    "share": (2.0, "expected a float from 0 to 1"),
    "done": (1, "expected a bool"),
    "mode": ("still", "expected one of slow, fast"),
    "rng": ({"bit_generator": "load"}, "expected the state of one of PCG64"),
    "root": ((1, (), 1 << 40, 0), r"state\['root'\]\[2\]: expected an int from 4 to 64"),
    "wheels": (({"turns": np.zeros(2), "saved": None},) * 2, r"state\['wheels'\]\[0\]\['turns'\]: expected an array"),
    "history": ((Sighting(1, np.zeros((1, 2)), np.array([5])),), r"\['history'\]\[0\].rows: expected integers from 0"),
    "changes": ((Outer(),), "expected one of Sighting, Ended"),
    "groups": (((3,),), r"state\['groups'\]\[0\]\[0\]: expected an int from 0 to 2"),
    "pairs": ({3: {1}}, r"state\['pairs'\]: key: expected 2 values"),
    "num_wheels": (3, r"state\['wheels'\]: expected 3 of them, got 2"),
    "front": ({"class": "Ended", "length": 1.0}, r"state\['front'\]: expected the state of one of Axle, Wheel"),
    "ends": ((0.5,), r"state\['ends'\]: expected 2 of them, got 1"),
    "row_of": ({1: 5}, r"state\['row_of'\]\[1\]: expected an int from 0 to 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", Everything.STATE.parts)
def test_a_part_out_of_its_bounds_is_refused_by_name(name: str) -> None:
    """Type, shape, bounds and indices are checked, and a part that is missing is named."""
    state = take(Everything())
    value, says = BAD[name]
    with pytest.raises(ValueError, match=says):
        accepted(Everything, "state", state | {name: value}, SIZES)
    with pytest.raises(ValueError, match=f"got a mapping without '{name}'"):
        accepted(Everything, "state", {key: part for key, part in state.items() if key != name}, SIZES)


@pytest.mark.parametrize("kind", ["MT19937", "Philox", "SFC64", "PCG64DXSM"])
def test_all_bit_generators_are_restored_and_checked(kind: str) -> None:
    """Numpy takes any place in the buffer of a stream, and would read beyond it."""
    subject = Everything()
    subject.rng = np.random.Generator(getattr(np.random, kind)(0))
    state = take(subject)
    expected = subject.rng.random(9).tolist()
    restore(subject, accepted(Everything, "state", copy.deepcopy(state), SIZES))
    assert subject.rng.random(9).tolist() == expected
    rng = copy.deepcopy(state["rng"])
    outer = rng["state"] if kind == "MT19937" else rng
    outer["pos" if kind == "MT19937" else "has_uint32"] = 10**9
    with pytest.raises(ValueError, match=r"state\['rng'\].*\]: expected an int from 0 to"):
        accepted(Everything, "state", state | {"rng": rng}, SIZES)


def test_shared_parts_are_checked_once() -> None:
    """A file in which each part refers twice to the one before would take for ever."""

    class Pair:
        STATE = State(sides=Each(Saved(lambda: Pair)))

    state: Any = {"sides": ()}
    for _ in range(200):
        state = {"sides": (state, state)}
    found = accepted(Pair, "state", state)
    assert found["sides"][0] is found["sides"][1]


def test_the_format_follows_the_declarations() -> None:
    """Each change of a declaration, also of a child, a record or options, changes the number; nothing else does."""

    def declared(child: type = Wheel, **parts: Any) -> str:
        kind: Any = type("Box", (), {"STATE": State(child=Child(child), **parts)})
        return format_of(kind)

    other = type("Wheel", (), {"STATE": State(turns=Array(FLOAT64, "K"), saved=Maybe(Saved(lambda: Wheel)))})
    found = [declared(), declared(other), declared(a=Int()), declared(b=Int()), declared(a=Int(1)),
             declared(a=Record(Sighting)), declared(a=Record(Ended)), declared(a=Options(Outer))]  # fmt: skip
    assert len(set(found)) == len(found)
    assert declared(a=Record(lambda: Sighting)) == declared(a=Record(Sighting))
    assert format_of(Everything) == format_of(Everything)
