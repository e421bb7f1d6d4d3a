"""Linter for prose: phrases to avoid, and descriptions of arguments, fields and options that do not stand alone.

python -m studies.prose                    # `CHECKED`, as in `make lint`
python -m studies.prose FILE_OR_FOLDER ...
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
CHECKED = (
    *("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "docs", ".github"),
    *("slam_backend", "vslam_env", "agents", "training", "studies", "examples", "tests"),
)
EXEMPT = ("docs/lab/", "studies/prose.py", "tests/studies/test_prose.py")  # measurement logs; the list itself
PHRASES = (
    *("anew", "likewise", "seldom", "nobody", "whoever", "ever after", "of which there", "held against", "told all"),
    *(f"{verb} told" for verb in ("is", "are", "was", "were", "be", "been", "being")),
)
BARE = (
    *("as", "at", "by", "for", "from", "in", "into", "nor", "of", "on", "per", "since", "so", "than", "to", "with"),
    *("it", "its", "that", "their", "they", "those", "without"),
    *("how", "what", "when", "where", "which", "who", "whom", "whose", "why"),
)

# Words of a phrase may be separated by underscores, or by a line break within comments, strings and quotations
_PHRASE = re.compile("|".join(rf"(?<![a-z]){p}(?![a-z])".replace(" ", "[\\s_#\"'>]+") for p in PHRASES), re.IGNORECASE)
_SECTION = re.compile(r"(Args|Attributes|Returns|Yields):")
_ENTRY = re.compile(r" {4}\*{0,2}\w[\w*, ]*: (.*)")
# Shapes, types, units and frames before a description: "(n, 3) float64 [m], world frame. Positions."
_NOTATION = re.compile(r"(?:\(.*?\)|\[.*?\])[^.]*\.\s+|\[.*?\][\s,]+")


def phrases(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and message for each listed phrase."""
    for match in _PHRASE.finditer(text):
        found = " ".join(re.findall("[a-z]+", match.group().lower()))
        yield text.count("\n", 0, match.start()) + 1, f"phrase to avoid: {found!r}"


def is_bare(description: str) -> bool:
    """Return whether a description starts with a preposition, a pronoun or a question word."""
    words = re.match(r"[\w'-]+", _NOTATION.sub("", description, count=1).lower())
    return words is not None and words.group() in BARE


def bare_descriptions(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and message for each description that is no noun phrase.

    Descriptions are entries in the sections `Args`, `Attributes`, `Returns` and `Yields` of docstrings, comments beside
    the fields of a class, and texts of options: `help`, `description`, second argument of `option` and `setting`.
    """
    tree = ast.parse(source)
    fields: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            fields.update(part.end_lineno or 0 for part in node.body if isinstance(part, ast.AnnAssign))
        elif isinstance(node, ast.keyword) and node.arg in ("help", "description"):
            yield from _bare_text(node.value)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("option", "setting"):
            yield from _bare_text(*node.args[1:2])
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            yield from _bare_entries(ast.get_docstring(node) or "", node.body[0].lineno)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        comment = token.string.lstrip("# ")
        if token.type == tokenize.COMMENT and token.start[0] in fields and is_bare(comment):
            yield token.start[0], f"bare description: {comment}"


def _bare_text(*texts: ast.expr) -> Iterator[tuple[int, str]]:
    for text in texts:
        if isinstance(text, ast.Constant) and isinstance(text.value, str) and is_bare(text.value):
            yield text.lineno, f"bare description: {text.value}"


def _bare_entries(docstring: str, first_line: int) -> Iterator[tuple[int, str]]:
    section = ""
    for number, line in enumerate(docstring.splitlines(), first_line):
        heading = _SECTION.fullmatch(line)
        if heading or (line and not line.startswith(" ")):
            section = heading.group(1) if heading else ""
            continue
        entry = _ENTRY.fullmatch(line) if section in ("Args", "Attributes") else None
        text = entry.group(1) if entry else line.strip() if section in ("Returns", "Yields") else ""
        if text and is_bare(text):
            yield number, f"bare description: {line.strip()}"
        if text and not entry:
            section = ""  # the first line of a description is enough


def check(path: str) -> list[str]:
    """Return the faults in a file, or in all Python files and pages below a folder, as `file:line: message`."""
    top = ROOT / path
    if not top.exists():
        return [f"{path}: expected a file or folder."]
    files = [top] if top.is_file() else sorted(f for f in top.rglob("*") if f.suffix in (".py", ".md"))
    faults = []
    for file in files:
        name = file.relative_to(ROOT).as_posix() if file.is_relative_to(ROOT) else str(file)
        if name.startswith(EXEMPT):
            continue
        text = file.read_text(encoding="utf-8")
        found = [*phrases(text), *(bare_descriptions(text) if file.suffix == ".py" else ())]
        faults += [f"{name}:{line}: {message}" for line, message in sorted(found)]
    return faults


if __name__ == "__main__":
    sys.exit("\n".join(fault for path in sys.argv[1:] or CHECKED for fault in check(path)) or 0)
