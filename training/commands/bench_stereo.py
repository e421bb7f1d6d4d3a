"""The command `vslam bench stereo`: how fast and how good the stereo eye is, rendered and real."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markdown import Markdown
from rich.markup import escape

from training.commands._options import Config, Json, Out, Seed, words
from training.commands._progress import trials_shown
from training.commands._run_folder import begin, choose, finish

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench.stereo.bench import StereoBenchConfig
    from training.bench.stereo.real_images import RealPart

COMMAND = "bench stereo"
QUICK: dict[str, Any] = {"sizes": (320,), "landmarks": (100,), "walls": (40,), "steps": 30, "views": 15}


def bench_stereo(
    steps: Annotated[int | None, typer.Option(help="Timed pairs per row.", show_default="100")] = None,
    views: Annotated[int | None, typer.Option(help="Rendered pairs for quality.", show_default="60")] = None,
    descriptors: Annotated[str | None, typer.Option(help="With commas between.", show_default="usurf,sift,orb")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One size, 30 timed pairs, 15 views.")] = False,
    real: Annotated[
        Path | None,
        typer.Option(
            help="Folder of pairs with a model file: NAMEA, NAMEB, NAME_model.txt (homography), or left and right "
            "images with calib.txt or two sensor.yaml; folders in it, too.",
            show_default="$VSLAM_DATA, if set",
        ),
    ] = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Time rendering and front end, and measure disparities, guards and descriptors on rendered and real pairs."""
    import os

    from training.bench.stereo.bench import StereoBenchConfig
    from training.bench.stereo.figures import draw_stereo
    from training.bench.stereo.tables import markdown
    from training.experiments.run_folder import plain

    given = {"steps": steps, "views": views, "descriptors": words(descriptors), "seed": seed}
    fast = QUICK if quick else None
    chosen = choose(StereoBenchConfig, COMMAND, given, config=config, json=json, out=out, quick=fast)
    data = Path(os.environ["VSLAM_DATA"]) if real is None and "VSLAM_DATA" in os.environ else real
    parts = [] if data is None or (real is None and not data.is_dir()) else _parts(data, chosen.descriptors, real)
    console, folder = begin(COMMAND, chosen, out)
    result = _run_live(console, chosen, parts)
    tables = markdown(result)
    console.print(Markdown(tables))
    folder.write_text("tables.md", tables)
    if result["quality"] and result["retrieval"]:
        draw_stereo(folder.path / "stereo.png", result)
    finish(console, folder, folder.write_metrics(plain(result)), json)
    if result.get("failed"):
        errors = Console(stderr=True, soft_wrap=True, highlight=False)
        for name, why in result["failed"].items():
            errors.print(f"[red]error[/] {escape(f'{name}: {why}')}")
        raise typer.Exit(2)


def _parts(data: Path, descriptors: Sequence[str], real: Path | None) -> "list[RealPart]":
    """Return what is to be measured of real images, and refuse a folder that was named and holds none."""
    from slam_backend.core.validation import bad_argument
    from training.bench.stereo.real_images import EXPECTED, find_parts

    if not data.is_dir():
        raise bad_argument("real", "a folder of real images", "no such folder", f"Check {str(data)!r}.")
    parts = find_parts(data, descriptors)
    if real is not None and not parts:
        raise bad_argument("real", f"a folder with {EXPECTED}", "no such files", f"Check {str(data)!r}.")
    return parts


def _run_live(console: Console, config: "StereoBenchConfig", parts: "list[RealPart]") -> dict[str, Any]:
    """Run all parts, telling of each; Ctrl-C ends after the one under way."""
    import cv2

    from training.bench.stereo.bench import run_stereo_bench
    from training.bench.stereo.real_images import measure_parts

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    with trials_shown(console, None) as (on_part, interrupted):
        result = run_stereo_bench(config, on_part, interrupted)
        measure_parts(parts, result, on_part, interrupted)
    cv2.setNumThreads(threads)
    return result
