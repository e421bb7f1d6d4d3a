"""Content of a report: playback, charts, tables and pictures, read from a run folder."""

import base64
import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.text_files import read_json, read_text, read_toml
from slam_backend.core.validation import FloatArray, argument_error
from training.experiments.output.tables import ATE_NOTE, E_SCALE, MAPS_NOTE, NIS_NOTE, heading, in_words, significant
from training.experiments.policy_names import parted_label
from training.experiments.run_folder import CONFIG_FILE, METRICS_FILE
from training.report.packing import Packer
from training.report.recording import RECORDING_FILE, Recording, axes_95
from vslam_env.navigation import CELL, FREE, OCCUPIED, CandidateKind
from vslam_env.rendering.palette import robot_colour

MOST_ROWS = 2000  # of a table
MOST_PICTURES = 1_500_000  # bytes of all pictures
CELLS = 12_000_000  # of all grids of a page, as they are decoded
CURVES_FILE = "curves.csv"
NOT_TABLES = ("config", "versions")
TITLES = {  # of tables, with notes
    "robots": ("maps and paths of the robots", ATE_NOTE), "merges": ("merges", MAPS_NOTE),
    "refusals": ("merge attempts by pair of maps", "Maps are named by their robots."),
    "consistency": ("consistency of the filters", NIS_NOTE),
}  # fmt: skip
SHADES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5430", "#46464C")


@dataclass
class Content:
    """Content of a page: plain values, with arrays in a `Packer`."""

    title: str
    command: str = ""  # Command that repeats the run
    about: list[tuple[str, str]] = field(default_factory=list)  # Facts by name, shown as a list
    config: str = ""  # Text of the configuration
    episode: dict[str, Any] | None = None
    charts: list[dict[str, Any]] = field(default_factory=list)
    tables: list[dict[str, Any]] = field(default_factory=list)
    pictures: list[dict[str, str]] = field(default_factory=list)
    packer: Packer = field(default_factory=Packer)

    def to_mapping(self) -> dict[str, Any]:
        """Return the content as plain values, except the packed arrays."""
        return {
            "title": self.title, "command": self.command, "about": self.about, "config": self.config,
            "episode": self.episode, "charts": self.charts, "tables": self.tables, "pictures": self.pictures,
        }  # fmt: skip


