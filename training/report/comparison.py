"""Comparison of two run folders: options that differ, and metrics side by side, paired over common seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from slam_backend.core.validation import argument_error
from training.experiments.output.tables import console_table, heading, in_words, number
from training.experiments.run_folder import plain
from training.experiments.statistics import interval
from training.report.content import (
    CURVES_FILE,
    Content,
    as_is,
    curve_charts,
    in_unit,
    label,
    read_curves,
    read_folder,
    table,
)
from training.report.packing import Packer
from training.report.page import render
from training.report.recording import RECORDING_FILE, SCORES, Recording

# Fields of trials and rows that say what was run; all other numbers are metrics.
KEYS = (
    "policy", "world", "family", "extent", "robots", "oracle", "preset", "sensor", "max_range", "baseline", "method",
    "association", "length", "measurements", "particles", "landmarks", "proposal", "lookalikes", "noise_factor",
    "landmark_noise", "case", "kind", "overlap", "outliers", "mode", "regime", "robot", "seed",
)  # fmt: skip
ROW_LISTS = ("trials", "summary", "policies", "rows")  # lists of rows in metrics.json, the first found is compared
Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A metric in two folders: means over common seeds, or the values of two runs."""

    where: str  # World, policy and other values of the compared trials; "" if there is one kind
    metric: str
    one: float | None
    other: float | None
    difference: float | None  # Other minus one
    low: float | None = None  # Lower end of its 95 % interval
    high: float | None = None  # Upper end of its 95 % interval
    seeds: int | None = None  # Number of common seeds


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Comparison of two run folders."""

    folders: tuple[Path, Path]
    names: tuple[str, str]
    options: tuple[tuple[str, str, str], ...]  # Names and both values of the options that differ
    differences: tuple[Difference, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values."""
        options = [dict(zip(("option", "one", "other"), row, strict=True)) for row in self.options]
        return {"folders": self.folders, "options": options, "differences": [asdict(row) for row in self.differences]}


def compare_folders(one: Path, other: Path) -> Comparison:
    """Compare two run folders.

    Raises:
        ValueError: If one is not a run folder, or they have no metric in common.
    """
    (config_a, metrics_a), (config_b, metrics_b) = read_folder(one), read_folder(other)
    names = one.resolve().name, other.resolve().name
    if names[0] == names[1]:
        names = str(one), str(other)
    sides = [_options(config) for config in (config_a, config_b)]
    options = tuple(
        (name, sides[0].get(name, "-"), sides[1].get(name, "-"))
        for name in dict.fromkeys([*sides[0], *sides[1]])
        if sides[0].get(name) != sides[1].get(name)
    )
    differences = _differences(metrics_a, metrics_b)
    if not differences:
        got = f"a run of {config_a.get('command')!r} and one of {config_b.get('command')!r}"
        raise argument_error("folders", "two run folders with metrics in common", got, "Compare runs of one command.")
    return Comparison(folders=(one, other), names=names, options=options, differences=tuple(differences))


def _options(config: Mapping[str, Any]) -> dict[str, str]:
    """Return command, seed, options and versions as texts."""
    options = {name: str(config.get(name)) for name in ("command", "seed")}
    options |= {str(name): str(value) for name, value in config.get("config", {}).items()}
    return options | {f"version of {name}": str(value) for name, value in config.get("versions", {}).items()}


def _differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Difference]:
    """Compare rows of trials if both have them, else the metrics of a run."""
    for name in ROW_LISTS:
        rows = [[row for row in side.get(name) or () if isinstance(row, Mapping)] for side in (one, other)]
        if all(rows):
            return _compare_rows(*rows)
    sides = [_of_run(side) for side in (one, other)]
    return [_plain_difference("", name, sides[0][name], sides[1][name]) for name in sides[0] if name in sides[1]]


