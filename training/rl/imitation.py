"""`Imitation`: behaviour cloning of a planner, with rounds in which the pupil drives and the teacher labels (DAgger).

Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
AISTATS 2011. In the first round the teacher drives, in all others the pupil; each round fits all labels so far, and
ends with the weights of its epoch that predicts the teacher best on validation worlds.

From top to bottom: labels on disk, their collection, and the training.
"""

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure

from agents.goal_network import NAMES, SHAPES, Weights, logits
from agents.planners.next_best_view import decide
from agents.trained import load_model
from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import write_file
from slam_backend.core.validation import BoolArray, Float32Array, IntArray, argument_error
from training.rl.checkpoint import BOARD, as_arrays, as_tensors, check_device, restoring, save_run
from training.rl.config import SPLIT_TRAIN, SPLIT_TRY, TrainConfig
from training.rl.network import GoalPolicy, actor_part, check_finite
from training.vec_env import ExplorationVecEnv, load_kernels
from vslam_env import vslam_v1
from vslam_env.belief.observation import observation_space
from vslam_env.belief.observation_keys import SCALES
from vslam_env.config import EnvConfig

FORMAT = 3  # incremented when the content of files of labels or the meaning of observations changes
GRID = "local_grid"
BIT_AXES = {GRID: 2, "action_mask": 1, "teammates_mask": 1}  # axes along which arrays of bits are packed
ABOUT = "about"
MOST = 6e4  # largest number in a file
HINT = "Delete it, or use another folder."
LABELS = "labels"
SCORED = 1024  # labels scored at once
FIT_SHARE = 0.25  # of the time of a decision that one pass over a label takes, for the time left
Row = dict[str, float]
Progress = Callable[[str, float, float], None]

# ---------------------------------------------------------------------- labels


@dataclass(frozen=True, eq=False)
class Labels:
    """n decisions, with the inputs of the network only, in 2 kB each.

    Attributes:
        packed: Arrays by the names of `agents.goal_network.SHAPES`: grids as bits, eight rows of an image in a row of
            bytes (n, 3, 6, 48) uint8, which are compressed best; masks as bits (n, bytes) uint8; other numbers as
            (n, ...) float16 with 6 bits of mantissa, exact to 0.8 %.
        chosen: (n,) int64. Action of the teacher.
        preferences: (n, 1 + C) float32. Logarithms of the teacher's preferences, 0 for the best, -inf for actions that
            it did not consider.
    """

    packed: dict[str, NDArray[Any]]
    chosen: IntArray
    preferences: Float32Array

    def __len__(self) -> int:
        return len(self.chosen)

    def take(self, rows: IntArray) -> "Labels":
        """Return copies of some labels."""
        packed = {name: values[rows] for name, values in self.packed.items()}
        return Labels(packed, self.chosen[rows], self.preferences[rows])

    def inputs(self, rows: IntArray | slice) -> dict[str, NDArray[Any]]:
        """Return the inputs (m, ...) of the network for m labels, with the types that the environment returns."""
        found: dict[str, NDArray[Any]] = {}
        for name, shape in SHAPES.items():
            values, axis = self.packed[name][rows], BIT_AXES.get(name)
            if axis is None:
                found[name] = values.astype(np.float32)
            else:
                bits = np.unpackbits(values, axis=axis, count=shape[axis - 1])
                found[name] = bits * np.uint8(255) if name == GRID else bits.view(np.int8)
        return found


def pack(seen: Mapping[str, NDArray[Any]], chosen: IntArray, preferences: Float32Array) -> Labels:
    """Return labels for observations (n, ...) as the environment returned them."""
    packed: dict[str, NDArray[Any]] = {}
    for name in SHAPES:
        values, axis = np.asarray(seen[name]), BIT_AXES.get(name)
        packed[name] = _rounded(values) if axis is None else np.packbits(values != 0, axis=axis)
    return Labels(packed, chosen, preferences)


def write_labels(file: Path, labels: Labels, about: Mapping[str, Any]) -> int:
    """Write labels atomically, and return the size of the file [bytes].

    Args:
        file: The file. It is smallest if labels of one robot follow each other.
        labels: The labels.
        about: Environment, seed and name of the file, as plain values, which `read_labels` compares.

    Raises:
        ValueError: If the file cannot be written.
    """
    arrays = {name: _planes(values) if values.dtype == np.float16 else values for name, values in labels.packed.items()}
    arrays |= {"chosen": labels.chosen.astype(np.uint8), "preferences": labels.preferences.astype(np.float16)}
    stream = io.BytesIO()
    metadata = np.array(json.dumps({"format": FORMAT, **about}))
    np.savez_compressed(stream, allow_pickle=False, **{ABOUT: metadata}, **arrays)
    write_file(file, stream.getvalue(), "out")
    return stream.tell()


