"""`PlainConfig`: what decides a command's results, from plain values as a `config.toml` holds them, and back."""

from collections.abc import Mapping, Sequence
from dataclasses import Field, asdict, fields, is_dataclass
from typing import Any, ClassVar, Self

from slam_backend.core.validation import bad_argument


class PlainConfig:
    """Base of the frozen dataclasses that hold all that decides a command's results.

    Attributes:
        seed: Of all random draws, or the first of several. Run folders keep it beside the other values.
    """

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    seed: int

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a config from plain values, as `to_mapping` gives them; what is left out has its default.

        Args:
            values: By the names of the fields; a table for a field that is a dataclass itself, lists for tuples.

        Raises:
            ValueError: If a name is unknown or a value is out of its range; the message names it.
        """
        _refuse_unknown("config", values, cls)
        all_values = cls.completed(values)
        chosen: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in all_values.items()}
        for field in fields(cls):
            if isinstance(field.type, type) and is_dataclass(field.type) and chosen.get(field.name) is not None:
                _refuse_unknown(field.name, chosen[field.name], field.type)
                chosen[field.name] = field.type(**chosen[field.name])
        return cls(**chosen)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return plain values with what they leave out, where that depends on the others."""
        return values

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat the command, the seed apart."""
        return {name: value for name, value in asdict(self).items() if name != "seed"}


def check_each_once(name: str, values: Sequence[Any]) -> None:
    """Refuse a list without values, or with one of them twice.

    Raises:
        ValueError: If it is such; the message names `name`.
    """
    if not values or len(set(values)) < len(values):
        raise bad_argument(name, "at least one value, each once", list(values), "Correct the list.")


def _refuse_unknown(name: str, values: Any, kind: type[Any]) -> None:
    """Raise if `values` is no mapping, or names something that the dataclass `kind` lacks."""
    names = [field.name for field in fields(kind)]
    if not isinstance(values, Mapping):
        raise bad_argument(name, f"a table of {', '.join(names)}", values, "Write it as a table.")
    unknown = [key for key in values if key not in names]
    if unknown:
        raise bad_argument(name, f"names among {', '.join(names)}", unknown[0], "Correct the name.")
