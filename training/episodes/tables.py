"""Final output of runs and replays: rows of `metrics.json` on merges and consistency, tables, and map files."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from training.experiments.output.tables import (
    ATE_NOTE,
    E_SCALE,
    MAPS_NOTE,
    NIS_NOTE,
    console_table,
    heading,
    in_words,
    number,
)

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from slam_backend.fastslam.consistency import Consistency
    from slam_backend.maps.landmark_map import LandmarkMap
    from slam_backend.team.reports import PairAttempts
    from training.experiments.run_folder import RunFolder
    from vslam_env.navigation import OccupancyGrid

# Metrics in the columns of the tables, with their digits
MAPS = {"map_error": 3, "map_rmse_m": 3, "map_recall": 1, "map_precision": 1}
PATHS = {
    "ate_aligned_m": 3, "dead_reckoning_ate_aligned_m": 3, "ate_start_m": 3, "dead_reckoning_ate_start_m": 3,
    "path_m": 1, "dead_reckoning_end_percent": 1,
}  # fmt: skip
CONSISTENCY = {"nis_mean": 2, "nis_share": 1, "ess_share": 1, "rejected_share": 1}

MISSED = {
    "translation": "The standard deviation of the translation exceeded its bound.",
    "rotation": "The standard deviation of the rotation exceeded its bound.",
    "one match": "Removing one match would have changed the result by more than the bound.",
    "paths": "The uncertainty of the paths left the transform between the starts uncertain beyond the bound.",
}
MAP_FILES = (".npz", ".csv", ".ply")


def print_tables(console: Console, metrics: Mapping[str, Any]) -> None:
    """Print the metrics of robots and team, a row for each, then the merges; columns without values are omitted."""
    lines = [(str(row.get("robot", robot)), row) for robot, row in enumerate(metrics["robots"])]
    lines += [("team", metrics["team"])] if "team" in metrics else []
    for title, columns, note in (
        ("Maps, each in its robot's start frame", MAPS, E_SCALE), ("Paths", PATHS, ATE_NOTE),
    ):  # fmt: skip
        shown = {name: n for name, n in columns.items() if any(row.get(name) is not None for _, row in lines)}
        if not set(shown) - {"path_m"}:
            console.print(f"{title}: no ground truth in this log.")
            continue
        rows = [[name, *figures(row, shown)] for name, row in lines]
        console.print(console_table(title, ("robot", *map(heading, shown)), rows))
        console.print(note)
    if metrics["merges"]:
        console.print(_merges(metrics["merges"]))
        console.print(MAPS_NOTE)
    elif len(metrics["robots"]) > 1:
        console.print("No merge.")
    print_refusals(console, metrics["refusals"])
    if len(metrics["robots"]) > 1:
        _print_groups(console, metrics)
    if metrics["coverage"] is not None:
        console.print(
            f"Coverage: {number(metrics['coverage'], 1, 100.0)} % of the floor in {metrics['duration_s']:.0f} s."
        )


def _print_groups(console: Console, metrics: Mapping[str, Any]) -> None:
    """Print the groups at the end, and the number of merge attempts."""
    groups = "; ".join(", ".join(map(str, group)) for group in metrics["groups"])
    console.print(f"Groups of robots with a common map at the end: {groups}.  Merge attempts: {metrics['attempts']}.")


def figures(row: Mapping[str, Any], columns: Mapping[str, int]) -> list[str]:
    """Return the cells of some metrics, given with their digits, in the units of their headings."""
    return [number(row[metric], digits, in_words(metric)[2]) for metric, digits in columns.items()]


def _merges(rows: list[Mapping[str, Any]]) -> Table:
    """Return the table of merges."""
    metrics = ("time_s", "robots_a", "robots_b", "landmarks", "error_m", "error_deg", "verdict")
    cells = []
    for row in rows:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        errors = number(row["error_m"], 3), number(row["error_deg"], 2)
        verdict = "false" if row["false"] else "right"
        if row["undone_s"] is not None:
            verdict += f", undone at {row['undone_s']:.1f} s"
        cells.append([f"{row['time_s']:.1f}", *sides, str(row["landmarks"]), *errors, verdict])
    title = "Merges, compared with the true transform between the start poses"
    return console_table(title, list(map(heading, metrics)), cells)


def pair_rows(
    pairs: "Sequence[PairAttempts] | None", groups: Sequence[Sequence[int]], numbers: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """Return one row for each pair of groups that attempted a merge, and for each final pair that never did.

    `apart` is whether the two share no map at the end; `last_step` counts filter steps.

    Args:
        numbers: Number of each robot; None: its index.
    """
    if pairs is None:
        return []
    group_of = {robot: group for group in groups for robot in group}

    def named(robots: Sequence[int]) -> list[int]:
        return [robot if numbers is None else numbers[robot] for robot in robots]

    rows = [
        {
            "robots_a": named(pair.robots_a), "robots_b": named(pair.robots_b), "attempts": pair.attempts,
            "refused": dict(pair.refusals), "last_reason": pair.last_reason, "last_step": pair.last_step,
            "missed": pair.missed, "excess": pair.excess,
            "apart": group_of[pair.robots_a[0]] != group_of[pair.robots_b[0]],
        }
        for pair in pairs
    ]  # fmt: skip
    tried = {frozenset((group_of[pair.robots_a[0]], group_of[pair.robots_b[0]])) for pair in pairs}
    for i, one in enumerate(groups):
        for other in groups[i + 1 :]:
            if frozenset((one, other)) not in tried:
                rows.append(_never_tried(named(one), named(other)))
    return rows


def print_refusals(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the attempts and refusals of each pair, and hints for pairs without a common map at the end."""
    from slam_backend.maps.alignment_types import HINTS

    shown = [row for row in rows if row["refused"] or not row["attempts"]]
    if not shown:
        return
    cells = []
    for row in shown:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        reasons = ", ".join(f"{reason} ({count})" for reason, count in row["refused"].items())
        cells.append([*sides, str(row["attempts"]), reasons, _last(row), "yes" if row["apart"] else "no"])
    title = "Refused merge attempts (with the factor by which a bound was missed)"
    metrics = ("robots_a", "robots_b", "attempts", "refused", "last_reason", "apart")
    console.print(console_table(title, list(map(heading, metrics)), cells))
    for reason in dict.fromkeys(row["last_reason"] for row in shown if row["apart"] and row["last_reason"]):
        console.print(f"{reason}: {HINTS[reason]}")
    for missed in dict.fromkeys(row["missed"] for row in shown if row["apart"] and row["missed"]):
        console.print(f"{missed}: {MISSED[missed]}")
    if any(not row["attempts"] for row in shown):
        console.print(f"not attempted: The robots were out of contact, or: {HINTS['too few candidates']}")