def read_labels(file: Path, about: Mapping[str, Any]) -> Labels:
    """Read labels of `write_labels`; no code from the file is run.

    Args:
        file: The file.
        about: Environment, seed and name that the file must have.

    Raises:
        ValueError: If the file is missing, damaged, of another format, or belongs to something else.
    """
    expected = "labels that vslam train wrote"
    if not file.is_file():
        raise argument_error("labels", expected, "no such file", f"Copy {str(file)!r} again, or use another folder.")
    try:
        arrays = dict(read_arrays(file))
        found = json.loads(str(arrays.pop(ABOUT)))
        version = found.pop("format")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise argument_error("labels", expected, "a broken file", f"{str(file)!r} cannot be read. {HINT}") from error
    if version != FORMAT:
        raise argument_error("labels", f"those of format {FORMAT}", f"format {version}", f"See {str(file)!r}. {HINT}")
    for name, value in about.items():
        if found.get(name) != value:
            hint = f"{str(file)!r} was made in another run. {HINT}"
            raise argument_error("labels", f"those of this {name}", f"those of another {name}", hint)
    try:
        return _unpacked(arrays)
    except (ValueError, KeyError, TypeError) as error:
        hint = f"{str(file)!r} has other arrays. {HINT}"
        raise argument_error("labels", expected, "another file", hint) from error


def joined(parts: Sequence[Labels]) -> Labels:
    """Return all labels together."""
    return Labels(
        {name: np.concatenate([part.packed[name] for part in parts]) for name in SHAPES},
        np.concatenate([part.chosen for part in parts]),
        np.concatenate([part.preferences for part in parts]),
    )


def _unpacked(arrays: Mapping[str, NDArray[Any]]) -> Labels:
    """Return the labels of the arrays in a file."""
    if arrays["chosen"].dtype.kind not in "iu" or arrays["preferences"].dtype.kind != "f":
        raise ValueError("labels of another type")
    chosen, preferences = arrays["chosen"].astype(np.int64), arrays["preferences"].astype(np.float32)
    n, num_actions = len(chosen), SHAPES["action_mask"][0]
    if preferences.shape != (n, num_actions) or chosen.ndim != 1 or ((chosen < 0) | (chosen >= num_actions)).any():
        raise ValueError("labels of other actions")
    if not (preferences <= 0.0).all() or not np.isfinite(preferences[np.arange(n), chosen]).all():  # False for NaN
        raise ValueError("preferences that are no logarithms")
    packed: dict[str, NDArray[Any]] = {}
    for name, shape in SHAPES.items():
        axis, expected = BIT_AXES.get(name), [n, *shape]
        packed[name] = arrays[name] if axis is not None else _from_planes(arrays[name])
        if axis is not None:
            expected[axis] = -(-expected[axis] // 8)
        dtype = np.float16 if axis is None else np.uint8
        if packed[name].dtype != dtype or packed[name].shape != tuple(expected):
            raise ValueError(f"{name} of another shape")
        if not np.isfinite(packed[name]).all():
            raise ValueError(f"{name} with NaN or infinity")
    return Labels(packed, chosen, preferences)


def _rounded(values: NDArray[Any]) -> NDArray[np.float16]:
    """Return values as float16 whose last four bits are zero; large ones become the largest one."""
    halves = np.clip(values, -MOST, MOST).astype(np.float16).view(np.uint16)
    return np.asarray((halves + np.uint16(8)) & np.uint16(0xFFF0)).view(np.float16)


def _planes(values: NDArray[np.float16]) -> NDArray[np.uint8]:
    """Return the high and the low bytes of (n, ...) numbers apart, (2, ..., n), which are compressed better."""
    moved = np.ascontiguousarray(np.moveaxis(values.astype("<f2"), 0, -1))
    return np.ascontiguousarray(np.moveaxis(moved.view(np.uint8).reshape(*moved.shape, 2), -1, 0))


def _from_planes(planes: NDArray[np.uint8]) -> NDArray[np.float16]:
    """Return the inverse of `_planes`."""
    if planes.dtype != np.uint8 or len(planes) != 2:
        raise ValueError("no planes of bytes")
    joint = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f2")[..., 0]
    return np.ascontiguousarray(np.moveaxis(joint, -1, 0).astype(np.float16))


# ---------------------------------------------------------------------- collection


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


# ---------------------------------------------------------------------- training


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
        with restoring():
            self.policy.load_state_dict(as_tensors(kept["policy"]))
            check_finite(self.policy)
            self.policy.optimizer.load_state_dict(as_tensors(kept["optimizer"]))
            self.rows = [dict(row) for row in kept["rows"]]
            self._best, self._best_weights = kept["best"]
            self._returns = dict(kept["returns"])

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

        A lost file is collected again where its driver is at hand: the teacher, or a pupil that has not learned since.

        Raises:
            ValueError: If the file is missing or damaged, or of another run.
        """
        config, name = self.config, _name(number, part, split)
        file = self._folder / LABELS / f"{name}.npz"
        env_configs = config.make_env_configs(split)
        about = {"environment": [each.to_toml() for each in env_configs], "seed": config.seed, "file": name}
        has_driver = number in (0, len(self.rows) / config.epochs)
        if name not in self._returns or (has_driver and not file.is_file()):
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
        seen["local_grid"] *= SCALES["local_grid"][0]
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
        content = {
            "policy": as_arrays(self.policy.state_dict()),
            "optimizer": as_arrays(self.policy.optimizer.state_dict()), "rows": self.rows, "returns": self._returns,
            "best": (self._best, self._best_weights),
        }  # fmt: skip
        steps = int(self.rows[-1]["labels"]) if self.rows else 0
        weights = self._best_weights or as_arrays(self.policy.state_dict())
        save_run(self._folder, self.config, content, actor_part(weights), steps)


def _score_of(row: Row) -> float:
    """Return what the best epoch of a round has least of."""
    return row["cross_entropy"] + row["driven_cross_entropy"]


def _name(number: int, part: int, split: str) -> str:
    return f"{number:02d}-{split}-{part:03d}"
