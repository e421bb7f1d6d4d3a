"""The command `vslam bench filter`: how fast the filter is on this machine."""

from typing import Annotated, Any

import typer

from training.commands._options import Config, Json, Out, Seed, numbers
from training.commands._progress import trials_shown
from training.commands._run_folder import begin, choose, finish

COMMAND = "bench filter"
QUICK: dict[str, Any] = {"measurements": (15,), "robots": (1,), "steps": 100}


def bench_filter(
    particles: Annotated[
        str | None, typer.Option(help="Numbers M with commas between.", show_default="100,1000")
    ] = None,
    landmarks: Annotated[
        str | None, typer.Option(help="Numbers N, all held by all particles.", show_default="100,300,1000")
    ] = None,
    measurements: Annotated[
        str | None, typer.Option(help="Numbers B, of all robots together.", show_default="5,15")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="Numbers K.", show_default="1,2,3")] = None,
    lookalikes: Annotated[
        int | None, typer.Option(help="So many landmarks share one descriptor.", show_default="1")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Timed steps per row.", show_default="300")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="B=15, K=1, 100 steps.")] = False,
    large: Annotated[
        bool | None, typer.Option(help="Also 10,000 particles with 300 and 1,000 landmarks.", show_default="no-large")
    ] = None,
    compilation: Annotated[
        bool | None,
        typer.Option("--compile/--no-compile", help="Also compiling into an empty cache.", show_default="no-compile"),
    ] = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Time steps of the filter over particles, landmarks, measurements and robots, on one thread."""
    from training.bench.filter.bench import BenchConfig, count_trials, run_bench
    from training.bench.filter.figures import draw_speed
    from training.bench.filter.tables import print_result
    from training.experiments.run_folder import plain

    given = {
        "particles": numbers("particles", particles),
        "landmarks": numbers("landmarks", landmarks),
        "measurements": numbers("measurements", measurements),
        "robots": numbers("robots", robots),
        "lookalikes": lookalikes,
        "steps": steps,
        "large": large,
        "compile": compilation,
        "seed": seed,
    }
    fast = QUICK if quick else None
    chosen = choose(BenchConfig, COMMAND, given, config=config, json=json, out=out, quick=fast)
    console, folder = begin(COMMAND, chosen, out)
    with trials_shown(console, count_trials(chosen)) as (on_trial, interrupted):
        result = run_bench(chosen, on_trial, interrupted)
    print_result(console, result)
    metrics = folder.write_metrics(plain(result.to_mapping()))
    draw_speed(folder.path / "speed.png", result)
    finish(console, folder, metrics, json)
