"""The tables that `vslam paper fig6` ends with."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from training.experiments.tables import console_table, number
from training.paper.fig6.claims import Claim
from training.paper.fig6.noise_regimes import REGIMES


def print_result(
    console: Console,
    lines: Sequence[Mapping[str, Any]],
    ratios: Sequence[Mapping[str, Any]],
    claims: Sequence[Claim],
) -> None:
    """Print a table of each regime and proposal, one of the ratios, and which claims hold.

    Args:
        console: Where to.
        lines: Of `paper_summary.summarise`.
        ratios: Of `robots_ratios`.
        claims: Of `check_claims`.
    """
    for regime, proposal in dict.fromkeys((line["regime"], line["proposal"]) for line in lines):
        own = [line for line in lines if (line["regime"], line["proposal"]) == (regime, proposal)]
        _print_points(console, f"{REGIMES[regime].title}, {proposal}", own)
    if ratios:
        few, many = ratios[0]["robots"]
        table = console_table(f"Map error, K={many} over K={few} (95 %)", ("regime", "M", "as it is", "aligned"))
        for row in ratios:
            name = f"{REGIMES[row['regime']].title}, {row['proposal']}"
            table.add_row(
                escape(name), str(row["particles"] or "-"), *(_interval(row[key]) for key in ("raw", "aligned"))
            )
        console.print(table)
    if claims:
        table = console_table("The paper's claims", ("claim", "ratio (95 %)", ""))
        for claim in claims:
            verdict = "holds" if claim.holds else "[red]does not hold[/]"
            table.add_row(escape(claim.claim), _interval(claim.to_mapping()), verdict)
        console.print(table)


def _print_points(console: Console, title: str, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print map error and time, a row for each M and a column for each K."""
    robots = sorted({line["robots"] for line in lines})
    parts = [("map error [m]", "map_rmse_m", 3, 1)] + [("step [ms]", "median_ms", 3, 0)] * any(
        line["median_ms"] is not None for line in lines
    )
    table = console_table(f"{title}, {max(line['seeds'] for line in lines)} seeds", ("M",))
    for name, *_ in parts:
        for k in robots:
            table.add_column(escape(f"{name}\nK={k}"), justify="right")
    for m in dict.fromkeys(line["particles"] for line in lines):
        own = {line["robots"]: line for line in lines if line["particles"] == m}
        cells = [_cell(own.get(k), figure, digits, bool(wide)) for _, figure, digits, wide in parts for k in robots]
        table.add_row(str(m or "-"), *cells)
    console.print(table)


def _cell(line: Mapping[str, Any] | None, figure: str, digits: int, with_interval: bool) -> str:
    """Show a mean, with its interval if asked for, and what is not known as a dash."""
    if line is None:
        return "-"
    low, high = line[f"{figure}_low"], line[f"{figure}_high"]
    ends = f"\n{number(low, digits)}-{number(high, digits)}" if with_interval and low is not None else ""
    return number(line[figure], digits) + ends


def _interval(found: Mapping[str, Any]) -> str:
    """Show a ratio with its interval."""
    ends = "" if found["low"] is None else f" ({number(found['low'])}-{number(found['high'])})"
    return number(found["ratio"]) + ends
