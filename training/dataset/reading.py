"""Readers of data sets: episode by episode, or as a data set of Minari. They run no code of a folder."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from slam_backend.core.array_files import UnreadableArchiveError, read_arrays
from slam_backend.core.files import read_file
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import read_json
from slam_backend.core.validation import BoolArray, FloatArray, argument_error
from training.dataset.recording import OBSERVATIONS, Array, EpisodeTrial, Field, shape_of
from training.experiments.run_folder import METRICS_FILE

FORMAT = 1  # of data sets: names of arrays, and the description in metrics.json
EXPECTED = "a data set of vslam record"
LARGEST_SHAPE = 10**9


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RecordedEpisode:
    """One episode of K robots and T steps.

    Attributes:
        number: Number of the episode in the data set.
        seed: Seed of world, noise and policy.
        observations: (K, T + 1, ...) by key; the first of a robot is that of the reset.
        actions: (K, T) int64, or (K, T, 2) float32 for continuous ones.
        rewards: (K, T) float64.
        terminations: (K, T) bool.
        truncations: (K, T) bool.
        times: (T + 1,) float64 [s]. Time since the reset.
        estimates: `poses` (K, T + 1, 3) float64 [m, m, rad], start frames; `groups` (K, T + 1) int64.
        truth: `poses` (K, T + 1, 3) float64 [m, m, rad], world frame; `map_errors` (K, T + 1) float64 [m]; `coverage`
            (T + 1,) float64; `landmarks` (N, 3) and `walls` (S, 4) float64 [m], world frame.
    """

    number: int
    seed: int
    observations: dict[str, Array]
    actions: Array
    rewards: FloatArray
    terminations: BoolArray
    truncations: BoolArray
    times: FloatArray
    estimates: dict[str, Array]
    truth: dict[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """What `metrics.json` says of a data set."""

    fields: dict[str, Field]  # Arrays of each file
    rows: list[dict[str, Any]]  # Episodes, see `training.dataset.recording.play`
    sha256: str  # Digest of all files


def read_description(folder: str | Path, name: str = "folder") -> Description:
    """Read the description of a data set.

    Args:
        folder: Folder of the data set.
        name: Name of the argument in errors.

    Raises:
        ValueError: If the folder is no data set, of another format, or its description is damaged.
    """
    file = Path(folder) / METRICS_FILE
    hint = f"Check {str(file)!r}; the command that recorded it, with --out {folder}, writes it again."
    if not file.is_file():
        raise argument_error(name, EXPECTED, f"no {METRICS_FILE}", hint)
    content = read_json(file, name, hint)
    try:
        version = content["format"]
        fields = {str(array): Field(**about | {"shape": tuple(about["shape"])}) for array, about in
                  content["arrays"].items()}  # fmt: skip
        for field in fields.values():
            _check_field(field)
        rows = [dict(row) for row in content["episodes"]]
        for row in rows:
            if row["file"] != EpisodeTrial(row["episode"], row["seed"]).file or not isinstance(row["sha256"], str):
                raise ValueError(f"an episode {row['episode']!r}")
        description = Description(fields, rows, str(content["sha256"]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise argument_error(name, EXPECTED, "a damaged description", f"{hint} Error: {error!r}.") from error
    if version != FORMAT:
        raise argument_error(
            name, f"one of format {FORMAT}", f"a data set of format {version!r}", "Use the release that recorded it."
        )
    return description


def _check_field(field: Field) -> None:
    """Raise unless the description of an array can be one of numbers."""
    if np.dtype(field.dtype).kind not in "biuf":
        raise ValueError(f"numbers of type {field.dtype!r}")
    for axis in field.shape:
        if not isinstance(axis, str) and (type(axis) is not int or not 0 <= axis <= LARGEST_SHAPE):
            raise ValueError(f"an axis of length {axis!r}")


def load_episodes(folder: str | Path) -> Iterator[RecordedEpisode]:
    """Read the episodes of a data set one after another, so that one at a time is in memory.

    No code from the files is run. The digest of each file, and names, types, shapes and finiteness of its arrays are
    checked.

    Args:
        folder: Folder that `vslam record` wrote; it may be the one of a stopped command.

    Yields:
        The episodes, by rising number.

    Raises:
        ValueError: If the folder is no data set, or a file is missing, damaged or of another data set; the message
            names it.
    """
    description = read_description(folder)
    return (read_episode(Path(folder), description, row) for row in description.rows)


def read_episode(folder: Path, description: Description, row: Mapping[str, Any]) -> RecordedEpisode:
    """Read the file of one row; see `load_episodes`."""
    file = folder / row["file"]
    check_file(file, row["sha256"])
    try:
        arrays: dict[str, Array] = dict(read_arrays(file))
        _check_arrays(arrays, description.fields, row["steps"])
    except (UnreadableArchiveError, ValueError, TypeError) as error:
        raise argument_error("folder", EXPECTED, "a broken file", f"Check {str(file)!r}: {error}.") from error

    def below(prefix: str) -> dict[str, Array]:
        return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}

    return RecordedEpisode(
        number=row["episode"], seed=row["seed"], observations=below(OBSERVATIONS), actions=arrays["actions"],
        rewards=arrays["rewards"], terminations=arrays["terminations"], truncations=arrays["truncations"],
        times=arrays["times"], estimates=below("estimates/"), truth=below("truth/"),
    )  # fmt: skip


def check_file(file: Path, digest: str) -> None:
    """Check that the file of an episode is there and is the one that was recorded.

    Raises:
        ValueError: If it is missing, or its digest is another one.
    """
    if not file.is_file():
        hint = f"Copy {str(file)!r} again, or remove its line of trials.jsonl and resume the command that recorded it."
        raise argument_error("folder", "all files of the data set", "a missing file", hint)
    try:
        found = hashlib.sha256(read_file(file)).hexdigest()
    except OSError as error:
        raise argument_error("folder", EXPECTED, "an unreadable file", f"Check {str(file)!r}: {error}.") from error
    if found != digest:
        hint = f"{str(file)!r} has changed since it was recorded. Copy it again."
        raise argument_error("folder", f"a file with the digest {digest[:12]}", found[:12], hint)


def _check_arrays(arrays: Mapping[str, Array], fields: Mapping[str, Field], steps: int) -> None:
    """Raise unless names, types and shapes are as described, and all numbers are finite."""
    if arrays.keys() != fields.keys():
        raise ValueError(f"it lacks or adds {sorted(arrays.keys() ^ fields.keys())}")
    sizes = {"steps": steps, "times": steps + 1}
    for name, field in fields.items():
        array = arrays[name]
        if array.ndim != len(field.shape) or array.dtype != np.dtype(field.dtype):
            raise ValueError(f"{name} is {array.dtype} of shape {array.shape}")
        for axis, length in zip(field.shape, array.shape, strict=True):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
        if array.shape != shape_of(field, sizes):
            raise ValueError(f"{name} has the shape {array.shape}, not {shape_of(field, sizes)}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has numbers that are not finite")


def to_minari(folder: str | Path, dataset_id: str, **about: Any) -> Any:
    """Make a data set of Minari: what one robot saw and did in one episode is an episode of it.

    Robots of a team share the spaces, and are numbered one after another. Episodes are read one at a time. Infos are
    the true and estimated poses `true_pose`, `estimated_pose` (T + 1, 3), and `map_error` (T + 1, 1).

    Args:
        folder: Folder that `vslam record` wrote.
        dataset_id: Name of the new data set, such as `vslam/office/frontier-v0`.
        **about: More arguments of `minari.create_dataset_from_buffers`, such as `author` or `data_format`.

    Returns:
        The `minari.MinariDataset`, which Minari stores where it stores all.

    Raises:
        ValueError: If Minari is not installed, or for the reasons of `load_episodes`.
    """
    try:
        import minari
        from minari.data_collector.episode_buffer import EpisodeBuffer
    except ImportError as error:
        hint = f"Install it: pip install 'minari[hdf5,arrow]'. Python says: {error}."
        raise argument_error("minari", "the package minari", "no such package", hint) from error
    description = read_description(folder)
    observed: dict[str, spaces.Space[Any]] = {
        name.removeprefix(OBSERVATIONS): _box(field)
        for name, field in description.fields.items() if name.startswith(OBSERVATIONS)
    }  # fmt: skip
    acted = description.fields["actions"]
    action = spaces.Discrete(int(acted.high) + 1) if acted.dtype == "int64" else _box(acted)

    def buffers() -> Iterator[Any]:
        number = 0
        for episode in load_episodes(folder):
            for robot in range(len(episode.rewards)):
                yield EpisodeBuffer(
                    id=number, seed=episode.seed,
                    observations={key: values[robot] for key, values in episode.observations.items()},
                    actions=episode.actions[robot], rewards=episode.rewards[robot],
                    terminations=episode.terminations[robot], truncations=episode.truncations[robot],
                    infos={
                        "true_pose": episode.truth["poses"][robot],
                        "estimated_pose": episode.estimates["poses"][robot],
                        "map_error": episode.truth["map_errors"][robot, :, None],  # a row each, as its Arrow files need
                    },
                )  # fmt: skip
                number += 1

    options = {"description": f"Episodes of vslam record, {description.sha256[:12]}.", "jpeg_encoding": False} | about
    return minari.create_dataset_from_buffers(
        dataset_id, buffers(), observation_space=spaces.Dict(observed), action_space=action, **options
    )


def _box(field: Field) -> spaces.Box:
    """Return the space of an entry of an array of robots and times."""
    shape = tuple(int(axis) for axis in field.shape[2:])
    dtype: Any = np.dtype(field.dtype)
    low, high = (np.broadcast_to(np.asarray(end, dtype), shape) for end in (field.low, field.high))
    return spaces.Box(low, high, shape, dtype.type)
