"""Plots are written with a palette, and look the same as without."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from training.experiments.output import study_chart
from training.experiments.output.plotting import add_legend, save_png
from training.experiments.study import Chart, Column, Curves, Panel


def _figure() -> Figure:
    """Plot with lines of ten colours, error bars, a shaded band and text."""
    rng = np.random.default_rng(3)
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for row in rng.normal(size=(10, 30)):
        axes.errorbar(np.arange(30), row.cumsum(), 0.3, alpha=0.7)
    axes.axhspan(-1.0, 1.0, alpha=0.1)
    axes.set_xlabel("particles M")
    return figure


def test_a_small_file_shows_the_same_figure(tmp_path: Path) -> None:
    """The picture has the requested size, and no pixel is far from that of the larger file with all colours."""
    small, whole = tmp_path / "small.png", tmp_path / "whole.png"
    save_png(_figure(), small, 120)
    figure = _figure()
    FigureCanvasAgg(figure)
    figure.savefig(whole, dpi=120)
    shown, expected = (imageio.imread(file)[:, :, :3].astype(int) for file in (small, whole))
    assert shown.shape == expected.shape == (480, 720, 3)
    apart = np.abs(shown - expected).max(axis=2)
    assert apart.mean() < 1.0
    assert np.quantile(apart, 0.999) <= 24
    assert small.stat().st_size < 0.5 * whole.stat().st_size


def test_the_same_figure_is_the_same_file(tmp_path: Path) -> None:
    """A plot made twice gives identical files."""
    for name in ("one.png", "two.png"):
        save_png(_figure(), tmp_path / name, 80)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_panels_without_values_leave_no_gaps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Panels of a row that has no values are left out, and each row is named once."""
    drawn: list[Figure] = []
    monkeypatch.setattr(study_chart, "save_png", lambda figure, file, dpi: drawn.append(figure))
    rows = [{"k": "a", "x": 1, "u": 1.0, "v": 2.0}, {"k": "b", "x": 1, "u": 1.0}, {"k": "c", "x": 1, "u": 3.0}]
    panels = tuple(Panel(column=Column(name)) for name in "uv")
    study_chart.draw_chart(tmp_path / "chart.png", Chart(x="x", label="x", rows="k", panels=panels), rows)
    shown = [ax for ax in drawn[0].axes if ax.get_visible()]
    assert [ax.get_ylabel() for ax in shown] == ["u", "v", "u", "u"]
    assert [ax.get_title(loc="left") for ax in shown] == ["a", "", "b", "c"]


def test_a_legend_fits_into_the_width_of_its_figure() -> None:
    """A legend with long texts has as many rows as it takes, and one with short texts has one."""
    for text, columns in (("a", 6), ("policy " * 3, 2)):
        figure = Figure(figsize=(6.0, 4.0), layout="constrained")
        axes = figure.subplots()
        for place in range(6):
            axes.plot([0, 1], label=f"{text} {place}")
        add_legend(figure, axes)
        (legend,) = figure.legends
        figure.draw_without_rendering()
        assert legend.get_window_extent().width <= figure.bbox.width
        assert len({round(text.get_window_extent().x0) for text in legend.get_texts()}) == columns


def test_curves_with_a_common_label_share_a_panel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each combination has a panel with a line for each curve, without the first time, at which errors are zero."""
    drawn: list[Figure] = []
    monkeypatch.setattr(study_chart, "save_png", lambda figure, file, dpi: drawn.append(figure))
    rows = [{"k": k, "curves": {"time_s": [0.0, 1.0, 2.0], "u": [0.0, 1.0, 2.0], "v": [0.0, 3.0, 4.0]}} for k in "abcd"]
    curves = Curves(by=("k",), columns=(Column("u"), Column("v")), label="error [m]")
    study_chart.draw_curves(tmp_path / "curves.png", curves, rows)
    shown = [ax for ax in drawn[0].axes if ax.get_visible()]
    assert [ax.get_title(loc="left") for ax in shown] == list("abcd")
    assert [[np.asarray(line.get_ydata()).tolist() for line in ax.lines] for ax in shown] == [
        [[1.0, 2.0], [3.0, 4.0]]
    ] * 4
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["u", "v"]
