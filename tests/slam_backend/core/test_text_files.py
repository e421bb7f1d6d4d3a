"""The reader of users' text files: encodings, limits, and places in errors."""

import tracemalloc
from pathlib import Path

import pytest

from slam_backend.core.text_files import parse_toml, read_json, read_text, read_toml, read_yaml

TEXT = "Größe\nzwei\n"
MARKED = {"utf-8": "utf-8-sig", "utf-16": "utf-16", "utf-32": "utf-32"}  # Python writes the mark of the last two


@pytest.mark.parametrize("encoding", ["utf-8", *MARKED.values()])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_marks_and_ends_of_lines(tmp_path: Path, encoding: str, end: str) -> None:
    """A text is the same with any byte order mark and any end of lines."""
    file = tmp_path / "a.txt"
    file.write_bytes(TEXT.replace("\n", end).encode(encoding))
    assert read_text(file) == TEXT


def test_other_encoding_is_located(tmp_path: Path) -> None:
    """Bytes that are not UTF-8 are named by line and column."""
    file = tmp_path / "a.txt"
    file.write_bytes("eins\nGröße\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"in UTF-8, got a file in another encoding.*line 2, column 3 of .*a\.txt"):
        read_text(file)


@pytest.mark.parametrize("path", ["missing.txt", ".", "x" * 5000, "a\0b", 3])
def test_no_such_file(path: object) -> None:
    """A path without a file is refused in one line."""
    with pytest.raises(ValueError, match="log: expected") as caught:
        read_text(path, "log")  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_size_is_limited(tmp_path: Path) -> None:
    """A file above the limit is refused with the limit."""
    file = tmp_path / "a.txt"
    with open(file, "wb") as stream:
        stream.truncate((1 << 20) + 1)
    with pytest.raises(ValueError, match="at most 1 MiB"):
        read_text(file, most_megabytes=1)


def test_reading_takes_memory_for_the_file_and_not_for_its_limit(tmp_path: Path) -> None:
    """A file of two bytes that may have a GiB is read in less than a MiB."""
    (tmp_path / "a.txt").write_text("ab")
    tracemalloc.start()
    try:
        assert read_text(tmp_path / "a.txt", most_megabytes=1024) == "ab"
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5e-2", 0.05), ("+1E3", 1000.0), (".5", 0.5), ("5.", 5.0), ("010", 10), ("-7", -7), ("1_0", "1_0"),
        ("1:30", "1:30"), ("0x1F", "0x1F"), ("5e", "5e"), ("-.inf", -float("inf")), ("a1", "a1"), ("'5'", "5"),
    ],
)  # fmt: skip
def test_yaml_numbers(tmp_path: Path, text: str, value: object) -> None:
    """Numbers are those of YAML 1.2, which has no octal, binary or sexagesimal ones of YAML 1.1."""
    (tmp_path / "a.yaml").write_text(f"x: {text}")
    found = read_yaml(tmp_path / "a.yaml", "world", "Write x.")["x"]
    assert (found, type(found)) == (value, type(value))


ALIASES = zip("abcdefgh", "bcdefghi", strict=True)
BOMB = "a: &a [x, x]\n" + "".join(f"{k}: &{k} [{', '.join([f'*{j}'] * 9)}]\n" for j, k in ALIASES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 20_000, "nested too deeply. Correct line 1, column 51"),
        ("- " * 20_000, "nested too deeply. Correct line 1, column 101"),
        (BOMB, "an alias, which is not followed. Correct line 2, column 8"),
        ("a: [1\nb: 2", "Correct line 2, column 2"),
        ("a: 1\nb: 2\na: 3", "a second 'a'. Correct line 3, column 1"),
        ("a: \0", "a syntax error"),
        ("a: " + "9" * 5000, "a syntax error"),
        ("a: !!python/object/apply:os.system [ls]", "Correct line 1, column 4"),
    ],
    ids=["lists", "items", "aliases", "syntax", "twice", "character", "digits", "code"],
)
def test_bad_yaml(tmp_path: Path, text: str, message: str) -> None:
    """Malformed, recursive and expanding YAML is refused in one line with its place."""
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match="world: expected a file in YAML") as caught:
        read_yaml(tmp_path / "a.yaml", "world", "Write x.")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "line 1, column 2"), ("[" * 100_000, "nested too deeply"), ("9" * 5000, "a syntax error"), ("", "line 1")],
)
def test_bad_json(tmp_path: Path, text: str, message: str) -> None:
    """Malformed and deeply nested JSON is refused in one line with its place."""
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match="world: expected a file in JSON") as caught:
        read_json(tmp_path / "a.json", "world", "Write walls.")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = 1 2", "line 1, column 7 of b.toml"),
        ("a = " + "[" * 20_000, "nested too deeply"),
        ("a = ", "b.toml"),
        ("a = " + "9" * 5000, "Exceeds the limit"),
    ],
)
def test_bad_toml(text: str, message: str) -> None:
    """Malformed and deeply nested TOML, and ints of thousands of digits, are refused in one line with its place."""
    with pytest.raises(ValueError, match="config: expected a file in TOML") as caught:
        parse_toml(text, "config", "b.toml")
    assert message in str(caught.value)


def test_toml_with_mark(tmp_path: Path) -> None:
    """A TOML file of an editor that writes a byte order mark is read."""
    (tmp_path / "a.toml").write_bytes("\ufeffseed = 3\r\n".encode())
    assert read_toml(tmp_path / "a.toml", "config") == {"seed": 3}
