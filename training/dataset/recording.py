"""Recording of episodes: what a file of an episode holds, declared once, and how it is filled and written."""

import hashlib
import io
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.files import MAX_BYTES, write_file
from slam_backend.core.validation import argument_error
from training.dataset.config import RecordConfig
from training.episodes.guard import PolicyError
from training.episodes.runner import EpisodeRecord, Progress, run_episode
from training.experiments.trial_store import FAILED
from vslam_env.environment import ExplorationEnv

OBSERVATIONS = "observations/"
PACKED_SHARE = 0.1  # of the bytes of an episode in memory that its file takes, at most, as measured
ABOUT = {  # units and meanings of the keys of observations
    "pose": ("m, m, rad", "estimated pose, start frame"), "pose_std": ("m, m, rad", "one sigma of each"),
    "map_stats": ("mixed", "statistics of the group's map"),
    "local_grid": ("-", "free, occupied, landmarks around the robot; cells of 0.2 m"),
    "scan": ("m", "ranges from right to left"), "candidates": ("mixed", "a place to go to in each slot"),
    "teammates": ("m, m, -, -, m", "x, y, cos and sin of the heading, sigma of each other robot"),
    "teammates_mask": ("-", "which rows of teammates are filled"),
    "landmark_counts": ("-", "landmarks by number of measurements"), "time_left": ("s", "time until the limit"),
    "global_grid": ("-", "shares of free, occupied, looked-at cells; start frame"),
    "global_grid_frame": ("m", "middle of global_grid, and size of its cells"),
    "action_mask": ("-", "which actions are valid"),
}  # fmt: skip
Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class EpisodeTrial:
    """One episode of a data set."""

    episode: int
    seed: int

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"episode_{self.episode:05d}.npz"


class Field(NamedTuple):
    """Array of an episode.

    Attributes:
        shape: Lengths of its axes; words for those that depend on the episode: `times` is one more than `steps`.
        dtype: Type of its numbers.
        unit: Unit, or units of the columns.
        meaning: Content in words.
        low: Lower bound, or bounds of an entry, of a space; None: no space.
        high: Upper bound, or bounds.
    """

    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    meaning: str
    low: Any = None
    high: Any = None


def fields_of(env: ExplorationEnv) -> dict[str, Field]:
    """Return the arrays of an environment's episodes by name, in the order of the file.

    The first axis of what belongs to a robot is the robot. Row t of `observations` was seen at `times[t]`; `actions`,
    `rewards`, `terminations` and `truncations` t belong to the step from there to `times[t + 1]`.
    """
    agent, robots = env.possible_agents[0], len(env.possible_agents)
    observed, action = env.observation_space(agent), env.action_space(agent)
    assert isinstance(observed, spaces.Dict)  # data sets have no flat observations
    rows: tuple[int | str, ...] = (robots, "times")
    found: dict[str, Field] = {}
    for key, box in observed.spaces.items():
        assert isinstance(box, spaces.Box)
        found[OBSERVATIONS + key] = _of_box((*rows, *box.shape), box, *ABOUT[key])
    steps: tuple[int | str, ...] = (robots, "steps")
    if isinstance(action, spaces.Discrete):
        found["actions"] = Field(steps, "int64", "-", "action, by number", 0, int(action.n) - 1)
    else:
        assert isinstance(action, spaces.Box)
        found["actions"] = _of_box((*steps, *action.shape), action, "-", "speed and turn, as shares of the largest")
    return found | {
        "rewards": Field(steps, "float64", "m", "decrease of the map error E of the robot"),
        "terminations": Field(steps, "bool", "-", "whether the episode ended by itself"),
        "truncations": Field(steps, "bool", "-", "whether the time limit ended the episode"),
        "times": Field(("times",), "float64", "s", "simulated time since the reset"),
        "estimates/poses": Field((*rows, 3), "float64", "m, m, rad", "estimated pose, start frame of the robot"),
        "estimates/groups": Field(rows, "int64", "-", "lowest robot with which the robot shares a map"),
        "truth/poses": Field((*rows, 3), "float64", "m, m, rad", "true pose, world frame"),
        "truth/map_errors": Field(rows, "float64", "m", "map error E, start frame of the robot"),
        "truth/coverage": Field(("times",), "float64", "-", "share of the reachable floor that the team has seen"),
        "truth/landmarks": Field(("landmarks", 3), "float64", "m", "true landmarks, world frame"),
        "truth/walls": Field(("walls", 4), "float64", "m", "walls x1, y1, x2, y2, world frame"),
    }


def _of_box(shape: tuple[int | str, ...], box: spaces.Box, unit: str, meaning: str) -> Field:
    ends = (end.flat[0].item() if (end == end.flat[0]).all() else end.tolist() for end in (box.low, box.high))
    return Field(shape, str(box.dtype), unit, meaning, *ends)


