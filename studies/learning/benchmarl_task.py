"""The task of `examples/first_curve.py` for BenchMARL: IPPO and MAPPO of one robot, or of several with one network.

`python -m studies.learning.first_curve --learners ippo,mappo` draws their curves. Needs
`docs/how-to/learners/benchmarl.txt` and the extra `train`.
"""

import itertools
import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from examples.first_curve import ENVS, KEYS, REWARD, STEPS, task
from vslam_env import vslam_v1
from vslam_env.belief.observation_keys import MASK
from vslam_env.wrappers import Scaled

ALGORITHMS = {"ippo": IppoConfig, "mappo": MappoConfig}  # MAPPO's critic sees `state()`, the truth
CELLS, RATE, PASSES = [64, 64], 3e-4, 10  # of networks and updates, as in `examples/first_curve.py`
GROUP = "robot"


class Exploration(PettingZooClass):
    """Robots that explore together, with masked goals and scaled vectors."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Return a function that makes an environment with a seed of its own."""
        seeds = itertools.count(1000 * (seed or 0))  # BenchMARL gives one seed to all environments: equal worlds
        config = task(self.config["robots"]).replace(observation_type="flat")
        return lambda: PettingZooWrapper(
            Scaled(vslam_v1.parallel_env(config=config)), return_state=self.config["state"], seed=next(seeds),
            device=device,
        )  # fmt: skip

    def supports_continuous_actions(self) -> bool:
        """Return False: actions are goals."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Return True: actions are goals."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """Return False: no pictures are needed."""
        return False

    @staticmethod
    def env_name() -> str:
        """Return the name of the environment."""
        return "vslam"


class _Curve(Callback):  # type: ignore[misc]   # its types are not checked
    """Mean return of the episodes of each update, by the number of decisions of all robots."""

    def __init__(self) -> None:
        super().__init__()
        self.points: list[tuple[int, float]] = []

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        rewards = batch["next", GROUP, "reward"]  # (ENVS, STEPS, K, 1): whole episodes
        decisions = (len(self.points) + 1) * rewards.numel()
        self.points.append((decisions, float(rewards.sum(1).mean()) / REWARD))
        print(f"{decisions:8d} decisions: {self.points[-1][1]:.3f} m of map error removed", flush=True)


def train(
    algorithm: str, robots: int, decisions: int, seed: int
) -> tuple[Callable[[Mapping[str, Any], bool], int], list[tuple[int, float]]]:
    """Train one network for all robots.

    Args:
        algorithm: Name in `ALGORITHMS`.
        robots: Number of robots K.
        decisions: Decisions of all robots together.
        seed: Seed of worlds, episodes and networks.

    Returns:
        A function of a scaled observation, and of whether to take the most probable action, that returns an action;
        and the curve of decisions and returns [m].
    """
    torch.set_num_threads(1)  # small networks are faster on one thread
    experiment, curve = ExperimentConfig.get_from_yaml(), _Curve()
    experiment.max_n_iters, experiment.max_n_frames = max(1, decisions // (robots * ENVS * STEPS)), None
    experiment.on_policy_collected_frames_per_batch, experiment.on_policy_n_envs_per_worker = ENVS * STEPS, ENVS
    experiment.on_policy_n_minibatch_iters, experiment.on_policy_minibatch_size = PASSES, ENVS * STEPS // 2
    experiment.lr = RATE
    experiment.loggers, experiment.evaluation, experiment.render, experiment.create_json = [], False, False, False
    config = ALGORITHMS[algorithm].get_from_yaml()
    config.share_param_critic = algorithm == "ippo"  # the truth is the same for all, but not their rewards
    network = MlpConfig(num_cells=CELLS, activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear)
    with tempfile.TemporaryDirectory() as folder:
        experiment.save_folder = folder
        run = Experiment(
            task=Exploration("EXPLORATION", {"robots": robots, "state": algorithm == "mappo", "max_cycles": STEPS}),
            algorithm_config=config, model_config=network, critic_model_config=network, seed=seed, config=experiment,
            callbacks=[curve],
        )  # fmt: skip
        run.run()

    def choose(observation: Mapping[str, Any], is_greedy: bool) -> int:
        vector = np.concatenate([observation[name].ravel() for name in KEYS if name != MASK])
        seen = {"observation": {"observation": vector}, MASK: observation[MASK].astype(bool)}
        team = TensorDict({GROUP: TensorDict.from_dict(seen, batch_size=[])}).expand(1)
        team[GROUP] = team[GROUP].unsqueeze(1).expand(1, robots)
        how = ExplorationType.DETERMINISTIC if is_greedy else ExplorationType.RANDOM
        with torch.no_grad(), set_exploration_type(how):
            return int(run.policy(team)[GROUP, "action"][0, 0])

    return choose, curve.points
