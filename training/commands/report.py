"""Commands `vslam report` and `vslam compare`: pages about run folders."""

from pathlib import Path
from typing import Annotated

import typer

from training.commands.helpers.run_folder import claim_stdout, write_json
from training.experiments.output.console import make_console

Open = Annotated[bool, typer.Option("--open", help="Open the page in the browser.")]


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run, replay, bench, evaluation or training.")],
    show: Open = False,
) -> None:
    """Write report.html into a run folder: playback of the episode, curves and tables, in one file for any browser.

    Commands write it themselves; this repeats it, for folders of earlier versions and after a change by hand.
    """
    from training.report.page import write_report

    _finish(write_report(folder), show)


def compare(
    one: Annotated[Path, typer.Argument(help="Run folder.")],
    other: Annotated[Path, typer.Argument(help="Run folder to compare with it.")],
    out: Annotated[
        Path | None, typer.Option(help="Also write a page with tables and curves to this .html file.")
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option(
            help="Also write the differences to this file; - is stdout, with all other output on stderr.",
            show_default=False, callback=claim_stdout,
        ),
    ] = None,
    show: Open = False,
) -> None:  # fmt: skip
    """Compare two run folders: options that differ, and metrics side by side.

    Benches and evaluations with common seeds have the paired difference with its 95 % interval.
    """
    import tempfile

    from slam_backend.core.files import check_writable, write_file
    from slam_backend.core.validation import argument_error
    from training.experiments.run_folder import plain, to_json
    from training.report.comparison import compare_folders, comparison_page, print_comparison

    if out is not None:
        if out.suffix.lower() != ".html":
            raise argument_error("out", "a name that ends in .html", out, "Pages are written as HTML.")
        check_writable(out, "out")
    comparison = compare_folders(one, other)
    print_comparison(make_console(), comparison)
    if json is not None:
        write_json(json, to_json(plain(comparison.to_mapping())))
    if show and out is None:
        out = Path(tempfile.mkdtemp(prefix="vslam-")) / "compare.html"
    if out is not None:
        _finish(write_file(out, comparison_page(comparison), "out"), show)


def _finish(page: Path, show: bool) -> None:
    """Print the path of a page, and open it if requested."""
    make_console().print(f"Report: {page}", soft_wrap=True)
    if show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
