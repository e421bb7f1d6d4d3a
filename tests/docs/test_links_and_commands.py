"""What the pages say is there: files and headings that they link to, commands and options that they show."""

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
DATED = [ROOT / "CHANGELOG.md", *(ROOT / "docs" / "lab").glob("*.md")]  # they speak of the code of their day
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
    r"(?<![\w/.:-])((?:slam_backend|vslam_env|agents|training|tests|benchmarks|examples|docs)/[\w/.*-]*\w/?)"
)
MAKE = re.compile(r"(?:^|`)make (\w[\w-]*)", re.MULTILINE)
PAGE_NAME = re.compile(r"docs/[\w/-]+\.md")
SOURCES = [
    file
    for folder in ("slam_backend", "vslam_env", "agents", "training", "benchmarks", "examples", "tests")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if PAGE_NAME.search(file.read_text(encoding="utf-8"))
]


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _anchors(page: Path) -> set[str]:
    """Return the anchors that a page's headings have where it is shown."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    """Every file that a page links to is there, and every heading within one."""
    for target in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{target} is not there"
        assert not anchor or anchor in _anchors(file), f"{target} has no such heading"


@pytest.mark.parametrize("source", SOURCES, ids=_name)
def test_pages_that_sources_name_exist(source: Path) -> None:
    """A docstring or comment that refers to a page names one that exists."""
    for page in PAGE_NAME.findall(source.read_text(encoding="utf-8")):
        assert (ROOT / page).exists(), f"{page} does not exist"


@pytest.mark.parametrize("page", [page for page in PAGES if page not in DATED], ids=_name)
def test_files_that_pages_name_exist(page: Path) -> None:
    """A file or folder of the repository that a page names in code style, or gives to Python, exists."""
    text = page.read_text(encoding="utf-8")
    for path in FILE_NAME.findall(text):
        if not re.search(r"NAME|\*|-v\d+$", path):  # placeholders, and names of environments
            assert (ROOT / path).exists(), f"{path} does not exist"


@pytest.mark.parametrize("page", [page for page in PAGES if page not in DATED], ids=_name)
def test_make_targets_that_pages_show_exist(page: Path) -> None:
    """Every `make` target that a page shows is one of the Makefile."""
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(MAKE.findall(page.read_text(encoding="utf-8"))) <= targets


def _lines() -> Iterator[tuple[str, str]]:
    """Yield page and text of each command line that the pages show, `vslam` first."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        shown = [line.split("#")[0] for block in FENCED.findall(text) for line in block.splitlines()]
        for line in [line for line in shown if line.startswith("vslam ")] + TOLD.findall(FENCED.sub("", text)):
            yield _name(page), line.strip()


@pytest.mark.parametrize(("page", "line"), sorted(set(_lines())))
def test_commands_on_the_pages_exist(page: str, line: str) -> None:
    """Every command that a page shows is one, and has the options shown with it."""
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
    """What a docstring shows is what comes out."""
    results = doctest.testmod(import_module(".".join(module.parts)), verbose=False)
    assert results.attempted
    assert not results.failed
