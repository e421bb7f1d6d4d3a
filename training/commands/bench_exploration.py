"""The command `vslam bench exploration`: scripted policies, and your own, on the same worlds."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.commands._options import (
    Config,
    EnvRejuvenateEvery,
    FirstSeed,
    Json,
    Noise,
    OutToGoOn,
    Particles,
    Processes,
    Sensor,
    numbers,
    words,
)
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench.exploration.bench import ExplorationBenchConfig, ExplorationTrial

QUICK: dict[str, Any] = {"worlds": ("office",), "duration": 60.0, "seeds": 3}


def bench_exploration(
    policies: Annotated[
        str | None,
        typer.Option(
            help="Names, models' paths, MODULE:NAME of your own; NAME@discrete chooses how it acts. "
            "The others are compared with the first.",
            show_default="frontier,random_goals,random_walk",
        ),
    ] = None,
    worlds: Annotated[
        str | None, typer.Option(help="Families or paths.", show_default="office,maze,loops,hall")
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="train, validation or test worlds, or any.", show_default="validation")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="How many explore together.", show_default="3")] = None,
    oracles: Annotated[
        str | None,
        typer.Option(help="What robots are told: none, pose, association, merge, all.", show_default="none,all"),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds of an episode.", show_default="120")] = None,
    particles: Particles = None,
    rejuvenate_every: EnvRejuvenateEvery = None,
    preset: Noise = None,
    sensor: Sensor = None,
    seeds: Annotated[int | None, typer.Option(help="Episodes of each policy.", show_default="10")] = None,
    first_seed: FirstSeed = None,
    quick: Annotated[bool, typer.Option("--quick", help="Offices alone, 60 s, 3 seeds.")] = False,
    processes: Processes = 1,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Compare scripted policies, and your own, over worlds: floor seen, maps, poses, merges, with intervals.

    All policies of a seed meet the same worlds, starts and noise. Plurals take several values with commas between; all
    combinations are played. Robots that are told poses, names of landmarks and merges show what estimation costs.
    Ctrl-C finishes the episode under way; the same command with --out FOLDER goes on from there.
    """
    from functools import partial

    from slam_backend.core.validation import check_int
    from training.bench.exploration.bench import COMMAND, TRIALS_FILE, ExplorationBenchConfig, ExplorationTrial
    from training.bench.exploration.figures import draw_exploration
    from training.bench.exploration.summary import compare_oracles, compare_policies, curves, summarise
    from training.bench.exploration.tables import markdown, print_tables, to_csv
    from training.bench.exploration.trials import play
    from training.experiments.run_folder import plain

    check_int("processes", processes, 1, "Use one process or more.")
    given = {
        "policies": words(policies),
        "worlds": words(worlds),
        "split": split,
        "robots": numbers("robots", robots),
        "oracles": words(oracles),
        "duration": duration,
        "particles": particles,
        "rejuvenate_every": rejuvenate_every,
        "preset": preset,
        "sensor": sensor,
        "seeds": seeds,
        "seed": first_seed,
    }
    fast = QUICK if quick else None
    chosen = choose(ExplorationBenchConfig, COMMAND, given, config=config, json=json, out=out, quick=fast)
    trials = chosen.trials()
    firsts = {(t.policy, t.world, t.robots): t for t in reversed(trials)}.values()
    console, folder = begin(COMMAND, chosen, out, *(partial(_first_steps, chosen, t) for t in firsts), goes_on=True)
    part = KeptPart(
        file=TRIALS_FILE, kind=ExplorationTrial, play=partial(play, chosen), trials=trials, processes=processes,
        tell=lambda row: f"{row['world']}, {row['policy']}, seed {row['seed']}: {row['coverage']:.0%} seen",
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part)
    lines, over_time = plain(summarise(rows)), plain(curves(rows))
    policies_differ, oracles_differ = plain(compare_policies(rows)), plain(compare_oracles(rows))
    print_tables(console, lines, policies_differ, oracles_differ)
    metrics = folder.write_metrics({
        "summary": lines, "policies_differ": policies_differ, "oracles_differ": oracles_differ,
        "trials": rows,
    })  # fmt: skip
    folder.write_text("tables.md", markdown(lines, policies_differ, oracles_differ))
    folder.write_text("trials.csv", to_csv(rows))
    folder.write_text("curves.csv", to_csv(over_time))
    if over_time:
        draw_exploration(folder.path / "exploration.png", over_time)
    finish(console, folder, metrics, json)


def _first_steps(config: "ExplorationBenchConfig", trial: "ExplorationTrial") -> None:
    """Play the first two steps of a trial: a world that cannot be had, or a policy that fails, shows at once."""
    from training.episodes.runner import run_episode
    from vslam_env import vslam_v0

    steps = iter(range(2))
    env = vslam_v0.parallel_env(config=config.environment(trial))
    run_episode(env, config.run(trial).make_policies(env), trial.seed, should_stop=lambda: next(steps, None) is None)
    env.close()
