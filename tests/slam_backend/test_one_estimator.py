"""The estimator is one and the same at every size of map and length of run: no constant switches its behaviour."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

import slam_backend

ROOT = Path(slam_backend.__file__).parent
MODULES = sorted(path for part in ("fastslam", "smoother", "team", "maps") for path in (ROOT / part).rglob("*.py"))

# What tells the size of a map, a graph or a run; `latest` are the robots' last steps
SIZES = {"landmark_ids", "num_landmarks", "map_size", "latest", "num_steps", "num_keys", "num_poses", "num_sightings"}
NAMED = re.compile(r"(^|_)(LARGE|SMALL|HUGE|MANY|WHOLE|(LONG|SHORT)_(RUN|LOG|MAP)S?)(_|$)")
SAID = re.compile(
    r"\b(large|small|huge|long|short) (joint )?(maps?|graphs?|runs?|logs?)\b"
    r"|\b(landmarks|steps|keys|keyframes)\b.* (above|beyond) which\b|\b(above|beyond) so many (landmarks|steps|key)"
)


GEOMETRY = 4  # so many points or fewer fix a motion: a constant up to this is no size of a map


def constants(tree: ast.Module) -> dict[str, int]:
    """Return the constants that a module defines or imports, and their lines."""
    found = {}
    for node in tree.body:
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            if isinstance(node.value, ast.Constant) and node.value.value in range(GEOMETRY + 1):
                continue
            targets = [part for target in node.targets for part in getattr(target, "elts", [target])]
        elif isinstance(node, ast.AnnAssign):
            targets = [node.target]
        found |= {target.id: node.lineno for target in targets if isinstance(target, ast.Name)}
        if isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: node.lineno for alias in node.names}
    return {name: line for name, line in found.items() if name.isupper()}


def names_in(node: ast.AST) -> set[str]:
    """Return the names of variables and attributes in an expression, but for arguments given by keyword."""
    if isinstance(node, ast.keyword):
        return set()
    own = {getattr(node, "id", None), getattr(node, "attr", None)} - {None}
    return own.union(*(names_in(part) for part in ast.iter_child_nodes(node)))


def thresholds(source: str) -> Iterator[str]:
    """Yield the places where a module compares or diminishes a size by a constant, or has a constant for sizes."""
    tree = ast.parse(source)
    known, lines = constants(tree), source.splitlines()
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
            sides = [node.left, node.right]
        else:
            continue
        by_constant = [side for side in sides if names_in(side) & known.keys()]
        if by_constant and any(names_in(side) & SIZES for side in sides):
            yield f"{node.lineno}: {ast.unparse(node)}"
    comments = {
        token.start[0]: token.string
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    for name, line in known.items():
        above = line - 1
        while above in comments and lines[above - 1].startswith("#"):
            above -= 1
        said = " ".join(comments[row] for row in range(above + 1, line + 1) if row in comments)
        if NAMED.search(name) or SAID.search(said):
            yield f"{line}: {name} {said}".rstrip()


SWITCHES = {
    "len(graph.landmark_ids) > LIMIT": "LIMIT = 2000\n\ndef f(graph):\n    return len(graph.landmark_ids) > LIMIT\n",
    "LIMIT < latest.max()": "from x import LIMIT\n\ndef f(latest):\n    return LIMIT < latest.max()\n",
    "num_landmarks - LIMIT": "LIMIT, MORE = 1, 2\n\ndef f(num_landmarks):\n    return max(num_landmarks - LIMIT, 0)\n",
    "not graph.num_keys <= 2 * LIMIT": "LIMIT = 9\n\ndef f(graph):\n    return not graph.num_keys <= 2 * LIMIT\n",
    "MANY_STEPS": "MANY_STEPS = 6000\n",
    "LIMIT": "# In large maps landmarks\n# of few poses go first\nLIMIT = 10\n",
    "PART": "PART = 512  # landmarks beyond which they are written in parts\n",
}


@pytest.mark.parametrize("switch", SWITCHES)
def test_switches_by_size_are_found(switch: str) -> None:
    """Each form of a constant that ties behaviour to a size is found, and nothing else in its module."""
    (found,) = thresholds(SWITCHES[switch])
    assert switch.removeprefix("not ") in found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_constant_switches_the_estimator_by_size(path: Path) -> None:
    """Limits that depend on the size of a map or a run are options, and hold from the first step on."""
    assert list(thresholds(path.read_text(encoding="utf-8"))) == []


def test_all_parts_of_the_estimator_are_searched() -> None:
    """Kernels are, too."""
    parts = {path.relative_to(ROOT).parts[:2] for path in MODULES}
    assert {("fastslam", "_kernels"), ("smoother", "_kernels"), ("maps", "ransac.py")} <= parts
    assert len(MODULES) > 60
