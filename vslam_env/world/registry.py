"""A name, a path, a `World` or a function becomes a `World`."""

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
        world: A family name (see `WORLD_FAMILIES`); a path of a floor plan (.png, .jpg, .pgm), of a ROS map (.yaml), of
            a .json file of walls, or of a folder of such files, of which one is drawn; a `World`; or a function of
            `rng` that returns one.
        rng: Source of all draws.
        split: Of a folder, only files of this split are drawn; see `splits`. Else of no effect.

    Raises:
        ValueError: If there is no such family or file, or the function returns something else.
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
    """Refuse what `make_world` could not make a world from, without making one.

    Raises:
        ValueError: If there is no such family or file, or a folder holds none, or it is nothing of the kind.
    """
    if isinstance(world, (str, Path)):
        if not (isinstance(world, str) and world in WORLD_FAMILIES):
            _files(world)
    elif isinstance(world, World):
        return
    elif callable(world):
        _check_maker(world)
    else:
        cure = f"Names: {', '.join(WORLD_FAMILIES)}."
        raise argument_error("world", "a name, a path, a World or a function", world, cure)


def _check_maker(maker: Callable[..., Any]) -> None:
    """Refuse a function that cannot be called with a random generator alone."""
    if is_built_in(maker):
        raise argument_error("world", "a function of rng that returns a World", maker, "Write one in Python.")
    try:
        taken = signature(maker)
    except (TypeError, ValueError):  # some built-in functions do not tell
        return
    try:
        taken.bind(None)
    except TypeError as error:
        cure = f"Define it as def make(rng); the call says: {error}."
        raise argument_error("world", "a function of one argument, a random generator", maker, cure) from error


def is_single_layout(world: WorldSource) -> bool:
    """Tell whether all worlds of a source have the same walls, so that there is nothing to split."""
    named = isinstance(world, (str, Path)) and not (isinstance(world, str) and world in WORLD_FAMILIES)
    return isinstance(world, World) or (named and not Path(world).is_dir())  # type: ignore[arg-type]


def _load(world: str | Path, rng: np.random.Generator, split: str | None) -> World:
    """Load the world at a path, or one of a folder's."""
    files = _files(world)
    if Path(world).is_dir() and split is not None:
        files = files_of_split(files, split)
    path = files[int(rng.integers(len(files)))] if Path(world).is_dir() else files[0]
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read(path: Path, changed: int) -> World:
    """Read a file once for as long as it does not change; what is wrong with it names it, among many of a folder."""
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
    """Return the file at a path, or those of a folder, at least one; an image of a YAML file counts with it."""
    path = Path(world)
    try:
        is_folder = path.is_dir()
    except OSError as error:  # e.g. a name too long for the system
        raise argument_error("world", "a file", Path(path), f"Check the path: {error.strerror}.") from error
    if is_folder and world != "":  # the path of no characters would be the current folder
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in FILE_SUFFIXES)
        maps = {file.stem for file in files if file.suffix.lower() in MAP_SUFFIXES}
        files = [file for file in files if file.stem not in maps or file.suffix.lower() not in IMAGE_SUFFIXES]
        if not files:
            cure = "Put .png, .jpg, .pgm, .yaml or .json files there."
            raise argument_error("world", "a folder with floor plans", Path(path), cure)
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
