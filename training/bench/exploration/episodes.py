"""Rows of episodes of a plan, as files that anybody may write: columns with their ranges, declared once."""

import csv
import gzip
import hashlib
import io
import math
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from slam_backend.core.validation import argument_error
from slam_backend.maps.alignment import REASONS
from training.experiments.output.tables import csv_text

CSV, PACKED, PARQUET = "episodes.csv", "episodes.csv.gz", "episodes.parquet"
MOST_BYTES = 64 * 2**20  # of a table of episodes, unpacked: 100,000 rows
LONGEST_TEXT, LONGEST_NUMBER = 300, 40  # characters
REFUSED = "refused: "  # columns of the number of refused merges by reason
Rows = Sequence[Mapping[str, Any]]


class Field(NamedTuple):
    """Column of a table of episodes: its type, range, and whether a value may be missing."""

    kind: type
    low: float = 0.0
    high: float = math.inf
    may_lack: bool = False

    @property
    def expected(self) -> str:
        """What a value must be, in words."""
        if self.kind is str:
            return f"a text of at most {LONGEST_TEXT} printable characters"
        if self.kind is bool:
            return "True or False"
        name = "an int" if self.kind is int else "a number"
        return f"{name} from {self.low:g} to {self.high:g}" if self.high < math.inf else f"{name} >= {self.low:g}"

    def parsed(self, text: str) -> Any:
        """Return the value of a cell.

        Raises:
            ValueError: If it is none in the range.
        """
        if text == "" and self.may_lack:
            return None
        if self.kind is str and len(text) <= LONGEST_TEXT and text.isprintable():
            return text
        if self.kind is bool and text in ("True", "False"):
            return text == "True"
        if (
            self.kind in (int, float)
            and len(text) <= LONGEST_NUMBER
            and self.low <= (value := self.kind(text)) <= self.high
            and math.isfinite(value)
        ):
            return value
        raise ValueError

    def cell(self, value: Any) -> str:
        """Return the cell of a value, the same for what was measured and for what `parsed` returns."""
        return "" if value is None else f"{value:.6g}" if self.kind is float else str(value)


TEXT, SHARE, COUNT, AMOUNT = Field(str), Field(float, 0.0, 1.0), Field(int), Field(float)
FIELDS: dict[str, Field] = {
    "track": TEXT, "policy": TEXT, "family": TEXT, "world": TEXT, "robots": Field(int, 1, 8), "relaxation": TEXT,
    "seed": COUNT, "coverage": SHARE, "mean_coverage": SHARE, "reached_90": Field(bool), "below_50_s": AMOUNT,
    "below_90_s": AMOUNT, "overlap": SHARE, "map_error": Field(float, 0.0, 10.0), "map_rmse_m": Field(float, 0.0, 1e3),
    "map_recall": SHARE, "map_precision": SHARE, "ate_start_m": AMOUNT, "ate_aligned_m": AMOUNT,
    "squared_misplaced": AMOUNT, "squared_missed": AMOUNT, "squared_duplicate": AMOUNT, "squared_false": AMOUNT,
    "pose_error": AMOUNT, "nees": Field(float, may_lack=True), "way_m": AMOUNT, "balance": SHARE,
    "right_merges": COUNT, "false_merges": COUNT, "undone_merges": COUNT, "first_merge_s": Field(float, may_lack=True),
    "last_merge_s": Field(float, may_lack=True), "one_group": Field(bool), "attempts": COUNT, "bytes_sent": COUNT,
    "collisions": COUNT, "invalid_actions": COUNT, "decision_ms": AMOUNT, "decision_p99_ms": AMOUNT,
    "action_type": TEXT, "task": TEXT, "digest": TEXT, "policy_digest": TEXT, "version": TEXT, "machine": TEXT,
    **{f"{REFUSED}{reason}": COUNT for reason in REASONS},
}  # fmt: skip   # a policy without a file of its own has an empty digest


def row_digest(row: Mapping[str, Any]) -> str:
    """Return the first 16 hexadecimal digits of SHA-256 over what a table of episodes says of an episode."""
    (tidy,) = tidy_rows([row])
    return hashlib.sha256(repr([FIELDS[name].cell(value) for name, value in tidy.items()]).encode()).hexdigest()[:16]


