"""Notebooks are made from their sources, small, free of traces of a machine, and run in Jupyter."""

import json
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from studies.notebooks import FOLDER, install_cell
from tests.docs.blocks import alike

SOURCES = sorted(FOLDER.glob("*.py"))
CELL = re.compile(r"^# %%([^\n]*)\n", re.MULTILINE)
TRACES = re.compile(r"/(?:home|root|tmp|usr|work)/|\b\d+ ms\b|\bCPU\b|\bWarning\b")


def notebook_of(source: Path) -> Any:
    """Return the notebook made from a source, as JSON."""
    return json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))


def outputs(notebook: Any) -> list[tuple[int, str, str]]:
    """Return cell, kind and text of each output."""
    return [
        (index, output["output_type"], "".join(output.get("text", "")))
        for index, cell in enumerate(notebook["cells"])
        for output in cell.get("outputs", ())
    ]


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_notebooks_have_the_cells_of_their_sources(source: Path) -> None:
    """Texts and programs are those of the source, after a cell that installs the package on Colab."""
    parts = CELL.split(source.read_text(encoding="utf-8"))[1:]
    expected = [("code", install_cell())] + [
        ("markdown", re.sub(r"^# ?", "", text.strip(), flags=re.MULTILINE)) if kind else ("code", text.strip())
        for kind, text in zip(parts[::2], parts[1::2], strict=True)
    ]
    cells = notebook_of(source)["cells"]
    assert [(cell["cell_type"], "".join(cell["source"])) for cell in cells] == expected, "stale: make notebooks"


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_notebooks_are_small_and_show_nothing_of_a_machine(source: Path) -> None:
    """Notebooks have a picture and less than 200 kB; no output has times, paths or warnings."""
    assert source.with_suffix(".ipynb").stat().st_size < 200_000
    notebook = notebook_of(source)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    assert {key for cell in notebook["cells"] for key in cell["metadata"]} == {"tags"}
    shown = outputs(notebook)
    assert {"display_data", "stream"} == {kind for _, kind, _ in shown}
    assert not [text for _, _, text in shown if TRACES.search(text)]


@pytest.mark.slow
@pytest.mark.parametrize("source", [each for each in SOURCES if "jax" not in each.read_text(encoding="utf-8")],
                         ids=lambda source: source.stem)  # fmt: skip
def test_sources_of_notebooks_run(source: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The cells run in their order as a program, too, and draw pictures."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    shown: list[Any] = []
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gcf()))
    monkeypatch.chdir(tmp_path)
    exec(compile(source.read_text(encoding="utf-8"), str(source), "exec"), {"__name__": "__main__"})
    assert shown
    assert all(axes.has_data() for figure in shown for axes in figure.axes)
    pyplot.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_notebooks_run_in_jupyter(source: Path) -> None:
    """A notebook runs in Jupyter, and gives the pictures and the words that it shows; numbers may differ."""
    reason = "the extra docs is not installed: make notebooks"
    pytest.importorskip("nbclient", reason=reason)
    nbformat = pytest.importorskip("nbformat", reason=reason)
    if "jax" in source.read_text(encoding="utf-8"):
        pytest.importorskip("jax", reason="jax is not installed: pip install .[jax]")
    from studies.notebooks import executed

    kept = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    expected, got = outputs(kept), outputs(executed(deepcopy(kept)))
    assert [each[:2] for each in got] == [each[:2] for each in expected]
    assert all(alike(before[2], after[2]) for before, after in zip(expected, got, strict=True))
