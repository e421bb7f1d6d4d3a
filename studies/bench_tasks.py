"""Digests of the tasks of a benchmark plan, to be frozen with it: the table [tasks] of its file.

python -m studies.bench_tasks vslam-bench-v1        # minutes; VSLAM_DATA for floor plans
"""

import argparse

from training.bench.exploration.plan import NO_RELAXATION, Plan, PlanTrial, task_name
from training.bench.exploration.trials import task_digest
from vslam_env import vslam_v1

POLICY = "frontier"  # any: tasks do not depend on it


def digest(plan: Plan, trial: PlanTrial) -> str:
    """Return the digest of the task of an episode."""
    env = vslam_v1.parallel_env(config=plan.environment(trial))
    env.reset(seed=trial.seed)
    return task_digest(env)


def tasks(plan: Plan) -> dict[str, str]:
    """Return the digests of all episodes without relaxations, by track, world and number of robots."""
    found: dict[str, dict[int, str]] = {}
    for trial in plan.trials([POLICY], with_missing=True):
        if trial.relaxation == NO_RELAXATION:
            found.setdefault(task_name(trial), {})[trial.seed] = digest(plan, trial)
    return {name: " ".join(words[seed] for seed in sorted(words)) for name, words in found.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", help="name or TOML file of a plan")
    found = tasks(Plan.load(parser.parse_args().plan))
    print("[tasks]  # by track, world and number of robots, in order of seeds")
    for name, words in found.items():
        print(f'"{name}" = "{words}"')


if __name__ == "__main__":
    main()
