"""The public names of the project and their signatures, one a line.

    python tests/regression/public_api.py --record    # after a change that the changelog lists, old -> new

Public are the names that the packages list in `__all__`, the modules that the documentation imports from, and the
commands with their options. Defaults are written without their modules, so that moving a class changes nothing here.
"""

import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import typer

FILE = Path(__file__).with_name("public_api.txt")
PACKAGES = (
    "slam_backend", "slam_backend.distributed", "slam_backend.frontend", "slam_backend.metrics",
    "vslam_env", "vslam_env.navigation", "vslam_env.sensors", "vslam_env.world", "vslam_env.rendering",
    "agents",
)  # fmt: skip
MODULES = (
    "slam_backend.geometry", "slam_backend.trajectory", "slam_backend.pose_graph", "slam_backend.fastslam.existence",
    "slam_backend.readers.calibration", "slam_backend.readers.kitti", "slam_backend.readers.mrclam",
    "slam_backend.readers.pose_graphs", "slam_backend.readers.victoria",
    "vslam_env.vslam_v0", "vslam_env.vslam_v1", "vslam_env.reward", "vslam_env.solo", "vslam_env.wrappers",
    "training.replay.log", "training.vec_env",
)  # fmt: skip
OWN = re.compile(r"\b(?:slam_backend|vslam_env|agents|training)(?:\.\w+)*\.(\w+)")
ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def public_api() -> list[str]:
    """Return one line for each public name."""
    lines = []
    for package in PACKAGES:
        module = importlib.import_module(package)
        lines += [line for name in sorted(module.__all__) for line in described(f"{package}.{name}", module, name)]
    for path in MODULES:
        module = importlib.import_module(path)
        for name, value in sorted(vars(module).items()):
            if not name.startswith("_") and getattr(value, "__module__", None) == path:
                lines += described(f"{path}.{name}", module, name)
    return lines + sorted(commands())


def described(path: str, module: Any, name: str) -> Iterator[str]:
    """Yield a name with its signature and, of a class, its public members."""
    value = getattr(module, name)
    if inspect.isclass(value):
        yield path + signature(value)
        if is_dataclass(value) or hasattr(value, "_fields"):
            names = value._fields if hasattr(value, "_fields") else [field.name for field in fields(value)]
            yield f"{path}: {', '.join(names)}"
        for member, content in sorted(members(value)):
            yield f"{path}.{member}" + signature(content)
    elif callable(value):
        yield path + signature(value)
    else:
        yield f"{path}: {type(value).__name__}"


def members(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties that the project itself gives a class."""
    own = (base for base in kind.__mro__ if base.__module__.split(".")[0] in ("slam_backend", "vslam_env", "agents"))
    names = {name for base in own for name in vars(base) if not name.startswith("_")}
    for name in names:
        value = inspect.getattr_static(kind, name)
        if callable(value) or isinstance(value, (property, classmethod, staticmethod)):
            yield name, getattr(kind, name)


def signature(value: Any) -> str:
    """Return names, kinds and defaults of arguments; nothing for a property. mypy checks the types."""
    if isinstance(value, property):
        return ""
    try:
        found = inspect.signature(value)
    except (TypeError, ValueError):
        return ""
    empty = inspect.Parameter.empty
    parameters = [parameter.replace(annotation=empty) for parameter in found.parameters.values()]
    bare = found.replace(parameters=parameters, return_annotation=inspect.Signature.empty)
    return ADDRESS.sub("", OWN.sub(r"\1", str(bare)))


def commands() -> Iterator[str]:
    """Yield each command of the command line with its options."""
    from training.cli import app

    def walk(command: Any, path: str) -> Iterator[str]:
        if hasattr(command, "commands"):
            for name, inner in command.commands.items():
                yield from walk(inner, f"{path} {name}")
        else:
            options = sorted("/".join([*p.opts, *p.secondary_opts]) for p in command.params if p.name != "help")
            yield f"{path}: {' '.join(options)}"

    yield from walk(typer.main.get_command(app), "vslam")


def main() -> None:
    """Print the lines, or record them."""
    text = "\n".join(dict.fromkeys(public_api())) + "\n"
    if "--record" in sys.argv[1:]:
        FILE.write_text(text, encoding="utf-8")
    else:
        print(text, end="")


if __name__ == "__main__":
    main()
