"""Charts of studies."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, StrMethodFormatter
from matplotlib.transforms import ScaledTranslation

from training.experiments.output.plotting import add_legend, picture, save_png
from training.experiments.output.tables import in_words
from training.experiments.statistics import grouped
from training.experiments.study import Chart, Column, Curves, Panel, Row, value_text

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7f7f7f")  # safe for the colour-blind
MARKERS = "osD^vxP"
MOST_TICKS = 6  # of a logarithmic axis; above, labels would overlap, and powers of ten are labelled
MOST_COLUMNS = 3  # of panels with shared curves
WIDTH = 36  # of a title [letters]
STYLES = "-", "--", ":", "-."
APART = 2.2  # distance between the points of two lines at the same x, so that their intervals do not overlap [pt]


@picture
def draw_chart(file: Path, chart: Chart, rows: Sequence[Row]) -> None:
    """Draw the chart of a study into a PNG file; nothing if no row counts. Panels without values leave no gaps."""
    chosen = list(filter(chart.where, rows))
    drawn = [
        (key, group, panel)
        for key, group in grouped(chosen, (chart.rows,) if chart.rows else ()).items()
        for panel in chart.panels
        if panel.column.estimate(group).value is not None
    ]
    if not drawn:
        return
    names = [name for (name,) in grouped(chosen, (chart.by,))] if chart.by else [""]
    columns = min(len(chart.panels), len(drawn))
    count = -(-len(drawn) // columns)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(3.1 * columns, 2.7 * count + 0.4), layout="constrained")
        axes = figure.subplots(count, columns, squeeze=False, sharex=True).ravel()
        last = None
        for place, (ax, (key, group, panel)) in enumerate(zip(axes, drawn, strict=False)):
            draw_panel(ax, chart, panel, group, names)
            if key and (key != last or place % columns == 0):
                ax.set_title(fill(chart.title(key[0]), WIDTH), loc="left")
            last = key
            if place + columns >= len(drawn):
                ax.set_xlabel(chart.label)
                ax.tick_params(labelbottom=True)
        for ax in axes[len(drawn) :]:
            ax.set_visible(False)
        if chart.log:  # of all panels, which share it
            axes[0].set_xscale("log")
            ticks = sorted({chart.factor * row[chart.x] for row in chosen if row[chart.x] is not None})
            if len(ticks) <= MOST_TICKS:
                axes[0].set_xticks(ticks)
            axes[0].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes[0].xaxis.set_minor_locator(NullLocator())
        if chart.by:
            title = chart.words[chart.by][0] if chart.by in chart.words else in_words(chart.by)[0]
            add_legend(figure, axes[0], title=title)
        save_png(figure, file, 110)


def draw_panel(ax: Axes, chart: Chart, panel: Panel, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Draw a quantity over the field of the x axis, a line for each of some names; a level one where there is no x."""
    column = panel.column
    for place, name in enumerate(names):
        of_name = [row for row in rows if not chart.by or row[chart.by] == name]
        colour, text = COLOURS[place % len(COLOURS)], value_text(chart.words, chart.by, name)
        if of_name and all(row[chart.x] is None for row in of_name):
            level = column.estimate(of_name).value
            if level is not None:
                ax.axhline(level, lw=1.2, ls="--", color=colour, label=text)
            continue
        groups = sorted(grouped(of_name, (chart.x,)).items())
        found = [(chart.factor * x, column.estimate(group)) for (x,), group in groups]
        known = [(x, estimate) for x, estimate in found if estimate.value is not None]
        xs, values = [x for x, _ in known], [estimate.value for _, estimate in known]
        aside = (place - 0.5 * (len(names) - 1)) * APART / 72.0
        drawn = ax.plot(
            xs, values, marker=MARKERS[place % len(MARKERS)], ms=5, mfc="none", lw=1.2, color=colour, label=text
        )
        for x, estimate in known:
            if estimate.low is not None and estimate.high is not None:
                drawn += ax.plot([x, x], [estimate.low, estimate.high], color=colour, lw=0.8)
        for line in drawn if len(drawn) > 1 else ():  # after the limits of the axes include them
            line.set_transform(ax.transData + ScaledTranslation(aside, 0.0, ax.figure.dpi_scale_trans))
    if panel.log:
        ax.set_yscale("log")
        bottom, top = ax.get_ylim()
        if top < 1e3 * bottom:  # otherwise powers of ten are easier to read
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    if panel.limits is not None:
        ax.set_ylim(*panel.limits)
    if panel.guide is not None:
        ax.axhline(panel.guide, color="0.5", lw=0.8, ls=":")
    ax.set_ylabel(column.title)
    ax.grid(alpha=0.2, which="both")


