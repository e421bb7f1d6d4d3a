"""Collection of labels: episodes in which the teacher or its pupil drives, and the teacher says what it would do."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.goal_network import Weights, logits
from agents.planners.next_best_view import decide
from slam_backend.core.validation import BoolArray, Float32Array
from training.rl.imitation.labels import Labels, joined, pack
from training.vec_env import ExplorationVecEnv, load_kernels
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig


class TaughtEnv:
    """Environment that can be asked what the teacher would do; all else is the environment's own.

    The teacher's previous goal is the one to which the robot drives, even if the pupil chose it: its answers depend on
    what the robot observes, not on answers that were not followed.

    Args:
        config: Configuration of the environment, with `goal` actions.
    """

    def __init__(self, config: EnvConfig) -> None:
        self._env = vslam_v1.parallel_env(config=config)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def teacher_labels(self) -> list[tuple[int, Float32Array]]:
        """Return action and preferences (1 + C,) of the teacher for each robot."""
        labels = []
        for agent in self._env.possible_agents:
            belief = self._env.belief(agent)
            held = np.flatnonzero(belief.candidates.own_goal)
            slot, preferences = decide(belief, int(held[0]) if len(held) else None)
            labels.append((0 if slot is None else 1 + slot, (preferences - preferences.max()).astype(np.float32)))
        return labels


def make_taught_envs(
    configs: Sequence[EnvConfig], num_envs: int, workers: int, cluster: str | None = None
) -> ExplorationVecEnv:
    """Make environments that can be asked for the teacher's labels; their configurations alternate."""
    makers = [partial(TaughtEnv, configs[i % len(configs)]) for i in range(num_envs)]
    return ExplorationVecEnv(makers, workers, partial(load_kernels, configs[0]), cluster)


def collect(
    env: ExplorationVecEnv,
    kept: BoolArray,
    seed: int,
    pupil: Weights | None = None,
    on_step: Callable[[int], None] = lambda decisions: None,
) -> tuple[Labels, float]:
    """Play one episode in each environment and label decisions of all robots.

    The result is a function of environments, seed and pupil alone.

    Args:
        env: Environments of `make_taught_envs`.
        kept: (T,) bool. Whether each of the T decisions of an episode is labelled.
        seed: Seed of worlds, noise and the pupil's draws.
        pupil: Weights of the network that drives and draws its actions; None: the teacher drives.
        on_step: Function called with the number of decisions so far.

    Returns:
        The labels, ordered by robot and then by time, and the mean return of the robots.
    """
    rng = np.random.default_rng([seed, 1])
    env.seed(seed)
    seen: dict[str, NDArray[Any]] = env.reset()
    parts: list[Labels] = []
    gained = 0.0
    for step, is_kept in enumerate(kept):
        if is_kept or pupil is None:
            answers = [one for of in env.env_method("teacher_labels", indices=env.first_slots) for one in of]
            actions = np.array([action for action, _ in answers])
            if is_kept:
                parts.append(pack(seen, actions, np.array([wish for _, wish in answers])))
        if pupil is not None:
            actions = draw(pupil, seen, rng)
        seen, rewards, _, _ = env.step(actions)
        gained += float(rewards.mean())
        on_step((step + 1) * len(actions))
    order = np.arange(len(parts) * env.num_envs).reshape(len(parts), -1).T.ravel()
    return joined(parts).take(order), gained


def draw(pupil: Weights, seen: dict[str, NDArray[Any]], rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw an action (n,) from the softmax of the logits of each observation."""
    noise = rng.gumbel(size=(len(seen["action_mask"]), seen["action_mask"].shape[1]))
    return np.asarray((logits(pupil, seen) + noise).argmax(axis=1))
