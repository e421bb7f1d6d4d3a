"""The command `vslam bench alignment`: options, live progress, tables, and the run folder."""

from typing import Annotated

import typer

from training.commands._options import Config, FirstSeed, Json, OutToGoOn, words
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish


def bench_alignment(
    methods: Annotated[
        str | None, typer.Option(help="Of ransac, svd, icp, impicp, gnc, clique.", show_default="all")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Trials of each cell of the grid.", show_default="500")] = None,
    hard: Annotated[int | None, typer.Option(help="Trials of each hard set.", show_default="1000")] = None,
    first_seed: FirstSeed = None,
    quick: Annotated[bool, typer.Option("--quick", help="10 trials of each cell, 45 of each hard set.")] = False,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Success, error over the Cramer-Rao bound and time of all alignment methods, on pairs of simulated maps.

    A grid over the share of common landmarks and of wrong look-alikes; U: maps that must not be aligned; I: maps that
    just can be. One process, one thread, so that times count. Ctrl-C ends the bench after the trial under way and sums
    up what there is; the same command with --out FOLDER goes on from there.
    """
    from training.bench.alignment.bench import COMMAND, QUICK, TRIALS_FILE, AlignmentBenchConfig
    from training.bench.alignment.figures import draw_alignment
    from training.bench.alignment.summary import summarise
    from training.bench.alignment.tables import markdown, print_tables
    from training.bench.alignment.trials import Trial, play
    from training.experiments.run_folder import plain

    given = {
        "methods": words(methods),
        "seeds": seeds,
        "hard": hard,
        "seed": first_seed,
    }
    fast = QUICK if quick else None
    chosen = choose(AlignmentBenchConfig, COMMAND, given, config=config, json=json, out=out, quick=fast)
    console, folder = begin(COMMAND, chosen, out, goes_on=True)
    part = KeptPart(
        file=TRIALS_FILE, kind=Trial, play=play, trials=chosen.trials(),
        tell=lambda row: f"{row['kind']} {row['case']}".strip(),
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part, timed=True)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    metrics = folder.write_metrics({"summary": lines})
    folder.write_text("tables.md", markdown(lines))
    draw_alignment(folder.path / "alignment.png", lines)
    finish(console, folder, metrics, json)
