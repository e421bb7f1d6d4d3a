"""Reader of text files of users: encodings, ends of lines, sizes, and places in error messages.

Every text file that is not the program's own is read here: logs, calibrations, configurations, worlds. Files are
limited in size before memory is taken, and no content runs code.
"""

import codecs
import json
import os
import re
from collections.abc import Hashable, Iterable, Iterator
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any

from slam_backend.core.files import checked_path, missing_error
from slam_backend.core.validation import argument_error

MOST_MEGABYTES = 1024  # of a log; a million rows of TUM take 100
MOST_SETTINGS_MEGABYTES = 16  # of TOML, JSON and YAML, whose trees take a hundred times the memory
DEEPEST = 50  # levels of nested lists and mappings
MARKS = (  # UTF-32's mark begins with UTF-16's
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def place(file: str | PathLike[str], line: int, column: int | None = None) -> str:
    """Name a place in a file, counted from 1, as all error messages do.

    >>> place("log.tum", 3), place("map.yaml", 3, 7)
    ('line 3 of log.tum', 'line 3, column 7 of map.yaml')
    """
    return f"line {line}{'' if column is None else f', column {column}'} of {file}"


def existing_file(path: str | PathLike[str], name: str = "path", kind: str = "a file") -> Path:
    """Return the path of an existing file.

    Args:
        path: Path of the file.
        name: The argument that gave the path, for the error.
        kind: Kind of file, for the error, for example "a CSV file".

    Raises:
        ValueError: If there is no such file.
    """
    path = checked_path(path, name)
    try:
        exists = path.is_file()
    except OSError as error:  # e.g. a name too long for the system
        raise argument_error(name, kind, path, f"Check the path: {error.strerror}.") from error
    if not exists:
        raise missing_error(name, kind, path)
    return path


def read_bytes(path: str | PathLike[str], name: str, kind: str, most_megabytes: int) -> bytes:
    """Return the content of an existing file of limited size.

    Raises:
        ValueError: If the file is missing, cannot be read or is larger than `most_megabytes` [2^20 bytes].
    """
    file, most = existing_file(path, name, kind), most_megabytes << 20
    try:
        with open(file, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            content = stream.read() if size <= most else b""  # read(most) would take that much memory for any file
    except OSError as error:
        raise argument_error(name, f"{kind} that can be read", file, f"The system says: {error.strerror}.") from error
    if max(size, len(content)) > most:
        raise argument_error(name, f"{kind} of at most {most_megabytes} MiB", file, "Split it, or drop what is unused.")
    return content


def read_text(
    path: str | PathLike[str], name: str = "path", kind: str = "a text file", most_megabytes: int = MOST_MEGABYTES
) -> str:
    r"""Return the text of a file, without byte order mark and with lines that end with "\n".

    Args:
        path: File in UTF-8, or in UTF-16 or UTF-32 with a byte order mark; lines end with LF, CRLF or CR.
        name: The argument that gave the path, for the error.
        kind: Kind of file, for the error, for example "a CSV file".
        most_megabytes: Largest size of the file [2^20 bytes].

    Raises:
        ValueError: If the file is missing, too large or in another encoding.
    """
    content = read_bytes(path, name, kind, most_megabytes)
    mark, encoding = next(((mark, name) for mark, name in MARKS if content.startswith(mark)), (b"", "utf-8"))
    try:
        text = content[len(mark) :].decode(encoding) if encoding == "utf-8" else content.decode(encoding)
    except UnicodeDecodeError as error:
        before = content[: error.start]
        line = before.count(b"\n") + 1
        where = place(path, line, error.start - before.rfind(b"\n")) if encoding == "utf-8" else str(path)
        hint = f"Save the file in UTF-8; see {where}."
        raise argument_error(name, f"{kind} in UTF-8", "a file in another encoding", hint) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def data_lines(text: str) -> Iterator[tuple[int, str]]:
    r"""Yield number and content of each line of `read_text` with more than a comment, which begins with `#`.

    >>> list(data_lines("# x y\n1 2  # start\n\n3 4"))
    [(2, '1 2'), (4, '3 4')]
    """
    for number, line in enumerate(text.split("\n"), start=1):
        if body := line.partition("#")[0].strip():
            yield number, body


def parse_numbers(words: Iterable[str]) -> list[float] | None:
    """Return the numbers that words write, or None if one of them does not write any.

    >>> parse_numbers("1 -2.5e3".split()), parse_numbers("1_000 2".split())
    ([1.0, -2500.0], None)
    """
    found = list(words)
    if any("_" in word for word in found):  # Python accepts 1_000, which is damage in a log
        return None
    try:
        return [float(word) for word in found]
    except ValueError:
        return None


def line_error(name: str, expected: str, got: str, path: str | PathLike[str], line: int) -> ValueError:
    """Return the error of a line, or a part `got` of it, in a file that an argument names."""
    return argument_error(name, expected, repr(got), f"Correct {place(path, line)}.")


def read_json(path: str | PathLike[str], name: str, hint: str) -> Any:
    """Return the content of a JSON file.

    Args:
        path: Path of the file.
        name: The argument that gave the path, for the error.
        hint: Advice on the expected content, a full sentence.

    Raises:
        ValueError: If the file is missing or too large, is not JSON or is nested too deeply.
    """
    text = read_text(path, name, "a JSON file", MOST_SETTINGS_MEGABYTES)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise _syntax_error(name, "JSON", error.msg, place(path, error.lineno, error.colno), hint) from error
    except ValueError as error:  # an int of thousands of digits
        raise _syntax_error(name, "JSON", str(error), str(path), hint) from error
    except RecursionError as error:
        raise _syntax_error(name, "JSON", "nested too deeply", str(path), hint) from error


def read_toml(path: str | PathLike[str], name: str, hint: str = "") -> dict[str, Any]:
    """Return the content of a TOML file; arguments and errors are those of `read_json`."""
    return parse_toml(read_text(path, name, "a TOML file", MOST_SETTINGS_MEGABYTES), name, path, hint)


def parse_toml(text: str, name: str, source: str | PathLike[str], hint: str = "") -> dict[str, Any]:
    """Return the content of a text in TOML.

    Args:
        text: The text.
        name: The argument that gave it, for the error.
        source: File or origin of the text, for the error.
        hint: Advice on the expected content, a full sentence or nothing.

    Raises:
        ValueError: If the text is not TOML, or is nested too deeply.
    """
    import tomllib  # a slow import

    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        reason, _, at = str(error).partition(" (at ")
        found = re.match(r"line (\d+), column (\d+)", at)
        where = place(source, int(found[1]), int(found[2])) if found else str(source)
        raise _syntax_error(name, "TOML", reason, where, hint) from error
    except ValueError as error:  # an int of thousands of digits
        raise _syntax_error(name, "TOML", str(error), str(source), hint) from error
    except RecursionError as error:
        raise _syntax_error(name, "TOML", "nested too deeply", str(source), hint) from error


def read_yaml(path: str | PathLike[str], name: str, hint: str) -> Any:
    """Return the content of a YAML file, with numbers as YAML 1.2 and ROS read them: `5e-2` is one.

    Aliases, which can make a small file expand to gigabytes, are refused.

    Args:
        path: Path of the file.
        name: The argument that gave the path, for the error.
        hint: Advice on the expected content, a full sentence.

    Raises:
        ValueError: If the file is missing or too large, is not YAML, uses an alias, or is nested too deeply.
    """
    import yaml

    text = read_text(path, name, "a YAML file", MOST_SETTINGS_MEGABYTES)
    try:
        return _yaml_loader()(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = str(path) if mark is None else place(path, mark.line + 1, mark.column + 1)
        raise _syntax_error(name, "YAML", error.problem or error.context or "", where, hint) from error
    except (yaml.YAMLError, ValueError) as error:  # a character or a number that YAML cannot hold
        raise _syntax_error(name, "YAML", str(error).splitlines()[0], str(path), hint) from error


@cache  # the class is built at first use, when PyYAML is imported
def _yaml_loader() -> Any:
    """Return the class of loaders of `read_yaml`."""
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]   # no type information is published
        """Loader that follows no aliases, limits the depth and reads numbers of YAML 1.2."""

        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            event = self.peek_event()
            if self.check_event(yaml.AliasEvent):
                raise yaml.MarkedYAMLError(problem="an alias, which is not followed", problem_mark=event.start_mark)
            self.depth += 1
            if self.depth > DEEPEST:
                raise yaml.MarkedYAMLError(problem="nested too deeply", problem_mark=event.start_mark)
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
            keys = [key.value for key, _ in node.value]
            for index, (key, _) in enumerate(node.value):
                if isinstance(key.value, str) and key.value in keys[:index]:
                    raise yaml.MarkedYAMLError(problem=f"a second {key.value!r}", problem_mark=key.start_mark)
            return dict(super().construct_mapping(node, deep))

    numbers = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
    Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in numbers]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    Loader.add_implicit_resolver(numbers[0], re.compile(r"[-+]?[0-9]+$"), list("-+0123456789"))
    decimal = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
    Loader.add_implicit_resolver(numbers[1], decimal, list("-+0123456789."))
    Loader.add_constructor(numbers[0], lambda loader, node: int(loader.construct_scalar(node)))
    return Loader


def _syntax_error(name: str, language: str, reason: str, where: str, hint: str) -> ValueError:
    """Return the error of a file that its language does not allow."""
    return argument_error(
        name, f"a file in {language}", f"a syntax error: {reason}", f"Correct {where}. {hint}".rstrip()
    )
