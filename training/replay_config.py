"""Configurations of replays: plain values in, checked dataclasses out, and back."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, TypeVar

from slam_backend.errors import bad_argument, check_choice, check_float, check_int
from slam_backend.filter_options import PROPOSALS

Config = TypeVar("Config")


def from_plain(kind: type[Config], values: Mapping[str, Any], tables: Mapping[str, type[Any]]) -> Config:
    """Build a config of a dataclass from plain values, as `to_plain` gives them.

    Args:
        kind: The dataclass.
        values: By the names of its fields.
        tables: Fields that are dataclasses themselves, and given as tables of values.

    Raises:
        ValueError: If a name is unknown or a value is out of its range.
    """
    chosen = dict(values)
    _refuse_unknown("config", chosen, kind)
    for name, inner in tables.items():
        if chosen.get(name) is not None:
            _refuse_unknown(name, chosen[name], inner)
            chosen[name] = inner(**chosen[name])
    return kind(**chosen)


def to_plain(config: Any) -> dict[str, Any]:
    """Return the plain values that repeat a replay, the seed apart."""
    return {name: value for name, value in asdict(config).items() if name != "seed"}


def check_common(
    particles: int, estimator: str, seed: int, duration: float | None, rejuvenate_every: int | None
) -> None:
    """Refuse what no replay can use.

    Raises:
        ValueError: If a value is out of its range; the text names it.
    """
    check_int("particles", particles, 1, "Use at least one particle; 100 is a good start.")
    check_int("seed", seed, 0, "Use 0 or a positive number.")
    check_choice("estimator", estimator, PROPOSALS)
    if duration is not None:
        check_float("duration", duration, "Give seconds, or leave it away.", above=0.0)
    if rejuvenate_every is not None:
        check_int("rejuvenate_every", rejuvenate_every, 1, "Give a number, or leave it away for never.")


def _refuse_unknown(name: str, values: Any, kind: type[Any]) -> None:
    """Raise if `values` is no mapping, or names something that the dataclass `kind` lacks."""
    names = [known.name for known in fields(kind)]
    if not isinstance(values, Mapping):
        raise bad_argument(name, f"a table of {', '.join(names)}", values, "Write it as a table.")
    unknown = [key for key in values if key not in names]
    if unknown:
        raise bad_argument(name, f"names among {', '.join(names)}", unknown[0], "Correct the name.")
