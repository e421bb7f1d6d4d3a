"""Construction of worlds from names, paths and functions."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.text_files import existing_file
from slam_backend.core.validation import argument_error, check_choice, choice_error, did_you_mean, is_built_in
from vslam_env.world.generators.campus import campus
from vslam_env.world.generators.fig5 import fig5
from vslam_env.world.generators.hall import hall
from vslam_env.world.generators.loops import loops
from vslam_env.world.generators.maze import maze
from vslam_env.world.generators.office import office
from vslam_env.world.generators.rooms import rooms
from vslam_env.world.loaders.floorplan import OUTSIDE, load_floorplan, load_walls_json
from vslam_env.world.loaders.ros_map import image_of_ros_map, load_ros_map
from vslam_env.world.loaders.splits import files_of_split
from vslam_env.world.spec import World

WorldMaker = Callable[[np.random.Generator], World]
WorldSource = str | Path | World | WorldMaker

WORLD_FAMILIES: dict[str, Callable[..., World]] = {
    "office": office,
    "maze": maze,
    "loops": loops,
    "hall": hall,
    "fig5": fig5,
    "rooms": rooms,
    "campus": campus,
}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm")
MAP_SUFFIXES = (".yaml", ".yml")
PLAN_OPTIONS = ("metres_per_pixel", "tolerance_px", "outside")  # parameters of loaders that a path may set
NAME_AND_OPTIONS = re.compile(r"(.*?)((?::[a-z_]+=[^:=]*)*)", re.DOTALL)
LOADERS: dict[str, Callable[..., World]] = {
    **dict.fromkeys(IMAGE_SUFFIXES, load_floorplan),
    **dict.fromkeys(MAP_SUFFIXES, load_ros_map),
    ".json": load_walls_json,
}
Options = dict[str, float | str]
Stamp = tuple[str, int, int, int]


def make_world(world: WorldSource, rng: np.random.Generator, split: str | None = None) -> World:
    """Make a world.

    Args:
        world: Family name (see `WORLD_FAMILIES`); path of a floor plan (.png, .jpg, .pgm), of a ROS map (.yaml), of a
            .json file of walls, or of a folder of such files to draw from; `World`; or a function of `rng` that returns
            a `World`. Options follow the name of a family or the path of plans: `"rooms:extent=120:room=10"`,
            `"plan.png:metres_per_pixel=0.1"`, `"map.yaml:outside=keep"`.
        rng: Source of all draws.
        split: Split of the files in a folder, see `splits`; ignored for other sources.

    Raises:
        ValueError: If the family or file does not exist, an option is unknown or out of range, or the function does not
            return a `World`.
    """
    check_source(world)
    if isinstance(world, World):
        return world
    if isinstance(world, (str, Path)):
        name, options = _parted(str(world))
        return WORLD_FAMILIES[name](rng, **options) if name in WORLD_FAMILIES else _load(name, options, rng, split)
    made = world(rng)
    if not isinstance(made, World):
        raise argument_error("world", "a function that returns a World", made, "Return World(name, walls).")
    return made


def check_source(world: object) -> None:
    """Validate a source of worlds without making a world.

    Raises:
        ValueError: If the family or file does not exist, an option is unknown or not a number, a folder has no suitable
            file, or the type is wrong.
    """
    if isinstance(world, (str, Path)):
        name, options = _parted(str(world))
        if name not in WORLD_FAMILIES:
            loaders = {LOADERS[file.suffix.lower()] for file in _files(name)}
            for option in options:
                if not any(option in _options_of(loader) for loader in loaders):
                    hint = "ROS maps and files of walls contain their scale."
                    raise argument_error("world", f"no option {option!r} for files of this kind", str(world), hint)
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
    if not isinstance(world, (str, Path)):
        return isinstance(world, World)
    name, _ = _parted(str(world))
    return name not in WORLD_FAMILIES and not Path(name).is_dir()


def portable_source(world: str) -> str:
    """Return a family as it is, and a path, with its options, made absolute so that it holds in any folder."""
    return world if _parted(world)[0] in WORLD_FAMILIES else str(Path(world).resolve())


def _parted(world: str) -> tuple[str, Options]:
    """Part a family or path from its options, such as `:extent=120:room=10`.

    Raises:
        ValueError: If an option is unknown, repeated or not a number.
    """
    match = NAME_AND_OPTIONS.fullmatch(world)
    name, text = match.groups() if match else (world, "")
    if text and name not in WORLD_FAMILIES:
        _files(name)  # the name is wrong before its options are
    known = PLAN_OPTIONS if name not in WORLD_FAMILIES else tuple(signature(WORLD_FAMILIES[name]).parameters)[1:]
    options: Options = {}
    for option in text.split(":")[1:]:
        key, value = option.split("=")
        if key not in known or key in options:
            hint = f"Options: {', '.join(known)}, each once." if known else "This family has no options."
            near = "" if key in known else did_you_mean(key, known)
            raise argument_error("world", f"options that {name!r} has", world, near + hint)
        if key == "outside":
            options[key] = check_choice("world: outside", value, OUTSIDE)
            continue
        try:
            options[key] = float(value)
        except ValueError as error:
            raise argument_error("world", f"a number for {key!r}", world, f"Write {name}:{key}=...") from error
    return name, options


def _load(world: str, options: Options, rng: np.random.Generator, split: str | None) -> World:
    """Load the world at a path, or a random one of a folder."""
    files = _files(world)
    if Path(world).is_dir() and split is not None:
        files = files_of_split(files, split)
    path = files[int(rng.integers(len(files)))] if Path(world).is_dir() else files[0]
    with _file_named(path):
        used = (path, image_of_ros_map(path)) if path.suffix.lower() in MAP_SUFFIXES else (path,)
    return _read(path, tuple(_stamp(file) for file in used), tuple(options.items()))


def _stamp(file: Path) -> Stamp:
    """Return what changes when a file is edited or replaced."""
    status = file.stat()
    return str(file), status.st_mtime_ns, status.st_size, status.st_ino


@lru_cache(maxsize=64)
def _read(path: Path, stamps: tuple[Stamp, ...], options: tuple[tuple[str, float | str], ...]) -> World:
    """Load a file, cached by its options and by the stamps of all files that it is read from."""
    loader = LOADERS[path.suffix.lower()]
    known = _options_of(loader)
    with _file_named(path):
        return loader(path, **{name: value for name, value in options if name in known})


@contextmanager
def _file_named(path: Path) -> Iterator[None]:
    """Add the path to errors that do not name it."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{error} The file is {path}.") from error


