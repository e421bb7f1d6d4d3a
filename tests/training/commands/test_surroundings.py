"""What surrounds a command: names of folders, and settings of matplotlib, that are the user's."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure
from rich.text import Text
from typer.main import get_command

import training
from training import cli
from training.experiments.output.console import make_console, text_column
from training.experiments.output.plotting import picture, save_png

ROOT = Path(training.__file__).parent
ODD = "a [b] [/c] [red]d :boom: {x}"  # markup of rich, also a closing tag that nothing opens
SHORT = ("run", "--world", "fig5", "--robots", "1", "--particles", "5", "--max-cycles", "3", "--no-video")


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, whose name looks like markup."""
    folder = tmp_path / "a [b] [" / "c] [red]d :boom: {x}"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def test_paths_are_printed_as_they_are(odd: Path, vslam: Any) -> None:
    """Commands and errors name paths with brackets, braces and colons letter by letter."""
    for name in ("one [1]", "two [i]"):
        said = vslam(*SHORT, "--out", str(odd / name))
        assert said.status == 0, said.err
        assert f"Report: {odd / name}/report.html" in said.out
        assert f"Run folder: {odd / name}" in said.out
    assert f"Report: {odd / 'one [1]'}/report.html" in vslam("report", str(odd / "one [1]")).out
    compared = vslam("compare", "one [1]", "two [i]")
    assert compared.status == 0, compared.err
    assert {"[1]", "[i]"} <= set(compared.out.split())  # headings are folded between words
    pictured = vslam("worlds", "preview", "fig5", "--out", str(odd / "w [i].png"))
    assert f"Picture: {odd / 'w [i].png'}" in pictured.out
    for arguments in (
        (*SHORT, "--world", f"{odd}/[/none].png"), (*SHORT, "--policy", "[/none]"),
        (*SHORT, "--out", str(odd / "one [1]")),
        ("report", "[/none]"), (*SHORT, "--config", "[red].toml"), ("replay", "mrclam", "--path", "[/none]"),
    ):  # fmt: skip
        refused = vslam(*arguments)
        assert refused.status == 2
        assert arguments[-1] in refused.err.replace("\\\\", "\\"), refused.err
        assert len(refused.err.splitlines()) == 1
    for arguments in (("run", "--[/b]x"), ("[/b]",)):
        assert "[/b]" in vslam(*arguments).err


def test_trials_with_odd_names_are_printed_as_they_are(odd: Path, vslam: Any) -> None:
    """A benchmark that is resumed names its folder, and its bar shows names of policies and worlds."""
    few = ("bench", "exploration", "--policies", "frontier,no:[b]", "--worlds", "fig5", "--robots", "1", "--seeds", "1")
    assert "no:[b]" in vslam(*few, "--out", "bench [/x]").err


@pytest.mark.parametrize("text", [ODD, "[/]", "[link=x]y"])
def test_consoles_and_columns_show_texts_as_they_are(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever looks like markup, or like an emoji, is printed; columns format their template alone."""
    make_console().print(text, soft_wrap=True)
    assert capsys.readouterr().out == f"{text}\n"

    class Task:
        description = text

    assert text_column("{task.description}").render(Task()).plain == text


def test_no_other_console_is_made() -> None:
    """Consoles and columns come from one module, so that all text is shown as it is."""
    for file in ROOT.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        if file.name != "console.py":
            assert not {"Console", "TextColumn"} & set(_called(tree)), file


def _called(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions that a program calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id


def test_help_shows_brackets() -> None:
    """Units in brackets are no markup: the help of each command and option is shown with them."""

    def check(command: Any) -> None:
        for text in [command.help or "", *(getattr(param, "help", None) or "" for param in command.params)]:
            assert Text.from_markup(text).plain == text.replace("\\[", "[")
        for below in getattr(command, "commands", {}).values():
            check(below)

    check(get_command(cli.app))


def test_settings_of_matplotlib_are_the_programs_own(
    vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures are the same bytes whatever the user's settings are, which stay as they are."""
    monkeypatch.chdir(tmp_path)
    assert vslam(*SHORT, "--seed", "1", "--out", "plain").status == 0
    with mpl.rc_context({"text.usetex": True, "font.family": "none such", "lines.linewidth": 9.0, "savefig.dpi": 7}):
        said = vslam(*SHORT, "--seed", "1", "--out", "odd")
        assert mpl.rcParams["text.usetex"]
    assert said.status == 0
    assert not said.err
    for name in ("map.png", "error.png"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "odd" / name).read_bytes()


def test_a_picture_that_fails_costs_one_line(vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command goes on without it, writes its report, and succeeds."""

    def broken(figure: Figure, *values: Any, **named: Any) -> None:
        raise RuntimeError("no font\nfound [/]")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Figure, "savefig", broken)
    said = vslam(*SHORT, "--out", "run")
    assert said.status == 0
    assert said.err.splitlines() == [f"warning {name} is not drawn: RuntimeError: no font found [/]" for name in
                                     ("map.png", "error.png")]  # fmt: skip
    assert {"report.html", "recording.npz"} <= {file.name for file in (tmp_path / "run").iterdir()}


def test_a_picture_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    """A missing folder, unlike a font, is the user's: the error names it."""

    @picture
    def draw(file: Path) -> None:
        save_png(Figure(), file, 50)

    with pytest.raises(ValueError, match="out: expected"):
        draw(tmp_path / "none" / "picture.png")


def test_all_functions_that_save_pictures_are_guarded() -> None:
    """Each function that calls `save_png` has the decorator that guards it."""
    found = 0
    for file in ROOT.rglob("*.py"):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and "save_png" in _called(node):
                found += 1
                assert "picture" in {ast.unparse(each) for each in node.decorator_list}, f"{file}: {node.name}"
    assert found > 10
