"""`ExperimentConfig`: complete configuration of a command; its fields are the options of the command.

The modules that define configurations import no numerical library, so that `--help` is fast.
"""

from collections.abc import Iterable, Mapping
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict
from pydantic.fields import FieldInfo

Positive = Annotated[int, Field(ge=1)]
NonNegative = Annotated[int, Field(ge=0)]
RobotCount = Annotated[int, Field(ge=1, le=8)]
ActionType = Literal["continuous", "discrete", "goal"]
NoisePreset = Literal["easy", "standard", "hard"]
Preset = Literal["easy", "standard", "hard", "large"]
Sensor = Literal["landmark", "stereo"]
Proposal = Literal["fastslam2", "fastslam1"]
Descriptor = Literal["usurf", "sift", "orb"]
ONE_PARTICLE = "Use at least one particle; 100 is a good start."
HINTS = {int: "Choose a number in this range.", bool: "Say true or false.", str: "Write it as text."}


def option(
    default: Any, help: str, *, name: str | None = None, also: str = "", shown: str | None = None, hint: str = "",
    is_path: bool = False, is_argument: bool = False, **constraints: Any,
) -> Any:  # fmt: skip
    """Return a field that is also an option on the command line.

    Args:
        name: Name of the option, or two names with a slash for a flag; None: the name of the field.
        also: Second spelling of the option, with its dashes.
        shown: Default as `--help` shows it; None: the value.
        hint: Advice in the error for a bad value; a full sentence.
        is_path: Whether the value is a path, which is made absolute.
        constraints: Bounds, as for `pydantic.Field`.
    """
    about: JsonDict = {
        "option": name or "", "also": also, "shown": shown, "hint": hint, "is_path": is_path,
        "is_argument": is_argument,
    }  # fmt: skip
    return Field(default, description=help, json_schema_extra=about, **constraints)


def setting(default: Any, description: str = "", **constraints: Any) -> Any:
    """Return a field without a command-line option; programs and the `config.toml` of earlier runs set it."""
    return Field(default, description=description, **constraints)


def first_seed() -> Any:
    """Return the field of the first of several consecutive seeds."""
    return option(0, "First of the consecutive seeds.", name="first_seed", ge=0, hint="Use 0 or a positive number.")


def table(path: str) -> Any:
    """Return the type of a field that is a dataclass of another package, imported when a configuration is created."""

    def build(value: Any, info: ValidationInfo) -> Any:
        module, name = path.split(":")
        kind: Any = getattr(import_module(module), name)
        if isinstance(value, kind):
            return value
        names, field = list(kind.__dataclass_fields__), str(info.field_name)
        if not isinstance(value, Mapping):
            raise _error(field, f"a table of {', '.join(names)}", value, "Write it as a table.")
        for name in value:
            if name not in names:
                raise _unknown_name(field, name, names)
        return kind(**value)

    return Annotated[Any, BeforeValidator(build), Field(validate_default=True)]


class Checked(BaseModel):
    """Frozen values, validated at creation."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        """Validate all values.

        Raises:
            ValueError: If a name is unknown or a value is out of range; the message gives the name.
        """
        try:
            super().__init__(**{name: tuple(v) if isinstance(v, list) else v for name, v in values.items()})
        except ValidationError as error:
            raise _one_line_error(type(self), error) from None

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed, validated again."""
        return type(self)(**{**dict(self), **changes})

    def check(self) -> None:
        """Refuse combinations of values that are not allowed; each value alone is in range."""

    @field_validator("*")
    @classmethod
    def _check_list(cls, value: Any) -> Any:
        if isinstance(value, tuple) and (not value or len(set(value)) < len(value)):
            raise ValueError  # `_one_line_error` adds the name
        return value

    @model_validator(mode="after")
    def _check_all(self) -> Self:
        self.check()
        return self


