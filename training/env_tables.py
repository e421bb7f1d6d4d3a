"""The tables that `vslam bench env` ends with."""

from rich.console import Console
from rich.table import Table

from training.bench_env import EnvBenchResult
from training.env_timing import PEER, StepTimes
from training.timed_bench import print_caveats, print_goals

TIMES = ("median us", "mean us", "99 % us", "least us", "undisturbed us")  # the last: the median over best repeats


def print_env_result(console: Console, result: EnvBenchResult, asked_peer: bool) -> None:
    """Print rows, the budget of a step, what else was measured, and the goals."""
    if result.rows:
        table = Table(title="env.step", title_justify="left")
        for column in ("robots", "particles", "world", "walls", "mode", *TIMES, "steps/s", "by mean"):
            table.add_column(column, justify="left" if column in ("world", "mode") else "right")
        for row in result.rows:
            load = row.load
            numbers = (str(load.robots), str(load.particles), load.world, str(row.walls), load.mode)
            table.add_row(*numbers, *_times(row.times))
        console.print(table)
    if result.budget:
        table = Table("part of a step", title="Budget, first row", title_justify="left")
        for column in ("planned us", "median us", "mean us"):
            table.add_column(column, justify="right")
        for part in result.budget:
            table.add_row(part.phase, f"{part.planned_us:.0f}", f"{part.median_us:.0f}", f"{part.mean_us:.0f}")
        sums = [sum(getattr(part, name) for part in result.budget) for name in ("planned_us", "median_us", "mean_us")]
        table.add_row("sum", *(f"{total:.0f}" for total in sums), style="bold")
        console.print(table)
    table = Table("", title="Beside", title_justify="left")
    for column in (*TIMES, "per second", "by mean"):
        table.add_column(column, justify="right")
    others: dict[str, StepTimes | None] = {
        "simulator only": result.simulator,
        "reset": result.reset,
        **result.snapshots,
        f"simple_spread of {PEER}, no walls, no SLAM": result.peer,
    }
    for name, times in others.items():
        if times is not None:
            table.add_row(name, *_times(times))
    console.print(table)
    if asked_peer and result.peer is None and result.complete:
        console.print(f"{PEER} is not installed: no peer was timed (pip install {PEER}).", highlight=False)
    print_goals(console, result.goals())
    print_caveats(console, result.machine, result.complete)


def _times(times: StepTimes) -> tuple[str, ...]:
    micros = (times.median_us, times.mean_us, times.p99_us, times.min_us, times.undisturbed_us)
    return *(f"{value:.0f}" for value in micros), f"{times.per_second:,.0f}", f"{times.per_second_mean:,.0f}"
