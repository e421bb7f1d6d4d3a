"""Checkpoints of a training: one file that is whole or not there, marked with what made it."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam_backend.core.files import write_file
from slam_backend.core.state_codec import MAX_BYTES, decode, encode, read_file
from slam_backend.core.validation import argument_error
from training.experiments.run_folder import installed_versions
from vslam_env.state_kinds import ENV_KINDS

FORMAT = 2  # raised when what a checkpoint holds changes
MAGIC = b"vslam train checkpoint "
CHECKPOINT_FILE = "checkpoint.bin"
DECISIVE = ("vslam-env", "torch", "stable-baselines3", "sb3-contrib", "numpy")  # a training goes on exactly with these


def write_checkpoint(file: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint; an interrupted write leaves the one before.

    The file holds data alone: to read it runs no code of the file's.

    Raises:
        ValueError: If it cannot be written.
    """
    packed = encode(dict(content), ENV_KINDS)
    mark = {
        "format": FORMAT, "versions": _versions(), "bytes": len(packed), "sha256": hashlib.sha256(packed).hexdigest(),
    }  # fmt: skip
    write_file(file, MAGIC + json.dumps(mark).encode() + b"\n" + packed, "out")


def read_checkpoint(file: Path) -> dict[str, Any]:
    """Read a checkpoint that `write_checkpoint` wrote.

    Raises:
        ValueError: If it is missing, cut off, changed, or of other versions with which it would not go on exactly.
    """
    expected = "the checkpoint of a training"
    if not file.is_file():
        cure = f"There is no {str(file)!r}: the run ended before its first checkpoint. Train anew."
        raise argument_error("resume", expected, "no such file", cure)
    try:
        head, _, packed = read_file(file).partition(b"\n")
    except OSError as error:
        cure = f"{str(file)!r} cannot be read: {error}."
        raise argument_error("resume", f"{expected} of at most {MAX_BYTES >> 20} MiB", "another file", cure) from error
    try:
        if not head.startswith(MAGIC):
            raise ValueError("another kind of file")
        mark = json.loads(head[len(MAGIC) :])
        size, digest, version, versions = (mark[name] for name in ("bytes", "sha256", "format", "versions"))
    except (ValueError, KeyError, TypeError) as error:
        raise argument_error("resume", expected, "a broken file", f"{str(file)!r} is none: train anew.") from error
    if version != FORMAT:
        raise argument_error("resume", f"one of format {FORMAT}", f"a checkpoint of format {version}", "Train again.")
    if len(packed) != size or hashlib.sha256(packed).hexdigest() != digest:
        cure = f"{str(file)!r} was cut off or changed: copy it again, or train anew."
        raise argument_error("resume", f"{expected}, {size} bytes", f"a broken file of {len(packed)}", cure)
    for package, here in _versions().items():
        if versions.get(package) != here:
            cure = f"Install {package}=={versions.get(package)}, or train anew."
            raise argument_error("resume", f"a checkpoint made with {package} {here}", versions.get(package), cure)
    try:
        content = decode(packed, ENV_KINDS)
        if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
            raise ValueError("it holds no parts by name")
    except ValueError as error:
        cure = f"{str(file)!r} was made by something else: train again. Reading says: {error}."
        raise argument_error("resume", expected, "a broken file", cure) from error
    return content


def _versions() -> dict[str, str]:
    installed = installed_versions()
    return {name: installed[name] for name in DECISIVE if name in installed}
