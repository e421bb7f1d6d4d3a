"""Evaluation of a trained model against baseline policies on the same unseen worlds."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
from rich.console import Console

from agents.policy import Policy
from agents.registry import make_policy
from agents.trained import TrainedGoalPolicy, load_model
from training.episodes.runner import run_episode
from training.experiments.policy_names import parted_label
from training.experiments.statistics import format_ci, mean_ci, paired_difference, summarise_means
from training.experiments.tables import E_SCALE, console_table
from training.rl.config import MODEL, EvaluateConfig, EvaluateTrial
from vslam_env import vslam_v1
from vslam_env.environment import ExplorationEnv

LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions", "distance")
FIGURES = ("return", *LAST)

Rows = Sequence[Mapping[str, Any]]
SHOWN = {
    "return": "return [m]", "map_error": "E [m]", "map_recall": "recall", "coverage": "cover-\nage",
    "merges": "merges", "distance": "path [m]",
}  # fmt: skip
WITH_INTERVAL = ("return", "map_error")  # metrics.json has the intervals of all metrics


def play(config: EvaluateConfig, trial: EvaluateTrial) -> dict[str, Any]:
    """Run an episode; return the trial and its metrics as means over the robots."""
    env = _environment(config)
    policies = {agent: _policy(config, trial.policy) for agent in env.possible_agents}
    rewards: list[float] = []
    record = run_episode(env, policies, trial.seed, lambda step: rewards.extend(step.rewards.values()))
    last = {name: float(np.mean([info[name] for info in record.infos])) for name in LAST}
    return asdict(trial) | {"return": sum(rewards) / len(policies)} | last


@cache
def _environment(config: EvaluateConfig) -> ExplorationEnv:
    return vslam_v1.parallel_env(config=config.environment())


def _policy(config: EvaluateConfig, name: str) -> Policy:
    if name == MODEL:
        return TrainedGoalPolicy(load_model(config.model)[0], config.greedy)
    return make_policy(parted_label(name)[1], "goal")


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return one line per policy: its number of seeds, and mean and confidence interval of each metric."""
    return summarise_means(rows, ("policy",), FIGURES)


def leads(rows: Rows) -> list[dict[str, Any]]:
    """Return the lead of the model's return over each other policy on common seeds.

    Fields: `over`, `seeds` (number of common seeds), `lead` with `lead_low` and `lead_high` (95 %, bootstrap), `won`:
    share of the seeds in which the model's return is higher.
    """
    returns: dict[str, dict[int, float]] = {}
    for row in rows:
        returns.setdefault(row["policy"], {})[row["seed"]] = row["return"]
    own = returns.pop(MODEL, {})
    found = []
    for name, theirs in returns.items():
        ahead = paired_difference(own, theirs)
        if len(ahead):
            lead = {"over": name, "seeds": len(ahead), "won": float((ahead > 0.0).mean())}
            found.append(lead | mean_ci("lead", ahead))
    return found


def _shown(policy: str) -> str:
    """Return the label of a policy, or else the policy."""
    return parted_label(policy)[0] or policy


def print_evaluation(console: Console, lines: Rows, ahead: Rows, split: str | None) -> None:
    """Print a table that fits into 80 columns, and one line for each lead.

    Args:
        split: Split of the worlds; None for a world with a single layout.
    """
    played = sorted({line["seeds"] for line in lines})
    episodes = "-".join(str(n) for n in (played if len(played) < 2 else (played[0], played[-1])))
    rows = [
        [
            _shown(line["policy"]),
            *(format_ci(line, name, stacked=True) if name in WITH_INTERVAL else f"{line[name]:.2f}" for name in SHOWN),
        ]
        for line in lines
    ]
    worlds = "One building" if split is None else f"Worlds of the {split} split"
    title = f"{worlds}, {episodes} episodes of each policy"
    table = console_table(title, ["policy", *SHOWN.values()], rows)
    table.columns[0].min_width = 12  # long names are folded, figures are not
    for column in table.columns[1:]:
        column.no_wrap = True
    console.print(table)
    console.print(E_SCALE)
    for lead in ahead:
        console.print(
            f"model, paired difference to {_shown(lead['over'])}: {format_ci(lead, 'lead')} m of return, ahead in "
            f"{100.0 * lead['won']:.0f} % of {lead['seeds']} seeds",
            soft_wrap=True,
        )
