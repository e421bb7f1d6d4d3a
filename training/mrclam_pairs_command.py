"""The command `vslam bench mrclam`: maps of real robots aligned pairwise, with a table, and the run folder."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from training.command_options import Config, Json, Out, Seed, finish, gather
from training.compiling import prepare
from training.replay_command import DATASET
from training.replay_paths import default_path

HEADINGS = (
    "after [s]", "barcodes", "method", "pairs", "aligned", "false", "median [m]", "worst [m]", "median [°]",
    "worst [°]",
)  # fmt: skip


def bench_mrclam(
    path: Annotated[
        Path | None, typer.Option(help="Folder of the log.", show_default=f"{DATASET} in $VSLAM_DATA")
    ] = None,
    durations: Annotated[
        str | None,
        typer.Option(help="Seconds after which maps are aligned; 0: at the end.", show_default="100,200,400,0"),
    ] = None,
    particles: Annotated[int | None, typer.Option(help="Of each robot's filter.", show_default="100")] = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Five real robots map alone from their own starts; all pairs of maps are aligned, barcodes seen and hidden.

    Errors are against the motion between the fits of both maps to the true landmarks.
    """
    from training.bench_command import _numbers
    from training.mrclam_pairs import COMMAND, MrclamPairsConfig, align_log, check_goals, summarise
    from training.run_folder import RunFolder, plain

    given = {
        "path": path, "durations": _numbers("durations", durations, float), "particles": particles, "seed": seed,
    }  # fmt: skip
    values = gather(COMMAND, given, config, json, out)
    if "path" not in values:
        values["path"] = default_path(DATASET, "the MR.CLAM log")
    chosen = MrclamPairsConfig.from_mapping(values)
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    columns = (
        TextColumn("robots map alone"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=1.0)
        rows = align_log(chosen, lambda share: progress.update(task, completed=share))
    lines, goals = summarise(rows), check_goals(rows)
    table = Table(title="Maps of real robots, aligned pairwise", box=SIMPLE_HEAD)
    for heading in HEADINGS:
        table.add_column(escape(heading))
    for line in lines:
        table.add_row(*cells(line))
    console.print(table)
    for goal in goals:
        verdict = "met" if goal["met"] else "missed"
        text = f"{goal['goal']}: {goal['measured']:.3g}, {goal['wanted']}: {verdict}"
        console.print(text, markup=False, highlight=False)
    folder.write_text("table.md", markdown(lines))
    finish(console, folder, folder.write_metrics(plain({"summary": lines, "goals": goals, "pairs": rows})), json)


def cells(line: dict[str, Any]) -> list[str]:
    """Return one line of the table as text."""
    after = "all" if line["duration_s"] is None else f"{line['duration_s']:g}"
    errors = (line[name] for name in ("median_m", "worst_m", "median_deg", "worst_deg"))
    shown = ["-" if value is None else f"{value:.2f}" for value in errors]
    counts = [str(line[name]) for name in ("pairs", "accepted", "false")]
    return [after, line["barcodes"], line["method"], *counts, *shown]


def markdown(lines: list[dict[str, Any]]) -> str:
    """Return the table as Markdown."""
    rows = ["| " + " | ".join(row) + " |" for row in (HEADINGS, ["---"] * len(HEADINGS), *map(cells, lines))]
    return "\n".join([*rows, ""])
