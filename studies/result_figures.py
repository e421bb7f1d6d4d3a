"""Draw tables of the page of results: a step by what is in the loop, and the filter beside GTSAM.

python -m studies.result_figures     # docs/figures/loop.png and docs/figures/beside_gtsam.png
"""

import re
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_backend.core.validation import argument_error
from training.experiments.output.plotting import picture, save_png

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "results.md"
DARK, LIGHT, ORANGE = "#1f5a8a", "#a9c9e2", "#d9822b"


def read_table(page: str, first_heading: str) -> tuple[list[str], list[tuple[str, list[float]]]]:
    """Return the headings of a Markdown table, found by its first one, and its rows: a label, and numbers.

    Raises:
        ValueError: If the page has no such table.
    """
    lines = iter(page.splitlines())
    headings = next((cells(line) for line in lines if line.startswith(f"| {first_heading} |")), None)
    if headings is None:
        hint = "Give the text of docs/reference/results.md."
        raise argument_error("page", f"a table whose first heading is {first_heading!r}", "no such table", hint)
    next(lines)  # The line of dashes.
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        label, *numbers = cells(line)
        rows.append((label.replace("`", ""), [float(number.replace(",", "")) for number in numbers]))
    return headings, rows


def cells(line: str) -> list[str]:
    """Return the cells of a row of a Markdown table."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


@picture
def draw_loop(page: str, file: Path) -> None:
    """Draw the median and the mean time of a step by what is in the loop."""
    headings, rows = read_table(page, "in the loop")
    median, mean = headings.index("median") - 1, headings.index("mean") - 1
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    ax = figure.subplots()
    places = range(len(rows))
    ax.barh(places, [numbers[mean] / 1e3 for _, numbers in rows], color=LIGHT, label="mean, with merges and smoothing")
    ax.barh(places, [numbers[median] / 1e3 for _, numbers in rows], color=DARK, height=0.4, label="median")
    ax.set_xlabel("step of three robots [ms]")
    _name_rows(ax, [label for label, _ in rows])
    ax.legend(frameon=False, loc="upper right")
    save_png(figure, file, 110)


@picture
def draw_beside_gtsam(page: str, file: Path) -> None:
    """Draw position errors of the filter over those of iSAM2, for one robot and for teams, and times of a step."""
    headings, alone = read_table(page, "position RMS [m]")
    _, teams = read_table(page, "three robots [m]")
    ratio, own, other = (headings.index(name) - 1 for name in ("filter over iSAM2", "step [ms]", "of iSAM2 [ms]"))
    figure = Figure(figsize=(8.4, 5.0), layout="constrained")
    errors, times = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    places = range(len(alone))
    errors.axvline(1.0, color=ORANGE, lw=1.0)
    errors.barh(places, [row[ratio] for _, row in alone], color=DARK, label="one robot")
    below = range(len(alone), len(alone) + len(teams))
    errors.barh(below, [row[ratio] for _, row in teams], color=LIGHT, label="three robots that merge")
    errors.set_xlabel("position RMS over that of iSAM2")
    times.scatter([row[other] for _, row in alone], places, color=ORANGE, s=24, label="iSAM2")
    times.scatter([row[own] for _, row in alone], places, color=DARK, s=24, label="vslam_env")
    times.set_xscale("log")
    times.set_xlabel("step [ms]")
    times.grid(alpha=0.2, which="both", axis="x")
    figure.legend(*errors.get_legend_handles_labels(), ncols=2, frameon=False, loc="outside upper left")
    figure.legend(*times.get_legend_handles_labels(), ncols=2, frameon=False, loc="outside upper right")
    _name_rows(errors, [label for label, _ in (*alone, *teams)])
    save_png(figure, file, 110)


def _name_rows(ax: Axes, labels: list[str]) -> None:
    """Write labels at rows from top to bottom."""
    ax.set_yticks(range(len(labels)), labels)
    ax.invert_yaxis()
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def main() -> None:
    """Draw both figures from the page."""
    page = PAGE.read_text(encoding="utf-8")
    draw_loop(page, ROOT / "docs" / "figures" / "loop.png")
    draw_beside_gtsam(page, ROOT / "docs" / "figures" / "beside_gtsam.png")


if __name__ == "__main__":
    main()
