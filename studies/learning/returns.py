"""Returns of scripted policies by discount: the default reward, the running cost, and shaping with the map error only.

python -m studies.learning.returns --seeds 20
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from agents import make_policy
from agents.policy import Policy
from slam_backend.core.validation import FloatArray
from training.commands.study import run_program
from training.episodes.runner import Progress, run_episode
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Row, Study
from vslam_env import ExplorationEnv, vslam_v1
from vslam_env.belief.team_belief import Belief
from vslam_env.reward import RUNNING_COST

DISCOUNTS = (1.0, 0.999, 0.99)  # discounts per tick
TICKS_OF_A_TURN = 42  # at 1.5 rad/s: slightly more than a full turn
REWARDS = {"map_error": "default", RUNNING_COST: "running cost", "shaping": "shaping only"}


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


class Config(ExperimentConfig):
    """Episodes of scripted policies in the default environment."""

    duration: float = option(100.0, "Length of the episodes [s].", gt=0.0, hint="Give seconds.")
    seeds: int = option(20, "Number of episodes of each policy.", ge=2, hint="A confidence interval needs two or more.")
    seed: int = first_seed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One episode of one policy."""

    policy: str  # Name in `PLAYERS`
    seed: int


def trials(config: Config) -> list[Trial]:
    """Return all trials, ordered by seed."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [Trial(policy=policy, seed=seed) for seed, policy in product(seeds, PLAYERS)]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode; return its `returns`, means over the robots, by reward and discount."""
    env = vslam_v1.parallel_env(reward={"map_error": 1.0, RUNNING_COST: 1.0}, max_seconds=config.duration)
    paid, errors = play_ticks(env, PLAYERS[trial.policy], trial.seed)
    by_discount = {_name(gamma): returns_of(paid, errors, gamma) for gamma in DISCOUNTS}
    return {"returns": {reward: {name: r[reward] for name, r in by_discount.items()} for reward in REWARDS}}


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
    """Return the discounted return of an episode by the names in `REWARDS`.

    Args:
        paid: (T, 2) float64. Default reward and running cost of each step.
        errors: (T + 1,) float64 [m]. Map error at the reset and after each step.
        gamma: Discount per step.
    """
    discounts = gamma ** np.arange(len(paid))
    shaping = errors[:-1] - gamma * errors[1:]  # gamma phi' - phi with phi = -E
    sums = discounts @ np.column_stack([paid, shaping])
    return dict(zip(REWARDS, sums.tolist(), strict=True))


def unfold(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each reward of each trial."""
    return [
        {"reward": REWARDS[reward], "policy": row["policy"], "seed": row["seed"]} | returns
        for row in rows
        for reward, returns in row["returns"].items()
    ]


def _name(gamma: float) -> str:
    return f"gamma {gamma:g}"


COLUMNS = tuple(Column(_name(gamma), interval=True) for gamma in DISCOUNTS)

STUDY = Study(
    name="returns",
    about="""Run scripted policies in the default environment, and show their returns by discount per tick.

    The rewards are the default one, the running cost, and potential-based shaping with the potential -E only. Ctrl-C
    finishes the current episode; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    unfold=unfold,
    quick={"seeds": 2, "duration": 10.0},
    tables=(
        ResultTable(name="returns", title="Returns", by=("reward", "policy"), each=("reward",), columns=COLUMNS),
        ResultTable(
            name="differences", title="Paired differences to the nearest frontier", by=("reward", "policy"),
            each=("reward",), columns=COLUMNS, against="policy", base=FRONTIER,
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
