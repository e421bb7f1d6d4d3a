"""Tables and figure of `vslam bench stereo`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from training.experiments.plotting import picture, save_png
from training.experiments.tables import number, titled_markdown

MEASURES = ("min_ms", "median_ms", "processor_ms")
NAMES = {
    "usurf": "u-SURF", "sift": "SIFT", "orb": "ORB", "sift_own": "SIFT, own keypoints", "orb_own": "ORB, own keypoints",
}  # fmt: skip

COLOURS = {"usurf": "#0072B2", "sift": "#D55E00", "orb": "#009E73"}


def markdown(result: dict[str, Any]) -> str:
    """Return all tables with content, as Markdown."""
    parts = [_speed(result["speed"])]
    for row in result["quality"]:
        per_frame = f"{row['landmarks_per_frame']:.1f} landmarks per frame"
        parts.append(_guards(f"Rendered pairs from an office, {NAMES[row['descriptor']]}: {per_frame}", row["guards"]))
    parts.append(_retrieval(result["retrieval"]))
    if "second_looks" in result:
        lines = [
            [f"{scale} x", f"{row['pairs']}", f"{100 * row['within']:.1f} %", f"{row['anees']:.2f}"]
            for scale, row in result["second_looks"].items()
        ]
        title = "Repeated views of a landmark: NEES with the default camera noise, and with twice this noise"
        headings = ["noise", "pairs of views", "within the 99.9 % gate", "ANEES of these"]
        parts.append(titled_markdown(title, headings, lines))
    for descriptor, rows in result.get("aloe", {}).items():
        parts.append(_guards(f"Aloe, {NAMES[descriptor]} (true disparities are whole pixels)", rows))
    if "chessboard" in result:
        row = result["chessboard"]
        parts.append(
            f"**Chessboard rig**: {row['pairs']} pairs, calibrated to {row['calibration_px']:.2f} px; {row['points']} "
            f"points on the board lie {row['median_squares']:.3f} squares (median) off its plane, "
            f"{row['median_percent_of_depth']:.2f} % of the depth; {100 * row['within_20th']:.1f} % lie within 0.05 "
            f"squares of it."
        )
    if "planar" in result:
        parts.append(_planar(result["planar"]))
    parts.append(_rigs(result.get("rigs", [])))
    if result.get("failed"):
        failed = [f"- {name}: {why}" for name, why in result["failed"].items()]
        parts.append("\n".join(["**Failed**", "", *failed]))
    return "\n\n".join(part.rstrip() for part in parts if part) + "\n"


def _speed(rows: Sequence[dict[str, Any]]) -> str:
    columns = ["image", "walls", "landmarks", "descriptor", "render, ms", "front end, ms", "pair, ms"]
    lines = []
    for row in rows:
        parts = [[row[part][name] for name in MEASURES] for part in ("render", "front_end")]
        parts.append([a + b for a, b in zip(*parts, strict=True)])
        times = [" / ".join(f"{value:.2f}" for value in part) for part in parts]
        size, name = f"{row['width']} x {row['height']}", NAMES[row["descriptor"]]
        lines.append([size, str(row["walls"]), f"{row['landmarks']} of {row['wanted']}", name, *times])
    return titled_markdown("Time on one thread: minimum / median wall-clock time / mean processor time", columns, lines)


def _guards(title: str, rows: Sequence[dict[str, Any]]) -> str:
    columns = ["check", "matches", "outliers > 1 px", "median error, px", "RMS of inliers, px", "bias, px"]
    lines = [
        [
            row["name"], str(row["matches"]), f"{100 * row['outliers']:.2f} %", f"{row['median_px']:.3f}",
            f"{row['rms_px']:.3f}", f"{row['bias_px']:+.3f}",
        ]
        for row in rows
    ]  # fmt: skip
    return titled_markdown(title, columns, lines)


def _retrieval(rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return ""
    angles, ratios = list(rows[0]["angles"]), list(rows[0]["ratios"])
    columns = ["walls", "descriptor", *(f"{angle} deg" for angle in angles), *(f"x {ratio}" for ratio in ratios[1:])]
    lines = []
    for row in rows:
        name = NAMES[row["descriptor"]] + (f", window {row['window']:g} m" if row["window"] else "")
        cells = [row["angles"][angle] for angle in angles] + [row["ratios"][ratio] for ratio in ratios[1:]]
        lines.append(
            [row["style"], name, *(number(cell["recall"]) + " / " + number(cell["precision"]) for cell in cells)]
        )
    title = "Retrieval by descriptor: recall / precision, by viewing angle and distance"
    return titled_markdown(title, columns, lines)


def _planar(rows: Sequence[dict[str, Any]]) -> str:
    pairs = list(dict.fromkeys(row["pair"] for row in rows))
    lines = []
    for way in dict.fromkeys(row["way"] for row in rows):
        by_pair = {row["pair"]: row for row in rows if row["way"] == way}
        right, matches = (sum(row[key] for row in by_pair.values()) for key in ("right", "matches"))
        cells = [f"{by_pair[pair]['right']} / {by_pair[pair]['matches']}" for pair in pairs]
        lines.append([NAMES[way], *cells, f"{100 * right / max(matches, 1):.0f} %"])
    return titled_markdown("Planar pairs: right matches / mutual matches", ["descriptor", *pairs, "score"], lines)


def _rigs(rows: Sequence[dict[str, Any]]) -> str:
    guards = list(rows[0]["left"]) if rows else []
    columns = ["images", "descriptor", "pairs", "matches", *(f"+ {name}" for name in guards), "points"]
    columns += ["median depth, m", "front end, ms"]
    lines = []
    for row in rows:
        counts = [f"{count:.0f}" for count in (row["matches"], *row["left"].values(), row["points"])]
        means = [number(row["depth_m"]), number(row["ms"], 1)]
        lines.append([row["rig"], NAMES[row["descriptor"]], str(row["pairs"]), *counts, *means])
    return titled_markdown("Stereo pairs with a calibration: mean number of matches after each check", columns, lines)


@picture
def draw_stereo(file: Path, result: dict[str, Any]) -> None:
    """Draw outliers after each match check, and recall by angle and by distance, into a PNG file."""
    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    guards, angles, ratios = figure.subplots(1, 3)
    for row in result["quality"]:
        names = [entry["name"] for entry in row["guards"]]
        shares = [100.0 * entry["outliers"] for entry in row["guards"]]
        name = row["descriptor"]
        guards.plot(range(len(names)), shares, marker="o", color=COLOURS[name], label=NAMES[name])
    guards.set_xticks(range(len(names)), names, rotation=25)
    guards.set_ylabel("matches with an error above 1 px [%]")
    guards.set_title("Successive match checks")
    for axes, key, label in (
        (angles, "angles", "viewing angle [degrees]"),
        (ratios, "ratios", "distance, times 2.5 m"),
    ):
        for row in result["retrieval"]:
            if row["style"] != "distinct":
                continue
            name = NAMES[row["descriptor"]] + (f", window {row['window']:g} m" if row["window"] else "")
            numbers = [float(value) for value in row[key]]
            style = {"color": COLOURS[row["descriptor"]], "ls": "--" if row["window"] else "-", "marker": "o"}
            axes.plot(numbers, [cell["recall"] for cell in row[key].values()], label=name, **style)
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel(label)
        axes.set_ylabel("recall (nearest descriptor)")
    angles.set_title("Retrieval from another angle")
    ratios.set_title("Retrieval from another distance")
    for axes in (guards, angles, ratios):
        axes.grid(alpha=0.2)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)
    save_png(figure, file, 120)
