"""The command `vslam bench mrclam`: maps of real robots aligned pairwise, with a table, and the run folder."""

from pathlib import Path
from typing import Annotated, Any

import typer

from training.commands._options import Config, Json, Out, Seed, numbers
from training.commands._progress import share_shown
from training.commands._run_folder import begin, choose, finish
from training.commands.replay import DATASET, LOG
from training.experiments.tables import console_table, markdown_table, number

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

    Errors are against the motion between the fits of both maps to the true landmarks. The odometry noise was calibrated
    on data sets 7 and 4 of MR.CLAM.
    """
    from training.bench.alignment.mrclam import COMMAND, MrclamPairsConfig, align_log, summarise
    from training.experiments.run_folder import plain

    given = {
        "path": path, "durations": numbers("durations", durations, float), "particles": particles, "seed": seed,
    }  # fmt: skip
    chosen = choose(MrclamPairsConfig, COMMAND, given, config=config, json=json, out=out, log=LOG)
    console, folder = begin(COMMAND, chosen, out)
    with share_shown(console, "robots map alone") as update:
        rows = align_log(chosen, update)
    lines = summarise(rows)
    shown = [cells(line) for line in lines]
    console.print(console_table("Maps of real robots, aligned pairwise", HEADINGS, shown))
    folder.write_text("table.md", markdown_table(HEADINGS, shown))
    metrics = folder.write_metrics(plain({"summary": lines, "pairs": rows}))
    finish(console, folder, metrics, json)


def cells(line: dict[str, Any]) -> list[str]:
    """Return one line of the table as text."""
    after = "all" if line["duration_s"] is None else f"{line['duration_s']:g}"
    shown = [number(line[name]) for name in ("median_m", "worst_m", "median_deg", "worst_deg")]
    counts = [str(line[name]) for name in ("pairs", "accepted", "false")]
    return [after, line["barcodes"], line["method"], *counts, *shown]
