"""The command `vslam bench env`: how fast an environment steps, where the time goes, and a peer beside it."""

from typing import Annotated, Any

import typer

from training.commands._options import Config, Json, Out, numbers, words
from training.commands._progress import trials_shown
from training.commands._run_folder import begin, choose, finish

COMMAND = "bench env"
QUICK: dict[str, Any] = {"robots": (3,), "particles": (100,), "worlds": ("office",), "modes": ("dict",), "steps": 300}


def bench_env(
    robots: Annotated[
        str | None, typer.Option(help="Numbers K with commas between, the base first.", show_default="3,1,2,4,6,8")
    ] = None,
    particles: Annotated[str | None, typer.Option(help="Numbers M.", show_default="100,30,300,1000")] = None,
    worlds: Annotated[
        str | None, typer.Option(help="Families or paths.", show_default="office,fig5,maze,hall,loops")
    ] = None,
    modes: Annotated[str | None, typer.Option(help="Of dict, flat, goal.", show_default="all")] = None,
    steps: Annotated[int | None, typer.Option(help="Timed steps per row.", show_default="600")] = None,
    peer: Annotated[bool | None, typer.Option(help="Also simple_spread of MPE2.", show_default="peer")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="The base alone, 300 steps.")] = False,
    seed: Annotated[int | None, typer.Option(help="Of the episodes.", show_default="100")] = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Time steps of environments with the filter in the loop, on one thread, and tell where the time goes."""
    from training.bench.env.bench import EnvBenchConfig, count_trials, run_bench
    from training.bench.env.tables import print_env_result
    from training.experiments.run_folder import plain as to_plain
    from vslam_env import vslam_v0

    given = {
        "robots": numbers("robots", robots),
        "particles": numbers("particles", particles),
        "worlds": words(worlds),
        "modes": words(modes),
        "steps": steps,
        "peer": peer,
        "seed": seed,
    }
    fast = QUICK if quick else None
    chosen = choose(EnvBenchConfig, COMMAND, given, config=config, json=json, out=out, quick=fast)
    for load in chosen.loads():  # what cannot be built shows before there is a folder
        vslam_v0.parallel_env(config=load.config())
    console, folder = begin(COMMAND, chosen, out)
    with trials_shown(console, count_trials(chosen)) as (on_trial, interrupted):
        result = run_bench(chosen, on_trial, interrupted)
    print_env_result(console, result, chosen.peer)
    metrics = folder.write_metrics(to_plain(result.to_mapping()))
    finish(console, folder, metrics, json)