def _last(row: Mapping[str, Any]) -> str:
    """Describe the last refusal of a pair."""
    if row["last_step"] is None:
        return "not attempted"
    text = f"{row['last_reason']} at step {row['last_step']}"
    if row["missed"]:
        factor = "" if row["excess"] is None else f" {row['excess']:.1f}"
        text += f" ({row['missed']}{factor})"
    return text


def _never_tried(robots_a: list[int], robots_b: list[int]) -> dict[str, Any]:
    """Return the row of two groups without a common map that were never compared."""
    return {
        "robots_a": robots_a, "robots_b": robots_b, "attempts": 0, "refused": {}, "last_reason": "", "last_step": None,
        "missed": "", "excess": float("nan"), "apart": True,
    }  # fmt: skip


def consistency_rows(robots: Iterable[int], reports: Iterable["Consistency"]) -> list[dict[str, Any]]:
    """Return the entry `consistency` of `metrics.json`, one row for each robot, with the given numbers."""
    return [{"robot": robot} | report.to_mapping() for robot, report in zip(robots, reports, strict=True)]


def print_consistency(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the result of `consistency_rows`, with NaN as None, and each warning once."""
    cells = []
    for row in rows:
        cells.append([str(row["robot"]), *figures(row, CONSISTENCY), row["verdict"]])
    title = "Consistency: errors relative to the estimated covariances"
    console.print(console_table(title, ("robot", *map(heading, CONSISTENCY), "verdict"), cells))
    console.print(NIS_NOTE)
    texts: dict[str, list[str]] = {}
    for row in rows:
        for warning in row["warnings"]:
            texts.setdefault(warning["text"], []).append(str(row["robot"]))
    for text, robots in texts.items():
        console.print(f"Warning, robot {', '.join(robots)}: {text}")


def write_maps(
    folder: "RunFolder", maps: "Mapping[str, LandmarkMap]", grids: "Mapping[str, OccupancyGrid] | None" = None
) -> str:
    """Write each map as `map_<group>` .npz, .csv and .ply, each grid as `grid_<group>.yaml` and .pgm.

    Args:
        maps: Maps by the name of the group, each in the start frame of the group's first robot.
        grids: Occupancy grids of the first robots, by the same names.

    Returns:
        A line for the console that lists them.
    """
    from vslam_env.world import save_ros_map

    for name, landmarks in maps.items():
        for suffix in MAP_FILES:
            landmarks.save(folder.path / f"map_{name}{suffix}")
    for name, grid in (grids or {}).items():
        save_ros_map(grid, folder.path / f"grid_{name}.yaml")
    names = ", ".join(f"map_{name}" for name in maps)
    line = f"Maps as data: {names} (.npz for LandmarkMap.load, .csv, .ply)"
    return line + ("; grid_* (.yaml and .pgm for Nav2)." if grids else ".")
