"""The command `vslam replay stereo`: two local visual maps of one room are aligned in space, or a drive is followed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from training.commands._options import Config, Duration, Json, Out, Particles, Seed
from training.commands._run_folder import begin, finish, gather
from training.experiments.tables import console_table

COMMAND = "replay stereo"
PAIRS = Path("euroc_pairs")
WHAT = "a folder with two stereo pairs (left_img_0.png, right_img_0.png, left_img_1.png, ...) and their calibration"
DRIVE_ALONE = ("times", "duration", "particles")  # options of drives, which two pairs do not have


def replay_stereo(
    path: Annotated[
        Path | None, typer.Option(help="Folder of stereo images.", show_default=f"{PAIRS} in $VSLAM_DATA")
    ] = None,
    left: Annotated[
        str | None,
        typer.Option(
            help="Left images in the folder: a pattern (cam0/*.png), or names with commas.",
            show_default="left_img_*.png",
        ),
    ] = None,
    right: Annotated[
        str | None, typer.Option(help="Right images, in the same order.", show_default="right_img_*.png")
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            help="calib.txt of KITTI for rectified images, or two sensor.yaml of EuRoC with a comma, left first.",
            show_default="sensorLeft.yaml,sensorRight.yaml",
        ),
    ] = None,
    times: Annotated[
        str | None, typer.Option(help="File of the seconds of a drive's frames.", show_default="0.1 s apart")
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            help="File of true poses: rows of 3 x 4 matrices; of two pairs also image, quaternion w x y z, position.",
            show_default="poses_dev.txt of two pairs, if there",
        ),
    ] = None,
    max_range: Annotated[
        float | None,
        typer.Option(help="Points farther than this are dropped (m).", show_default="12 of two pairs, 40 of a drive"),
    ] = None,
    duration: Duration = None,
    particles: Particles = None,
    descriptor: Annotated[
        str | None, typer.Option(help="usurf, sift or orb; the others are shown beside it.", show_default="usurf")
    ] = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Two stereo pairs of one room: the motion between the two places. Three pairs or more: a drive in the plane.

    File names are looked up in the folder, unless they are whole paths.
    """
    from slam_backend.core.validation import bad_argument
    from slam_backend.readers.stereo_files import StereoFiles, find_pairs
    from training.commands.replay_images import replay_folder_of_images

    given: dict[str, Any] = {
        "path": path,
        "left": left,
        "right": right,
        "calibration": calibration,
        "truth": truth,
        "times": times,
    }
    given |= {
        "max_range": max_range,
        "duration": duration,
        "particles": particles,
        "descriptor": descriptor,
        "seed": seed,
    }
    values = gather(COMMAND, given, config=config, json=json, out=out, log=(PAIRS, WHAT))
    usual = StereoFiles()
    names = {key: values.get(key, getattr(usual, key)) for key in ("left", "right", "calibration")}
    count = len(find_pairs(values["path"], StereoFiles(**names))[0])
    if count > 2:
        replay_folder_of_images(values | names, out, json, COMMAND)
        return
    for name in DRIVE_ALONE:
        if name in values:
            cure = "Leave it away: two pairs are aligned in space."
            raise bad_argument(name, "a drive of three pairs or more", "a folder with two pairs", cure)
    _align(values, out, json)


def _align(values: Mapping[str, Any], out: Path | None, json: Path | None) -> None:
    """Align two pairs by each descriptor, print how well, and write the run folder."""
    import numpy as np

    from slam_backend.frontend import DESCRIPTORS
    from training.episodes.maps import write_maps
    from training.experiments.run_folder import plain
    from training.replay.image_figures import draw_matches
    from training.replay.stereo_pairs import PairsConfig, align_pairs, load_pairs, summarise_pairs

    chosen = PairsConfig.from_mapping(values)
    log = load_pairs(chosen.path, chosen.files)
    console, folder = begin(COMMAND, chosen, out)
    order = [chosen.descriptor, *(name for name in DESCRIPTORS if name != chosen.descriptor)]
    told = chosen.to_mapping() | {"seed": chosen.seed}
    results = {name: align_pairs(log, PairsConfig.from_mapping(told | {"descriptor": name})) for name in order}
    metrics = plain(summarise_pairs(results))
    known = log.poses is not None
    headings = ("descriptor", "points", "matches", "inliers", *(("error (m)", "error (degrees)") if known else ()))
    rows = []
    for name, row in metrics["alignments"].items():
        kinds = (("error_m", 3), ("error_deg", 2)) if known else ()
        errors = ["none" if row[key] is None else f"{row[key]:.{n}f}" for key, n in kinds]
        points = " + ".join(str(count) for count in row["points"])
        rows.append([name, points, str(row["matches"]), str(row["inliers"]), *errors])
    console.print(console_table("Motion between the two places", headings, rows))
    if not known:
        console.print("Errors: no ground truth in this folder.")
    main = results[chosen.descriptor]
    if not np.isnan(main.true_m):
        console.print(f"The places are {main.true_m:.2f} m and {main.true_deg:.1f} degrees apart.", highlight=False)
    if main.motion is not None:
        a, b = (
            frame.pixels[rows, :2] for frame, rows in zip(main.frames, main.motion.pairs.T, strict=True)
        )  # fmt: skip
        draw_matches(folder.path / "matches.png", *main.images, a, b, np.flatnonzero(main.motion.inliers))
    maps = {str(place): landmarks for place, landmarks in enumerate(main.maps)}
    console.print(write_maps(folder, maps), soft_wrap=True, highlight=False)
    finish(console, folder, folder.write_metrics(metrics), json)
