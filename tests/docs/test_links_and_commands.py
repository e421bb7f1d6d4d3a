"""References on pages exist: linked files and headings, commands and options."""

import doctest
import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from training.cli import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / ".github").rglob("*.md"), *(ROOT / "docs").rglob("*.md")])
DATED = [ROOT / "CHANGELOG.md", *(ROOT / "docs" / "lab").glob("*.md")]  # dated pages refer to the code of that time
MODULES = [
    file.relative_to(ROOT).with_suffix("")
    for package in ("slam_backend", "vslam_env", "agents", "training")
    for file in sorted((ROOT / package).rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]
LINK = re.compile(r"\[[^\]]+\]\(([^)\s]+)\)")
FENCED = re.compile(r"^```[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
TOLD = re.compile(r"`(vslam [^`\n]+)`")
FILE_NAME = re.compile(
    r"(?<![\w/.:-])((?:slam_backend|vslam_env|agents|training|studies|tests|benchmarks|examples|docs)/[\w/.*-]*\w/?)"
)
MAKE = re.compile(r"(?:^|`)make (\w[\w-]*)", re.MULTILINE)
PAGE_NAME = re.compile(r"docs/[\w/-]+\.md")
SOURCES = [
    file
    for folder in ("slam_backend", "vslam_env", "agents", "training", "studies", "examples", "tests")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if PAGE_NAME.search(file.read_text(encoding="utf-8"))
]


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_linked_files_and_headings_exist(page: Path) -> None:
    """Every linked file exists, and every linked heading in it."""
    for target in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{target} is not there"
        assert not anchor or anchor in _anchors(file), f"{target} has no such heading"


@pytest.mark.parametrize("source", SOURCES, ids=_name)
def test_pages_named_in_sources_exist(source: Path) -> None:
    """Pages named in docstrings and comments exist."""
    for page in PAGE_NAME.findall(source.read_text(encoding="utf-8")):
        assert (ROOT / page).exists(), f"{page} does not exist"


@pytest.mark.parametrize("page", [page for page in PAGES if page not in DATED], ids=_name)
def test_files_named_on_pages_exist(page: Path) -> None:
    """Files and folders of the repository exist if a page names them in code style, or runs them with Python."""
    text = page.read_text(encoding="utf-8")
    for path in FILE_NAME.findall(text):
        if not re.search(r"NAME|\*|-v\d+$", path):  # placeholders, and names of environments
            assert (ROOT / path).exists(), f"{path} does not exist"


@pytest.mark.parametrize("page", [page for page in PAGES if page not in DATED], ids=_name)
def test_make_targets_on_pages_exist(page: Path) -> None:
    """Every `make` target on a page is in the Makefile."""
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(MAKE.findall(page.read_text(encoding="utf-8"))) <= targets


def _lines() -> Iterator[tuple[str, str]]:
    """Yield page and text of each command line on the pages, starting with `vslam`."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        shown = [line.split("#")[0] for block in FENCED.findall(text) for line in block.splitlines()]
        for line in [line for line in shown if line.startswith("vslam ")] + TOLD.findall(FENCED.sub("", text)):
            yield _name(page), line.strip()


@pytest.mark.parametrize(("page", "line"), sorted(set(_lines())))
def test_commands_on_the_pages_exist(page: str, line: str) -> None:
    """Every command on a page exists, with the options shown."""
    command: Any = typer.main.get_command(app)
    words = shlex.split(line.replace("[", " ").replace("]", " "))[1:]
    while hasattr(command, "commands") and words and words[0].isidentifier():
        assert words[0] in command.commands, f"{words[0]} is no command of {command.name}"
        command, words = command.commands[words[0]], words[1:]
    of_which = command.commands.values() if hasattr(command, "commands") else [command]
    params = [param for each in of_which for param in each.params]
    options = {name for param in params for name in (*param.opts, *param.secondary_opts)}
    assert {word.split("=")[0] for word in words if word.startswith("--")} <= options | {"--help"}


@pytest.mark.parametrize("module", MODULES, ids=lambda path: ".".join(path.parts))
def test_examples_in_docstrings_hold(module: Path) -> None:
    """Examples in docstrings give the documented results."""
    results = doctest.testmod(import_module(".".join(module.parts)), verbose=False)
    assert results.attempted
    assert not results.failed
