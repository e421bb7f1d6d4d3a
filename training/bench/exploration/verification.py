"""Repetition of finished episodes: the same bits with the same numerics, the same numbers up to rounding elsewhere."""

import datetime
import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.files import append_text
from slam_backend.core.validation import argument_error
from training.bench.exploration.episodes import bounded_bytes, row_digest
from training.bench.exploration.players import label
from training.experiments.statistics import grouped
from training.experiments.study import Column, ResultTable

VERIFIED_FILE = "verified.jsonl"
Rows = Sequence[Mapping[str, Any]]
OUTCOMES = ("all bits equal", "all numbers equal", "different")
CLOSE = 1e-4  # relative difference up to which numbers count as equal where last bits may differ
CLOSE_TO_ZERO = 1e-7  # absolute one
NOT_COMPARED = ("digest", "policy_digest", "version", "machine", "decision_ms", "decision_p99_ms", "curves")
COMMAND = "vslam bench exploration --verify"  # the only one whose comparisons count
TENTH = 0.1  # share of the episodes that are played again, and that must be for a row to count as replayed


def choose(rows: Rows, count: int | None, rng: np.random.Generator) -> list[Mapping[str, Any]]:
    """Return random rows of each policy, up to a number of them; None: a tenth."""
    chosen: list[Mapping[str, Any]] = []
    for group in grouped(rows, ("policy",)).values():
        wanted = math.ceil(TENTH * len(group)) if count is None else count
        chosen += [group[i] for i in sorted(rng.choice(len(group), min(wanted, len(group)), replace=False))]
    return chosen


def compare(stored: Mapping[str, Any], again: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored row's comparison with its repetition.

    `is_equal` is None where numerics or versions differ, so that last bits may, too; `is_close` tells whether all
    results are the same, numbers up to `CLOSE`. `row` is the `row_digest` of a stored row of a plan.
    """
    comparable = stored["machine"] == again["machine"]
    return {
        "policy": stored["policy"], "is_equal": stored["digest"] == again["digest"] if comparable else None,
        "is_close": all(_close(value, again[name]) for name, value in stored.items() if name not in NOT_COMPARED),
        "is_other_policy": (stored["policy_digest"] or "") != again["policy_digest"],
        "digest": stored["digest"], "again": again["digest"], "machine": again["machine"],
        "row": row_digest(stored) if "track" in stored else None,
        "stored_on": stored["machine"], "map_error": stored["map_error"], "map_error_again": again["map_error"],
        "more": again["map_error"] - stored["map_error"],
    }  # fmt: skip


def keep(folder: Path, comparison: Mapping[str, Any], trial: Mapping[str, Any]) -> None:
    """Append a comparison, with its trial, the date and the command, to the run folder."""
    about = {"date": datetime.date.today().isoformat(), "by": f"{COMMAND} {version('vslam-env')}"}
    append_text(folder / VERIFIED_FILE, json.dumps({**about, **trial, **comparison}) + "\n", "verify")


def outcome_counts(comparisons: Rows) -> list[int]:
    """Return the numbers of comparisons with each of `OUTCOMES`: the second is found where last bits may differ."""
    outcomes = [outcome_of(row) for row in comparisons]
    return [outcomes.count(outcome) for outcome in OUTCOMES]


def outcome_of(comparison: Mapping[str, Any]) -> str:
    """Return which of `OUTCOMES` a comparison has: what a row says must be what was played, whatever its digest."""
    if comparison["is_equal"] is False or not comparison["is_close"]:
        return OUTCOMES[2]
    return OUTCOMES[1] if comparison["is_equal"] is None else OUTCOMES[0]


def replayed(folder: Path, rows: Rows, argument: str = "folders") -> dict[str, list[int]]:
    """Return the `outcome_counts` of each policy of a run folder, each of its episodes once, by its last comparison.

    A comparison counts if `COMMAND` made it, of an episode of which a row still says the same.

    Raises:
        ValueError: If the file is too large, or a line is none that the command writes; the text names it.
    """
    file = folder / VERIFIED_FILE
    lines = bounded_bytes(file, argument).decode(errors="replace").splitlines() if file.is_file() else []
    known = {(row["policy"], row["digest"], row_digest(row)) for row in rows}
    last: dict[tuple[str, str, str], Mapping[str, Any]] = {}
    for count, text in enumerate(lines, start=1):
        line = _comparison(text)
        if line is None:
            hint = f"Remove line {count} of {str(file)!r}, and play its episode again."
            raise argument_error(argument, "a comparison in each line", f"a damaged line {count}", hint)
        episode = line["policy"], line["digest"], line["row"]
        if episode in known and line["by"].startswith(COMMAND):
            last[episode] = line
    return {policy: outcome_counts(group) for (policy,), group in grouped(last.values(), ("policy",)).items()}


def _comparison(text: str) -> Mapping[str, Any] | None:
    """Return the comparison in a line, None if there is none."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not all(
        isinstance(line.get(name), str) for name in ("by", "policy", "digest", "row", "date")
    ):
        return None
    is_sound = type(line.get("is_close")) is bool and type(line.get("is_equal", "")) in (bool, type(None))
    return line if is_sound else None


def _close(stored: Any, again: Any) -> bool:
    """Return whether two results are the same, numbers up to rounding."""
    if isinstance(stored, (int, float)) and isinstance(again, (int, float)):
        return math.isclose(stored, again, rel_tol=CLOSE, abs_tol=CLOSE_TO_ZERO)
    return bool(stored == again)


def _count(outcome: int, comparisons: Rows) -> int:
    return outcome_counts(comparisons)[outcome]


TABLE = ResultTable(
    name="verified", title="Episodes played again", by=("policy",), words={"policy": ("policy", label)},
    columns=(
        Column("episodes", "played again", len, digits=0),
        *(Column(name, "", partial(_count, i), digits=0) for i, name in enumerate(OUTCOMES)),
        Column("more", "E [cm], again minus stored", digits=2, factor=100.0, interval=True),
    ),
)  # fmt: skip