class ExperimentConfig(Checked):
    """Base of all configurations, which are stored in `config.toml`; run folders store the seed separately."""

    seed: int = option(0, "Seed of all random draws.", ge=0, hint="Use 0 or a positive number.")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from the plain values of `to_mapping`; omitted values have their defaults."""
        return cls(**cls.completed(values))

    @classmethod
    def implied(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return further plain values that given ones imply, such as those of a preset."""
        return {}

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return plain values with omitted values filled in, where these depend on other values."""
        return {**cls.implied(values), **values}

    @classmethod
    def merged(cls, earlier: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the plain values of an earlier run, overridden by given ones and what these imply."""
        return {**earlier, **cls.implied(given), **given}

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values that repeat the command, except the seed."""
        return self.model_dump(exclude={"seed"})


def option_arguments(field: FieldInfo) -> dict[str, Any] | None:
    """Return the arguments of `option` for a field; None if the field is not an option."""
    extra = field.json_schema_extra
    return dict(extra) if isinstance(extra, Mapping) and "option" in extra else None


def value_type(annotation: Any) -> tuple[Any, list[Any]]:
    """Return the type and constraints of a value, or of the entries of a list; an alternative None is ignored.

    >>> value_type(tuple[Positive, ...] | None)
    (<class 'int'>, [Ge(ge=1)])
    """
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        kind, constraints = value_type(inner)
        return kind, [*constraints, *(c for each in more for c in getattr(each, "metadata", [each]))]
    if get_origin(annotation) in (Union, UnionType, tuple):
        return value_type(next(each for each in get_args(annotation) if each is not NoneType))
    return annotation, []


def _one_line_error(kind: type[Checked], error: ValidationError) -> ValueError:
    """Return the first validation error in the error format of the project."""
    errors = error.errors()
    for each in errors:
        if each["type"] == "extra_forbidden":
            return _unknown_name("config", str(each["loc"][0]), kind.model_fields)
    first, value = errors[0], errors[0]["input"]
    cause = first.get("ctx", {}).get("error")
    if cause is not None and str(cause):
        return ValueError(str(cause))
    field = kind.model_fields[str(first["loc"][0])]
    about = option_arguments(field) or {"option": "", "hint": ""}
    name = str(about["option"] or first["loc"][0]).split("/")[0].removeprefix("--")
    if cause is not None:
        return _error(name, "at least one value, each once", list(value), "Correct the list.")
    leaf, constraints = value_type(field.annotation)
    hint = str(about["hint"]) or HINTS.get(leaf, HINTS[int])
    if first["type"] == "missing":
        return _error(name, "a value", "none", hint)
    if get_origin(leaf) is Literal:
        from slam_backend.core.validation import choice_error

        return choice_error(name, value, get_args(leaf))
    return _error(name, _range(leaf, [*constraints, *field.metadata]), value, hint)


def _range(kind: Any, constraints: list[Any]) -> str:
    """Describe the values that a number may have."""
    if kind not in (int, float):
        return {bool: "a bool", str: "a text"}.get(kind, "a table")
    bounds = {name: getattr(each, name) for each in constraints for name in ("gt", "ge", "le") if hasattr(each, name)}
    if kind is int and "ge" in bounds and "le" in bounds:
        return f"an int from {bounds['ge']} to {bounds['le']}"
    signs = {"gt": ">", "ge": ">=", "le": "<="}
    limits = " and ".join(f"{signs[name]} {bound:g}" for name, bound in bounds.items())
    return f"{'an int' if kind is int else 'a finite number'} {limits}".rstrip()


def _unknown_name(name: str, wrong: Any, known: Iterable[str]) -> ValueError:
    """Return the error of a name in a table that has none such."""
    from slam_backend.core.validation import did_you_mean

    expected = f"names among {', '.join(known)}"
    return _error(name, expected, wrong, f"{did_you_mean(wrong, known)}Correct the name.")


def _error(name: str, expected: str, got: Any, hint: str) -> ValueError:
    from slam_backend.core.validation import argument_error

    return argument_error(name, expected, got, hint)
