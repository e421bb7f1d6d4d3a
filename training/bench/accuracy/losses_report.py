"""Report of the losses of accuracy: summary, tables, Markdown and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from slam_backend.core.validation import FloatArray
from training.bench.accuracy.losses import ESTIMATES, LADDER, LOSSES
from training.experiments.plotting import picture, save_png
from training.experiments.statistics import grouped, interval
from training.experiments.tables import console_table, number, titled_markdown

CONDITION = ("world", "robots", "policy", "preset", "max_range", "baseline", "measurements", "particles")
NAMES = {
    "odometry": "odometry", "ideal_online": "ideal online", "batch": "batch ML",
    "noise_as_assumed": "noise as assumed", "own_associations": "own associations", "online": "online",
    "all_keyframes": "all keyframes", "filter": "filter",
}  # fmt: skip
OF_TRIALS = (
    "map_rms_m", "batch_map_rms_m", "map_recall", "map_precision", "wrong_match_share", "unused_share",
    "copies_per_landmark", "way_m", "merges", "groups", "revisits", "missed_revisits",
)  # fmt: skip
COLOURS = ("#7f7f7f", "#E69F00", "#D55E00", "#56B4E9", "#009E73", "#0072B2")  # safe for colour-blind readers
Line = dict[str, Any]
Table = tuple[str, list[str], list[list[str]]]  # title, headings, rows


def geometric_mean(values: FloatArray) -> dict[str, float | int | None]:
    """Return the geometric mean of positive values (n,), its 95 % bootstrap interval, the largest value and n.

    Other values are left out; without any, all but `seeds` are None.

    >>> geometric_mean(np.array([1.0, 4.0]))["mean"]
    2.0
    """
    logs = np.log(values[np.isfinite(values) & (values > 0.0)])
    if not len(logs):
        return {"mean": None, "low": None, "high": None, "worst": None, "seeds": 0}
    low, high = interval(logs, np.mean)
    return {
        "mean": float(np.exp(logs.mean())), "low": None if low is None else float(np.exp(low)),
        "high": None if high is None else float(np.exp(high)), "worst": float(np.exp(logs.max())), "seeds": len(logs),
    }  # fmt: skip


def losses_of(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the factor of each of `LOSSES` in a trial; their product is the filter's error over that of the batch."""
    errors = row["position_rms_m"]
    names = [name for name, _ in LADDER]
    return {
        loss: _ratio(errors[after], errors[before])
        for loss, before, after in zip(LOSSES, names[:-1], names[1:], strict=True)
    }  # fmt: skip


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Line]:
    """Return one line per condition, in the order of first occurrence.

    Returns:
        The fields of `CONDITION`, `seeds`; `position_rms_m` and `end_error_m` of each estimate, `losses` by name,
        `filter_over_batch`, `filter_over_ideal_online` and `map_over_batch`: geometric means over the seeds as in
        `geometric_mean`; `worst_seed` by the filter's position error; `nees_median_filter`, `nees_median_ideal_online`
        and the fields of `OF_TRIALS`, means over the seeds.
    """
    lines = []
    for key, members in grouped(rows, CONDITION).items():
        line: Line = dict(zip(CONDITION, key, strict=True)) | {"seeds": len(members)}
        for figure in ("position_rms_m", "end_error_m"):
            line[figure] = {name: _over_seeds([row[figure][name] for row in members]) for name in ESTIMATES}
        losses = [losses_of(row) for row in members]
        line["losses"] = {loss: _over_seeds([own[loss] for own in losses]) for loss in LOSSES}
        errors = [row["position_rms_m"] for row in members]
        for name, other in (("filter_over_batch", "batch"), ("filter_over_ideal_online", "ideal_online")):
            line[name] = _over_seeds([_ratio(own["filter"], own[other]) for own in errors])
        line["map_over_batch"] = _over_seeds([_ratio(row["map_rms_m"], row["batch_map_rms_m"]) for row in members])
        line["worst_seed"] = max(members, key=lambda row: row["position_rms_m"]["filter"])["seed"]
        for name in ("ideal_online", "filter"):
            line[f"nees_median_{name}"] = _mean([row["nees_median"][name] for row in members])
        lines.append(line | {name: _mean([row[name] for row in members]) for name in OF_TRIALS})
    return lines


