"""`Imitation`: behaviour cloning of a planner, with rounds in which the pupil drives and the teacher labels (DAgger).

Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
AISTATS 2011. In the first round the teacher drives, in all others the pupil; each round fits all labels so far, and
ends with the weights of its epoch that predicts the teacher best on validation worlds.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure

from agents.goal_network import GRID_SCALE, NAMES, SHAPES
from agents.trained import MODEL_FILE, load_model, save_model
from slam_backend.core.validation import argument_error
from training.experiments.run_folder import installed_versions
from training.rl.checkpoint import CHECKPOINT_FILE, write_checkpoint
from training.rl.config import SPLIT_TRAIN, SPLIT_TRY, TrainConfig
from training.rl.imitation.collection import collect, make_taught_envs
from training.rl.imitation.labels import Labels, joined, read_labels, write_labels
from training.rl.network import GoalPolicy, actor_part, check_finite
from training.rl.trainer import BOARD, as_arrays, as_tensors, check_device
from training.vec_env import ExplorationVecEnv
from vslam_env.belief.observation import observation_space

LABELS = "labels"
SCORED = 1024  # labels scored at once
FIT_SHARE = 0.25  # of the time of a decision that one pass over a label takes, for the time left
Row = dict[str, float]
Progress = Callable[[str, float, float], None]


class Imitation:
    """Imitation in its own folder.

    Every file of labels and every epoch is a function of the configuration, the seed and what came before: a run gives
    the same weights, whether interrupted or not and for any number of processes, on the same machine with the same
    packages.

    Args:
        folder: Folder of labels, checkpoint, model and TensorBoard curves.
        workers: Number of processes that step the environments of the training; 0: this process.
        device: Torch device: `"cpu"`, `"cuda"` or one of several GPUs.
        cluster: Address of a Ray cluster that steps the environments; 0 workers are then one per core.

    Attributes:
        rows: One row per epoch: `round`, `epoch`, `labels`, `loss`; on validation worlds in which the teacher drives
            `cross_entropy`, `agreement`, the share of decisions in which the most probable action is the teacher's, and
            `overlap`, the mean of the probability that both give to the same actions; the same with `driven_` before
            for the driver of this round, and its `return`. Validation worlds are the same in all rounds.

    Raises:
        ValueError: If the device does not exist.
    """

    def __init__(
        self, config: TrainConfig, folder: Path, workers: int = 0, device: str = "cpu", cluster: str | None = None
    ) -> None:
        check_device(device)
        torch.set_num_threads(1)
        assert config.rounds is not None  # the configuration checks it
        self.config, self._folder, self._device = config, folder, device
        self._workers, self._cluster = workers, cluster
        self._rounds = config.rounds
        torch.manual_seed(config.seed)
        space, actions = observation_space(NAMES), spaces.Discrete(SHAPES["action_mask"][0])
        self.policy = GoalPolicy(space, actions, lambda left: config.learning_rate).to(device)
        if config.start_file is not None:
            self.policy.load_actor(load_model(config.start_file)[0])
        self.rows: list[Row] = []
        self._best = np.inf
        self._best_weights: dict[str, Any] = {}
        self._returns: dict[str, float] = {}
        self._envs: dict[str, ExplorationVecEnv] = {}  # those of one split, whose workers keep cores of a cluster

    @property
    def parts(self) -> int:
        """Number of files of labels of each round."""
        return -(-self.config.updates // self._rounds)

    @property
    def best_row(self) -> Row:
        """Row of the last round's best epoch, whose weights the model has."""
        number = self.rows[-1]["round"]
        return min((row for row in self.rows if row["round"] == number), key=_score_of)

    @property
    def label_bytes(self) -> int:
        """Size of all files of labels."""
        return sum(file.stat().st_size for file in (self._folder / LABELS).glob("*.npz"))

    def run(
        self,
        on_progress: Progress = lambda stage, done, total: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Run all rounds that are left; a checkpoint and the model are saved after every epoch.

        Args:
            on_progress: Function called with the name of the stage, and the work done of that of the whole run.
            should_stop: Function called between files of labels and between epochs.

        Returns:
            Whether the training is complete.
        """
        self._logger = configure(str(self._folder / BOARD), [BOARD])
        try:
            return all(not should_stop() for _ in self._stages(on_progress))
        finally:
            self._logger.close()

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Resume from a checkpoint of `stored_checkpoint`.

        Raises:
            ValueError: If a part does not fit this training.
        """
        try:
            self.policy.load_state_dict(as_tensors(kept["policy"]))
            check_finite(self.policy)
            self.policy.optimizer.load_state_dict(as_tensors(kept["optimizer"]))
            self.rows = [dict(row) for row in kept["rows"]]
            self._best, self._best_weights = kept["best"]
            self._returns = dict(kept["returns"])
        except Exception as error:  # torch raises various errors for parts of another model
            hint = "Another version or another run wrote it: copy the checkpoint again, or train again."
            raise argument_error("resume", "a checkpoint of this model", "a different one", hint) from error

    def close(self) -> None:
        """Close the environments and their processes."""
        for env in self._envs.values():
            env.close()
        self._envs = {}

    # ------------------------------------------------------------------ within

    @property
    def _work(self) -> float:
        """Finished work, in decisions."""
        passes = sum(row["labels"] for row in self.rows)
        return len(self._returns) * self.config.rollout + FIT_SHARE * passes

    @property
    def _all_work(self) -> float:
        """Work of the whole run, in decisions."""
        config, count = self.config, self._rounds
        files, labels = count * (self.parts + 1), self.parts * config.rollout / config.thin
        return files * config.rollout + FIT_SHARE * config.epochs * labels * count * (count + 1) / 2

    def _stages(self, on_progress: Progress) -> Iterator[None]:
        """Work through the rounds, and yield after each file of labels and each epoch."""
        epochs = self.config.epochs
        for number in range(len(self.rows) // epochs, self._rounds):
            learn: list[Labels] = []
            for earlier in range(number + 1):
                for part in range(self.parts):
                    learn.append(self._labels(earlier, part, SPLIT_TRAIN, on_progress))
                    yield
            tried = {}
            for prefix, earlier in (("", 0), ("driven_", number)):
                tried[prefix] = self._labels(earlier, 0, SPLIT_TRY, on_progress)
                yield
            data = joined(learn)
            for epoch in range(len(self.rows) - number * epochs, epochs):
                row: Row = {"round": float(number), "epoch": float(epoch + 1), "labels": float(len(data))}
                row["loss"] = self._fit(data, number, epoch, on_progress)
                for prefix, labels in tried.items():
                    row |= {f"{prefix}{name}": value for name, value in self._score(labels).items()}
                row["return"] = self._returns[_name(number, 0, SPLIT_TRY)]
                self._keep_best(_score_of(row), epoch)
                self.rows.append(row)
                for name, value in row.items():
                    self._logger.record(f"imitation/{name}", value)
                self._logger.dump(len(self.rows))
                self._save()
                yield

    def _keep_best(self, score: float, epoch: int) -> None:
        """Keep the weights of the best epoch of a round so far; the next round begins with them."""
        if epoch == 0 or score < self._best:
            self._best, self._best_weights = score, as_arrays(self.policy.state_dict())
        if epoch + 1 == self.config.epochs:
            self.policy.load_state_dict(as_tensors(self._best_weights))

    def _labels(self, number: int, part: int, split: str, on_progress: Progress) -> Labels:
        """Return the labels of a file, collected first unless the checkpoint says that they were.

        Raises:
            ValueError: If the file is missing or damaged, or of another run.
        """
        config, name = self.config, _name(number, part, split)
        file = self._folder / LABELS / f"{name}.npz"
        env_configs = config.make_env_configs(split)
        about = {"environment": [each.to_toml() for each in env_configs], "seed": config.seed, "file": name}
        if name not in self._returns:
            file.parent.mkdir(exist_ok=True)
            if split not in self._envs:
                self.close()
                self._envs[split] = make_taught_envs(env_configs, config.envs, self._workers, self._cluster)
            stage, begun = f"round {number + 1} of {self._rounds}, labels {name}", self._work
            kept = (np.arange(config.max_cycles) + part) % (config.thin if split == SPLIT_TRAIN else 1) == 0
            found, gained = collect(
                self._envs[split], kept, self._seed(number, part, split),
                self.policy.actor_weights() if number else None,
                lambda done: on_progress(stage, begun + done, self._all_work),
            )  # fmt: skip
            write_labels(file, found, about)
            self._returns[name] = gained
            self._save()
        return read_labels(file, about)

    def _seed(self, number: int, part: int, split: str) -> int:
        words = [self.config.seed, 0, 0, 1] if split == SPLIT_TRY else [self.config.seed, number, part, 0]
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    def _fit(self, data: Labels, number: int, epoch: int, on_progress: Progress) -> float:
        """Pass once over the labels, and return the mean loss."""
        order = np.random.default_rng([self.config.seed, number, epoch]).permutation(len(data))
        for group in self.policy.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * (1.0 - epoch / self.config.epochs)
        stage, summed, begun = f"round {number + 1} of {self._rounds}, epoch {epoch + 1}", 0.0, self._work
        for begin in range(0, len(order), self.config.batch):
            rows = np.sort(order[begin : begin + self.config.batch])
            loss = self._cross_entropy(data, rows)[0].mean()
            self.policy.optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
            self.policy.optimizer.step()
            summed += float(loss.detach()) * len(rows)
            on_progress(stage, begun + FIT_SHARE * (begin + len(rows)), self._all_work)
        return summed / len(order)

    def _cross_entropy(self, data: Labels, rows: NDArray[np.int64]) -> tuple[Any, Any, Any]:
        """Return cross entropies (m,), and probabilities (m, 1 + C) of the teacher and of the pupil, for m labels."""
        inputs = data.inputs(rows)
        seen = {name: torch.from_numpy(inputs[name]).to(self._device).float() for name in NAMES}
        seen["local_grid"] *= GRID_SCALE
        scores = self.policy.logits(seen).log_softmax(1)
        wishes = (torch.from_numpy(data.preferences[rows]).to(self._device) / self.config.temperature).softmax(1)
        return -(wishes * scores).sum(1), wishes, scores.exp()

    @torch.no_grad()  # type: ignore[untyped-decorator, unused-ignore]
    def _score(self, data: Labels) -> Row:
        """Return cross entropy, agreement and overlap on labels."""
        sums = np.zeros(3)
        for begin in range(0, len(data), SCORED):
            rows = np.arange(begin, min(begin + SCORED, len(data)))
            losses, wishes, chances = self._cross_entropy(data, rows)
            agreed = (chances.argmax(1).cpu().numpy() == data.chosen[rows]).sum()
            sums += float(losses.sum()), float(agreed), float(torch.minimum(wishes, chances).sum())
        return dict(zip(("cross_entropy", "agreement", "overlap"), (sums / len(data)).tolist(), strict=True))

    def _save(self) -> None:
        """Write the checkpoint and the current model."""
        config = self.config
        content = {
            "config": config.to_mapping(), "seed": config.seed, "policy": as_arrays(self.policy.state_dict()),
            "optimizer": as_arrays(self.policy.optimizer.state_dict()), "rows": self.rows, "returns": self._returns,
            "best": (self._best, self._best_weights),
        }  # fmt: skip
        write_checkpoint(self._folder / CHECKPOINT_FILE, content)
        about = {
            "version": installed_versions()["vslam-env"],
            "environment": config.make_env_config(SPLIT_TRY).to_toml(),
            "steps": int(self.rows[-1]["labels"]) if self.rows else 0, "seed": config.seed,
            "config": config.to_mapping(),
        }  # fmt: skip
        weights = self._best_weights or as_arrays(self.policy.state_dict())
        save_model(self._folder / MODEL_FILE, actor_part(weights), about)


def _score_of(row: Row) -> float:
    """Return what the best epoch of a round has least of."""
    return row["cross_entropy"] + row["driven_cross_entropy"]


def _name(number: int, part: int, split: str) -> str:
    return f"{number:02d}-{split}-{part:03d}"
