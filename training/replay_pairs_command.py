"""The command `vslam replay stereo`: two local visual maps of one room are aligned in space."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from training.command_folder import begin, choose, finish
from training.command_options import Config, Json, Out, Seed

COMMAND = "replay stereo"
PAIRS = Path("euroc_pairs")
WHAT = "a folder with two stereo pairs (left_img_0.png, right_img_0.png, left_img_1.png, ...) and their calibration"


def replay_stereo(
    path: Annotated[
        Path | None, typer.Option(help="Folder of two raw stereo pairs.", show_default=f"{PAIRS} in $VSLAM_DATA")
    ] = None,
    descriptor: Annotated[
        str | None, typer.Option(help="usurf, sift or orb; the others are shown beside it.", show_default="usurf")
    ] = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Two stereo pairs of one room from two places: points, descriptors, and the motion between the cameras."""
    import numpy as np

    from slam_backend.frontend import DESCRIPTORS
    from training.figures_images import draw_matches
    from training.replay_pairs import PairsConfig, align_pairs, load_pairs, summarise_pairs
    from training.run_folder import plain

    given, place = {"path": path, "descriptor": descriptor, "seed": seed}, (PAIRS, WHAT)
    chosen = choose(PairsConfig, COMMAND, given, config=config, json=json, out=out, log=place)
    log = load_pairs(chosen.path)
    console, folder = begin(COMMAND, chosen, out)
    order = [chosen.descriptor, *(name for name in DESCRIPTORS if name != chosen.descriptor)]
    told = chosen.to_mapping() | {"seed": chosen.seed}
    results = {name: align_pairs(log, PairsConfig.from_mapping(told | {"descriptor": name})) for name in order}
    metrics = plain(summarise_pairs(results))
    table = Table(title="Motion between the two places")
    for title in ("descriptor", "points", "matches", "inliers", "error (m)", "error (degrees)"):
        table.add_column(title, justify="right")
    for name, row in metrics["alignments"].items():
        errors = ["-" if row[key] is None else f"{row[key]:.{n}f}" for key, n in (("error_m", 3), ("error_deg", 2))]
        points = " + ".join(str(count) for count in row["points"])
        table.add_row(name, points, str(row["matches"]), str(row["inliers"]), *errors)
    console.print(table)
    main = results[chosen.descriptor]
    if not np.isnan(main.true_m):
        console.print(f"The places are {main.true_m:.2f} m and {main.true_deg:.1f} degrees apart.", highlight=False)
    if main.motion is not None:
        a, b = (
            frame.pixels[rows, :2] for frame, rows in zip(main.frames, main.motion.pairs.T, strict=True)
        )  # fmt: skip
        draw_matches(folder.path / "matches.png", *main.images, a, b, np.flatnonzero(main.motion.inliers))
    finish(console, folder, folder.write_metrics(metrics), json)
