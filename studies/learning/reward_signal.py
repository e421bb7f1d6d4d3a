"""Learning signal of rewards: correlation of advantages with choices of goals, and effect of discounts on returns.

    python -m studies.learning.reward_signal choices --episodes 60
    python -m studies.learning.reward_signal returns --seeds 20

`choices` measures the signal for the decisions of `vslam train`. Robots drive to random candidates in worlds of the
training split. For several rewards and values of lambda of the generalised advantage estimate (with a fitted linear
value as baseline) it prints the correlation between the advantage of a decision and features of the choice relative to
the alternatives: a shorter path, a longer frontier, no nearer teammate. Each correlation comes with its t value over
    the
episodes: the larger the t value, the fewer decisions a policy gradient needs; twice the t value needs a quarter of the
decisions.

`returns` runs scripted policies in the default environment, and prints the return of each, undiscounted and discounted
per tick, for three rewards: the default reward, the running cost, and potential-based shaping with the potential -E
only. Each mean over robots and seeds comes with its difference to the nearest frontier, paired over the seeds, with its
95 % bootstrap interval.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from agents import make_policy
from agents.policy import Policy
from slam_backend.core.validation import FloatArray, check_int
from training.episodes.runner import Progress, run_episode
from training.experiments.statistics import format_ci, mean_ci
from training.experiments.tables import markdown_table
from training.rl.config import SPLIT_TRAIN, TrainConfig
from vslam_env import CANDIDATE_FEATURES, NUM_CANDIDATES, ExplorationEnv, vslam_v1
from vslam_env.belief.team_belief import Belief
from vslam_env.reward import RUNNING_COST

TERMS = ("map_error", "coverage", "own_coverage")
REWARDS: tuple[dict[str, float], ...] = (
    {"map_error": 1.0},
    {"map_error": 1.0, "coverage": 1.0},
    {"map_error": 3.0, "own_coverage": 10.0},
)
TRACES = (0.95, 0.9, 0.5, 0.0)
COLUMNS = ("path_length", "size", "teammate_path_length")
CHOICES = ("shorter path", "longer frontier", "no teammate nearer")
RIDGE = 1e-2
WIDTH = 120
DISCOUNTS = (1.0, 0.999, 0.99)  # discounts per tick
TICKS_OF_A_TURN = 42  # at 1.5 rad/s: slightly more than a full turn
RETURNS = {"map_error": "default", RUNNING_COST: "running cost", "shaping": "shaping only"}


class Spin:
    """Policy that turns on the spot, then stands still.

    Args:
        ticks: Number of ticks of turning.
    """

    def __init__(self, ticks: int) -> None:
        self._ticks = ticks
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._left = self._ticks

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> FloatArray:
        """Return the `continuous` action: a turn to the left at full speed, or zeros."""
        self._left -= 1
        return np.array([0.0, float(self._left >= 0)])


FRONTIER = "nearest frontier"
PLAYERS: dict[str, Callable[[], Policy]] = {
    FRONTIER: partial(make_policy, "frontier", "continuous"),
    "random walk": partial(make_policy, "random_walk", "continuous"),
    "spin": partial(Spin, 10**9),
    "one turn, then stay": partial(Spin, TICKS_OF_A_TURN),
    "idle": partial(Spin, 0),
}

app = typer.Typer(help="Learning signal of rewards.", no_args_is_help=True, add_completion=False)


def play(env: ExplorationEnv, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run an episode of random goals.

    Returns:
        Arrays by decision and robot: reward terms (T, K, 3), the choice relative to the valid candidates, in standard
        deviations (T, K, 3), zeros without a choice, and features of the value (T, K, V).
    """
    observations, _ = env.reset(seed=seed)
    rng, policy = np.random.default_rng(seed), make_policy("random_goals", "goal")
    paid: list[Any] = []
    chosen: list[Any] = []
    seen: list[Any] = []
    while env.agents:
        agents = env.agents
        actions = {agent: policy.act(observations[agent], env.belief(agent), rng) for agent in agents}
        progress = len(paid) / env.max_cycles
        chosen.append([choice_features(observations[agent], actions[agent]) for agent in agents])
        seen.append([value_features(observations[agent], progress) for agent in agents])
        observations, _, _, _, infos = env.step(actions)
        paid.append([[infos[agent][f"reward/{term}"] for term in TERMS] for agent in agents])
    return np.array(paid), np.array(chosen), np.array(seen)


def described(observation: Mapping[str, Any]) -> FloatArray:
    """Return the features `CHOICES` of each valid candidate (n, 3)."""
    rows = observation["candidates"][observation["action_mask"][1:] != 0].astype(np.float64)
    length, size, mate = (rows[:, CANDIDATE_FEATURES.index(name)] for name in COLUMNS)
    return np.column_stack([-np.log1p(length), np.log1p(size), mate >= length])


def choice_features(observation: Mapping[str, Any], action: int) -> FloatArray:
    """Return the chosen candidate minus the mean of the valid ones (3,), in their standard deviations."""
    valid = np.flatnonzero(observation["action_mask"][1:])
    rows = described(observation)
    if action == 0 or len(rows) < 2:
        return np.zeros(len(CHOICES))
    spread = rows.std(axis=0)
    differs: FloatArray = (rows[np.flatnonzero(valid == action - 1)[0]] - rows.mean(axis=0)) / np.maximum(spread, 1e-6)
    return np.where(spread > 1e-6, differs, 0.0)


