"""The command `vslam bench accuracy`, and the group `vslam bench`."""

from typing import Annotated, Any

import typer

from training.commands._options import Config, FirstSeed, Json, OutToGoOn, Processes, numbers, words
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish

bench = typer.Typer(help="Measure how good and how fast filters, environments and trainings are.", no_args_is_help=True)


@bench.command("accuracy")
def bench_accuracy(
    seeds: Annotated[int | None, typer.Option(help="How many.", show_default="16")] = None,
    first_seed: FirstSeed = None,
    preset: Annotated[str | None, typer.Option(help="good, coarse or paper noise.", show_default="good")] = None,
    association: Annotated[str | None, typer.Option(help="known or unknown.", show_default="known")] = None,
    robots: Annotated[str | None, typer.Option(help="How many share a map.", show_default="1")] = None,
    length: Annotated[str | None, typer.Option(help="Metres that each robot drives.", show_default="100")] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="dead_reckoning, batch_ml, ideal_online, fastslam1, fastslam2, fastslam2+existence, "
            "fastslam2+rejuvenation.",
            show_default="all but the last two",
        ),
    ] = None,
    particles: Annotated[str | None, typer.Option(help="Per filter.", show_default="10,30,100,300,1000")] = None,
    noise_factor: Annotated[
        float | None, typer.Option(help="Times the true variance of the measurements, to filters.", show_default="1")
    ] = None,
    landmark_noise: Annotated[
        float | None,
        typer.Option(help="Metres by which landmarks may walk.", show_default="0, if rejuvenated 0.005"),
    ] = None,
    processes: Processes = 1,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """How far filters are from the truth on simulated stereo runs, beside dead reckoning and what could be reached.

    Options in the singular take several values with commas between; all combinations are tried. Ctrl-C finishes the
    trial under way and sums up what there is; the same command with --out FOLDER goes on from there.
    """
    from slam_backend.core.validation import check_int
    from training.bench.accuracy.bench import COMMAND, TRIALS_FILE, AccuracyConfig
    from training.bench.accuracy.figures import draw_accuracy
    from training.bench.accuracy.summary import summarise
    from training.bench.accuracy.tables import markdown, print_tables
    from training.bench.accuracy.trials import Trial, play
    from training.experiments.run_folder import plain

    check_int("processes", processes, 1, "Use one process or more.")
    given = {
        "presets": words(preset),
        "associations": words(association),
        "robots": numbers("robots", robots),
        "lengths": numbers("length", length, float),
        "methods": words(methods),
        "particles": numbers("particles", particles),
        "seeds": seeds,
        "seed": first_seed,
        "noise_factor": noise_factor,
        "landmark_noise": landmark_noise,
    }
    chosen = choose(AccuracyConfig, COMMAND, given, config=config, json=json, out=out)
    console, folder = begin(COMMAND, chosen, out, goes_on=True)

    def tell(row: dict[str, Any]) -> str:
        return f"seed {row['seed']}, {row['method']}" + (f" {row['particles']}" if row["particles"] else "")

    part = KeptPart(
        file=TRIALS_FILE, kind=Trial, play=play, trials=chosen.trials(), tell=tell, processes=processes
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    metrics = folder.write_metrics({"summary": lines, "trials": rows})
    folder.write_text("tables.md", markdown(lines))
    if lines:
        draw_accuracy(folder.path / "accuracy.png", lines)
    finish(console, folder, metrics, json)
