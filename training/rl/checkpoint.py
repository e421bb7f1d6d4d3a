"""Checkpoints of a training: single files, written atomically and tagged with package versions; and its model."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from agents.trained import MODEL_FILE, save_model
from slam_backend.core.files import MAX_BYTES, read_file, write_file
from slam_backend.core.validation import argument_error
from slam_backend.state.codec import decode, encode
from training.experiments.run_folder import installed_versions
from training.rl.config import SPLIT_TRY, TrainConfig

FORMAT = 5  # incremented when the content of checkpoints changes
MAGIC = b"vslam train checkpoint "
CHECKPOINT_FILE = "checkpoint.bin"
BOARD = "tensorboard"
# Packages whose versions must match for an exact resume
DECISIVE = ("vslam-env", "torch", "stable-baselines3", "sb3-contrib", "numpy")


def write_checkpoint(file: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically: an interrupted write keeps the previous one.

    The file contains data only; reading it runs no code.

    Raises:
        ValueError: If it cannot be written.
    """
    packed = encode(dict(content))
    mark = {
        "format": FORMAT, "versions": _versions(), "bytes": len(packed), "sha256": hashlib.sha256(packed).hexdigest(),
    }  # fmt: skip
    write_file(file, MAGIC + json.dumps(mark).encode() + b"\n" + packed, "out")


def read_checkpoint(file: Path) -> dict[str, Any]:
    """Read a checkpoint of `write_checkpoint`.

    Raises:
        ValueError: If it is missing, truncated, changed, or written with package versions that prevent an exact resume.
    """
    expected = "the checkpoint of a training"
    if not file.is_file():
        hint = f"There is no {str(file)!r}: the run ended before its first checkpoint. Train again."
        raise argument_error("resume", expected, "no such file", hint)
    try:
        head, _, packed = read_file(file).partition(b"\n")
    except OSError as error:
        hint = f"{str(file)!r} cannot be read: {error}."
        raise argument_error("resume", f"{expected} of at most {MAX_BYTES >> 20} MiB", "another file", hint) from error
    try:
        if not head.startswith(MAGIC):
            raise ValueError("another kind of file")
        mark = json.loads(head[len(MAGIC) :])
        size, digest, version, versions = (mark[name] for name in ("bytes", "sha256", "format", "versions"))
        if not isinstance(versions, dict):
            raise ValueError("no versions")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise argument_error(
            "resume", expected, "a broken file", f"{str(file)!r} is not a checkpoint. Train again."
        ) from error
    if version != FORMAT:
        raise argument_error("resume", f"one of format {FORMAT}", f"a checkpoint of format {version}", "Train again.")
    if len(packed) != size or hashlib.sha256(packed).hexdigest() != digest:
        hint = f"{str(file)!r} was truncated or changed. Copy it again, or train again."
        raise argument_error("resume", f"{expected}, {size} bytes", f"a broken file of {len(packed)}", hint)
    for package, here in _versions().items():
        if versions.get(package) != here:
            hint = f"Install {package}=={versions.get(package)}, or train again."
            raise argument_error("resume", f"a checkpoint made with {package} {here}", versions.get(package), hint)
    try:
        content = decode(packed)
        if not isinstance(content, dict) or not {"config", "seed"} <= set(content):
            raise ValueError("it has no configuration and seed")
    except (ValueError, TypeError, RecursionError) as error:
        hint = f"{str(file)!r} was made by another program. Train again. Error: {error}."
        raise argument_error("resume", expected, "a broken file", hint) from error
    return content


def _versions() -> dict[str, str]:
    installed = installed_versions()
    return {name: installed[name] for name in DECISIVE if name in installed}


def save_run(
    folder: Path, config: TrainConfig, content: Mapping[str, Any], weights: Mapping[str, Any], steps: int
) -> None:
    """Write the checkpoint and the current model, for `agents.trained`, into the folder of a training."""
    mine = {"seed": config.seed, "config": config.to_mapping()}
    write_checkpoint(folder / CHECKPOINT_FILE, mine | dict(content))
    about = {
        "version": installed_versions()["vslam-env"], "environment": config.make_env_config(SPLIT_TRY).to_toml(),
        "steps": steps,
    }  # fmt: skip
    save_model(folder / MODEL_FILE, dict(weights), about | mine)


@contextmanager
def restoring() -> Iterator[None]:
    """Refuse a checkpoint whose parts do not fit a training.

    Raises:
        ValueError: If anything is raised within the block.
    """
    try:
        yield
    except Exception as error:  # torch raises various errors for parts of another model
        hint = "Another version or another run wrote it: copy the checkpoint again, or train again."
        raise argument_error("resume", "a checkpoint of this model", "a different one", hint) from error


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
