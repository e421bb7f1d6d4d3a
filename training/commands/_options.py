"""Options of commands, generated from the class of their configuration."""

from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from training.commands._run_folder import Call, ConfigT, claim_stdout
from training.experiments.config import about_option, kind_of

NEXT_FREE = "the next free one in runs"

Check = Annotated[bool, typer.Option("--check", help="Exit with status 1 unless all claims hold.")]
Json = Annotated[
    Path | None,
    typer.Option(
        help="Write the metrics to this file too; - is stdout, and all else goes to stderr then.",
        show_default=False,
        callback=claim_stdout,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
]
OUT = {False: "New run folder.", True: "Run folder: a new one, or that of a run to go on with."}


def _check_processes(number: int) -> int:
    if number < 1:
        from slam_backend.core.validation import argument_error

        raise argument_error("processes", "an int >= 1", number, "Use one process or more.")
    return number


Processes = Annotated[int, typer.Option(help="Trials at a time.", callback=_check_processes)]


def options(
    kind: type[ConfigT], command: str, *, quick: Mapping[str, Any] | None = None, quick_help: str = "",
    log: tuple[Path, str] | None = None, continues: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:  # fmt: skip
    """Give a command the options of its configuration, and --quick, --out, --json and --config.

    The command is called with a `Call`; its other parameters are options of its own.

    Args:
        quick: Values that --quick stands for; None: there is no such option.
        log: As `Call` has it.
        continues: As `Call` has it.
    """
    fields = {_name(name, field): (name, field) for name, field in kind.model_fields.items() if about_option(field)}

    def decorate(work: Callable[..., None]) -> Callable[..., None]:
        own = list(signature(work).parameters.values())[1:]

        @wraps(work)
        def run(**told: Any) -> None:
            given = {field: _parsed(name, *fields[name], told[name]) for name, (field, _) in fields.items()}
            call = Call(
                kind=kind, command=command, given={name: v for name, v in given.items() if v is not None},
                out=told["out"], json=told["json"], file=told["config"], log=log, continues=continues,
                quick=quick if quick is not None and told["quick"] else {},
            )  # fmt: skip
            work(call, **{parameter.name: told[parameter.name] for parameter in own})

        parameters = [_parameter(name, *fields[name]) for name in fields if fields[name][0] != "seed"] + own
        parameters += [_parameter(name, *fields[name]) for name in fields if fields[name][0] == "seed"]
        if quick is not None:
            parameters.append(_keyword("quick", Annotated[bool, typer.Option("--quick", help=quick_help)], False))
        place = Annotated[Path | None, typer.Option(help=OUT[continues], show_default=NEXT_FREE)]
        parameters += [_keyword("out", place), _keyword("json", Json), _keyword("config", Config)]
        shape = signature(work).replace(parameters=[p.replace(kind=Parameter.KEYWORD_ONLY) for p in parameters])
        run.__signature__ = shape  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        return run

    return decorate


def words(text: str) -> tuple[str, ...]:
    """Return the words of a text with commas between."""
    return tuple(word.strip() for word in text.split(","))


def numbers(name: str, text: str, kind: Callable[[str], Any] = int) -> tuple[Any, ...]:
    """Return the numbers of a text such as `10, 100`.

    Raises:
        ValueError: If one is no number; the message names the option.
    """
    from slam_backend.core.validation import argument_error

    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError as error:
        raise argument_error(name, "numbers with commas between", repr(text), "Write them like 10,100.") from error


def _name(name: str, field: FieldInfo) -> str:
    """Return the name of a field's parameter."""
    told = str((about_option(field) or {})["option"])
    return name if not told or told.startswith("--") else told


def _is_list(field: FieldInfo) -> bool:
    return "tuple[" in str(field.annotation)


def _parsed(option: str, name: str, field: FieldInfo, value: Any) -> Any:
    """Return the value of an option as the configuration takes it; None: it was not given."""
    if value is None:
        return None
    if isinstance(value, Path):
        return str(value.resolve())
    kind, _ = kind_of(field.annotation)
    if not _is_list(field):
        return value
    return numbers(option, value, kind) if kind in (int, float) else words(value)


def _parameter(option: str, name: str, field: FieldInfo) -> Parameter:
    """Return the parameter from which typer makes an option, None by default: what is not given is left open."""
    about = about_option(field) or {}
    kind, _ = kind_of(field.annotation)
    if about["is_path"]:
        kind = Path
    elif _is_list(field) or kind not in (int, float, bool):
        kind = str
    shown = about["shown"] or _shown(option, field.default)
    if about["is_argument"]:
        return _keyword(option, Annotated[kind | None, typer.Argument(help=field.description, show_default=False)])
    flags = [about["option"]] if about["option"].startswith("--") else []
    return _keyword(option, Annotated[kind | None, typer.Option(*flags, help=field.description, show_default=shown)])


def _shown(option: str, default: Any) -> str | bool:
    """Return the default that `--help` shows."""
    if default is None or default is PydanticUndefined:
        return False
    if isinstance(default, bool):
        return option if default else f"no-{option}"
    return ",".join(f"{v:g}" if isinstance(v, float) else str(v) for v in _each(default))


def _each(value: Any) -> Iterator[Any]:
    yield from value if isinstance(value, tuple) else (value,)


def _keyword(name: str, annotation: Any, default: Any = None) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
