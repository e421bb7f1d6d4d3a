"""Live figures of a running episode: a bar, the map errors, and a line for each merge."""

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from training.episodes.runner import MergeRecord, Progress

REFRESH_STEPS = 5


class LiveProgress:
    """A progress bar with figures; use it in a `with` block.

    Args:
        console: Where it is shown; lines for merges are printed there too.
        num_steps: Of the episode.
        agents: Names, in order.
    """

    def __init__(self, console: Console, num_steps: int, agents: Sequence[str]) -> None:
        self._agents = list(agents)
        self._bar = Bar(
            TextColumn("{task.fields[time]:6.1f} s"),
            BarColumn(20),
            TextColumn("E {task.fields[errors]} m"),
            TextColumn("{task.fields[coverage]:2.0f} % seen"),
            TextColumn("{task.fields[groups]} maps"),
            TimeRemainingColumn(),
            console=console,
        )
        self._task = self._bar.add_task(
            "run", total=num_steps, time=0.0, errors="-", coverage=0.0, groups=len(self._agents)
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, progress: Progress) -> None:
        """Take in one step."""
        for merge in progress.new_merges:
            self._bar.console.print(describe(merge), highlight=False)
        if progress.step % REFRESH_STEPS == 0:
            infos = [progress.infos[agent] for agent in self._agents]
            self._bar.update(
                self._task,
                completed=progress.step,
                time=progress.time,
                errors=" ".join(f"{info['map_error']:.2f}" for info in infos),
                coverage=100.0 * infos[0]["coverage"],
                groups=len({info["group"] for info in infos}),
            )


def describe(merge: MergeRecord) -> str:
    """Tell of a merge in one line."""
    sides = [", ".join(map(str, side)) for side in (merge.robots_a, merge.robots_b)]
    off = f"off by {merge.error_m:.2f} m, {merge.error_deg:.1f} deg"
    return f"{merge.time:6.1f} s  maps of {sides[0]} and {sides[1]} merged on {merge.landmarks} landmarks, {off}"
