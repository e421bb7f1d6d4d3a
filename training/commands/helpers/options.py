"""Command-line options, generated from the class of a command's configuration."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from rich.markup import escape

from training.commands.helpers.run_folder import Call, ConfigT, claim_stdout
from training.experiments.config import option_arguments, value_type

NEXT_FREE = "the next free one in runs"

Check = Annotated[bool, typer.Option("--check", help="Exit with status 1 unless all claims hold.")]
Json = Annotated[
    Path | None,
    typer.Option(
        help="Also write the metrics to this file; - is stdout, with all other output on stderr.",
        show_default=False,
        callback=claim_stdout,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
]
OUT = {False: "New run folder.", True: "Run folder: a new one, or the one of a stopped run to resume."}


def _check_workers(number: int) -> int:
    if number < 1:
        from slam_backend.core.validation import argument_error

        raise argument_error("workers", "an int >= 1", number, "Use at least one process.")
    return number


Workers = Annotated[
    int, typer.Option(help="Number of processes; each runs a trial at a time.", callback=_check_workers)
]
Cluster = Annotated[
    str | None,
    typer.Option(
        help="Address of a Ray cluster that plays the episodes, or auto; see ray start.", show_default="this machine"
    ),
]


def options(
    kind: type[ConfigT], command: str, *, quick: Mapping[str, Any] | None = None, quick_help: str = "",
    log: tuple[Path, str] | None = None, continues: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:  # fmt: skip
    """Give a command the options of its configuration, plus --quick, --out, --json and --config.

    The command is called with a `Call`; its other parameters are additional options.

    Args:
        quick: Values set by --quick; None: there is no such option.
        log: Folder of the log, see `Call`.
        continues: Whether stopped runs can be resumed, see `Call`.
    """
    fields = {_name(name, field): (name, field) for name, field in kind.model_fields.items() if option_arguments(field)}

    def decorate(work: Callable[..., None]) -> Callable[..., None]:
        own = list(signature(work).parameters.values())[1:]

        @wraps(work)
        def run(**passed: Any) -> None:
            given = {field: _parsed(name, *fields[name], passed[name]) for name, (field, _) in fields.items()}
            call = Call(
                kind=kind, command=command, given={name: v for name, v in given.items() if v is not None},
                out=passed["out"], json=passed["json"], file=passed["config"], log=log, continues=continues,
                quick=quick if quick is not None and passed["quick"] else {},
            )  # fmt: skip
            work(call, **{parameter.name: passed[parameter.name] for parameter in own})

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
    """Return the words of a comma-separated text."""
    return tuple(word.strip() for word in text.split(","))


def numbers(name: str, text: str, kind: Callable[[str], Any] = int) -> tuple[Any, ...]:
    """Return the numbers of a comma-separated text such as `10, 100`.

    Raises:
        ValueError: If an entry is not a number; the message gives the option.
    """
    from slam_backend.core.validation import argument_error

    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError as error:
        raise argument_error(name, "comma-separated numbers", repr(text), "Write them like 10,100.") from error


@contextmanager
def naming(**options: str) -> Iterator[None]:
    """Let errors about an argument within a block name the option that gave it.

    Args:
        options: The option by name of the argument: `path="truth"`.
    """
    from slam_backend.core.validation import is_argument_error

    try:
        yield
    except ValueError as error:
        name, colon, rest = str(error).partition(":")
        if name not in options or not is_argument_error(error):
            raise
        raise ValueError(options[name] + colon + rest) from error


def _name(name: str, field: FieldInfo) -> str:
    """Return the parameter name of a field."""
    option = str((option_arguments(field) or {})["option"])
    return name if not option or option.startswith("--") else option


def _is_list(field: FieldInfo) -> bool:
    return "tuple[" in str(field.annotation)


def _parsed(option: str, name: str, field: FieldInfo, value: Any) -> Any:
    """Return the value of an option as the configuration takes it; None if it was not given."""
    if value is None:
        return None
    if isinstance(value, Path):
        return str(value.resolve())
    kind, _ = value_type(field.annotation)
    if not _is_list(field):
        return value
    return numbers(option, value, kind) if kind in (int, float) else words(value)


def _parameter(option: str, name: str, field: FieldInfo) -> Parameter:
    """Return the parameter from which typer makes an option; its default is None, which means not given."""
    about = option_arguments(field) or {}
    kind, _ = value_type(field.annotation)
    text = escape(field.description or "")  # units in brackets are not markup
    if about["is_path"]:
        kind = Path
    elif _is_list(field) or kind not in (int, float, bool):
        kind = str
    shown = about["shown"] or _shown(option, field.default)
    if about["is_argument"]:
        return _keyword(option, Annotated[kind | None, typer.Argument(help=text, show_default=False)])
    flags = [about["option"]] if about["option"].startswith("--") else []
    if about["also"]:
        flags = [f"--{option.replace('_', '-')}", about["also"]]
    declared = typer.Option(*flags, help=text, show_default=shown, autocompletion=_completion(field))
    return _keyword(option, Annotated[kind | None, declared])


def _completion(field: FieldInfo) -> Callable[[str], list[str]] | None:
    """Return the function with which a shell completes an option that has names to choose from."""
    leaf, _ = value_type(field.annotation)
    if get_origin(leaf) is not Literal:
        return None

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if _is_list(field) else ("", "", incomplete)
        return [f"{before}{comma}{name}" for name in get_args(leaf) if name.startswith(last)]

    return complete


def _shown(option: str, default: Any) -> str | bool:
    """Return the default shown by `--help`."""
    if default is None or default is PydanticUndefined:
        return False
    if isinstance(default, bool):
        return option if default else f"no-{option}"
    return ",".join(f"{v:g}" if isinstance(v, float) else str(v) for v in _each(default))


def _each(value: Any) -> Iterator[Any]:
    yield from value if isinstance(value, tuple) else (value,)


def _keyword(name: str, annotation: Any, default: Any = None) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