def check_row(row: Mapping[str, Any]) -> None:
    """Refuse a row that lacks a column, or has a value out of range.

    Raises:
        KeyError, TypeError, ValueError: If it does.
    """
    for name, value in tidy_rows([row])[0].items():
        FIELDS[name].parsed(FIELDS[name].cell(value))


def tidy_rows(rows: Rows) -> list[dict[str, Any]]:
    """Return rows with the columns of `FIELDS`, one for each reason of a refusal, and without curves."""
    return [
        {
            name: row["refusals"].get(name.removeprefix(REFUSED), 0) if name.startswith(REFUSED) else row[name]
            for name in FIELDS
        }
        for row in rows
    ]


def episodes_csv(rows: Rows) -> str:
    """Return a line for each episode as CSV; floats have six significant digits."""
    return csv_text(list(FIELDS), (list(row.values()) for row in tidy_rows(rows)))


def write_parquet(file: Path, rows: Rows) -> bool:
    """Write a line for each episode as Parquet; return whether pyarrow (extra `parquet`) is installed."""
    try:
        import pyarrow as pa  # type: ignore[import-untyped]
        from pyarrow import parquet
    except ImportError:
        return False
    from slam_backend.core.files import write_file

    stream = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(tidy_rows(rows)), stream)
    write_file(file, stream.getvalue(), "out")
    return True


def kept_episodes(folder: Path, argument: str = "folders") -> list[dict[str, Any]] | None:
    """Return the rows of `episodes.csv` or its compressed form in a folder, or None if there is neither.

    Raises:
        ValueError: If the file is too large, damaged, or a value is out of range; the text names file and line.
    """
    file = next((folder / name for name in (CSV, PACKED) if (folder / name).is_file()), None)
    return None if file is None else read_episodes(bounded_bytes(file, argument), str(file), argument)


def bounded_bytes(file: Path, argument: str) -> bytes:
    """Return the content of a file, unpacked if it ends with `.gz`, of at most `MOST_BYTES`.

    Raises:
        ValueError: If there is more, or the file cannot be read.
    """
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        hint = f"Copy {str(file)!r} again. The system says: {error}."
        raise argument_error(argument, "a whole file of episodes", "a damaged one", hint) from error
    if len(content) > MOST_BYTES:
        hint = f"Check {str(file)!r}."
        raise argument_error(argument, f"a file of at most {MOST_BYTES >> 20} MiB", "a larger one", hint)
    return content


def read_episodes(content: bytes, name: str, argument: str = "folders") -> list[dict[str, Any]]:
    """Read the rows that `episodes_csv` wrote.

    Args:
        content: The file.
        name: Name of the file, for errors.
        argument: Name of the argument, for errors.

    Raises:
        ValueError: If columns are missing or unknown, or a value is out of range; the text names file and line.
    """
    hint = f"Check {name!r}; vslam bench exploration --plan writes such files."
    try:
        lines = csv.reader(io.StringIO(content.decode()), strict=True)
        head = next(lines, [])
        if sorted(head) != sorted(FIELDS):
            if missing := [name for name in FIELDS if name not in head]:
                raise argument_error(argument, f"a column {missing[0]!r} in the first line", "none", hint)
            other = next(name for name in head if name not in FIELDS or head.count(name) > 1)
            raise argument_error(argument, "only columns of an episode, each once, in the first line", other, hint)
        return [_row(head, cells, lines.line_num, argument, hint) for cells in lines]
    except (csv.Error, UnicodeDecodeError) as error:
        raise argument_error(argument, "a table of episodes", f"none: {error}", hint) from error


def _row(head: Sequence[str], cells: Sequence[str], line: int, argument: str, hint: str) -> dict[str, Any]:
    """Return the row of a line."""
    if len(cells) != len(head):
        raise argument_error(argument, f"{len(head)} values in line {line}", len(cells), hint)
    row: dict[str, Any] = {}
    for name, text in zip(head, cells, strict=True):
        try:
            row[name] = FIELDS[name].parsed(text)
        except ValueError:
            expected = f"{FIELDS[name].expected} as {name!r} in line {line}"
            raise argument_error(argument, expected, text[:LONGEST_NUMBER], hint) from None
    refusals = {reason: count for reason in REASONS if (count := row.pop(f"{REFUSED}{reason}"))}
    return {**row, "refusals": refusals}
