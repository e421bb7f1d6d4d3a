"""Digests of the tasks of a benchmark plan, to be frozen with it: the table [tasks] of its file.

python -m studies.bench_tasks vslam-bench-v1        # minutes; VSLAM_DATA for floor plans
"""

from typing import Annotated

import typer

from training.bench.exploration.plan import NO_RELAXATION, Plan, PlanTrial, task_name
from training.bench.exploration.trials import task_digest
from training.cli import run
from vslam_env import vslam_v1

POLICY = "frontier"  # any: tasks do not depend on it
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def digest(plan: Plan, trial: PlanTrial) -> str:
    """Return the digest of the task of an episode."""
    env = vslam_v1.parallel_env(config=plan.environment(trial))
    env.reset(seed=trial.seed)
    return task_digest(env)


def tasks(plan: Plan) -> dict[str, str]:
    """Return the digests of all episodes without relaxations, by track, world and number of robots.

    Floor plans are left out if some are missing.
    """
    found: dict[str, dict[int, str]] = {}
    for trial in plan.trials([POLICY]):
        if trial.relaxation == NO_RELAXATION:
            found.setdefault(task_name(trial), {})[trial.seed] = digest(plan, trial)
    return {name: " ".join(words[seed] for seed in sorted(words)) for name, words in found.items()}


@app.command()
def main(plan: Annotated[str, typer.Argument(help="Name or TOML file of a plan.")]) -> None:
    """Print the table [tasks] of a plan: digests of walls, landmarks, starts and first readings of each episode."""
    loaded = Plan.load(plan)
    if missing := loaded.missing_floor_plans():
        typer.echo(f"Floor plans are left out: VSLAM_DATA lacks {len(missing)} of {len(loaded.floor_plans)}.", err=True)
    found = tasks(loaded)
    typer.echo("[tasks]  # by track, world and number of robots, in order of seeds")
    for name, words in found.items():
        typer.echo(f'"{name}" = "{words}"')


if __name__ == "__main__":
    run(app, "python -m studies.bench_tasks")