def value_features(observation: Mapping[str, Any], progress: float) -> FloatArray:
    """Return the features of the value (V,): time, map, pose, candidates, free cells and walls nearby."""
    rows, (count, sigma, _, _, _, group) = described(observation), observation["map_stats"]
    best = rows.max(axis=0) if len(rows) else np.zeros(3)
    mean = rows.mean(axis=0) if len(rows) else np.zeros(3)
    around = observation["local_grid"].mean(axis=(1, 2)) / 255.0
    scalars = (1.0, progress, progress**2, progress * group, count / 100, 5 * sigma, group, observation["pose_std"][0])
    return np.array([*scalars, len(rows) / NUM_CANDIDATES, *best, *mean, *around])


def advantages(rewards: FloatArray, seen: FloatArray, gamma: float, trace: float) -> tuple[FloatArray, float]:
    """Return the advantages (E, T, K), with mean 0 and standard deviation 1, and the explained share of the returns.

    Args:
        rewards: (E, T, K) float64. Rewards by episode, decision and robot.
        seen: (E, T, K, V) float64. Features of the value.
        gamma: Discount per decision.
        trace: Lambda of the generalised advantage estimate.
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


def play_ticks(env: ExplorationEnv, make: Callable[[], Policy], seed: int) -> tuple[FloatArray, FloatArray]:
    """Run an episode with one policy for all robots.

    Returns:
        Default reward and running cost of each step, means over the robots (T, 2), and the mean map error at the reset
        and after each step (T + 1,) [m].
    """
    paid, errors = [], []

    def note(progress: Progress) -> None:
        infos = progress.infos.values()
        paid.append([[info[f"reward/{term}"] for term in ("map_error", RUNNING_COST)] for info in infos])
        errors.append([info["map_error"] for info in infos])

    run_episode(env, {agent: make() for agent in env.possible_agents}, seed, note)
    return np.mean(paid[1:], axis=1), np.mean(errors, axis=1)


def returns_of(paid: FloatArray, errors: FloatArray, gamma: float) -> dict[str, float]:
    """Return the discounted return of an episode by the names in `RETURNS`.

    Args:
        paid: (T, 2) float64. Default reward and running cost of each step.
        errors: (T + 1,) float64 [m]. Map error at the reset and after each step.
        gamma: Discount per step.
    """
    discounts = gamma ** np.arange(len(paid))
    shaping = errors[:-1] - gamma * errors[1:]  # gamma phi' - phi with phi = -E
    sums = discounts @ np.column_stack([paid, shaping])
    return dict(zip(RETURNS, sums.tolist(), strict=True))


def table_of(found: Mapping[tuple[str, float, str], FloatArray]) -> str:
    """Return the Markdown table of the returns (seeds,) by reward, discount and policy."""
    rows = []
    for reward, title in RETURNS.items():
        for policy in PLAYERS:
            cells = []
            for gamma in DISCOUNTS:
                own = found[reward, gamma, policy]
                more = mean_ci("more", own - found[reward, gamma, FRONTIER])
                cells += [f"{own.mean():z.3f}", "" if policy == FRONTIER else format_ci(more, "more")]
            rows.append([title, policy, *cells])
    headings = [text for gamma in DISCOUNTS for text in (f"gamma {gamma:g}", "minus frontier")]
    return markdown_table(["reward", "policy", *headings], rows)


@app.command()
def returns(
    seeds: Annotated[int, typer.Option(help="Number of episodes of each policy, 100 s long.")] = 20,
    first_seed: Annotated[int, typer.Option(help="Seed of the first episode; later ones count up.")] = 0,
) -> None:
    """Run scripted policies, and print their returns by discount."""
    check_int("seeds", seeds, 2, "A confidence interval needs two or more.")
    check_int("first_seed", first_seed, 0, "Use 0 or a positive number.")
    env = vslam_v1.parallel_env(reward={"map_error": 1.0, RUNNING_COST: 1.0})
    every = [(policy, seed) for seed in range(first_seed, first_seed + seeds) for policy in PLAYERS]
    found: dict[tuple[str, float, str], list[float]] = {}
    for policy, seed in track(every, "Playing", console=Console(stderr=True), transient=True):
        episode = play_ticks(env, PLAYERS[policy], seed)
        for gamma in DISCOUNTS:
            for reward, value in returns_of(*episode, gamma).items():
                found.setdefault((reward, gamma, policy), []).append(value)
    typer.echo(table_of({key: np.array(values) for key, values in found.items()}))


@app.command()
def choices(
    episodes: Annotated[int, typer.Option(help="Number of episodes of three robots and 90 s.")] = 60,
    first_seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 2000,
    gamma: Annotated[float, typer.Option(help="Discount per decision.")] = TrainConfig().gamma,
) -> None:
    """Run random goals, and print the correlation of advantages with choices."""
    chosen_config = TrainConfig(reward=dict.fromkeys(TERMS, 1.0))
    env = vslam_v1.parallel_env(config=chosen_config.make_env_config(SPLIT_TRAIN))
    played = [play(env, seed) for seed in range(first_seed, first_seed + episodes)]
    paid, chosen, seen = (np.array([episode[part] for episode in played]) for part in range(3))
    table = Table("reward", "lambda", "value explains", *CHOICES, title="Correlation of advantage and choice (t value)")
    for weights in REWARDS:
        rewards = paid @ np.array([weights.get(term, 0.0) for term in TERMS])
        for trace in TRACES:
            scaled, explained = advantages(rewards, seen, gamma, trace)
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
    app()