def read_folder(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the content of `config.toml` and of `metrics.json` of a run folder; the latter may be missing.

    Raises:
        ValueError: If the folder is not a run folder, or a file is damaged.
    """
    file, metrics_file = folder / CONFIG_FILE, folder / METRICS_FILE
    if not file.is_file():
        hint = f"Check {str(folder)!r}."
        raise argument_error("folder", "the folder of a run, with config.toml", "no such folder", hint)
    config = read_toml(file, "folder")
    metrics = read_json(metrics_file, "folder", "Or remove it.") if metrics_file.is_file() else {}
    return config, metrics if isinstance(metrics, dict) else {}


def folder_content(folder: Path) -> Content:
    """Return the content of the report of a run folder.

    Raises:
        ValueError: If the folder is not a run folder, or a file is damaged.
    """
    config, metrics = read_folder(folder)
    command = str(config.get("command", ""))
    content = _begin(folder, command)
    versions = config.get("versions", {})
    content.about = [("command", command), ("seed", str(config.get("seed", "")))]
    content.about += [(name, str(versions[name])) for name in ("vslam-env", "python", "numpy") if name in versions]
    content.about += [
        (heading(name), _text(in_unit(name, value))) for name, value in metrics.items()
        if isinstance(value, int | float | str | bool) and name != "seed"
    ]  # fmt: skip
    if (folder / RECORDING_FILE).is_file():
        _add_recording(content, Recording.load(folder))
    content.charts += _curve_charts(folder / CURVES_FILE, content.packer)
    content.tables = list(_tables(metrics))
    if content.episode is None or not len(content.episode["scored"]):
        content.pictures = list(_pictures(folder))
    return content


def live_content(folder: Path, command: str, recording: Recording) -> Content:
    """Return playback and charts of an episode that still runs, for the run folder of a command."""
    content = _begin(folder, command)
    _add_recording(content, recording)
    return content


def _begin(folder: Path, command: str) -> Content:
    return Content(
        title=f"vslam {command}: {folder.resolve().name}",
        command=f"vslam {command} --config {folder / CONFIG_FILE}",
        config=read_text(folder / CONFIG_FILE, "folder"),
    )


def _add_recording(content: Content, recording: Recording) -> None:
    content.episode = _episode(recording, content.packer)
    content.charts += _episode_charts(recording, content.packer)


def _text(value: Any) -> str:
    """Return a value for the reader."""
    if value is None or value in ("", [], {}):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return significant(value)
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    if isinstance(value, Mapping) and value:
        return ", ".join(f"{key} ({_text(item)})" for key, item in value.items())
    return str(value)


# ---------------------------------------------------------------- playback


def _episode(recording: Recording, packer: Packer) -> dict[str, Any]:
    """Return the playback of a recording, with its arrays packed."""
    boxes, kept = _thinned_grids(recording)
    add, exact = packer.add, packer.add_integers
    about = recording.about
    return {
        "names": about["names"], "events": about["events"], "placed": about["placed"],
        "colours": ["#{:02x}{:02x}{:02x}".format(*robot_colour(robot)) for robot in range(len(about["names"]))],
        "kinds": {str(kind.value): kind.name.lower() for kind in CandidateKind if kind.name != "NONE"},
        "cell": CELL, "free": FREE, "occupied": OCCUPIED,
        "scored": list(recording.scores.shape) if recording.scores.size else [],
        "arrays": {
            "times": add(recording.times), "estimate": add(recording.estimate), "truth": add(recording.truth),
            "reckoned": add(recording.reckoned), "ellipses": add(axes_95(recording.covariances)),
            "frames": exact(recording.frames), "errors": add(recording.scores[..., 0]),
            "coverage": add(recording.coverage), "sights": add(recording.sights),
            "sightEnds": exact(recording.sight_ends),
            "walls": add(recording.walls), "landmarks": add(recording.landmarks),
            "keyframes": exact(recording.keyframes), "mapXY": add(recording.map_points[:, :2]),
            "mapAxes": add(recording.map_points[:, 2:4]), "mapAngles": add(recording.map_points[:, 4]),
            "mapEnds": exact(recording.map_ends), "gridValues": exact(recording.grid_values[kept]),
            "gridRuns": exact(recording.grid_runs[kept]), "gridEnds": exact(boxes[1]), "gridBoxes": add(boxes[0]),
            "starts": add(recording.starts), "candidateXY": add(recording.candidates[:, :2]),
            "candidateKinds": exact(recording.candidates[:, 2:]), "candidateEnds": exact(recording.candidate_ends),
        },
    }  # fmt: skip


def _thinned_grids(recording: Recording) -> tuple[tuple[FloatArray, Any], Any]:
    """Return boxes and ends of the grids, and which runs are kept: every n-th grid, so that pages stay small."""
    boxes, ends = recording.grid_boxes.copy(), np.asarray(recording.grid_ends, np.int64)
    areas = boxes[..., 2] * boxes[..., 3]
    stride = max(1, math.ceil(float(areas.sum()) / CELLS))
    lengths = np.diff(ends.ravel(), prepend=0).reshape(ends.shape)
    is_kept = np.zeros(ends.shape, bool)
    is_kept[::-1][::stride] = True  # with the last
    runs = np.repeat(is_kept.ravel(), lengths.ravel())
    return (boxes, np.cumsum(np.where(is_kept, lengths, 0).ravel())), runs


def parts_of_error(recording: Recording) -> dict[str, FloatArray]:
    """Return the parts of E^2 [m^2], the mean over robots, at each step (F,): they add up to the mean of E^2.

    E^2 is the mean over the true landmarks of the squared error of a held one, cut at c, and of c^2/2 for each missed
    one and each false or duplicate estimate (GOSPA with alpha 2).
    """
    half = 0.5 * float(recording.about["cutoff"]) ** 2
    errors, recalls, precisions = np.moveaxis(recording.scores[..., :3], -1, 0).astype(np.float64)
    missed = half * (1.0 - recalls)
    known = precisions > 0.0
    surplus = half * recalls * (1.0 / np.where(known, precisions, 1.0) - 1.0)
    surplus = np.where(known, surplus, np.maximum(errors**2 - missed, 0.0))  # without a match all of the rest is false
    off = np.maximum(errors**2 - missed - surplus, 0.0)
    parts = {"missed landmarks": missed, "false and duplicate ones": surplus, "position errors": off}
    return {name: part.mean(axis=1) for name, part in parts.items()}


def _episode_charts(recording: Recording, packer: Packer) -> list[dict[str, Any]]:
    """Return charts over time: map error and its parts, coverage, and pose errors with 95 % bands."""
    times, charts = packer.add(recording.times), []
    names = recording.about["names"]

    def line(name: str, values: FloatArray, **style: Any) -> dict[str, Any]:
        return {"name": name, "x": times, "y": packer.add(values), **style}

    def lines(values: FloatArray, bands: FloatArray | None = None) -> list[dict[str, Any]]:
        return [
            line(name, values[:, robot], robot=robot)
            | ({} if bands is None else {"low": packer.add(0.0 * bands[:, robot]), "high": packer.add(bands[:, robot])})
            for robot, name in enumerate(names)
        ]  # fmt: skip

    if recording.scores.size:
        charts.append({"title": "map error E", "unit": "m", "note": E_SCALE, "lines": lines(recording.scores[..., 0])})
        parts = parts_of_error(recording)
        total, stacked = np.zeros(len(recording.times)), []
        for (name, part), shade in zip(parts.items(), ("#9aa0a6", "#D55E00", "#0072B2"), strict=True):
            ends = {"low": packer.add(total), "high": packer.add(total + part)}
            stacked.append(line(name, total + part, colour=shade) | ends)
            total = total + part
        stack: dict[str, Any] = {
            "stacked": True, "title": "parts of E², mean over robots", "unit": "m²", "lines": stacked,
            "note": "The areas add up to the mean of E².",
        }  # fmt: skip
        charts.append(stack)
    if recording.coverage.size:
        whole = line("team", 100.0 * recording.coverage, colour="#46464c")
        charts.append({"title": "coverage", "unit": "%", "lines": [whole], "note": ""})
    errors = np.hypot(*np.moveaxis((recording.estimate - recording.truth)[..., :2], -1, 0))
    if np.isfinite(errors).any():
        bands = axes_95(recording.covariances)[..., 0] if recording.covariances.size else None
        note = "Bands: radius that holds the position with 95 %, as the filter claims." if bands is not None else ""
        charts.append({"title": "position error", "unit": "m", "lines": lines(errors, bands), "note": note})
    return charts


# ---------------------------------------------------------------- curves, tables, pictures


def read_curves(file: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file of curves over `time_s`; none if it is missing or has other content."""
    if not file.is_file():
        return []
    rows = list(csv.DictReader(io.StringIO(read_text(file, "folder", "a CSV file"))))
    return rows if rows and "time_s" in rows[0] else []


def _curve_charts(file: Path, packer: Packer) -> list[dict[str, Any]]:
    """Return a chart for each curve and place of a benchmark: a line for each policy, with 95 % intervals."""
    rows = read_curves(file)
    return curve_charts(rows, packer) if rows else []


def curve_charts(rows: Sequence[Mapping[str, str]], packer: Packer) -> list[dict[str, Any]]:
    """Return charts of rows of curves; columns before `time_s` name the line, the last of them its colour."""
    columns = list(rows[0])
    keys = columns[: columns.index("time_s")]
    figures = [name for name in columns[len(keys) + 1 :] if not name.endswith(("_low", "_high"))]
    places: dict[tuple[str, ...], dict[str, list[Mapping[str, str]]]] = {}
    for row in rows:
        named = [row[key] for key in keys] or [""]
        places.setdefault(tuple(named[:-1]), {}).setdefault(named[-1], []).append(row)
    order = {name: index for index, name in enumerate(dict.fromkeys(row[keys[-1]] for row in rows))} if keys else {}
    charts = []
    for where_key, own in places.items():
        where = ", ".join(f"{key} {Path(value).name}" for key, value in zip(keys, where_key, strict=False))
        for figure in figures:
            lines = []
            title, unit, factor = in_words(figure)
            for name, of_line in own.items():
                line: dict[str, Any] = {"name": label(name), "colour": SHADES[order.get(name, 0) % len(SHADES)]}
                ends = [end for end in ("", "_low", "_high") if f"{figure}{end}" in columns]
                arrays = [packer.add([factor * _number(row[f"{figure}{end}"]) for row in of_line]) for end in ends]
                line |= dict(zip(("y", "low", "high"), arrays, strict=False))
                lines.append(line | {"x": packer.add([_number(row["time_s"]) for row in of_line])})
            charts.append({"title": f"{title}: {where}" if where else title, "unit": unit, "lines": lines, "note": ""})
    return charts


def label(policy: str) -> str:
    """Return the label of a policy: the given one, or the last part of a path."""
    given, text = parted_label(policy)
    return given or (Path(text).name if "/" in text else text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _tables(metrics: Mapping[str, Any]) -> Iterable[dict[str, Any]]:
    """Yield the tables of a study, and a table for each list of rows in the metrics."""
    for name, rows in dict(metrics.get("tables") or {}).items():
        ends = [{re.sub(" (low|high)$", r"_\1", title): value for title, value in row.items()} for row in rows]
        yield table(name.replace("_", " "), "", ends)
    for name, rows in metrics.items():
        if name in NOT_TABLES or not isinstance(rows, list) or not rows:
            continue
        if all(isinstance(row, Mapping) for row in rows):
            if name == "robots" and isinstance(metrics.get("team"), Mapping):
                rows = [*rows, {"robot": "team", **metrics["team"]}]
            yield table(*TITLES.get(name, (name.replace("_", " "), "")), rows)


def table(
    title: str, note: str, rows: Sequence[Mapping[str, Any]], words: Callable[[str], tuple[str, str, float]] = in_words
) -> dict[str, Any]:
    """Return a table of rows: a metric and the ends of its interval share a column.

    Curves and columns without any value are left out.

    Args:
        words: Function that returns words, unit and factor of a column.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    shown = [
        name for name in names
        if not (name.endswith(("_low", "_high")) and name.rsplit("_", 1)[0] in names)
        and not any(isinstance(row.get(name), Mapping) and _is_long(row[name]) for row in rows)
        and any(row.get(name) not in (None, "", [], {}) for row in rows)
    ]  # fmt: skip
    columns = {name: words(name) for name in shown}
    cells = [[_cell(row, name, factor) for name, (_, _, factor) in columns.items()] for row in rows[:MOST_ROWS]]
    first = f"The first {MOST_ROWS} of {len(rows)} rows." if len(rows) > MOST_ROWS else ""
    has_error = any(row.get("map_error") is not None for row in rows)
    note = " ".join(filter(None, (first, note, E_SCALE if has_error else "")))
    return {
        "title": title,
        "note": note,
        "headings": [f"{text} [{unit}]" if unit else text for text, unit, _ in columns.values()],
        "rows": cells,
    }


def in_unit(name: str, value: Any) -> Any:
    """Return the value of a metric in the unit of its heading."""
    return _scaled(value, in_words(name)[2])


def _scaled(value: Any, factor: float) -> Any:
    return factor * value if factor != 1.0 and isinstance(value, int | float) else value


def _is_long(value: Mapping[str, Any]) -> bool:
    return any(isinstance(item, list) for item in value.values())


def as_is(name: str) -> tuple[str, str, float]:
    """Return a column's name as its words."""
    return name, "", 1.0


def _cell(row: Mapping[str, Any], name: str, factor: float) -> list[Any]:
    """Return the text of a cell, and the value by which rows are sorted."""
    value = row.get(name)
    text = _text(_scaled(value, factor))
    low, high = (_scaled(row.get(f"{name}{end}"), factor) for end in ("_low", "_high"))
    if low is not None and high is not None:
        text += f"\n({_text(low)} .. {_text(high)})"
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [text, value if is_number else None if value is None else text]


def _pictures(folder: Path) -> Iterable[dict[str, str]]:
    """Yield the pictures of a folder, as long as there is room."""
    left = MOST_PICTURES
    for file in sorted(folder.glob("*.png")):
        data = file.read_bytes()
        left -= len(data)
        if left < 0:
            return
        source = base64.b64encode(data).decode("ascii")
        yield {"title": file.stem.replace("_", " "), "source": f"data:image/png;base64,{source}"}
