"""How often particles were drawn anew in a replay, and why not."""

import re
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.fastslam.reports import RejuvenationReport

NUMBER = re.compile(r"\d+(\.\d+)?")


class RejuvenationCount:
    """Attempts by what came of them."""

    def __init__(self) -> None:
        self._reasons: Counter[str] = Counter()

    def add(self, report: "RejuvenationReport | None") -> None:
        """Count an attempt; None: there was none. Reasons that differ in their numbers alone are one."""
        if report is not None:
            self._reasons[NUMBER.sub("n", report.reason)] += 1

    def to_mapping(self) -> dict[str, Any]:
        """Return how often particles were `drawn`, and `refused`: by reason how often they were not."""
        refused = {reason: count for reason, count in sorted(self._reasons.items()) if reason}
        return {"drawn": self._reasons[""], "refused": refused}


def sentence_of(counts: Mapping[str, Any]) -> str:
    """Return a line that tells what `to_mapping` gave; "" if nothing was attempted."""
    refused = "; ".join(f"{reason} ({count})" for reason, count in counts["refused"].items())
    if not counts["drawn"] and not refused:
        return ""
    return f"Particles were drawn anew {counts['drawn']} times" + (f", and not, for: {refused}." if refused else ".")
