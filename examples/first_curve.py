"""A first learning curve: plain PPO of Stable-Baselines3 for one robot, or several with one network, in halls.

    python examples/first_curve.py --decisions 60000 --workers 2

A decision is a goal for one second. Observations are scaled to the order of one, the reward is ten per metre of map
error removed, and the discount looks 100 s ahead. PPO does not know which goals are valid: an invalid one is a second
of standing still, and that is what it unlearns first.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from training.vec_env import make_vec_env
from vslam_env import EnvConfig
from vslam_env.wrappers import Scaled

KEYS = ("map_stats", "candidates", "action_mask")
REWARD = 10.0  # per metre of map error removed
ENVS, STEPS = 8, 100  # environments, and decisions of each robot between two updates


def task(robots: int, split: Literal["train", "validation"] = "train") -> EnvConfig:
    """Return the task: halls of 100 s, in which a decision is a goal."""
    return EnvConfig(
        world="hall", num_robots=robots, action_type="goal", observation_keys=KEYS, reward={"map_error": REWARD},
        world_split=split,
    )  # fmt: skip


class Curve(BaseCallback):  # type: ignore[misc]   # its types are not checked
    """Mean return of the episodes that ended since the last update, by the number of decisions."""

    def __init__(self) -> None:
        super().__init__()
        self.points: list[tuple[int, float]] = []
        self._returns: list[float] = []

    def _on_step(self) -> bool:
        self._returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        if self._returns:
            self.points.append((self.num_timesteps, float(np.mean(self._returns)) / REWARD))
            print(f"{self.points[-1][0]:8d} decisions: {self.points[-1][1]:.3f} m of map error removed", flush=True)
            self._returns = []


def train(robots: int, decisions: int, seed: int = 0, workers: int = 0) -> tuple[PPO, list[tuple[int, float]]]:
    """Train one network for all robots; return the model, and its curve of decisions and returns [m]."""
    torch.set_num_threads(1)  # small networks are faster on one thread
    env: Any = make_vec_env(task(robots), ENVS, workers=workers, wrap=Scaled)
    model = PPO(
        "MultiInputPolicy", env, learning_rate=3e-4, n_steps=STEPS, batch_size=ENVS * STEPS * robots // 2, n_epochs=10,
        gamma=0.99, seed=seed, device="cpu",
    )  # fmt: skip
    curve = Curve()
    model.learn(decisions, callback=curve)
    env.close()
    return model, curve.points


def main(
    robots: Annotated[int, typer.Option(help="Number of robots.")] = 1,
    decisions: Annotated[int, typer.Option(help="Decisions of all robots together.")] = 60_000,
    seed: Annotated[int, typer.Option(help="Seed of worlds, episodes and network.")] = 0,
    workers: Annotated[int, typer.Option(help="Number of processes of environments; 0: this one.")] = 0,
    out: Annotated[Path, typer.Option(help="File of the model.")] = Path("first_curve.zip"),
) -> None:
    """Train, print the curve, and save the model."""
    model, _ = train(robots, decisions, seed, workers)
    model.save(out)
    print(f"Model: {out}")


if __name__ == "__main__":
    typer.run(main)
