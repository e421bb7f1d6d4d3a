"""The picture of `vslam bench exploration`: floor seen, map error and pose error over time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.bench.exploration.bench import NO_ORACLE
from training.bench.exploration.tables import label, who_is
from training.experiments.plotting import save_png

PANELS = {
    "coverage": ("floor seen [%]", 100.0),
    "map_error": ("map error E [m]", 1.0),
    "pose_error": ("pose error [m]", 1.0),
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7f7f7f")  # for colour-blind eyes too
STYLES = ("-", "--", ":", "-.")


def draw_exploration(file: Path, curves: Sequence[Mapping[str, Any]]) -> None:
    """Draw a row of panels for each world and number of robots into a PNG file: means over seeds, 95 % intervals.

    Args:
        file: Where to write.
        curves: Of `exploration_summary.curves`.
    """
    places = list(dict.fromkeys((line["world"], line["robots"]) for line in curves))
    colours = _each(COLOURS, (line["policy"] for line in curves))
    policy_of = {who_is(line): line["policy"] for line in curves}
    styles = _each(STYLES, (NO_ORACLE, *(line["oracle"] for line in curves)))
    figure = Figure(figsize=(12.0, 2.7 * len(places) + 0.5), layout="constrained")
    axes = figure.subplots(len(places), len(PANELS), squeeze=False, sharex=True)
    for row, (world, robots) in zip(axes, places, strict=True):
        here = [line for line in curves if (line["world"], line["robots"]) == (world, robots)]
        for panel, (name, (text, factor)) in zip(row, PANELS.items(), strict=True):
            for policy, oracle in dict.fromkeys((line["policy"], line["oracle"]) for line in here):
                own = [line for line in here if (line["policy"], line["oracle"]) == (policy, oracle)]
                _draw_mean(panel, own, name, factor, colours[policy], styles[oracle])
            panel.set_ylabel(text)
            panel.set_ylim(0.0, 100.0 if name == "coverage" else None)
            panel.grid(alpha=0.2)
            panel.spines[["top", "right"]].set_visible(False)
        row[0].set_title(f"{label(world)}, {robots} robots", loc="left", fontsize=10)
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    handles, names = axes[0][0].get_legend_handles_labels()
    entries = dict(sorted(zip(names, handles, strict=True), key=lambda e: list(colours).index(policy_of[e[0]])))
    columns = min(len(colours), 6)  # a policy, and below it what it does when it is told more
    figure.legend(entries.values(), entries, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
    save_png(figure, file, 100)


def _draw_mean(
    axes: Axes, lines: Sequence[Mapping[str, Any]], name: str, factor: float, colour: str, style: str
) -> None:
    """Draw one policy's mean over time with its interval, faint and without interval where it is told something."""
    times = [line["time_s"] for line in lines]
    mean = factor * np.array([line[name] for line in lines])
    alone = lines[0]["oracle"] == NO_ORACLE
    axes.plot(times, mean, color=colour, linestyle=style, linewidth=1.6 if alone else 1.1, label=who_is(lines[0]))
    if alone and lines[0][f"{name}_low"] is not None:
        low, high = (factor * np.array([line[f"{name}_{end}"] for line in lines]) for end in ("low", "high"))
        axes.fill_between(times, low, high, color=colour, alpha=0.15, linewidth=0)


def _each(choices: Sequence[str], names: Any) -> dict[str, str]:
    """Give each name a choice of its own, as long as there are enough."""
    return {name: choices[i % len(choices)] for i, name in enumerate(dict.fromkeys(names))}
