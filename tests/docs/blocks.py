"""Code blocks of pages: what they are, and how they are run."""

import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from training import cli

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    page
    for page in [*ROOT.glob("*.md"), *(ROOT / ".github").rglob("*.md"), *(ROOT / "docs").rglob("*.md")]
    if page.name != "CHANGELOG.md" and (ROOT / "docs" / "lab") not in page.parents  # dated
)
FENCE = re.compile(
    r"(?:^<!-- (?P<mark>not run|numbers vary): (?P<why>[^\n]+) -->\n)?^```(?P<kind>[^\n]*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
NUMBER = re.compile(r"-?\d+(?:[.,]\d+)*")


@dataclass(frozen=True)
class Block:
    """Code block of a page."""

    kind: str  # `python`, `console` (commands after `$ `, each with its output), `text`, or another word
    text: str
    why: str | None  # Reason why it is not run, from the comment above it
    varies: bool  # Whether the numbers of its output vary, as the comment above it says
    output: str | None  # Text of the block of kind `text` that follows at once: output of a program

    @property
    def runs(self) -> bool:
        """Whether the block is run by the tests."""
        return self.kind in ("python", "console") and self.why is None


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page."""
    content = page.read_text(encoding="utf-8")
    found = list(FENCE.finditer(content))
    made = []
    for block, after in zip(found, (*found[1:], None), strict=False):
        follows = after is not None and after["kind"] == "text" and not content[block.end() : after.start()].strip()
        why = block["why"] if block["mark"] == "not run" else None
        output = after["text"] if after and follows else None
        made.append(Block(block["kind"], block["text"], why, block["mark"] == "numbers vary", output))
    return made


def alike(expected: str, got: str, exact: bool = True) -> bool:
    r"""Return whether a text is as expected; `...` stands for any text, such as a time or a path.

    Args:
        expected: Text of a page.
        got: Output of the program.
        exact: Whether numbers count.

    >>> alike("pose 1.0 in ... s", "pose  1.0\nin 3 s"), alike("pose 1.0", "pose 1.1"), alike("a map", "a cat")
    (True, False, False)
    >>> alike("pose 1.0", "pose 1.1", exact=False)
    True
    """
    parts = [plain(part, exact) for part in expected.split("...")]
    pattern = r"\s*.*?\s*".join(re.escape(part) for part in parts)
    return re.fullmatch(pattern, plain(got, exact), re.DOTALL) is not None


def plain(text: str, exact: bool) -> str:
    """Return a text without the rules of tables, with single spaces; if not exact, with one sign for each number."""
    words = re.sub("[─━╸╺]", " ", text)
    return " ".join((words if exact else NUMBER.sub("#", words)).split())


def commands(text: str) -> Iterator[tuple[str, str]]:
    """Yield each command of a block of kind `console` with its expected output."""
    for part in re.split(r"^\$ ", text.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command.split("  # ")[0].strip(), output


def call(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command of a page in this process, where kernels are compiled already."""
    words = shlex.split(command)
    monkeypatch.setattr(sys, "argv", words)
    if words[0] == "vslam":
        run: Callable[[], object] = cli.main
    elif words[0] == "python" and words[1].endswith(".py"):
        script = words[1] if Path(words[1]).is_file() else str(ROOT / words[1])
        monkeypatch.setattr(sys, "argv", words[1:])
        run = partial(runpy.run_path, script, run_name="__main__")
    else:
        print(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
        return
    try:
        run()
    except SystemExit as end:
        if end.code:
            pytest.fail(f"{command}: exit status {end.code}")
