"""Metrics of the code base: sizes, folders, files on the path of a measurement, private accesses, import cycles.

make metrics
"""

import ast
import dis
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import numpy as np
from numba.core.dispatcher import Dispatcher

from slam_backend import FastSlam, Measurements
from vslam_env import vslam_v1

ROOT = Path(__file__).parents[1]
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")
NAMED_TUPLE = ("_replace", "_asdict", "_fields", "_make")
PRIVATE = re.compile(r"_[a-z]\w*")
MANY = 10  # limit for the number of kernel parameters


def sources(*folders: str) -> list[Path]:
    """Return the Python files below folders."""
    return sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))


def lines_of(files: list[Path]) -> int:
    """Return the number of lines in files."""
    return sum(file.read_text(encoding="utf-8").count("\n") for file in files)


def module_name(file: Path) -> str:
    """Return the dotted name of a module."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


# ---------------------------------------------------------------------- static analysis


def private_names(tree: ast.AST) -> set[str]:
    """Return the private attributes defined by a class, or by all classes of a module."""
    found = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            found.add(node.attr)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.add(node.target.id)
    return {name for name in found if PRIVATE.fullmatch(name)}


def private_accesses(file: Path, ours: set[str]) -> Iterator[tuple[int, str]]:
    """Yield line and text of each access to a private attribute of another class of the project.

    Args:
        file: Python file.
        ours: Private attributes of all classes of the project; all others belong to libraries.
    """
    tree = ast.parse(file.read_text(encoding="utf-8"))
    own: dict[ast.AST, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            own |= dict.fromkeys(ast.walk(node), private_names(node))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute) or node.attr not in ours or node.attr in NAMED_TUPLE:
            continue
        if ast.unparse(node.value) not in ("self", "cls") and node.attr not in own.get(node, ()):
            yield node.lineno, ast.unparse(node)


def imports(file: Path, known: set[str]) -> set[str]:
    """Return the project's modules that a module imports at load time."""
    found: set[str] = set()

    def visit(nodes: list[ast.stmt]) -> None:
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    found.add(inner if inner in known else node.module)
            elif isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
                visit(node.body + node.orelse)

    visit(ast.parse(file.read_text(encoding="utf-8")).body)
    return found & known


def import_circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other, directly or indirectly."""
    reach: dict[str, set[str]] = {}
    for start in graph:
        seen: set[str] = set()
        todo = [start]
        while todo:
            for module in graph[todo.pop()] - seen:
                seen.add(module)
                todo.append(module)
        reach[start] = seen
    circles = {frozenset(m for m in graph if m in reach[module] and module in reach[m]) for module in graph}
    return [sorted(circle) for circle in circles if circle]


# ---------------------------------------------------------------------- call traces


def files_run(call: Callable[[], Any]) -> set[str]:
    """Return the project's files that a call executes, including those of kernels and their callees."""
    codes: dict[CodeType, dict[str, Any]] = {}

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            codes[frame.f_code] = frame.f_globals

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    own = {code: names for code, names in codes.items() if is_plugin(code.co_filename)}
    kernels: set[Dispatcher] = set()
    todo = [kernel for code, names in own.items() for kernel in kernels_named(code, names)]
    while todo:
        kernel = todo.pop()
        if kernel not in kernels:
            kernels.add(kernel)
            todo += kernels_named(kernel.py_func.__code__, kernel.py_func.__globals__)
    files = {code.co_filename for code in own} | {kernel.py_func.__code__.co_filename for kernel in kernels}
    return {file for file in files if is_plugin(file)}


def kernels_named(code: CodeType, names: dict[str, Any]) -> Iterator[Dispatcher]:
    """Yield the kernels that a function refers to, directly or as attributes of modules."""
    previous: Any = None
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            previous = names.get(instruction.argval)
        elif instruction.opname in ("LOAD_ATTR", "LOAD_METHOD") and previous is not None:
            previous = getattr(previous, str(instruction.argval), None)
        else:
            previous = None
        if isinstance(previous, Dispatcher):
            yield previous


def is_plugin(file: str) -> bool:
    """Return whether a file belongs to one of the packages."""
    return any(file.startswith(str(ROOT / package) + os.sep) for package in PACKAGES)


def step_of_filter() -> set[str]:
    """Return the files executed between a measurement and its `StepReport`."""
    points = np.array([[-0.5, 0.0, 3.0], [0.2, 0.1, 4.0], [0.8, -0.1, 3.5]])
    frame = Measurements(points, np.eye(3, 64, dtype=np.float32))
    slam = FastSlam(num_particles=100, rejuvenate_every=None, seed=0)
    slam.step([None], [frame])
    return files_run(lambda: slam.step([(0.1, 0.0, 0.0)], [Measurements(points, frame.descriptors)]))


def step_of_environment() -> set[str]:
    """Return the files executed by a step of the default environment without a merge."""
    env = vslam_v1.parallel_env()
    env.reset(seed=0)
    actions = {agent: np.array([0.5, 0.1], np.float32) for agent in env.agents}
    env.step(actions)
    return files_run(lambda: env.step(actions))


def all_kernels() -> set[Dispatcher]:
    """Return the kernels of all loaded modules."""
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] in PACKAGES]
    return {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}


def main() -> None:
    """Print the metrics."""
    files = [file for file in sources(*PACKAGES) if file.name != "__init__.py"]
    graph = {module_name(file): set[str]() for file in sources(*PACKAGES)}
    for file in sources(*PACKAGES):
        graph[module_name(file)] = imports(file, set(graph)) - {module_name(file)}
    folders = Counter(file.parent for file in files)
    widest, count = folders.most_common(1)[0]
    ours = set().union(*(private_names(ast.parse(file.read_text(encoding="utf-8"))) for file in files))
    private = [(file, *access) for file in files for access in private_accesses(file, ours)]
    circles = import_circles(graph)
    env_files, filter_files = step_of_environment(), step_of_filter()
    kernels = {kernel for kernel in all_kernels() if is_plugin(kernel.py_func.__code__.co_filename)}
    long = sum(kernel.py_func.__code__.co_argcount >= MANY for kernel in kernels)
    rows = {
        "source lines of the four packages": lines_of(sources(*PACKAGES)),
        "source files without __init__.py": len(files),
        "test lines": lines_of(sources("tests")),
        f"modules in the widest folder ({widest.relative_to(ROOT)})": count,
        "files from a measurement to its StepReport": len(filter_files),
        "files of a whole env.step without a merge": len(env_files),
        "accesses to private attributes of objects of other classes": len(private),
        "import cycles between modules": len(circles),
        "loaded kernels": len(kernels),
        f"kernels with {MANY} or more parameters": long,
    }
    for name, number in rows.items():
        print(f"{name:62s} {number:7,d}")
    if "--list" in sys.argv[1:]:
        for file, line, text in private:
            print(f"private: {file.relative_to(ROOT)}:{line}: {text}")
        for circle in circles:
            print("circle:", " ".join(circle))


if __name__ == "__main__":
    main()
