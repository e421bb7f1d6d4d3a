"""Tables of `docs/explanation/merging.md` from results of `merging.soak --json`.

    python -m studies.merging.tables benchmarks/merge_soak/*.json
    python -m studies.merging.tables benchmarks/merge_soak/both_9000.json --worst 6

The first table has the outcomes of the merges of each soak; the second, over all merges that were not forced, compares
smoothed with unsmoothed maps; the third lists the merges with the largest errors and their shares of wrong pairs.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from slam_backend.core.validation import FloatArray, argument_error, check_int
from training.episodes.runner import is_false_merge

FAR = 0.3  # error from which a merge counts as inaccurate [m]


def read_soaks(files: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the results of soaks with their names."""
    soaks = []
    for file in files:
        try:
            soak = json.loads(file.read_text())
        except (OSError, ValueError) as error:
            raise argument_error("files", "soaks of merging.soak --json", str(file), str(error)) from error
        if not isinstance(soak, dict) or not {"setting", "summary", "merges", "delays"} <= set(soak):
            raise argument_error("files", "soaks of merging.soak --json", str(file), "Give files of this command.")
        soaks.append(soak | {"name": file.stem})
    return soaks


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def fates_table(soaks: Sequence[dict[str, Any]]) -> str:
    """Return the outcomes of the merges of each soak."""
    head = (
        "soak", "runs", "in one group", "merges", "false", "in force 200 steps later", "still off at the end",
        "right ones undone", "false ones undone, after", "RMS, then 200 steps later [m]", "put off",
    )  # fmt: skip
    rows = []
    for soak in soaks:
        seen, after = soak["summary"], soak["summary"]["steps_until_undone_median"]
        undone = f"{seen['false_merges_undone']} of {seen['false_merges']}"
        rows.append(
            (
                soak["name"], seen["runs"], seen.get("runs_in_one_group", "-"), seen["merges"],
                seen["false_merges"], seen["false_merges_in_force"],
                seen["false_at_the_end"],
                f"{seen['right_merges_undone']} of {seen['right_merges']}",
                undone if after is None else f"{undone}, {after:.0f} steps",
                " ".join(f"{_number(seen[name]):.3f}" for name in ("rms_error_m", "rms_error_after_the_window_m")),
                seen["refused_once_straight"],
            )
        )  # fmt: skip
    return table(head, rows)


def own_merges(soaks: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the merges that were not forced."""
    return [merge for soak in soaks if not soak["setting"]["forced"] for merge in soak["merges"]]


def straight_table(merges: Sequence[dict[str, Any]]) -> str:
    """Return the errors of merges of smoothed and of unsmoothed maps, for merges with both values."""
    both = [merge for merge in merges if merge["bent_m"] is not None]
    rows = []
    for name, prefix in (("unsmoothed", "bent"), ("smoothed", "error")):
        metres, degrees = (np.array([merge[f"{prefix}_{unit}"] for merge in both]) for unit in ("m", "deg"))
        rows.append((name, *_spread(metres), sum(map(is_false_merge, metres.tolist(), degrees.tolist()))))
    head = (f"maps of {len(both)} merges", "RMS [m]", "95 %", "worst", f"beyond {FAR} m", "false")
    return table(head, rows)


def worst_table(merges: Sequence[dict[str, Any]], count: int) -> str:
    """Return the given number of merges with the largest errors."""
    rows = []
    for merge in sorted(merges, key=lambda merge: -float(merge["error_m"]))[:count]:
        later = "undone" if merge["later_m"] is None else f"{merge['later_m']:.2f} m, {merge['later_deg']:.1f}°"
        groups = " with ".join("+".join(map(str, merge[side])) for side in ("robots_a", "robots_b"))
        wrong = "-" if merge["wrong_pairs"] is None else f"{merge['wrong_pairs']:.0%}"
        made = f"{merge['step']}: {merge['error_m']:.2f} m, {merge['error_deg']:.1f}°"
        rows.append((merge["seed"], merge["world"], groups, made, later, wrong))
    head = ("seed", "world", "robots", "step, error", "200 steps later, or at the end", "wrong pairs")
    return table(head, rows)


def _spread(metres: FloatArray) -> tuple[str, str, str, int]:
    """Return root mean square, 95 % quantile, maximum, and the number of large errors."""
    if not len(metres):
        return "-", "-", "-", 0
    squared = float(np.sqrt(np.mean(metres**2)))
    far = int(np.count_nonzero(metres > FAR))
    return f"{squared:.3f}", f"{np.quantile(metres, 0.95):.2f}", f"{metres.max():.2f}", far


def _number(value: float | None) -> float:
    """Return NaN for a JSON null."""
    return float("nan") if value is None else value


def main(
    files: Annotated[list[Path], typer.Argument(help="Files of merging.soak --json.")],
    worst: Annotated[int, typer.Option(help="Number of merges with the largest errors.")] = 6,
) -> None:
    """Print the tables."""
    check_int("worst", worst, 0, "Use 0 for none.")
    soaks = read_soaks(files)
    merges = own_merges(soaks)
    print(fates_table(soaks), straight_table(merges), worst_table(merges, worst), sep="\n\n")


if __name__ == "__main__":
    typer.run(main)
