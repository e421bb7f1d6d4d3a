"""The commands `vslam paper ...`: figures of the paper, computed anew."""

from typing import Annotated

import typer

from training.commands._options import Check, Config, FirstSeed, Json, Out, OutToGoOn, Processes, Seed, numbers, words
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish

paper = typer.Typer(help="Compute figures of the paper anew.", no_args_is_help=True)


@paper.command("fig6")
def fig6(
    seeds: Annotated[int | None, typer.Option(help="How many.", show_default="20")] = None,
    first_seed: FirstSeed = None,
    particles: Annotated[
        str | None, typer.Option(help="Numbers M with commas between.", show_default="the paper's eleven, 1 to 2000")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="Numbers K.", show_default="1,2,3")] = None,
    regimes: Annotated[str | None, typer.Option(help="paper, look_alikes, good.", show_default="all")] = None,
    measurements: Annotated[
        int | None, typer.Option(help="Number B in a step, of all robots together.", show_default="15")
    ] = None,
    length: Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="100")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="3 seeds, M = 1, 10, 100, and 25 m.")] = False,
    processes: Processes = 1,
    check: Check = False,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 6: time of a step, and map error, of one to three robots that share B measurements.

    The filter is the paper's (`fastslam1`, unknown association, resampling at random at every step), the noise large
    against the odometry; beside it look-alikes with false points, and good stereo with both proposals and with
    rejuvenation, for M = 10, 100, 1000. Map errors come from --processes at a time, times from one alone. The paper's
    claims are asked of the data. Ctrl-C finishes the trial under way and sums up what there is; the same command with
    --out FOLDER goes on from there.
    """
    from slam_backend.core.validation import check_int
    from training.experiments.run_folder import plain
    from training.paper.fig6.claims import check_claims, robots_ratios
    from training.paper.fig6.config import COMMAND, ERRORS_FILE, QUICK, TIMES_FILE, Fig6Config, cost
    from training.paper.fig6.figure import draw_fig6
    from training.paper.fig6.summary import summarise, to_csv
    from training.paper.fig6.tables import print_result
    from training.paper.fig6.trials import ErrorTrial, TimeTrial, play_error, play_time

    check_int("processes", processes, 1, "Use one process or more.")
    given = {
        "particles": numbers("particles", particles),
        "robots": numbers("robots", robots),
        "regimes": words(regimes),
        "measurements": measurements,
        "length": length,
        "seeds": seeds,
        "seed": first_seed,
    }
    fast = QUICK if quick else None
    chosen = choose(Fig6Config, COMMAND, given, config=config, json=json, out=out, quick=fast)
    console, folder = begin(COMMAND, chosen, out, goes_on=True)
    parts = (
        KeptPart(
            file=ERRORS_FILE, kind=ErrorTrial, play=play_error, trials=chosen.error_trials(), processes=processes,
            tell=lambda row: f"map errors: seed {row['seed']}, M={row['particles']}", cost=cost,
        ),
        KeptPart(
            file=TIMES_FILE, kind=TimeTrial, play=play_time, trials=chosen.time_trials(),
            tell=lambda row: f"times: seed {row['seed']}, M={row['particles']}", cost=cost,
        ),
    )  # fmt: skip
    errors, times = play_kept(console, folder, *parts, timed=True)
    lines, ratios, claims = plain(summarise(errors, times)), plain(robots_ratios(errors)), check_claims(errors, times)
    print_result(console, lines, ratios, claims)
    held = [claim.to_mapping() for claim in claims]
    metrics = folder.write_metrics({"summary": lines, "robots_ratios": ratios, "claims": held})
    folder.write_text("fig6.csv", to_csv(lines))
    if lines:
        draw_fig6(folder.path / "fig6.png", lines)
    finish(console, folder, metrics, json, check, [claim.holds for claim in claims])


@paper.command("fig1")
def fig1(
    seed: Seed = None,
    robots: Annotated[int | None, typer.Option(help="How many.", show_default="3")] = None,
    particles: Annotated[int | None, typer.Option(help="Of each cloud.", show_default="400")] = None,
    length: Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="30")] = None,
    every: Annotated[float | None, typer.Option(help="Metres between two clouds.", show_default="5")] = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 1: clouds of particles along the paths of three robots, by odometry alone and with what they see."""
    from training.paper.fig1 import COMMAND, Fig1Config, draw_clouds, figures_of, simulate_fig1
    from training.paper.fig1_figure import draw_fig1

    given = {"seed": seed, "robots": robots, "particles": particles, "length": length, "every": every}
    chosen = choose(Fig1Config, COMMAND, given, config=config, json=json, out=out)
    console, folder = begin(COMMAND, chosen, out)
    run = simulate_fig1(chosen)
    moved, measured = (draw_clouds(run, chosen, with_measurements) for with_measurements in (False, True))
    panels = [("motion model alone (Eq. 4)", "odometry", moved), ("with measurements", "estimate", measured)]
    draw_fig1(folder.path / "fig1.png", run, panels)
    found = {"odometry": figures_of(run, moved), "measurements": figures_of(run, measured)}
    for name, rows in found.items():
        for robot, row in enumerate(rows, 1):
            text = f"robot {robot}, {name}: path RMS {row['path_rms_m']:.2f} m, at the end off by"
            console.print(f"{text} {row['end_error_m']:.2f} m, spread {row['end_spread_m']:.2f} m", highlight=False)
    metrics = folder.write_metrics(found)
    finish(console, folder, metrics, json)
