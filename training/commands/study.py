"""Commands of studies: options, trials, tables, chart and report, the same for all of them."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from training.commands._options import Workers, options
from training.commands._plan import Cluster
from training.commands._progress import TrialSet, run_trial_sets
from training.commands._run_folder import Call
from training.experiments.study import Study

TRIALS_FILE = "trials.jsonl"


def command_of(study: Study[Any, Any], command: str) -> Callable[..., None]:
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


def run_program(study: Study[Any, Any]) -> None:
    """Run a study as a program with the options of its configuration; it exits as `vslam` does."""
    from training.cli import run

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command_of(study, f"study {study.name}"))
    spec = sys.modules["__main__"].__spec__
    run(app, f"python {Path(sys.argv[0]).name}" if spec is None else f"python -m {spec.name}")


def run_study(call: Call[Any], study: Study[Any, Any], workers: int = 1, cluster: str | None = None) -> None:
    """Play the trials that the run folder lacks, and write tables, chart and report.

    Raises:
        typer.Exit: With status 2 if trials failed.
    """
    from training.experiments.run_folder import plain
    from training.experiments.study_chart import draw_chart, draw_curves
    from training.experiments.tables import console_table, csv_of

    console, folder = call.begin(*study.checks(call.config))
    part = TrialSet(
        file=TRIALS_FILE, kind=study.trial, play=partial(_play, study.play, call.config),
        trials=study.trials(call.config), tell=partial(_told, study.trial), workers=workers, cluster=cluster,
    )  # fmt: skip
    (rows,) = run_trial_sets(console, folder, part, timed=study.timed)
    found = [(table, lines) for table in study.tables if (lines := table.lines(rows))]
    for table, lines in found:
        console.print(console_table(table.title, table.headings, list(map(table.cells, lines))))
        folder.write_text(f"{table.name}.csv", table.csv(lines))
    tables = {table.name: [_plain(line) for line in lines] for table, lines in found}
    call.write({"tables": tables, "trials": plain(rows)})
    folder.write_text("trials.csv", csv_of(rows))
    folder.write_text("tables.md", "\n".join(table.markdown(lines) for table, lines in found))
    if study.chart is not None:
        draw_chart(folder.path / f"{study.name}.png", study.chart, rows)
    if study.curves is not None:
        folder.write_text("curves.csv", csv_of(study.curves.lines(rows)))
        draw_curves(folder.path / "curves.png", study.curves, rows)
    call.finish()
    if part.failures:
        raise typer.Exit(2)


def _play(play: Callable[[Any, Any], Any], config: Any, trial: Any) -> dict[str, Any]:
    """Play a trial; return its row."""
    from dataclasses import asdict

    return asdict(trial) | dict(play(config, trial))


def _told(kind: type[Any], row: dict[str, Any]) -> str:
    """Return the fields of a trial that say which one it was."""
    return ", ".join(str(row[name]) for name in kind.__dataclass_fields__ if row[name] not in ("", None))


def _plain(line: dict[str, Any]) -> dict[str, Any]:
    """Return a line with the value and the interval of each estimate by name."""
    from training.experiments.study import Estimate

    plain: dict[str, Any] = {}
    for name, value in line.items():
        plain[name] = value.value if isinstance(value, Estimate) else value
        if isinstance(value, Estimate) and value.low is not None:
            plain |= {f"{name} low": value.low, f"{name} high": value.high}
    return plain