@picture
def draw_curves(file: Path, curves: Curves, rows: Sequence[Row]) -> None:
    """Draw means over time into a PNG file, a panel for each curve or combination; nothing without rows."""
    lines = curves.lines(rows)
    if not lines:
        return
    if curves.label:
        _draw_shared(file, curves, lines)
        return
    facets = grouped(lines, curves.rows)
    names = [name for name in curves.by[len(curves.rows) :] if len(grouped(lines, (name,))) > 1] or curves.by[-1:]
    keys = list(grouped(lines, names))
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        size = 3.1 * len(curves.columns), 2.7 * len(facets) + 0.4
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(facets), len(curves.columns), squeeze=False, sharex=True)
        for panels, (place, facet) in zip(axes, facets.items(), strict=True):
            for ax, column in zip(panels, curves.columns, strict=True):
                for key, group in grouped(facet, names).items():
                    _draw_curve(ax, column, _label(curves, names, key), keys.index(key), group)
                ax.set_ylabel(column.title)
                ax.grid(alpha=0.2)
            panels[0].set_title(_label(curves, curves.rows, place), loc="left")
        for ax in axes[-1]:
            ax.set_xlabel(curves.axis)
        add_legend(figure, axes[0][0], title=", ".join(in_words(name)[0] for name in names))
        save_png(figure, file, 110)


@picture
def _draw_shared(file: Path, curves: Curves, lines: Sequence[Row]) -> None:
    """Draw all curves of each combination into one panel, without the first time, at which errors are zero."""
    panels = grouped([line for line in lines if line["time_s"] > 0.0], curves.by)
    columns = min(len(panels), MOST_COLUMNS)
    count = -(-len(panels) // columns)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(3.1 * max(columns, 2), 2.7 * count + 0.4), layout="constrained")
        axes = figure.subplots(count, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for place, (ax, (key, group)) in enumerate(zip(axes, panels.items(), strict=False)):
            for line, column in enumerate(curves.columns):
                _draw_curve(ax, column, column.title, line, group)
            ax.set_yscale("log")
            ax.set_title(fill(_label(curves, curves.by, key), WIDTH), loc="left")
            ax.grid(alpha=0.2)
            if place % columns == 0:
                ax.set_ylabel(curves.label)
            if place + columns >= len(panels):
                ax.set_xlabel(curves.axis)
                ax.tick_params(labelbottom=True)
        for ax in axes[len(panels) :]:
            ax.set_visible(False)
        add_legend(figure, axes[0])
        save_png(figure, file, 110)


def _draw_curve(ax: Axes, column: Column, label: str, place: int, group: Sequence[Row]) -> None:
    """Draw the mean of a group over time with its interval."""
    known = [line for line in group if line[column.name] is not None]
    times, style = [line["time_s"] for line in known], STYLES[place // len(COLOURS) % len(STYLES)]
    colour, factor = COLOURS[place % len(COLOURS)], column.scale
    ax.plot(times, [factor * line[column.name] for line in known], lw=1.2, color=colour, ls=style, label=label)
    if known and known[0][f"{column.name}_low"] is not None:
        low, high = ([factor * line[f"{column.name}_{end}"] for line in known] for end in ("low", "high"))
        ax.fill_between(times, low, high, color=colour, alpha=0.12, lw=0)


def _label(curves: Curves, names: Sequence[str], values: Sequence[Any]) -> str:
    """Return values of fields as text."""
    return ", ".join(value_text(curves.words, *item) for item in zip(names, values, strict=True))
