"""The tables that `vslam bench env` ends with."""

from rich.console import Console

from training.bench.env.bench import EnvBenchResult, EnvRow
from training.bench.env.timing import PEER, StepTimes
from training.experiments.tables import console_table
from training.experiments.timed_bench import print_caveats

# "Undisturbed": the median over each call's best repeat. "Per s": by the median, then by the mean.
TIMES = ("median", "mean", "99 %", "least", "undis-\nturbed", "per s", "by mean")


def print_env_result(console: Console, result: EnvBenchResult, asked_peer: bool) -> None:
    """Print rows, the budget of a step, and what else was measured."""
    if result.rows:
        rows = [(_told(row), *_times(row.times)) for row in result.rows]
        console.print(console_table("env.step [us]: robots, particles, world, walls, mode", ("", *TIMES), rows))
    if result.budget:
        columns = ("median_us", "mean_us")
        budget = [(part.phase, *(f"{getattr(part, name):.0f}" for name in columns)) for part in result.budget]
        sums = (f"{sum(getattr(part, name) for part in result.budget):.0f}" for name in columns)
        headings = ("part of a step", "median", "mean")
        console.print(console_table("Budget, first row [us]", headings, [*budget, ("sum", *sums)]))
    others: dict[str, StepTimes | None] = {
        "simulator only": result.simulator,
        "reset": result.reset,
        **result.snapshots,
        f"{PEER} simple_spread": result.peer,
    }
    beside = [(name, *_times(times)) for name, times in others.items() if times is not None]
    console.print(console_table(f"Beside [us]; {PEER} has neither walls nor SLAM", ("", *TIMES), beside))
    if result.peer is not None:
        ratio = result.rows[0].times.undisturbed_us / result.peer.undisturbed_us
        told = f"{result.ratio:.2f} times as long as one of simple_spread beside it, {ratio:.2f} times undisturbed"
        console.print(f"A step of the first row takes {told}.", highlight=False)
    if asked_peer and result.peer is None and result.complete:
        console.print(f"{PEER} is not installed: no peer was timed (pip install {PEER}).", highlight=False)
    print_caveats(console, result.machine, result.complete)


def _told(row: EnvRow) -> str:
    load = row.load
    return f"{load.robots} {load.particles} {load.world} {row.walls} {load.mode}"


def _times(times: StepTimes) -> tuple[str, ...]:
    micros = (times.median_us, times.mean_us, times.p99_us, times.min_us, times.undisturbed_us)
    return *(f"{value:.0f}" for value in micros), f"{times.per_second:,.0f}", f"{times.per_second_mean:,.0f}"
