"""Commands of studies: options, trials, tables, chart and report, the same for all of them."""

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

from training.commands.helpers.options import Cluster, Workers, options
from training.commands.helpers.progress import TrialSet, run_trial_set
from training.commands.helpers.run_folder import Call

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.experiments.study import Claim, ResultTable, Row, Study


def command_of(study: "Study[Any, Any]", command: str) -> Callable[..., None]:
    """Return the function of a study from which typer makes a command.

    Args:
        study: The study.
        command: Name of the command in run folders.
    """
    quick = ", ".join(f"{name} {value}" for name, value in study.quick.items())

    def run(call: Call[Any], workers: Workers = 1, ray: Cluster = None) -> None:
        run_study(call, study, workers, ray)

    def run_timed(call: Call[Any]) -> None:
        run_study(call, study)

    chosen = run_timed if study.timed else run
    chosen.__doc__ = study.about
    return options(
        study.config, command, continues=True, quick=study.quick or None, quick_help=f"A short run: {quick}.",
        log=study.log,
    )(chosen)  # fmt: skip


def run_program(study: "Study[Any, Any]") -> None:
    """Run a study as a program with the options of its configuration; it exits as `vslam` does."""
    from training.cli import run

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command_of(study, f"study {study.name}"))
    spec = sys.modules["__main__"].__spec__
    run(app, f"python {Path(sys.argv[0]).name}" if spec is None else f"python -m {spec.name}")


def run_study(
    call: Call[Any], study: "Study[Any, Any]", workers: int = 1, cluster: str | None = None, check: bool = False
) -> None:
    """Play the trials that the run folder lacks, and write tables, chart and report.

    Raises:
        typer.Exit: With status 2 if trials failed, or 1 if `check` is set and a claim does not hold.
    """
    from training.experiments.machine.timing import busy_note, describe_machine
    from training.experiments.output.study_chart import draw_chart, draw_curves
    from training.experiments.output.tables import csv_of

    machine = {"machine": describe_machine()} if study.timed else {}
    console, folder = call.begin(*study.checks(call.config))
    part = TrialSet(
        kind=study.trial, play=partial(_play, study.play, call.config), trials=study.trials(call.config),
        workers=workers, cluster=cluster,
    )  # fmt: skip
    rows = study.unfold(run_trial_set(console, folder, part, timed=study.timed))
    write_tables(call, study.tables, rows, study.claims and study.claims(rows), **machine)
    if machine and (note := busy_note(machine["machine"])):
        console.print(note, soft_wrap=True)
    if study.chart is not None:
        draw_chart(folder.path / f"{study.name}.png", study.chart, rows)
    if study.curves is not None:
        folder.write_text("curves.csv", csv_of(study.curves.lines(rows)))
        draw_curves(folder.path / "curves.png", study.curves, rows)
    call.finish(check, [claim["holds"] for claim in call.metrics.get("claims", ())])
    if part.failures:
        raise typer.Exit(2)


def write_tables(
    call: Call[Any], tables: "Sequence[ResultTable]", rows: "Sequence[Row]", claims: "Sequence[Claim] | None" = None,
    **metrics: Any,
) -> None:  # fmt: skip
    """Print the tables of some rows and the claims about them, and write both with the rows into the run folder."""
    from training.experiments.output.tables import console_table, csv_of
    from training.experiments.run_folder import plain
    from training.experiments.study import Column

    found = [(table, lines) for table in tables if (lines := table.lines(rows))]
    for table, lines in found:
        print_table(call.console, table, lines)
        call.folder.write_text(f"{table.name}.csv", table.csv(lines))
    if claims:
        text = Column("", digits=2).text
        cells = [[c.text, text(c.measured), c.limits, "holds" if c.holds else "does not hold"] for c in claims]
        call.console.print(console_table("The paper's claims", ("claim", "measured", "limits", ""), cells))
        metrics["claims"] = plain_lines([claim._asdict() for claim in claims])
    by_name = {table.name: plain_lines(lines) for table, lines in found}
    call.write({"tables": by_name, **metrics, "trials": plain(rows)})
    call.folder.write_text("trials.csv", csv_of(rows))
    call.folder.write_text("tables.md", "\n".join(table.markdown(lines) for table, lines in found))


def print_table(console: Console, table: "ResultTable", lines: Sequence[dict[str, Any]]) -> None:
    """Print a table for a narrow console.

    Units and intervals are on a second line. Where there is no room, headings are folded first, then texts, and
    numbers last.
    """
    from training.experiments.output.tables import console_table

    for title, rows in table.parts(lines):
        cells = [[re.sub(r" \((\S+) \.\. (\S+)\)$", r"\n\1..\2", text) for text in row] for row in rows]
        columns = list(zip(*cells, strict=True))
        headings = [heading.replace(" [", "\n[") for heading in table.headings]
        if _width(headings, columns) > console.width:
            headings = [
                "\n".join(fill(line, _longest(heading, *texts)) for line in heading.split("\n"))
                for heading, texts in zip(headings, columns, strict=True)
            ]
        shown = console_table(title, headings, cells)
        for column, texts in zip(shown.columns[1:], columns[1:], strict=True):
            column.no_wrap = _width(headings, columns) <= console.width and not any(" " in text for text in texts)
        console.print(shown)
    if table.note:
        console.print(table.note)


def _width(headings: Sequence[str], columns: Sequence[Sequence[str]]) -> int:
    """Return the width of a table whose texts are folded at all spaces, but not its headings."""
    pairs = zip(headings, columns, strict=True)
    return 2 + sum(2 + max(_longest(*texts), *map(len, heading.split("\n"))) for heading, texts in pairs)


def _longest(*texts: str) -> int:
    """Return the length of the longest word of some texts."""
    return max((len(word) for text in texts for word in text.split()), default=1)


def _play(play: Callable[[Any, Any], Any], config: Any, trial: Any) -> dict[str, Any]:
    """Play a trial; return its row, with the error as `failed` if the policy fails."""
    from dataclasses import asdict

    from training.episodes.guard import PolicyError
    from training.experiments.trial_store import FAILED

    try:
        return asdict(trial) | dict(play(config, trial))
    except PolicyError as error:
        return asdict(trial) | {FAILED: str(error)}


def plain_lines(lines: "Sequence[Row]") -> list[dict[str, Any]]:
    """Return lines as plain values, with the value and the interval of each estimate by name."""
    from training.experiments.run_folder import plain
    from training.experiments.study import Estimate

    found: list[dict[str, Any]] = []
    for line in lines:
        found.append({})
        for name, value in line.items():
            found[-1][name] = plain(value.value if isinstance(value, Estimate) else value)
            if isinstance(value, Estimate) and value.low is not None:
                found[-1] |= {f"{name} low": value.low, f"{name} high": value.high}
    return found