def tables(lines: Sequence[Line]) -> list[Table]:
    """Return the tables of the report: title, headings, rows."""
    errors, others, matches = [], [], []
    for line in lines:
        title, found = condition_name(line), line["position_rms_m"]
        factors = {name: _cell(line["losses"][loss], 2) for name, loss in LADDER[1:]}
        loss_of = dict(LADDER)
        for i, name in enumerate(ESTIMATES):
            shown = title if i == 0 else ""
            errors.append([shown, NAMES[name], _cell(found[name], 3), loss_of.get(name, ""), factors.get(name, "")])
        worst = line["filter_over_ideal_online"]["worst"]
        others.append([
            title, str(line["seeds"]), _cell(line["filter_over_ideal_online"], 2), number(worst, 2),
            _cell(line["map_over_batch"], 2), number(line["nees_median_filter"], 1),
            number(line["nees_median_ideal_online"], 1),
        ])  # fmt: skip
        matches.append([
            title, number(line["wrong_match_share"], 2, 100.0), number(line["unused_share"], 1, 100.0),
            number(line["copies_per_landmark"], 2), number(line["revisits"], 1), number(line["missed_revisits"], 2),
            number(line["map_rms_m"], 3), number(found["filter"]["worst"], 3),
            str(line["worst_seed"]), number(line["way_m"], 0),
        ])  # fmt: skip
    return [
        (
            "Position RMS and losses: geometric means over the seeds, factor over the row above",
            ["world", "estimate", "position RMS [m]", "loss", "factor"], errors,
        ),
        (
            "Filter over ideal online estimate; map over batch ML; median NEES (ideal 2.4)",
            ["world", "seeds", "filter over ideal", "worst", "map over batch", "NEES", "of ideal"], others,
        ),
        (
            "Associations, map, worst seed",
            ["world", "wrong [%]", "unused [%]", "copies", "revisits", "missed", "map RMS [m]", "worst [m]", "its seed",
             "path [m]"], matches,
        ),
    ]  # fmt: skip


def print_tables(console: Console, lines: Sequence[Line]) -> None:
    """Print the tables of the report."""
    for title, headings, rows in tables(lines):
        console.print(console_table(title, headings, rows))


def markdown(lines: Sequence[Line]) -> str:
    """Return the same tables as Markdown."""
    return "\n".join(titled_markdown(title, headings, rows) for title, headings, rows in tables(lines))


def condition_name(line: Mapping[str, Any]) -> str:
    """Return a short name of the condition of a line: what differs from the default is named."""
    name = Path(line["world"]).stem if Path(line["world"]).suffix else str(line["world"])
    parts = [f"{name}, K = {line['robots']}"]
    parts += [line["policy"]] if line["policy"] != "frontier" else []
    parts += [line["preset"]] if line["preset"] != "standard" else []
    for key, text in (("max_range", "range {:g} m"), ("baseline", "baseline {:g} m"), ("measurements", "B = {}")):
        parts += [text.format(line[key])] if line[key] is not None else []
    parts += [f"M = {line['particles']}"] if line["particles"] != 100 else []
    return ", ".join(parts)


@picture
def draw_losses(file: Path, lines: Sequence[Line]) -> None:
    """Draw a bar for each condition into a PNG file: from the error of batch ML to the filter's, loss by loss."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(9.0, 1.2 + 0.42 * len(lines)), layout="constrained")
        ax = figure.subplots()
        for place, line in enumerate(lines):
            found = {name: each["mean"] for name, each in line["position_rms_m"].items()}
            names = [name for name, _ in LADDER]
            ax.barh(place, found["batch"], color=COLOURS[0], label="information" if place == 0 else None)
            for i, loss in enumerate(LOSSES):
                before, after = found[names[i]], found[names[i + 1]]
                # A loss below 1 is drawn as a thin bar back: two changes may compensate each other.
                ax.barh(
                    place, after - before, left=before, color=COLOURS[i + 1], height=0.8 if after >= before else 0.25,
                    label=loss if place == 0 else None,
                )  # fmt: skip
            for name, mark, colour in (("odometry", "x", "black"), ("ideal_online", "|", "black")):
                label = NAMES[name] if place == 0 else None
                ax.plot(found[name], place, mark, color=colour, ms=9, mew=1.6, ls="none", label=label)
        ax.set_yticks(range(len(lines)), [condition_name(line) for line in lines])
        ax.invert_yaxis()
        ax.set_xscale("log")
        ax.set_xlim(left=0.5 * min(line["position_rms_m"]["batch"]["mean"] for line in lines))  # shows all bars
        ax.set_xlabel("position RMS [m], geometric mean over seeds")
        ax.grid(alpha=0.25, axis="x", which="both")
        figure.legend(loc="outside lower center", ncols=5, frameon=False)
        save_png(figure, file, 110)


def _over_seeds(values: Sequence[float | None]) -> dict[str, float | int | None]:
    return geometric_mean(np.array([np.nan if value is None else value for value in values], dtype=np.float64))


def _ratio(above: float | None, below: float | None) -> float:
    """Return a ratio, NaN if it is unknown."""
    return float("nan") if above is None or not below else above / below


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the known values, None without any."""
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if known else None


def _cell(interval: Mapping[str, float | int | None], digits: int) -> str:
    """Format a geometric mean with its interval."""
    text = number(interval["mean"], digits)
    if interval["low"] is None:
        return text
    return f"{text} ({number(interval['low'], digits)}-{number(interval['high'], digits)})"
