"""Checkpoints of a training: single files, written atomically and tagged with package versions."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam_backend.core.files import MAX_BYTES, read_file, write_file
from slam_backend.core.validation import argument_error
from slam_backend.state.codec import decode, encode
from training.experiments.run_folder import installed_versions

FORMAT = 5  # incremented when the content of checkpoints changes
MAGIC = b"vslam train checkpoint "
CHECKPOINT_FILE = "checkpoint.bin"
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
