"""`RunFolder`: results of one run on disk, with everything needed to repeat the run."""

import json
import math
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomli_w

from slam_backend.core.files import write_file
from slam_backend.core.text_files import read_toml
from slam_backend.core.validation import argument_error, check_int
from slam_backend.trajectory import Trajectory

PACKAGES = (
    "vslam-env", "numpy", "scipy", "numba", "opencv-python-headless", "pymunk", "gymnasium", "pettingzoo",
    "stable-baselines3", "sb3-contrib", "torch",
)  # fmt: skip
CONFIG_FILE = "config.toml"
FORMAT = 1  # version of run folders: configuration and stored trials
METRICS_FILE = "metrics.json"


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Folder that belongs to exactly one run."""

    path: Path  # The folder; it exists
    command: str  # Command that created it, e.g. `"replay mrclam"`
    config: dict[str, Any]  # Arguments that repeat the run, as plain values
    seed: int  # Seed of all random draws
    versions: dict[str, str]  # Versions of Python and of the packages that affect results

    @classmethod
    def create(cls, out: Path | None, command: str, config: Mapping[str, Any], seed: int) -> Self:
        """Create the folder and write `config.toml`; no file is overwritten.

        Args:
            out: The folder; an existing folder must be empty. None: the next free `runs/<command>-<seed>-<n>`.
            config: Arguments of the command; nested mappings become tables, None means that a value was not given.

        Raises:
            ValueError: If `out` is a file, contains files, or cannot be written.
        """
        seed = check_int("seed", seed, 0, "Use 0 or a positive number.")
        folder = _next_free(Path("runs"), f"{command.replace(' ', '-')}-{seed}") if out is None else _claim(Path(out))
        run = cls(folder, command, _drop_none(plain(config)), seed, installed_versions())
        content = {"format": FORMAT, "command": command, "seed": seed, "config": run.config, "versions": run.versions}
        run.write_text(CONFIG_FILE, tomli_w.dumps(content))
        return run

    def write_metrics(self, metrics: Mapping[str, Any]) -> dict[str, Any]:
        """Write `metrics.json` with the config, seed and versions of the run added; return its content."""
        about = {"config": self.config, "seed": self.seed, "versions": self.versions}
        content: dict[str, Any] = plain({**metrics, **about})
        self.write_text(METRICS_FILE, to_json(content))
        return content

    def write_trajectory(self, name: str, trajectory: Trajectory) -> Path:
        """Write a trajectory as `<name>.tum`."""
        return self.write_text(f"{name}.tum", trajectory.to_tum())

    def write_text(self, name: str, text: str) -> Path:
        """Write a text file atomically."""
        return write_file(self.path / name, text, "out")


def read_config(path: Path, command: str, option: str = "config") -> tuple[dict[str, Any], int]:
    """Read the config and seed of an earlier run; a file without a `format` has the current format.

    Raises:
        ValueError: If the file is missing or damaged, has another format, or was written by another command.
    """
    file = path / CONFIG_FILE if path.is_dir() else path
    expected = f"the {CONFIG_FILE} of an earlier run"
    if not file.is_file():
        raise argument_error(option, expected, "no such file", f"Check {str(file)!r}.")
    content = read_toml(file, option)
    if (file_format := content.get("format", FORMAT)) != FORMAT or type(file_format) is not int:
        hint = f"Use the release that wrote {str(file)!r}."
        raise argument_error(option, f"one of format {FORMAT}", f"a run folder of format {file_format!r}", hint)
    if content.get("command") != command:
        raise argument_error(option, f"a run of {command!r}", content.get("command"), "Use the command that wrote it.")
    config, seed = content.get("config"), content.get("seed")
    if not isinstance(config, dict) or not isinstance(seed, int):
        raise argument_error(option, "a table [config] and an int seed", "none", f"Add them to {str(file)!r}.")
    return config, seed


def read_versions(path: Path) -> dict[str, str]:
    """Read the versions of Python and packages of an earlier run, whose configuration `read_config` accepts."""
    file = path / CONFIG_FILE if path.is_dir() else path
    return dict(read_toml(file, "config").get("versions", {}))


def plain(value: Any) -> Any:
    """Convert numpy values, tuples and paths for JSON and TOML; numbers that are not finite become None.

    >>> plain({"rmse": np.float64("nan"), "robots": (np.int64(1), 2)})
    {'rmse': None, 'robots': [1, 2]}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def to_json(content: Any) -> str:
    """Return plain values as indented JSON; a number that is not finite is an error."""
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages of `PACKAGES`."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _drop_none(value: Any) -> Any:
    """Drop keys whose value is None, which TOML cannot represent."""
    if isinstance(value, dict):
        return {key: _drop_none(item) for key, item in value.items() if item is not None}
    return value


def check_free(folder: Path) -> None:
    """Refuse a folder that no run can use, before work that takes a while. The folder is not created.

    Raises:
        ValueError: If it is a file, contains files, or cannot be created or written.
    """
    hint = f"Choose another than {str(folder)!r}, or omit --out."
    try:
        if folder.is_file():
            raise argument_error("out", "a new or empty folder", "a file", hint)
        full = folder.is_dir() and any(folder.iterdir())
        if not full:
            there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
            tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise _no_folder(folder, error, "omit --out") from error
    if full:
        raise argument_error("out", "a new or empty folder", "a folder with files", hint)


def _claim(folder: Path) -> Path:
    """Create `folder`, or accept it if it is empty."""
    check_free(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _no_folder(folder, error, "omit --out") from error
    return folder


def _next_free(parent: Path, stem: str) -> Path:
    """Create the folder `<stem>-<n>` with the smallest free n."""
    for n in range(1, 1_000_000):
        folder = parent / f"{stem}-{n}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise _no_folder(parent, error, "name one with --out") from error
        return folder
    raise argument_error("out", "a free number", f"a million folders {stem!r}", "Delete old runs.")


def _no_folder(folder: Path, error: OSError, hint: str) -> ValueError:
    """Return the error for a folder that cannot be created or written."""
    text = f"The system says: {error.strerror}. Choose another folder, or {hint}."
    return argument_error("out", "a folder that can be written", Path(folder), text)
