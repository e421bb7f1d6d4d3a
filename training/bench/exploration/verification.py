"""Repetition of finished episodes: the same bits with the same numerics, the same numbers up to rounding elsewhere."""

import datetime
import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.files import append_text
from slam_backend.core.text_files import read_text
from training.bench.exploration.players import label
from training.experiments.statistics import grouped
from training.experiments.study import Column, ResultTable

VERIFIED_FILE = "verified.jsonl"
Rows = Sequence[Mapping[str, Any]]
OUTCOMES = ("all bits equal", "all numbers equal", "different")
CLOSE = 1e-4  # relative difference up to which numbers count as equal where last bits may differ
CLOSE_TO_ZERO = 1e-7  # absolute one
NOT_COMPARED = ("digest", "policy_digest", "machine", "decision_ms", "decision_p99_ms", "curves")


def choose(rows: Rows, count: int, rng: np.random.Generator) -> list[Mapping[str, Any]]:
    """Return up to `count` random rows of each policy."""
    chosen: list[Mapping[str, Any]] = []
    for group in grouped(rows, ("policy",)).values():
        chosen += [group[i] for i in sorted(rng.choice(len(group), min(count, len(group)), replace=False))]
    return chosen


def compare(stored: Mapping[str, Any], again: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored row's comparison with its repetition.

    `is_equal` is None where numerics or versions differ, so that last bits may, too; `is_close` tells whether all
    results are the same there, numbers up to `CLOSE`.
    """
    comparable = stored["machine"] == again["machine"]
    return {
        "policy": stored["policy"], "is_equal": stored["digest"] == again["digest"] if comparable else None,
        "is_close": all(_close(value, again[name]) for name, value in stored.items() if name not in NOT_COMPARED),
        "is_other_policy": (stored["policy_digest"] or "") != again["policy_digest"],
        "digest": stored["digest"], "again": again["digest"], "machine": again["machine"],
        "stored_on": stored["machine"], "map_error": stored["map_error"], "map_error_again": again["map_error"],
        "more": again["map_error"] - stored["map_error"],
    }  # fmt: skip


def keep(folder: Path, comparison: Mapping[str, Any], trial: Mapping[str, Any]) -> None:
    """Append a comparison, with its trial and the date, to the run folder."""
    line = {"date": datetime.date.today().isoformat(), **trial, **comparison}
    append_text(folder / VERIFIED_FILE, json.dumps(line) + "\n", "verify")


def outcome_counts(comparisons: Rows) -> list[int]:
    """Return the numbers of comparisons with each of `OUTCOMES`: the second is found where last bits may differ."""
    outcomes = [OUTCOMES[_outcome(row)] for row in comparisons]
    return [outcomes.count(outcome) for outcome in OUTCOMES]


def last_outcomes(folder: Path) -> dict[str, list[int]]:
    """Return the `outcome_counts` of each policy's last verification date in a run folder, an episode once."""
    file = folder / VERIFIED_FILE
    text = read_text(file, "folders", "a file of comparisons") if file.is_file() else ""
    lines = [json.loads(line) for line in text.splitlines()]
    counts: dict[str, list[int]] = {}
    for (policy,), group in grouped(lines, ("policy",)).items():
        last = max(line["date"] for line in group)
        of_last = {row["digest"]: row for row in group if row["date"] == last}
        counts[policy] = outcome_counts(list(of_last.values()))
    return counts


def _outcome(comparison: Mapping[str, Any]) -> int:
    if comparison["is_equal"] is None:
        return 1 if comparison["is_close"] else 2
    return 0 if comparison["is_equal"] else 2


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
