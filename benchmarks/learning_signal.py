"""How well a learner can tell good goals from bad: what random play says about the choices that `vslam train` makes.

    python benchmarks/learning_signal.py --episodes 60

Robots drive to candidates drawn at random, in worlds of the training split. For several rewards and traces of the
generalised advantage estimate (lambda; a linear value is fitted and subtracted) it prints how the advantage of a
decision correlates with what was chosen, against what could have been: a shorter way, a longer frontier, one that no
teammate is nearer to. Beside each correlation stands its t value over the episodes: the larger, the fewer decisions a
policy gradient needs; twice the t value is a quarter of the decisions.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from agents import make_policy
from slam_backend.errors import FloatArray
from training.learn_config import SPLIT_TRAIN, TrainConfig
from vslam_env import ExplorationEnv, vslam_v0

TERMS = ("map_error", "coverage", "own_coverage")
REWARDS: tuple[dict[str, float], ...] = (
    {"map_error": 1.0},
    {"map_error": 1.0, "coverage": 1.0},
    {"map_error": 3.0, "own_coverage": 10.0},
)
TRACES = (0.95, 0.9, 0.5, 0.0)
CHOICES = ("shorter way", "longer frontier", "no teammate nearer")
RIDGE = 1e-2
WIDTH = 120


def play(env: ExplorationEnv, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Play an episode of random goals.

    Returns:
        By decision and robot: what each term paid (T, K, 3), the choice against what was valid, in standard deviations
        (T, K, 3), zeros where there was no choice, and what a value is fitted to (T, K, V).
    """
    observations, _ = env.reset(seed=seed)
    rng, policy = np.random.default_rng(seed), make_policy("random_goals", "goal")
    paid, chosen, seen = [], [], []
    while env.agents:
        agents = env.agents
        actions = {agent: policy.act(observations[agent], env.belief(agent), rng) for agent in agents}
        progress = len(paid) / env.max_cycles
        chosen.append([choice_of(observations[agent], actions[agent]) for agent in agents])
        seen.append([standing_of(observations[agent], progress) for agent in agents])
        observations, _, _, _, infos = env.step(actions)
        paid.append([[infos[agent][f"reward/{term}"] for term in TERMS] for agent in agents])
    return np.array(paid), np.array(chosen), np.array(seen)


def described(observation: Mapping[str, Any]) -> FloatArray:
    """Return what `CHOICES` names of each valid candidate (n, 3)."""
    _, _, length, size, mate = observation["candidates"][observation["action_mask"][1:] != 0].T.astype(np.float64)
    return np.column_stack([-np.log1p(length), np.log1p(size), mate >= length])


def choice_of(observation: Mapping[str, Any], action: int) -> FloatArray:
    """Return how the chosen candidate differs from the mean of the valid ones (3,), in their standard deviations."""
    valid = np.flatnonzero(observation["action_mask"][1:])
    rows = described(observation)
    if action == 0 or len(rows) < 2:
        return np.zeros(len(CHOICES))
    spread = rows.std(axis=0)
    differs: FloatArray = (rows[np.flatnonzero(valid == action - 1)[0]] - rows.mean(axis=0)) / np.maximum(spread, 1e-6)
    return np.where(spread > 1e-6, differs, 0.0)


def standing_of(observation: Mapping[str, Any], progress: float) -> FloatArray:
    """Return what a value is fitted to (V,): time, map, pose, candidates, floor and walls around."""
    rows, (count, sigma, _, _, _, group) = described(observation), observation["map_stats"]
    best = rows.max(axis=0) if len(rows) else np.zeros(3)
    mean = rows.mean(axis=0) if len(rows) else np.zeros(3)
    around = observation["local_grid"].mean(axis=(1, 2)) / 255.0
    told = (1.0, progress, progress**2, progress * group, count / 100, 5 * sigma, group, observation["pose_std"][0])
    return np.array([*told, len(rows) / 16, *best, *mean, *around])


def advantages(rewards: FloatArray, seen: FloatArray, gamma: float, trace: float) -> tuple[FloatArray, float]:
    """Return the advantages (E, T, K), mean 0 and standard deviation 1, and the share of the returns explained.

    Args:
        rewards: (E, T, K).
        seen: (E, T, K, V).
        gamma: Discount per decision.
        trace: lambda.
    """
    returns, ahead = np.zeros_like(rewards), np.zeros(rewards[:, 0].shape)
    for t in reversed(range(rewards.shape[1])):
        ahead = returns[:, t] = rewards[:, t] + gamma * ahead
    rows = seen.reshape(-1, seen.shape[-1])
    weights = np.linalg.solve(rows.T @ rows + RIDGE * np.eye(rows.shape[1]), rows.T @ returns.ravel())
    values = (rows @ weights).reshape(returns.shape)
    explained = 1.0 - float(np.mean((returns - values) ** 2) / returns.var())
    following = np.concatenate([values[:, 1:], np.zeros_like(values[:, :1])], axis=1)
    surprise, found, ahead = rewards + gamma * following - values, np.zeros_like(rewards), np.zeros_like(ahead)
    for t in reversed(range(rewards.shape[1])):
        ahead = found[:, t] = surprise[:, t] + gamma * trace * ahead
    scaled: FloatArray = (found - found.mean()) / found.std()
    return scaled, explained


def main(
    episodes: Annotated[int, typer.Option(help="Of three robots and 90 s; a second or two each.")] = 60,
    first_seed: Annotated[int, typer.Option(help="Of the first of them.")] = 2000,
) -> None:
    """Play, and print the table."""
    chosen_config = TrainConfig(reward=dict.fromkeys(TERMS, 1.0))
    env = vslam_v0.parallel_env(config=chosen_config.make_env_config(SPLIT_TRAIN))
    played = [play(env, seed) for seed in range(first_seed, first_seed + episodes)]
    paid, chosen, seen = (np.array([episode[part] for episode in played]) for part in range(3))
    table = Table("reward", "lambda", "value explains", *CHOICES, title="Correlation of advantage and choice (t value)")
    for weights in REWARDS:
        rewards = paid @ np.array([weights.get(term, 0.0) for term in TERMS])
        for trace in TRACES:
            scaled, explained = advantages(rewards, seen, chosen_config.gamma, trace)
            shown = []
            for k in range(len(CHOICES)):
                products = chosen[..., k] * scaled
                sums = products.sum(axis=(1, 2))
                t_value = sums.mean() / (sums.std(ddof=1) / np.sqrt(episodes))
                shown.append(f"{products[chosen[..., k] != 0.0].mean():.3f} ({t_value:.1f})")
            name = " + ".join(f"{weight:g} {term}" for term, weight in weights.items())
            table.add_row(name, f"{trace:g}", f"{explained:.2f}", *shown)
    Console(width=WIDTH).print(table)


if __name__ == "__main__":
    typer.run(main)
