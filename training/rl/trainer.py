"""`Training`: PPO built from a configuration; runs, saves checkpoints and resumes exactly."""

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import configure

from agents.trained import MODEL_FILE, load_model, save_model
from slam_backend.core.validation import argument_error
from slam_backend.state import checked_stream
from training.experiments.run_folder import installed_versions
from training.rl.callbacks import Row, TrainingCallback
from training.rl.checkpoint import CHECKPOINT_FILE, read_checkpoint, write_checkpoint
from training.rl.config import SPLIT_TRAIN, SPLIT_TRY, TrainConfig
from training.rl.learner import GoalPPO
from training.rl.network import check_finite
from training.rl.true_state import WithTrueState
from training.vec_env import make_vec_env

BOARD = "tensorboard"


class Training:
    """Training in its own folder.

    All sums run on one thread: two trainings of one configuration give the same weights, whether interrupted or not and
    for any number of processes, on the same machine with the same packages.

    Args:
        folder: Folder of checkpoint, model and TensorBoard curves.
        workers: Number of processes that step the environments; 0: this process.
        device: Torch device: `"cpu"`, `"cuda"` or one of several GPUs.
        cluster: Address of a Ray cluster that steps the environments; 0 workers are then one per core.

    Attributes:
        model: The learner.
        watch: Callback that reports progress and stops the training.

    Raises:
        ValueError: If the device does not exist, the environment cannot be built, or the cluster cannot be used.
    """

    def __init__(
        self, config: TrainConfig, folder: Path, workers: int = 0, device: str = "cpu", cluster: str | None = None
    ) -> None:
        check_device(device)
        torch.set_num_threads(1)
        self.config, self._folder = config, folder
        self.env = make_vec_env(
            config.make_env_configs(SPLIT_TRAIN), config.envs, workers, cluster=cluster, monitor=False,
            wrap=WithTrueState,
        )  # fmt: skip
        self.model = GoalPPO(
            env=self.env, learning_rate=lambda left: left * config.learning_rate, n_steps=config.max_cycles,
            batch_size=config.batch, n_epochs=config.epochs, gamma=config.gamma, gae_lambda=config.gae_lambda,
            clip_range=config.clip, ent_coef=config.entropy, seed=config.seed, device=device, anchor=config.anchor,
            value_rollouts=config.value_rollouts,
        )  # fmt: skip
        if config.start_file is not None:
            self.model.start_from(load_model(config.start_file)[0])
        self.watch = TrainingCallback(self.env, self.save, config.checkpoint_updates)

    @property
    def rows(self) -> list[Row]:
        """One row per rollout so far."""
        return self.watch.rows

    def run(self) -> bool:
        """Train to the end, or until the callback stops the training; save a checkpoint and the model.

        Returns:
            Whether the training is complete.
        """
        left = self.config.updates * self.config.rollout - self.model.num_timesteps
        if left > 0:
            self.model.set_logger(configure(str(self._folder / BOARD), [BOARD]))
            self.model.learn(left, callback=self.watch, reset_num_timesteps=self.model._last_obs is None)
            self.model.logger.close()
            if not self.watch.stopped:
                self.save()
        return not self.watch.stopped

    def save(self) -> None:
        """Write the checkpoint and the current model."""
        model = self.model
        content = {
            "config": self.config.to_mapping(),
            "seed": self.config.seed,
            "learner": as_arrays(model.get_state()),
            "counts": (model.num_timesteps, model._n_updates, model._current_progress_remaining),
            "last": (model._last_obs, model._last_episode_starts),
            "environments": self.env.get_state(),
            "watch": self.watch.get_state(),
            "draws": {
                "python": random.getstate(),
                "numpy": np.random.get_state(legacy=False),  # noqa: NPY002   # the learner uses the global generator
                "torch": as_arrays(torch.get_rng_state()),
                "cuda": as_arrays(_cuda_state()),
            },
        }
        write_checkpoint(self._folder / CHECKPOINT_FILE, content)
        self.save_model(self._folder / MODEL_FILE)

    def save_model(self, file: Path) -> None:
        """Write the model for `agents.trained`."""
        about = {
            "version": installed_versions()["vslam-env"],
            "environment": self.config.make_env_config(SPLIT_TRY).to_toml(), "steps": int(self.model.num_timesteps),
            "seed": self.config.seed, "config": self.config.to_mapping(),
        }  # fmt: skip
        save_model(file, self.model.trained.actor_weights(), about)

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Resume from a checkpoint of `stored_checkpoint`.

        Raises:
            ValueError: If a part does not fit this training.
        """
        try:
            self._go_on_from(kept)
        except Exception as error:  # torch raises various errors for parts of another model
            hint = "Another version or another run wrote it: copy the checkpoint again, or train again."
            raise argument_error("resume", "a checkpoint of this model", "a different one", hint) from error

    def _go_on_from(self, kept: Mapping[str, Any]) -> None:
        """Load the parts of a checkpoint."""
        model, draws = self.model, kept["draws"]
        model.set_state(as_tensors(kept["learner"]))
        check_finite(model.trained)
        model.num_timesteps, model._n_updates, model._current_progress_remaining = kept["counts"]
        model._last_obs, model._last_episode_starts = kept["last"]
        self.env.set_state(kept["environments"])
        self.watch.set_state(kept["watch"])
        random.setstate(draws["python"])
        checked_stream("draws", {name: draws["numpy"][name] for name in ("bit_generator", "state")})
        np.random.set_state(draws["numpy"])  # noqa: NPY002
        torch.set_rng_state(as_tensors(draws["torch"]))
        if draws["cuda"] is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(as_tensors(draws["cuda"]))

    def close(self) -> None:
        """Close the environments and their processes, and end an update that is running."""
        self.model.close()
        self.env.close()


def stored_checkpoint(folder: Path, config: TrainConfig) -> dict[str, Any]:
    """Return the checkpoint in the folder of a training.

    Raises:
        ValueError: If it is missing or damaged, or has another configuration or version.
    """
    kept = read_checkpoint(folder / CHECKPOINT_FILE)
    if (kept["config"], kept["seed"]) != (config.to_mapping(), config.seed):
        hint = "Restore the config.toml of the folder, or train again."
        raise argument_error("resume", "a checkpoint of the folder's configuration", "a checkpoint of another", hint)
    return kept


def check_device(device: str) -> str:
    """Return a device that torch can use.

    Raises:
        ValueError: If it is not a device, or this machine has no such device.
    """
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise argument_error("device", "cpu, cuda or cuda:0", device, "Omit it to use the processor.") from error
    if kind not in ("cpu", "cuda"):
        raise argument_error("device", "cpu, cuda or cuda:0", device, "Omit it to use the processor.")
    if kind == "cuda":
        num_gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (torch.device(device).index or 0) >= num_gpus:
            hint = "Omit --device to use the processor, or install a torch build that supports the GPU."
            raise argument_error("device", "a GPU that torch can use", f"a machine with {num_gpus} of them", hint)
    return device


def as_arrays(value: Any) -> Any:
    """Return nested dicts, lists and tuples with arrays in place of tensors, for a checkpoint."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy().copy()
    if isinstance(value, Mapping):
        return {key: as_arrays(entry) for key, entry in value.items()}
    return type(value)(map(as_arrays, value)) if isinstance(value, (list, tuple)) else value


def as_tensors(value: Any) -> Any:
    """Return the inverse of `as_arrays`, with tensors on the CPU."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, Mapping):
        return {key: as_tensors(entry) for key, entry in value.items()}
    return type(value)(map(as_tensors, value)) if isinstance(value, (list, tuple)) else value


def _cuda_state() -> Any:
    return torch.cuda.get_rng_state_all() if torch.cuda.is_available() else None
