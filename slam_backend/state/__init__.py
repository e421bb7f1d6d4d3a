"""State of objects, declared once: snapshots, their restoration and their checks.

A class lists the parts of its state, from which `take` makes a snapshot and `restore` returns to it:

>>> import numpy as np
>>> from slam_backend.state import INT64, Array, Generator, State, restore, take
>>> class Counter:
...     STATE = State(sums=Array(INT64, "K", low=0), rng=Generator())
...     def __init__(self) -> None:
...         self._sums, self.rng = np.zeros(3, np.int64), np.random.default_rng(0)
>>> counter = Counter()
>>> before = take(counter)
>>> counter._sums += 5
>>> restore(counter, before)
>>> counter._sums.tolist()
[0, 0, 0]

Names of parts are names of attributes or properties, with or without a leading underscore. A class may have hooks:
`make_room(snapshot)` provides arrays of the right sizes, before parts are set. `rebuild()` computes what follows from
the state, after that. `check_state(parts, sizes)` raises if kernels would go wrong with parts that are within their
bounds one by one.

A snapshot cannot be changed, nor can its arrays: `restore` takes it without checks. Copies, pickles and files of a
snapshot are plain dicts, which `accepted` turns into a snapshot again. It checks types, shapes and bounds, because
kernels trust the indices that they get.

Sizes have names. The first array with a name in its shape defines it; names in capitals also hold for children.
"""

from slam_backend.state.declaration import (
    Part,
    Sizes,
    Snapshot,
    State,
    is_stateful,
    refuse,
    restore,
    restored,
    take,
    with_state,
)
from slam_backend.state.objects import (
    CLASS,
    Child,
    ChildOf,
    OneOf,
    Options,
    Record,
    Saved,
    accepted,
    built_options,
    options_in,
)
from slam_backend.state.streams import Generator, Seed, checked_stream
from slam_backend.state.values import (
    BOOL,
    FLOAT32,
    FLOAT64,
    INT8,
    INT32,
    INT64,
    LARGEST,
    MAX_DESCRIPTOR,
    MAX_DISTANCE,
    MAX_INT,
    MAX_LANDMARKS,
    UINT8,
    Array,
    Dict,
    Each,
    Flag,
    Float,
    Int,
    Maybe,
    Row,
    Text,
    check_shape,
)

__all__ = [
    "BOOL",
    "CLASS",
    "FLOAT32",
    "FLOAT64",
    "INT8",
    "INT32",
    "INT64",
    "LARGEST",
    "MAX_DESCRIPTOR",
    "MAX_DISTANCE",
    "MAX_INT",
    "MAX_LANDMARKS",
    "UINT8",
    "Array",
    "Child",
    "ChildOf",
    "Dict",
    "Each",
    "Flag",
    "Float",
    "Generator",
    "Int",
    "Maybe",
    "OneOf",
    "Options",
    "Part",
    "Record",
    "Row",
    "Saved",
    "Seed",
    "Sizes",
    "Snapshot",
    "State",
    "Text",
    "accepted",
    "built_options",
    "check_shape",
    "checked_stream",
    "is_stateful",
    "options_in",
    "refuse",
    "restore",
    "restored",
    "take",
    "with_state",
]  # fmt: skip
