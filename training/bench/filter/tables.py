"""The tables that `vslam bench filter` ends with."""

from dataclasses import replace

from rich.console import Console
from rich.table import Table

from training.bench.filter.bench import STATE_LOAD, BenchResult
from training.bench.filter.trials import Row
from training.experiments.tables import console_table
from training.experiments.timed_bench import print_caveats


def print_result(console: Console, result: BenchResult) -> None:
    """Print rows and what else was measured."""
    machine = result.machine
    for proposal in dict.fromkeys(row.load.proposal for row in result.rows):
        console.print(_rows(result, proposal))
    if result.rows:
        console.print(
            "Unknown association, resampling at every step, one thread. right: measurements given to the landmark they "
            "are of.",
            highlight=False,
        )
    console.print(f"{machine['processor']}.", highlight=False)
    if result.rows:
        largest = max(result.rows, key=lambda row: row.load.particles * row.load.landmarks)
        console.print(
            f"Memory: {largest.bytes_per_landmark:.0f} bytes per particle and landmark; {largest.nbytes / 1e6:.0f} MB "
            f"for M={largest.load.particles}, N={largest.load.landmarks}.",
            highlight=False,
        )
    if result.state:
        times = ", ".join(f"{name} {_ms(timing.median_ms)} ms" for name, timing in result.state.items())
        console.print(f"M={STATE_LOAD.particles}, N={STATE_LOAD.landmarks}: {times} (medians).", highlight=False)
    if result.compilation is not None:
        cold, cached = result.compilation["cold"], result.compilation["cached"]
        console.print(
            f"Kernels: compiled in {cold['compile_s']:.0f} s, once; taken from the cache "
            f"({result.compilation['cache_bytes'] / 1e6:.1f} MB) in {cached['warm_up_s']:.1f} s; "
            f"import {cached['import_s']:.1f} s.",
            highlight=False,
        )
    print_caveats(console, machine, result.complete)


def _rows(result: BenchResult, proposal: str) -> Table:
    """Return the table of one proposal's times: a line for each number of particles, landmarks and measurements."""
    first, *more = sorted({row.load.robots for row in result.rows})
    headings = ("M", "N", "B", f"K={first}", "10-90 %", "least", *(f"K={k}" for k in more), "right")
    cells = []
    for row in result.rows:
        if row.load.robots != first or row.load.proposal != proposal:
            continue
        others = [result.find(**_numbers(row, robots=k)) for k in more]
        timing, load = row.timing, row.load
        cells.append([
            str(load.particles), str(load.landmarks), str(load.measurements),
            _ms(timing.median_ms), f"{_ms(timing.low_ms)}-{_ms(timing.high_ms)}", _ms(timing.min_ms),
            *("" if other is None else _ms(other.timing.median_ms) for other in others),
            f"{row.right:.0%}",
        ])  # fmt: skip
    return console_table(f"One step of {proposal}: median in ms", headings, cells)


def _numbers(row: Row, robots: int) -> dict[str, object]:
    """Return what tells a row's load from those of other rows."""
    load = replace(row.load, robots=robots)
    return {name: getattr(load, name) for name in ("proposal", "particles", "landmarks", "measurements", "robots")}


def _ms(value: float) -> str:
    """Show milliseconds with three digits that count."""
    return f"{value:.3f}" if value < 1.0 else f"{value:.2f}" if value < 10.0 else f"{value:.1f}"