def _options_of(loader: Callable[..., World]) -> tuple[str, ...]:
    """Return the options that a path may set of a loader of files."""
    return tuple(name for name in PLAN_OPTIONS if name in signature(loader).parameters)


def _files(world: str) -> list[Path]:
    """Return the file at a path, or the files of a folder, at least one; images with a YAML file are omitted."""
    path = Path(world)
    try:
        is_folder = path.is_dir()
    except OSError as error:  # e.g. a name too long for the system
        raise argument_error("world", "a file", Path(path), f"Check the path: {error.strerror}.") from error
    if is_folder and world != "":  # Path("") is the current folder
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in LOADERS)
        maps = {file.stem for file in files if file.suffix.lower() in MAP_SUFFIXES}
        files = [file for file in files if file.stem not in maps or file.suffix.lower() not in IMAGE_SUFFIXES]
        if not files:
            hint = "Add .png, .jpg, .pgm, .yaml or .json files."
            raise argument_error("world", "a folder with floor plans", Path(path), hint)
        return files
    if path.suffix.lower() not in LOADERS:
        hint = "Check the spelling, or that the file ends in .png, .jpg, .pgm, .yaml or .json."
        if world.split(":")[0] in WORLD_FAMILIES:
            hint = "Write options as in rooms:extent=60:room=10."
        others = ", or a path of an image, a .yaml or .json file or a folder"
        raise choice_error("world", world, WORLD_FAMILIES, hint, others)
    return [existing_file(path, "world")]
