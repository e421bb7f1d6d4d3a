"""Tables of studies: units, statistics, differences, and their width on the console."""

import io

import pytest
from rich.console import Console

from training.commands.study import print_table
from training.experiments.study import Column, Curves, Estimate, ResultTable

TABLE = ResultTable(
    name="maps", title="Maps", by=("policy",),
    columns=(
        Column("map_error", "E [cm]", factor=100.0, digits=1, interval=True),
        Column("undone", "merges undone later", "sum", digits=0),
    ),
)  # fmt: skip
ROWS = [
    {"policy": policy, "seed": seed, "map_error": error + 0.25 * seed, "undone": seed}
    for policy, error in (("a_policy_with_a_name", 0.5), ("b", 0.25))
    for seed in range(3)
]


def _printed(width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    print_table(console, TABLE, TABLE.lines(ROWS))
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def test_lines_and_files_have_the_unit_of_the_heading() -> None:
    """Values and ends of intervals are scaled in lines, cells and CSV alike; counts stay whole numbers."""
    line = TABLE.lines(ROWS)[0]
    assert line["E [cm]"] == Estimate(75.0, 50.0, 100.0)
    assert line["merges undone later"].value == 3
    assert TABLE.cells(line)[1:] == ["75.0 (50.0 .. 100)", "3"]
    assert TABLE.csv([line]).splitlines()[1] == "a_policy_with_a_name,75,50,100,3"


def test_seeds_without_a_value_do_not_count() -> None:
    """Means over time are over the seeds with a value; without any they are None, and one seed has no interval."""
    curves = Curves(by=("policy",), columns=(Column("coverage"),))
    values = ([0.1, None, None], [None, None, 0.3], [0.3, None, None], [0.5, None, None])
    rows = [{"policy": "a", "curves": {"time_s": [0, 1, 2], "coverage": own}} for own in values]
    first, unknown, alone = curves.lines(rows)
    assert first["coverage"] == pytest.approx(0.3)
    assert 0.1 <= first["coverage_low"] < 0.3 < first["coverage_high"] <= 0.5
    nothing = {"policy": "a", "coverage_low": None, "coverage_high": None}
    assert unknown == nothing | {"time_s": 1, "coverage": None}
    assert alone == nothing | {"time_s": 2, "coverage": 0.3}


def test_unknown_values_are_dashes_and_small_ones_have_no_sign() -> None:
    """A line without a value has a dash; a single seed has no interval; a rounded zero is positive."""
    column = Column("map_error", interval=True)
    texts = [column.text(column.estimate([{"map_error": value}])) for value in (None, 2.0, -1e-9)]
    assert texts == ["-", "2.00", "0.000"]


def test_functions_get_the_rows_of_differences() -> None:
    """In a comparison, columns sum up differences to the base, and functions get these rows."""
    columns = (
        Column("n", statistic=len),
        Column("map_error", "higher", "share above 0"),
        Column("undone", "", "least"),
    )
    table = ResultTable(name="", title="", by=("policy",), columns=columns, against="policy", base="b")
    (line,) = table.lines(ROWS[1:])
    assert {name: found if isinstance(found, str) else found.value for name, found in line.items()} == {
        "policy": "a_policy_with_a_name", "n": 2, "higher": 1.0, "undone": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize(("width", "heading", "names"), [
    (80, "  policy                      [cm]  merges undone later", ["a_policy_with_a_name"]),
    (50, "  policy                      [cm]   later", ["a_policy_with_a_name"]),
    (40, "  policy                  [cm]   later", ["a_policy_with_a_", "name"]),
])  # fmt: skip
def test_numbers_are_folded_last(width: int, heading: str, names: list[str]) -> None:
    """A table that is too wide folds its headings, then names; intervals stay in one piece."""
    printed = _printed(width)
    assert heading in printed
    assert [line.split()[0] for line in printed if line.startswith(("  a_", "  name"))] == names
    assert sum("50.0..100" in line for line in printed) == 1
