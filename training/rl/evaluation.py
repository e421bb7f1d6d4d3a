"""A trained model beside scripted policies, each on the same worlds it has never seen: one trial, and all summed up."""

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
from training.experiments.statistics import ahead_by, mean_of, shown, summarise_means
from training.experiments.tables import console_table
from training.rl.config import MODEL, EvaluateConfig, EvaluateTrial
from vslam_env import vslam_v0
from vslam_env.environment import ExplorationEnv

LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions", "distance")
FIGURES = ("return", *LAST)

Rows = Sequence[Mapping[str, Any]]
SHOWN = {
    "return": "return [m]", "map_error": "map error [m]", "map_recall": "recall", "coverage": "floor",
    "merges": "merges", "distance": "way [m]",
}  # fmt: skip
WITH_INTERVAL = ("return", "map_error")  # the others have theirs in metrics.json


def play(config: EvaluateConfig, trial: EvaluateTrial) -> dict[str, Any]:
    """Play an episode; return the trial and its figures, means over the robots."""
    env = _environment(config)
    policies = {agent: _policy(config, trial.policy) for agent in env.possible_agents}
    rewards: list[float] = []
    record = run_episode(env, policies, trial.seed, lambda step: rewards.extend(step.rewards.values()))
    last = {name: float(np.mean([info[name] for info in record.infos])) for name in LAST}
    return asdict(trial) | {"return": sum(rewards) / len(policies)} | last


@cache
def _environment(config: EvaluateConfig) -> ExplorationEnv:
    return vslam_v0.parallel_env(config=config.environment())


def _policy(config: EvaluateConfig, name: str) -> Policy:
    return TrainedGoalPolicy(load_model(config.model)[0], config.greedy) if name == MODEL else make_policy(name, "goal")


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return a line per policy: its seeds, and of each figure the mean and its interval."""
    return summarise_means(rows, ("policy",), FIGURES)


def leads(rows: Rows) -> list[dict[str, Any]]:
    """Return per other policy by how much the model's return is higher on the same seeds.

    Fields: `over`, `seeds` (those that both have played), `lead` with `lead_low` and `lead_high` (95 %, bootstrap),
    `won`: the share of seeds in which the model's is higher.
    """
    returns: dict[str, dict[int, float]] = {}
    for row in rows:
        returns.setdefault(row["policy"], {})[row["seed"]] = row["return"]
    own = returns.pop(MODEL, {})
    found = []
    for name, theirs in returns.items():
        ahead = ahead_by(own, theirs)
        if len(ahead):
            told = {"over": name, "seeds": len(ahead), "won": float((ahead > 0.0).mean())}
            found.append(told | mean_of("lead", ahead))
    return found


def print_evaluation(console: Console, lines: Rows, ahead: Rows, split: str | None) -> None:
    """Print a table, which 80 columns hold, and a line for each lead.

    Args:
        split: Of the worlds; None where all episodes are in the same building.
    """
    played = sorted({line["seeds"] for line in lines})
    episodes = "-".join(str(n) for n in (played if len(played) < 2 else (played[0], played[-1])))
    rows = [
        [
            line["policy"],
            *(shown(line, name, stacked=True) if name in WITH_INTERVAL else f"{line[name]:.2f}" for name in SHOWN),
        ]
        for line in lines
    ]
    worlds = "One building" if split is None else f"Worlds of the {split} split"
    title = f"{worlds}, {episodes} episodes of each policy"
    console.print(console_table(title, ["policy", *SHOWN.values()], rows))
    for lead in ahead:
        console.print(
            f"model - {lead['over']}: {shown(lead, 'lead')} m of return, ahead in {100.0 * lead['won']:.0f} % "
            f"of {lead['seeds']} seeds",
            soft_wrap=True,
        )
