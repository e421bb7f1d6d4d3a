"""Construction of worlds from names, paths and functions."""

from collections.abc import Callable
from functools import lru_cache
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.validation import argument_error, is_built_in
from vslam_env.world.generators.fig5 import fig5
from vslam_env.world.generators.hall import hall
from vslam_env.world.generators.loops import loops
from vslam_env.world.generators.maze import maze
from vslam_env.world.generators.office import office
from vslam_env.world.loaders.floorplan import existing, load_floorplan, load_walls_json
from vslam_env.world.loaders.ros_map import load_ros_map
from vslam_env.world.loaders.splits import files_of_split
from vslam_env.world.spec import World

WorldMaker = Callable[[np.random.Generator], World]
WorldSource = str | Path | World | WorldMaker

WORLD_FAMILIES: dict[str, WorldMaker] = {"office": office, "maze": maze, "loops": loops, "hall": hall, "fig5": fig5}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm")
MAP_SUFFIXES = (".yaml", ".yml")
FILE_SUFFIXES = (*IMAGE_SUFFIXES, *MAP_SUFFIXES, ".json")


def make_world(world: WorldSource, rng: np.random.Generator, split: str | None = None) -> World:
    """Make a world.

    Args:
        world: Family name (see `WORLD_FAMILIES`); path of a floor plan (.png, .jpg, .pgm), of a ROS map (.yaml), of a
            .json file of walls, or of a folder of such files to draw from; `World`; or a function of `rng` that returns
            a `World`.
        rng: Source of all draws.
        split: Split of the files in a folder, see `splits`; ignored for other sources.

    Raises:
        ValueError: If the family or file does not exist, or the function does not return a `World`.
    """
    check_source(world)
    if isinstance(world, World):
        return world
    if isinstance(world, str) and world in WORLD_FAMILIES:
        return WORLD_FAMILIES[world](rng)
    if isinstance(world, (str, Path)):
        return _load(world, rng, split)
    made = world(rng)
    if not isinstance(made, World):
        raise argument_error("world", "a function that returns a World", made, "Return World(name, walls).")
    return made


def check_source(world: object) -> None:
    """Validate a source of worlds without making a world.

    Raises:
        ValueError: If the family or file does not exist, a folder has no suitable file, or the type is wrong.
    """
    if isinstance(world, (str, Path)):
        if not (isinstance(world, str) and world in WORLD_FAMILIES):
            _files(world)
    elif isinstance(world, World):
        return
    elif callable(world):
        _check_maker(world)
    else:
        hint = f"Names: {', '.join(WORLD_FAMILIES)}."
        raise argument_error("world", "a name, a path, a World or a function", world, hint)


def _check_maker(maker: Callable[..., Any]) -> None:
    """Raise unless a function can be called with a random generator alone."""
    if is_built_in(maker):
        raise argument_error("world", "a function of rng that returns a World", maker, "Write one in Python.")
    try:
        parameters = signature(maker)
    except (TypeError, ValueError):  # some built-in functions have no signature
        return
    try:
        parameters.bind(None)
    except TypeError as error:
        hint = f"Define it as def make(rng); Python says: {error}."
        raise argument_error("world", "a function of one argument, a random generator", maker, hint) from error


def is_single_layout(world: WorldSource) -> bool:
    """Return whether a source always has the same walls, so that it cannot be split."""
    is_path = isinstance(world, (str, Path)) and not (isinstance(world, str) and world in WORLD_FAMILIES)
    return isinstance(world, World) or (is_path and not Path(world).is_dir())  # type: ignore[arg-type]


def _load(world: str | Path, rng: np.random.Generator, split: str | None) -> World:
    """Load the world at a path, or a random one of a folder."""
    files = _files(world)
    if Path(world).is_dir() and split is not None:
        files = files_of_split(files, split)
    path = files[int(rng.integers(len(files)))] if Path(world).is_dir() else files[0]
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read(path: Path, changed: int) -> World:
    """Load a file, cached by path and time of change; errors name the file."""
    suffix = path.suffix.lower()
    try:
        if suffix in MAP_SUFFIXES:
            return load_ros_map(path)
        return load_walls_json(path) if suffix == ".json" else load_floorplan(path)
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{error} The file is {path}.") from error


def _files(world: str | Path) -> list[Path]:
    """Return the file at a path, or the files of a folder, at least one; images with a YAML file are omitted."""
    path = Path(world)
    try:
        is_folder = path.is_dir()
    except OSError as error:  # e.g. a name too long for the system
        raise argument_error("world", "a file", Path(path), f"Check the path: {error.strerror}.") from error
    if is_folder and world != "":  # Path("") is the current folder
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in FILE_SUFFIXES)
        maps = {file.stem for file in files if file.suffix.lower() in MAP_SUFFIXES}
        files = [file for file in files if file.stem not in maps or file.suffix.lower() not in IMAGE_SUFFIXES]
        if not files:
            hint = "Add .png, .jpg, .pgm, .yaml or .json files."
            raise argument_error("world", "a folder with floor plans", Path(path), hint)
        return files
    if path.suffix.lower() not in FILE_SUFFIXES:
        names = ", ".join(repr(name) for name in WORLD_FAMILIES)
        raise argument_error(
            "world",
            f"one of {names}, or a path of an image, a .yaml or .json file or a folder",
            str(world),
            "Check the spelling, or that the file ends in .png, .jpg, .pgm, .yaml or .json.",
        )
    return [existing(path)]
