"""Repetition of finished episodes: the same bits on the same machine, the same means elsewhere."""

import datetime
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.files import append_text
from training.bench.exploration.machine import machine
from training.bench.exploration.report import label
from training.experiments.statistics import format_ci, grouped, mean_ci

VERIFIED_FILE = "verified.jsonl"
Rows = Sequence[Mapping[str, Any]]
HEADINGS = ("policy", "played again", "equal", "different", "other machine", "E [cm], again minus stored")


def choose(rows: Rows, count: int, rng: np.random.Generator) -> list[Mapping[str, Any]]:
    """Return up to `count` random rows of each policy."""
    found: list[Mapping[str, Any]] = []
    for own in grouped(rows, ("policy",)).values():
        found += [own[i] for i in sorted(rng.choice(len(own), min(count, len(own)), replace=False))]
    return found


def compare(stored: Mapping[str, Any], again: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored row's comparison with its repetition.

    `is_equal` is None where processor or versions differ, so that last bits may, too.
    """
    comparable = stored["machine"] == machine()
    return {
        "policy": stored["policy"], "is_equal": stored["digest"] == again["digest"] if comparable else None,
        "digest": stored["digest"], "again": again["digest"], "machine": machine(), "stored_on": stored["machine"],
        "map_error": stored["map_error"], "map_error_again": again["map_error"],
    }  # fmt: skip


def keep(folder: Path, comparison: Mapping[str, Any], trial: Mapping[str, Any]) -> None:
    """Append a comparison, with its trial and the date, to the run folder."""
    line = {"date": datetime.date.today().isoformat(), **trial, **comparison}
    append_text(folder / VERIFIED_FILE, json.dumps(line) + "\n", "verify")


def table_rows(comparisons: Rows) -> list[list[str]]:
    """Return the cells of a table of `HEADINGS`, a row per policy."""
    found = []
    for (policy,), own in grouped(comparisons, ("policy",)).items():
        counts = [sum(row["is_equal"] is value for row in own) for value in (True, False, None)]
        more = [row["map_error_again"] - row["map_error"] for row in own]
        found.append([label(policy), str(len(own)), *map(str, counts), format_ci(mean_ci("E", more), "E", 2, 100.0)])
    return found


def equal_rows(folder: Path) -> dict[str, tuple[int, int]]:
    """Return the numbers of equal and different rows of each policy's last verification date in a run folder."""
    file = folder / VERIFIED_FILE
    lines = [json.loads(text) for text in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    found: dict[str, tuple[int, int]] = {}
    for (policy,), own in grouped(lines, ("policy",)).items():
        last = [row for row in own if row["date"] == max(line["date"] for line in own)]
        found[policy] = sum(row["is_equal"] is True for row in last), sum(row["is_equal"] is False for row in last)
    return found