def _of_run(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics of a run as means over its robots, with those of the team."""
    robots = [row for row in metrics.get("robots") or () if isinstance(row, Mapping)]
    means: dict[str, float] = {}
    for name in dict.fromkeys(name for row in robots for name in row if name not in KEYS):
        values = [row[name] for row in robots if _is_number(row.get(name))]
        if values:
            means[name] = float(np.mean(values))
    return means | {name: float(value) for name, value in metrics.items() if _is_number(value) and name not in KEYS}


def _compare_rows(one: Rows, other: Rows) -> list[Difference]:
    """Compare rows that agree in what was run, except in what has one value in each folder, such as the policy."""
    keys = [name for name in KEYS if all(name in row for row in (*one, *other))]
    values = {name: [{str(row[name]) for row in side} for side in (one, other)] for name in keys}
    telling = [name for name, (a, b) in values.items() if len(a) == len(b) == 1 and a != b]
    keys = [name for name in keys if name not in telling and name != "seed"]
    sides = [_grouped(side, keys) for side in (one, other)]
    metrics = [name for name, value in one[0].items() if name not in KEYS and not name.endswith(("_low", "_high"))]
    shown = [name for name in keys if len(values[name][0] | values[name][1]) > 1]
    lines = []
    for key, rows in sides[0].items():
        if key not in sides[1]:
            continue
        where = ", ".join(label(value) if name in ("policy", "world") else f"{name} {value}"
                          for name, value in zip(keys, key, strict=True) if name in shown)  # fmt: skip
        for name in metrics:
            own, others = (
                {
                    row.get("seed", index): float(row[name])
                    for index, row in enumerate(side)
                    if _is_number(row.get(name))
                }
                for side in (rows, sides[1][key])
            )
            common = sorted(own.keys() & others.keys())
            if not common:
                continue
            more = np.array([others[seed] - own[seed] for seed in common])
            low, high = interval(more, np.mean)
            means = (float(np.mean([side[seed] for seed in common])) for side in (own, others))
            line = _plain_difference(where, name, *means)
            lines.append(Difference(**asdict(line) | {"low": low, "high": high, "seeds": len(common)}))
    return lines


def _grouped(rows: Rows, keys: Sequence[str]) -> dict[tuple[str, ...], list[Mapping[str, Any]]]:
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(str(row[name]) for name in keys), []).append(row)
    return groups


def _plain_difference(where: str, metric: str, one: float, other: float) -> Difference:
    return Difference(where=where, metric=metric, one=one, other=other, difference=other - one)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def print_comparison(console: Console, comparison: Comparison) -> None:
    """Print the options that differ, and a table of the metrics for each thing that was run."""
    one, other = comparison.names
    if comparison.options:
        console.print(console_table("Options that differ", ("option", one, other), comparison.options))
    else:
        console.print("All options are equal.")
    for where in dict.fromkeys(row.where for row in comparison.differences):
        rows = [row for row in comparison.differences if row.where == where]
        cells = [
            [heading(row.metric), *(_number(row, each) for each in (row.one, row.other, row.difference)), _ends(row)]
            for row in rows
        ]
        seeds = {row.seeds for row in rows if row.seeds is not None}
        columns = ["", one, other, "difference", f"95 % over {max(seeds)} seeds" if seeds else ""]
        if not seeds:
            cells, columns = [row[:-1] for row in cells], columns[:-1]
        console.print(console_table(where or "Metrics", columns, cells))


def _ends(row: Difference) -> str:
    return "-" if row.low is None else f"{_number(row, row.low)} .. {_number(row, row.high)}"


def _number(row: Difference, value: float | None) -> str:
    return number(value, 3, in_words(row.metric)[2])


def comparison_page(comparison: Comparison) -> str:
    """Return a page with the comparison, and with the curves of both folders in common charts."""
    one, other = comparison.names
    content = Content(title=f"{one} and {other}")
    content.command = "vslam compare " + " ".join(map(str, comparison.folders))
    content.charts = _charts(comparison, content.packer)
    options = [{"option": name, one: a, other: b} for name, a, b in comparison.options]
    rows = [
        {
            "run": row.where, "metric": heading(row.metric),
            **{
                name: in_unit(row.metric, value)
                for name, value in (
                    (one, row.one), (other, row.other), ("difference", row.difference),
                    ("difference_low", row.low), ("difference_high", row.high),
                )
            },
            "seeds": row.seeds,
        }
        for row in comparison.differences
    ]  # fmt: skip
    unused = [name for name in ("run", "seeds") if all(row[name] in ("", None) for row in rows)]
    rows = [{name: value for name, value in row.items() if name not in unused} for row in rows]
    content.tables = [table("metrics", "", plain(rows), as_is)] + (
        [table("options that differ", "", options, as_is)] if options else []
    )
    return render(content)


def _charts(comparison: Comparison, packer: Packer) -> list[dict[str, Any]]:
    """Return the curves of both folders over time: of recordings, and of benches."""
    colours = ("#0072B2", "#D55E00")
    charts: list[dict[str, Any]] = []
    if all((folder / RECORDING_FILE).is_file() for folder in comparison.folders):
        curves = [_mean_curves(Recording.load(folder)) for folder in comparison.folders]
        for title, unit in (("map error E, mean over robots", "m"), ("coverage", "%"), ("position error, mean", "m")):
            lines = [
                {"name": name, "colour": colour, "x": packer.add(own["times"]), "y": packer.add(own[title])}
                for name, colour, own in zip(comparison.names, colours, curves, strict=True) if title in own
            ]  # fmt: skip
            if lines:
                charts.append({"title": title, "unit": unit, "lines": lines, "note": ""})
    rows = [read_curves(folder / CURVES_FILE) for folder in comparison.folders]
    if all(rows) and rows[0][0].keys() == rows[1][0].keys() and "policy" in rows[0][0]:
        named = [
            {**row, "policy": f"{name}: {label(row['policy'])}"}
            for name, own in zip(comparison.names, rows, strict=True) for row in own
        ]  # fmt: skip
        charts += curve_charts(named, packer)
    return charts


def _mean_curves(recording: Recording) -> dict[str, Any]:
    """Return curves of a recording by title."""
    curves: dict[str, Any] = {"times": recording.times}
    if recording.scores.size:
        errors = recording.scores[..., SCORES.index("map_error")]
        curves |= {"map error E, mean over robots": errors.mean(axis=1), "coverage": 100.0 * recording.coverage}
    off = np.hypot(*np.moveaxis((recording.estimate - recording.truth)[..., :2], -1, 0))
    if np.isfinite(off).any():
        curves["position error, mean"] = off.mean(axis=1)
    return curves
