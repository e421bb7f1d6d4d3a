"""Pages of learners have the files for `make clients`."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def _programs(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def test_each_learner_has_what_its_target_needs() -> None:
    """The Makefile, the page on training and the folder list the same learners; each page has a program."""
    named = re.search(r"^CLIENTS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert named is not None
    clients = set(named.group(1).split())
    folder = ROOT / "docs" / "how-to" / "learners"
    assert {page.stem for page in folder.glob("*.md")} == {file.stem for file in folder.glob("*.txt")} == clients
    linked = re.findall(
        r"\(learners/(\w+)\.md\)", (ROOT / "docs" / "how-to" / "training.md").read_text(encoding="utf-8")
    )
    assert set(linked) == clients
    for client in clients:
        programs = _programs(folder / f"{client}.md")
        assert programs
        for program in programs:
            compile(program, client, "exec")
        assert "torch==2.13.0" in (folder / f"{client}.txt").read_text(encoding="utf-8").split()
