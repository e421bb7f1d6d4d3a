"""The paper draft cites what its bibliography has, and figures that the pages of results have."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
_, HEAD, TEXT = PAPER.split("---\n", 2)
FIGURE = re.compile(r"\d+(?:\.\d+)?")


def test_the_paper_is_that_of_the_citation() -> None:
    """Title and authors are those of CITATION.cff; the text has the length that the journal asks for."""
    about = yaml.safe_load(HEAD)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert about["title"] == citation["title"]
    assert [author["name"] for author in about["authors"]] == [author["name"] for author in citation["authors"]]
    assert (ROOT / "paper" / about["bibliography"]).is_file()
    assert 750 <= len(TEXT.split()) <= 1750


def test_citations_and_pictures_exist() -> None:
    """Each entry of the bibliography is cited, each citation is an entry, and each picture is a file."""
    cited = set(re.findall(r"(?<!\w)@(\w+)", TEXT))
    entries = re.findall(r"^@\w+\{(\w+),$", (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(entries) == sorted(cited)
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert pictures
    assert all((ROOT / "paper" / picture).is_file() for picture in pictures)


def test_figures_are_those_of_the_pages() -> None:
    """Each number of the section on accuracy and speed is on the page of results or of the leaderboard."""
    section = re.sub(r"!\[.*?\]\(.*?\)|@\w+|`[^`]*`", "", TEXT.split("# Accuracy and speed")[1], flags=re.DOTALL)
    pages = [ROOT / "docs" / "reference" / f"{name}.md" for name in ("results", "leaderboard")]
    there = {number for page in pages for number in FIGURE.findall(page.read_text(encoding="utf-8"))}
    used = FIGURE.findall(section.split("{ width")[0])
    assert len(used) > 20
    assert [number for number in used if number not in there] == []