def shape_of(field: Field, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Return the shape of an array in an episode with these lengths of named axes."""
    return tuple(sizes[axis] if isinstance(axis, str) else axis for axis in field.shape)


def step_sizes(steps: int) -> dict[str, int]:
    """Return the lengths of the axes that follow from the number of steps."""
    return {"steps": steps, "times": steps + 1}


def memory_of(fields: Mapping[str, Field], steps: int) -> int:
    """Return the bytes of an episode in memory, but for its walls and landmarks."""
    sizes = step_sizes(steps) | {"landmarks": 0, "walls": 0}
    return sum(prod(shape_of(field, sizes)) * np.dtype(field.dtype).itemsize for field in fields.values())


def check_room(config: RecordConfig, env: ExplorationEnv, out: Path | None) -> str:
    """Check that an episode fits into memory and the episodes that are left onto the disk.

    Args:
        config: Configuration of the data set.
        env: Environment of its episodes.
        out: Folder of the data set, which may exist; None: a folder in `runs`.

    Returns:
        A line about the size.

    Raises:
        ValueError: If an episode has more than 1 GiB, which readers refuse, or the disk has too little room.
    """
    one = memory_of(fields_of(env), config.num_steps)
    if one > MAX_BYTES:
        hint = "Shorten the episodes, or record fewer keys of observations."
        raise argument_error("max_seconds", "episodes of at most 1024 MiB", f"{one / 2**20:.0f} MiB each", hint)
    folder = Path("runs") if out is None else out
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    left = config.episodes - (len(list(folder.glob("episode_*.npz"))) if folder.is_dir() else 0)
    needed, free = PACKED_SHARE * one * left, shutil.disk_usage(there).free
    if needed > free:
        hint = "Record fewer or shorter episodes, or choose a folder on another disk."
        raise argument_error("out", f"a disk with {needed / 2**20:.0f} MiB left", f"{free / 2**20:.0f} MiB", hint)
    disk = PACKED_SHARE * one * config.episodes / 2**20
    return f"Size: about {disk:.1f} MiB on disk or less, {one / 2**20:.1f} MiB of memory for each process."


class Recorder:
    """Recorder of one episode into arrays of its greatest length, made once.

    Args:
        env: Environment of the episode.
        steps: Largest number of its steps.
    """

    def __init__(self, env: ExplorationEnv, steps: int) -> None:
        self._env, self._agents, self._fields = env, list(env.possible_agents), fields_of(env)
        sizes = step_sizes(steps) | {"landmarks": 0, "walls": 0}
        self._arrays: dict[str, Array] = {
            name: np.zeros(shape_of(field, sizes), field.dtype) for name, field in self._fields.items()
        }

    def on_step(self, progress: Progress) -> None:
        """Record the reset or a step."""
        row = progress.step
        for robot, agent in enumerate(self._agents):
            for key, value in progress.observations[agent].items():
                self._arrays[OBSERVATIONS + key][robot, row] = value
            self._arrays["estimates/groups"][robot, row] = progress.infos[agent]["group"]
            if row:
                for name, values in (
                    ("actions", progress.actions), ("rewards", progress.rewards),
                    ("terminations", progress.terminations), ("truncations", progress.truncations),
                ):  # fmt: skip
                    self._arrays[name][robot, row - 1] = values[agent]

    def finish(self, record: EpisodeRecord) -> dict[str, Array]:
        """Return the arrays of the episode, cut to its length."""
        times = len(record.times)
        sizes = step_sizes(times - 1)
        known = {
            "times": record.times, "estimates/poses": record.estimated, "truth/poses": record.true_poses,
            "truth/map_errors": record.map_errors, "truth/coverage": record.coverage,
            "truth/landmarks": record.true_landmarks, "truth/walls": self._env.episode.scenario.world.walls,
        }  # fmt: skip
        found = {}
        for name, field in self._fields.items():
            part = tuple(slice(sizes.get(str(axis))) for axis in field.shape)
            found[name] = np.ascontiguousarray(known[name] if name in known else self._arrays[name][part], field.dtype)
        return found


def packed(arrays: Mapping[str, Array]) -> bytes:
    """Return arrays as a compressed archive of numpy; equal arrays give equal bytes."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def play(config: RecordConfig, folder: Path | None, trial: EpisodeTrial) -> dict[str, Any]:
    """Play an episode, write its file, and return its row; a function of configuration and trial alone.

    Args:
        config: Configuration of the data set.
        folder: Folder of the data set; None: no file is written.
        trial: The episode.

    Returns:
        The fields of the trial; `file`, `bytes` and `sha256` of its file; `steps`; means over the robots of the
        `return` and of the last `map_error`; `coverage` and `maps` at the end; `policy`, and the `policy_digest` of a
        custom policy's file or a model. If the policy fails, the fields of the trial, and the error as `failed`.

    Raises:
        ValueError: If the file cannot be written.
    """
    from training.bench.exploration.players import parted

    env = config.make_env()
    recorder = Recorder(env, config.num_steps)
    try:
        team = config.make_policies(env)
        record = run_episode(env, team, trial.seed, recorder.on_step, options=config.reset_options())
    except PolicyError as error:
        return {**asdict(trial), FAILED: str(error)}
    finally:
        env.close()
    arrays = recorder.finish(record)
    content = packed(arrays)
    if folder is not None:
        write_file(folder / trial.file, content, "out")
    return {
        **asdict(trial), "file": trial.file, "steps": len(record.times) - 1,
        "return": float(arrays["rewards"].sum(axis=1).mean()), "map_error": float(record.map_errors[:, -1].mean()),
        "coverage": float(record.coverage[-1]), "maps": len(record.groups), "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(), "policy": config.policy,
        "policy_digest": parted(config.policy).source_digest(),
    }  # fmt: skip


def sums(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the digests of the files of some episodes as `sha256sum --check` reads them."""
    return "".join(f"{row['sha256']}  {row['file']}\n" for row in rows)
