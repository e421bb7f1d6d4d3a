"""The linter for prose finds planted faults, with their lines, and accepts plain descriptions."""

from pathlib import Path

import pytest

from studies import prose


@pytest.mark.parametrize("phrase", prose.PHRASES)
@pytest.mark.parametrize("text", ["One line.\nIt {}, here.\n", "One line.\ndef test_it_{}_here(): ...\n"])
def test_each_phrase_is_found_in_prose_and_in_test_names(phrase: str, text: str) -> None:
    """A phrase of the list is reported with its line, in sentences and in identifiers."""
    planted = text.format(phrase.replace(" ", "_") if "def" in text else phrase.capitalize())
    assert list(prose.phrases(planted)) == [(2, f"phrase to avoid: {phrase!r}")]


@pytest.mark.parametrize("between", ["\n", "\n    # ", '"\n    "', "\n> "])
def test_a_phrase_is_found_across_a_line_break(between: str) -> None:
    """The words of a phrase may stand on two lines of a page, a comment or a string."""
    assert list(prose.phrases(f"Robots are{between}told.")) == [(1, "phrase to avoid: 'are told'")]


def test_words_that_contain_a_phrase_are_accepted() -> None:
    """Only whole words count."""
    assert not list(prose.phrases("Janewood retold: this told, unlikewise, beheld against"))


@pytest.mark.parametrize(
    "description",
    [
        "Of the team.",
        "(K,) int64. Of each robot.",
        "[m] At which they were drawn.",
        "(n, 3) float64 [m], world frame. What was seen.",
        "[m], per axis. Per robot its error.",
        "How many.",
        "Its covariance.",
    ],
)
def test_a_bare_description_is_recognised(description: str) -> None:
    """A description that starts with a preposition, a pronoun or a question word is bare, after its notation too."""
    assert prose.is_bare(description)


@pytest.mark.parametrize(
    "description",
    [
        "Time step of the team.",
        "(K,) int64. Group of each robot.",
        "(n, 3) float64 [m], n >= 3.",
        "Whether robots merge.",
        "K.",
        "[m].",
        "Off-axis angle [rad].",
        "Per-robot maps.",
        "",
    ],
)
def test_a_description_that_stands_alone_is_accepted(description: str) -> None:
    """Noun phrases, `Whether` clauses and plain notation are no faults."""
    assert not prose.is_bare(description)


PLANTED = '''"""A module.

Attributes:
    LIMIT: Of the module.
"""
LIMIT = 1


class Record:
    """A record.

    Attributes:
        name: Name of the record.
        step: Of the team.
    """

    name: str  # Of the person
    size: int = 2  # Number of records
    other = 3  # Of no field


def function(step: int, *rest: int) -> int:
    """Return a number.

    Args:
        step: Of the team; further
            Of lines do not count.
        *rest: For later.

    Returns:
        What came of it.
        As the second line, which does not count.

    Raises:
        ValueError: Of no interest.
    """
    option(help="How many.")
    setting(1, "Of the network.")
    return option(None, "Number of robots.")
'''


def test_bare_descriptions_are_found_wherever_they_stand() -> None:
    """Docstring sections, comments of fields and texts of options are searched; other comments and lines are not."""
    assert sorted(line for line, _ in prose.bare_descriptions(PLANTED)) == [4, 14, 17, 26, 28, 31, 37, 38]


def test_faults_are_reported_by_file_and_line_below_a_folder(tmp_path: Path) -> None:
    """Python files are searched for phrases and descriptions, pages for phrases, and other files for nothing."""
    (tmp_path / "module.py").write_text(f"# {prose.PHRASES[0]}\n{PLANTED}"[:-1], encoding="utf-8")
    (tmp_path / "page.md").write_text(f"Title\n{prose.PHRASES[1]}\n", encoding="utf-8")
    (tmp_path / "data.csv").write_text(prose.PHRASES[2], encoding="utf-8")
    faults = prose.check(str(tmp_path))
    assert [fault.rsplit(":", 2)[0] for fault in faults if "phrase" in fault] == [
        f"{tmp_path}/module.py:1",
        f"{tmp_path}/page.md:2",
    ]
    assert len(faults) == 2 + 8


def test_a_missing_path_is_a_fault(tmp_path: Path) -> None:
    """A folder that was renamed does not drop out of the check unnoticed."""
    assert prose.check(str(tmp_path / "gone"))
