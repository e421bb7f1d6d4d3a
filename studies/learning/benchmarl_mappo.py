"""MAPPO of BenchMARL with the truth as the critic's input, in the environment of `vslam train --preset quick`.

    python -m studies.learning.benchmarl_mappo FOLDER [--seed 0] [--preset quick] [--updates 30]

The actor is the network of `vslam train`, so that `vslam evaluate FOLDER` plays its model. What differs is the learner:
the critic sees `state()` alone. Needs `docs/how-to/learners/benchmarl.txt` and the extra `train`.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.common import Model, ModelConfig
from benchmarl.models.mlp import MlpConfig
from gymnasium import spaces
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, PettingZooWrapper

from agents.goal_network import NAMES
from agents.trained import MODEL_FILE, save_model
from training.experiments.run_folder import installed_versions
from training.rl.config import SPLIT_TRAIN, SPLIT_TRY, TrainConfig
from training.rl.network import GoalPolicy, actor_part
from vslam_env import NUM_CANDIDATES, vslam_v1
from vslam_env.belief.observation import observation_space
from vslam_env.belief.observation_keys import SCALES

CRITIC_CELLS = [128, 128]


class Exploration(PettingZooClass):
    """Robots that explore together; each environment has a seed of its own."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Return a function that makes an environment."""
        seeds = itertools.count(1000 * (seed or 0))
        return lambda: PettingZooWrapper(
            vslam_v1.parallel_env(config=self.config["env_config"]), return_state=True, seed=next(seeds), device=device
        )

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


class GoalActor(Model):
    """Actor of `vslam train` for dict observations."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        space = observation_space(NAMES)
        policy = GoalPolicy(space, spaces.Discrete(1 + NUM_CANDIDATES), lambda left: 1.0)
        del policy.mlp_extractor.value_hidden  # the critic is another network
        self.features_extractor, self.mlp_extractor = policy.features_extractor, policy.mlp_extractor
        self.in_keys = [*self.in_keys, (self.agent_group, "action_mask")]

    def _forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        group, seen = self.agent_group, {}
        for name in NAMES:
            key = (group, name) if name == "action_mask" else (group, "observation", name)
            seen[name] = tensordict.get(key).float()
        seen["local_grid"] = seen["local_grid"] * SCALES["local_grid"][0]
        batch = tensordict.get((group, "action_mask")).shape[:-1]
        flat = {name: values.flatten(0, len(batch) - 1) for name, values in seen.items()}
        logits = self.mlp_extractor.forward_actor(self.features_extractor(flat))
        tensordict.set(self.out_key, logits.unflatten(0, batch))
        return tensordict


@dataclass
class GoalActorConfig(ModelConfig):
    """Configuration of `GoalActor`; it has no parameters."""

    @staticmethod
    def associated_class() -> type[Model]:
        """Return the class of the model."""
        return GoalActor


class Progress(Callback):
    """Printed returns, a learning rate that decays linearly to zero, and the model after each update."""

    def __init__(self, config: TrainConfig, updates: int, file: Path) -> None:
        super().__init__()
        self.config, self.updates, self.file, self.done = config, updates, file, 0
        self.begin = time.perf_counter()

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        """Print the return, and set the learning rate of this update."""
        rewards = batch["next", "robot", "reward"].sum(1).mean()
        infos = batch["next", "robot", "info"]
        seconds = time.perf_counter() - self.begin
        print(
            f"update {self.done + 1}: {seconds:.0f} s, return {rewards:.3f}, E {infos['map_error'][:, -1].mean():.3f}, "
            f"recall {infos['map_recall'][:, -1].mean():.3f}, invalid {infos['invalid_action'].sum():.0f}",
            flush=True,
        )
        for optimizer in self.experiment.optimizers["robot"].values():
            for group in optimizer.param_groups:
                group["lr"] = self.config.learning_rate * (1.0 - self.done / self.updates)

    def on_train_end(self, training_td: TensorDictBase, group: str) -> None:
        """Write the model."""
        self.done += 1
        config = self.config
        actor = next(module for module in self.experiment.policy.modules() if isinstance(module, GoalActor))
        about = {
            "version": installed_versions()["vslam-env"], "environment": config.make_env_config(SPLIT_TRY).to_toml(),
            "steps": self.done * config.rollout, "seed": config.seed, "config": config.to_mapping(),
        }  # fmt: skip
        weights = {name: tensor.detach().numpy() for name, tensor in actor.state_dict().items()}
        save_model(self.file, actor_part(weights), about)


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates", type=int, default=None)
    parser.add_argument("--preset", default="quick")
    given = parser.parse_args()
    torch.set_num_threads(1)
    quick = TrainConfig.from_mapping({"preset": given.preset, "seed": given.seed})
    updates = given.updates or quick.updates
    experiment = ExperimentConfig.get_from_yaml()
    experiment.max_n_iters, experiment.max_n_frames = updates, None
    frames = quick.envs * quick.max_cycles
    experiment.on_policy_collected_frames_per_batch, experiment.on_policy_n_envs_per_worker = frames, quick.envs
    experiment.on_policy_n_minibatch_iters = quick.epochs
    experiment.on_policy_minibatch_size = quick.batch // quick.robots
    experiment.gamma, experiment.lr, experiment.adam_eps = quick.gamma, quick.learning_rate, 1e-5
    experiment.clip_grad_val = 0.5
    experiment.loggers, experiment.evaluation, experiment.render, experiment.create_json = [], False, False, False
    algorithm = MappoConfig.get_from_yaml()
    algorithm.share_param_critic = False  # rewards differ between robots
    algorithm.clip_epsilon, algorithm.entropy_coef, algorithm.lmbda = quick.clip, quick.entropy, quick.gae_lambda
    (config,) = quick.make_env_configs(SPLIT_TRAIN)
    given.folder.mkdir(parents=True, exist_ok=True)
    experiment.save_folder = str(given.folder)
    run = Experiment(
        task=Exploration("EXPLORATION", {"env_config": config, "max_cycles": config.num_cycles}),
        algorithm_config=algorithm,
        model_config=GoalActorConfig(),
        critic_model_config=MlpConfig(
            num_cells=CRITIC_CELLS, activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear
        ),
        seed=given.seed,
        config=experiment,
        callbacks=[Progress(quick, updates, given.folder / MODEL_FILE)],
    )
    run.run()


if __name__ == "__main__":
    main()
