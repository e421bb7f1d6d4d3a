"""The page of learning libraries has the files and sections for `make clients`."""

import re
from pathlib import Path

from tests.docs.run_page import programs

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "learners.md"


def test_each_learner_has_what_its_target_needs() -> None:
    """The Makefile, the page and the folder of requirements list the same learners; each section has a program."""
    named = re.search(r"^CLIENTS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert named is not None
    clients = set(named.group(1).split())
    sections = re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert {section.lower() for section in sections} == clients
    assert {file.stem for file in PAGE.with_suffix("").glob("*.txt")} == clients
    for client in clients:
        assert programs(PAGE, client)
        for program in programs(PAGE, client):
            compile(program, client, "exec")
        requirements = PAGE.with_suffix("") / f"{client}.txt"
        assert "torch==2.13.0" in requirements.read_text(encoding="utf-8").split()


def test_a_section_that_is_not_there_has_no_programs() -> None:
    """The programs of the sections are those of the page; a misspelt section has none."""
    assert len(programs(PAGE)) == 5
    assert programs(PAGE, "torch") == []
