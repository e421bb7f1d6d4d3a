"""`RunFolder`: one run's results on disk, with all that is needed to repeat it."""

import json
import math
import platform
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomli_w

from slam_backend.core.files import write_file
from slam_backend.core.validation import argument_error, check_int
from slam_backend.trajectory import Trajectory

PACKAGES = (
    "vslam-env", "numpy", "scipy", "numba", "opencv-python-headless", "pymunk", "gymnasium", "pettingzoo",
    "stable-baselines3", "sb3-contrib", "torch",
)  # fmt: skip
CONFIG_FILE = "config.toml"
FORMAT = 1  # of run folders: their configuration, and the trials that are kept beside it
METRICS_FILE = "metrics.json"


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A folder that belongs to one run alone."""

    path: Path  # The folder; it exists
    command: str  # The command that made it, e.g. `"replay mrclam"`.
    config: dict[str, Any]  # Arguments that repeat the run, as `plain` leaves them
    seed: int  # Of all random draws
    versions: dict[str, str]  # Of Python and the packages that decide the results

    @classmethod
    def create(cls, out: Path | None, command: str, config: Mapping[str, Any], seed: int) -> Self:
        """Make the folder and write `config.toml`; no file is ever overwritten.

        Args:
            out: The folder; it may exist if it is empty. None: the next free `runs/<command>-<seed>-<n>`.
            config: Arguments of the command; nested mappings become tables, None means "not given".

        Raises:
            ValueError: If `out` is a file, holds files, or cannot be written.
        """
        seed = check_int("seed", seed, 0, "Use 0 or a positive number.")
        folder = _next_free(Path("runs"), f"{command.replace(' ', '-')}-{seed}") if out is None else _claim(Path(out))
        run = cls(folder, command, _drop_none(plain(config)), seed, installed_versions())
        content = {"format": FORMAT, "command": command, "seed": seed, "config": run.config, "versions": run.versions}
        run.write_text(CONFIG_FILE, tomli_w.dumps(content))
        return run

    def write_metrics(self, metrics: Mapping[str, Any]) -> dict[str, Any]:
        """Write `metrics.json` with the run's config, seed and versions added; return what was written."""
        about = {"config": self.config, "seed": self.seed, "versions": self.versions}
        content: dict[str, Any] = plain({**metrics, **about})
        self.write_text(METRICS_FILE, to_json(content))
        return content

    def write_trajectory(self, name: str, trajectory: Trajectory) -> Path:
        """Write a path as `<name>.tum`."""
        return self.write_text(f"{name}.tum", trajectory.to_tum())

    def write_text(self, name: str, text: str) -> Path:
        """Write a text file so that a reader finds it whole or not at all."""
        return write_file(self.path / name, text, "out")


def read_config(path: Path, command: str, option: str = "config") -> tuple[dict[str, Any], int]:
    """Read the config and seed of an earlier run; a file without a `format` is of the present one.

    Raises:
        ValueError: If the file is missing or damaged, of another format, or another command wrote it.
    """
    file = path / CONFIG_FILE if path.is_dir() else path
    expected = f"the {CONFIG_FILE} of an earlier run"
    if not file.is_file():
        raise argument_error(option, expected, "no such file", f"Check {str(file)!r}.")
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise argument_error(option, expected, "a broken file", f"Correct {str(file)!r}: {error}.") from error
    if (found := content.get("format", FORMAT)) != FORMAT or type(found) is not int:
        cure = f"Use the release that wrote {str(file)!r}."
        raise argument_error(option, f"one of format {FORMAT}", f"a run folder of format {found!r}", cure)
    if content.get("command") != command:
        raise argument_error(option, f"a run of {command!r}", content.get("command"), "Use the command that wrote it.")
    config, seed = content.get("config"), content.get("seed")
    if not isinstance(config, dict) or not isinstance(seed, int):
        raise argument_error(option, "a table [config] and a whole number seed", "none", f"Add them to {str(file)!r}.")
    return config, seed


def plain(value: Any) -> Any:
    """Turn numpy values, tuples and paths into what JSON and TOML know; numbers that are not finite become None.

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
    """Return indented JSON text of a plain value, a number that is not finite being an error."""
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of `PACKAGES`, as far as these are installed."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _drop_none(value: Any) -> Any:
    """Leave out the keys that are None, which TOML cannot say."""
    if isinstance(value, dict):
        return {key: _drop_none(item) for key, item in value.items() if item is not None}
    return value


def check_free(folder: Path) -> None:
    """Refuse a folder that no run can have, before work that takes a while. It is not made.

    Raises:
        ValueError: If it is a file, holds files, or could not be made or written.
    """
    cure = f"Choose another than {str(folder)!r}, or leave --out away."
    try:
        if folder.is_file():
            raise argument_error("out", "a new or empty folder", "a file", cure)
        full = folder.is_dir() and any(folder.iterdir())
        if not full:
            there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
            tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise _no_folder(folder, error, "leave --out away") from error
    if full:
        raise argument_error("out", "a new or empty folder", "a folder with files", cure)


def _claim(folder: Path) -> Path:
    """Make `folder`, or take it if it is empty."""
    check_free(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _no_folder(folder, error, "leave --out away") from error
    return folder


def _next_free(parent: Path, stem: str) -> Path:
    """Make the folder `<stem>-<n>` with the smallest n that nobody has taken."""
    for n in range(1, 1_000_000):
        folder = parent / f"{stem}-{n}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise _no_folder(parent, error, "name one with --out") from error
        return folder
    raise argument_error("out", "a free number", f"a million folders {stem!r}", "Clean up runs.")


def _no_folder(folder: Path, error: OSError, cure: str) -> ValueError:
    """Return the error that says why a folder cannot be made or written."""
    text = f"The system says: {error.strerror}. Choose another folder, or {cure}."
    return argument_error("out", "a folder that can be written", Path(folder), text)
