from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.readers import read_csv


def _file(folder: Path, text: str) -> Path:
    (folder / "log.csv").write_text(text, encoding="utf-8")
    return folder / "log.csv"


def test_columns_come_in_the_order_asked_for(tmp_path: Path) -> None:
    """Columns are found by name; others, empty lines and comments are skipped, blanks around entries do not count."""
    file = _file(tmp_path, "\ufeff# time, name ,x,junk\n1.5, a b ,2,zzz\n\n# no row\n2.5,c,-3e-1,\n")
    table = read_csv(file, ("x", "time"), labels=("name",))
    assert table.numbers.tolist() == [[2.0, 1.5], [-0.3, 2.5]]
    assert table.labels.tolist() == [["a b"], ["c"]]


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_delimiters_are_found(sign: str, tmp_path: Path) -> None:
    """Commas, semicolons and tabs delimit, as the first line shows; labels may be none, and quoted."""
    file = _file(tmp_path, f'time{sign}v\n1{sign}"2"\n')
    assert read_csv(file, ("time", "v")).numbers.tolist() == [[1.0, 2.0]]
    assert read_csv(file, ("v",), delimiter=sign).labels.shape == (1, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"expected log\.csv with a line of names, got no lines\. .*log\.csv is empty"),
        ("time,v\n", r"expected log\.csv with rows, got no rows\. .*log\.csv ends after"),
        (
            "time,w\n1,2\n",
            r"log\.csv with one column 'v', got a line of names 'time, w'\. Correct the first line of .*csv",
        ),
        ("time,v,v\n1,2,3\n", r"with one column 'v', got a line of names 'time, v, v'"),
        ("time,v\n1,2\n2,fast\n", r"a finite number in column 'v', got 'fast'\. Correct line 3 of .*log\.csv"),
        ("time,v\n1,nan\n", r"a finite number in column 'v', got 'nan'\. Correct line 2"),
        ("time,v\ninf,1\n", r"a finite number in column 'time', got 'inf'\. Correct line 2"),
        ("time,v\n1,1_0\n", r"a finite number in column 'v', got '1_0'"),
        ("time,v\n\n1\n", r"an entry in column 'v', got no entry\. Correct line 3"),
        ("time,v\n1,\n", r"an entry in column 'v', got no entry\. Correct line 2"),
    ],
)
def test_what_is_wrong_is_named_with_line_and_column(text: str, message: str, tmp_path: Path) -> None:
    """Each error names the file, and the line and the column where there is one."""
    with pytest.raises(ValueError, match="^path: .*" + message):
        read_csv(_file(tmp_path, text), ("time", "v"))


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    """A missing file and one that is not UTF-8 are distinguished; so is a delimiter that is none."""
    with pytest.raises(ValueError, match=r"path: expected a CSV file, got no such file\. Check '.*none\.csv'"):
        read_csv(tmp_path / "none.csv", ("time",))
    (tmp_path / "log.csv").write_bytes(b"time\n\xff\xfe\n")
    with pytest.raises(ValueError, match=r"path: expected log\.csv in UTF-8, got a file in another encoding"):
        read_csv(tmp_path / "log.csv", ("time",))
    with pytest.raises(ValueError, match="delimiter: expected one of"):
        read_csv(_file(tmp_path, "time\n1\n"), ("time",), delimiter=" ")


@given(st.text(max_size=40))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    """Whatever stands below the names, the table is finite or the error is the project's own."""
    file = tmp_path_factory.mktemp("log") / "log.csv"
    file.write_bytes(b"time,v\n" + text.encode("utf-8", "replace"))
    try:
        table: Any = read_csv(file, ("time",), labels=("v",))
    except ValueError as error:
        assert str(error).startswith("path: expected ")  # noqa: PT017   # either outcome is lawful
    else:
        assert len(table.numbers) == len(table.labels) > 0
