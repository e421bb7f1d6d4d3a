"""Stereo measurements: time of rendering and front end; disparities, match checks and descriptors on image pairs.

python -m studies.front_end.stereo --quick
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from slam_backend.core.validation import argument_error
from slam_backend.frontend import DESCRIPTOR_TYPES, MATCH_CHECKS, CornerOptions, FrontEndOptions, StereoFrontEnd
from slam_backend.models.camera import StereoCamera
from studies.front_end.real_images import (
    EXPECTED,
    WAYS,
    aloe_disparities,
    chessboard,
    find_images,
    match_planar,
    measure_rig,
)
from studies.front_end.rendered import ANGLES_DEG, CHECKS, RATIOS, map_wall, office_disparities, repeat_views, retrieve
from studies.front_end.scenes import Scene, panel_hall
from training.commands.study import run_program
from training.experiments.config import Descriptor, ExperimentConfig, Positive, option, setting
from training.experiments.machine.timing import time_calls
from training.experiments.study import Chart, Column, Panel, ResultTable, Row, Study
from training.experiments.trial_store import FAILED
from vslam_env.sensors.stereo.textures import STYLES, TextureConfig

BUSY = TextureConfig(polygons=20.0, posters=0.6)  # enough corners for 100 landmarks in an image
CROWDED = 2  # spacing of corners for more than 100 landmarks [px]; 4 px leave 270 corners per image
WARM_UP = 5  # number of pairs that are not timed
WINDOW = 0.6  # descriptor window of constant physical size [m]
OFFICE = "rendered office"
MIDDLE = 320, 100, 40  # width, landmarks and walls that are varied one at a time

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """Sizes and numbers. The height of images is three quarters of their width, with a constant field of view."""

    sizes: tuple[Annotated[int, Field(ge=64)], ...] = setting((320, 640), "Widths of the images [px].")
    landmarks: tuple[Positive, ...] = setting((50, 100, 200), "Numbers of landmarks per frame.")
    walls: tuple[Annotated[int, Field(ge=4)], ...] = setting((10, 40, 120), "Numbers of walls.")
    steps: int = option(100, "Number of timed pairs per row.", ge=1, hint="Use at least one pair.")
    views: int = option(
        60, "Number of rendered pairs per descriptor for the quality.", ge=1, hint="Use at least one pair."
    )
    descriptors: tuple[Descriptor, ...] = option(("usurf", "sift", "orb"), "Descriptors to compare.")
    real: str | None = option(
        None, "Folder with image pairs: NAMEA, NAMEB, NAME_model.txt (homography), or left and right images with "
        "calib.txt or two sensor.yaml; subfolders are included.", shown="$VSLAM_DATA, if set", is_path=True,
    )  # fmt: skip

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Take the images of the data folder, if it has any and no other folder is given."""
        data = Path(os.environ.get("VSLAM_DATA", "none"))
        return {"real": str(data.resolve()) if data.is_dir() and find_images(data) else None, **values}

    def check(self) -> None:
        """Refuse a folder of real images that does not exist."""
        if self.real is not None and not Path(self.real).is_dir():
            raise argument_error("real", "a folder of real images", "no such folder", f"Check {self.real!r}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One measurement; fields that its kind does not have are empty or None."""

    kind: Literal["speed", "checks", "retrieval", "repeats", "chessboard", "planar", "rig"]
    images: str = ""  # `OFFICE`, or folder or file of real images
    descriptor: str = ""  # Descriptor, or entry of `WAYS`
    check: str = ""  # Last match check, entry of `CHECKS`
    style: str = ""  # Style of the walls
    window: float | None = None  # Physical size of the descriptor window [m]; None: a constant size in pixels
    width: int | None = None  # Width of the images [px]
    wanted: int | None = None  # Wanted number of landmarks per frame
    walls: int | None = None  # Number of walls
    angle: float | None = None  # Angle of the views to those of the map [degrees]
    ratio: float | None = None  # Distance of the views over that of the map
    noise: float | None = None  # Assumed camera noise over the default one


def trials(config: Config) -> list[Trial]:
    """Return all trials: rendered pairs, then real images."""
    first, *_ = config.descriptors
    middle = (320 if 320 in config.sizes else config.sizes[0], *MIDDLE[1:])
    loads = [(*middle, descriptor) for descriptor in config.descriptors]
    loads += [(width, *middle[1:], first) for width in config.sizes if width != middle[0]]
    loads += [(middle[0], count, middle[2], first) for count in config.landmarks if count != middle[1]]
    loads += [(*middle[:2], walls, first) for walls in config.walls if walls != middle[2]]
    cases: list[tuple[str, float | None, str]] = [(descriptor, None, "distinct") for descriptor in config.descriptors]
    if "usurf" in config.descriptors:
        cases += [("usurf", WINDOW, "distinct"), *(("usurf", None, style) for style in STYLES if style != "distinct")]
    views = [*((angle, 1.0) for angle in ANGLES_DEG), *((0.0, ratio) for ratio in RATIOS if ratio != 1.0)]
    rendered = [
        *(Trial(kind="speed", width=w, wanted=n, walls=s, descriptor=descriptor) for w, n, s, descriptor in loads),
        *(
            Trial(kind="checks", images=OFFICE, descriptor=descriptor, check=check)
            for descriptor, check in product(config.descriptors, CHECKS)
        ),
        *(
            Trial(kind="retrieval", descriptor=descriptor, window=window, style=style, angle=angle, ratio=ratio)
            for (descriptor, window, style), (angle, ratio) in product(cases, views)
        ),
        *(Trial(kind="repeats", noise=noise) for noise in (1.0, 2.0)),
    ]
    return rendered + ([] if config.real is None else real_trials(Path(config.real), config.descriptors))


def real_trials(folder: Path, descriptors: Sequence[str]) -> list[Trial]:
    """Return the trials on the real images in a folder, and refuse one without any."""
    found = []
    for kind, path in find_images(folder):
        ways = {"chessboard": ("",), "planar": WAYS}.get(kind, tuple(descriptors))
        checks = CHECKS if kind == "checks" else ("",)
        found += [
            Trial(kind=kind, images=str(path), descriptor=way, check=check) for way, check in product(ways, checks)
        ]
    if not found:
        raise argument_error("real", f"a folder with {EXPECTED}", "no such files", f"Check {str(folder)!r}.")
    return found


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Measure, with one OpenCV thread; the functions that are called name the fields of the row.

    Real images that cannot be measured leave the error as `failed`.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return measured(config, trial)
    except Exception as error:  # any error of OpenCV, numpy or this package, since images are arbitrary
        if trial.images in ("", OFFICE):
            raise
        return {FAILED: f"{trial.images}: {str(error) or type(error).__name__}"}
    finally:
        cv2.setNumThreads(threads)


def measured(config: Config, trial: Trial) -> dict[str, Any]:
    """Return the row of a trial."""
    images, way = Path(trial.images), trial.descriptor
    match trial.kind:
        case "speed":
            return time_pairs(trial, config.steps, config.seed)
        case "checks" if trial.images == OFFICE:
            return office_disparities(way, config.views, config.seed).after(trial.check)
        case "checks":
            return aloe_disparities(images, way).after(trial.check)
        case "retrieval":
            known, gate = map_wall(way, trial.window, trial.style, config.seed), DESCRIPTOR_TYPES[way].gate
            return retrieve(known, gate, trial.angle or 0.0, trial.ratio or 1.0, config.seed)
        case "repeats":
            return repeat_views(config.seed, trial.noise or 1.0)
        case "chessboard":
            return chessboard(images)
        case "planar":
            return match_planar(images, way)
        case "rig":
            return measure_rig(images, way)


def camera_of(width: int) -> StereoCamera:
    """Return the default camera with another image width and the same field of view."""
    return StereoCamera(focal_px=float(width), width=width, height=3 * width // 4)


def time_pairs(trial: Trial, steps: int, seed: int) -> dict[str, Any]:
    """Time rendering and front end on one thread.

    Returns:
        Number of `landmarks`, and for `render` and `front_end` the least and the median wall-clock time, and the mean
        processor time, which other load does not affect.
    """
    assert trial.width is not None
    assert trial.wanted is not None
    assert trial.walls is not None
    camera, descriptor = camera_of(trial.width), trial.descriptor
    scene = Scene(panel_hall(trial.walls), camera, seed, BUSY)
    spacing = CROWDED if trial.wanted > 100 else CornerOptions().spacing
    corners = CornerOptions(most=round(2.6 * trial.wanted), spacing=spacing)
    options = FrontEndOptions(descriptor=descriptor, corners=corners, max_measurements=trial.wanted)  # type: ignore[arg-type]
    front_end, rng = StereoFrontEnd(camera, options), np.random.default_rng(seed)
    pose = np.array([1.5, 3.0, 0.5])
    view = scene.look(pose, rng)
    row: dict[str, Any] = {"landmarks": len(front_end.measure(view.left, view.right).measurements)}
    calls: dict[str, Callable[[Any], Any]] = {
        "render": lambda _: scene.look(pose, rng), "front_end": lambda _: front_end.measure(view.left, view.right)
    }  # fmt: skip
    for name, call in calls.items():
        time_calls(call, range(WARM_UP))
        begin = time.process_time()
        seconds, _ = time_calls(call, range(steps))
        row |= {
            f"{name}_least_ms": 1e3 * float(seconds.min()), f"{name}_ms": 1e3 * float(np.median(seconds)),
            f"{name}_processor_ms": 1e3 * (time.process_time() - begin) / steps,
        }  # fmt: skip
    return row


# ---------------------------------------------------------------------- results


def table(kind: str, title: str, by: Sequence[str], *columns: Column, pooled: Sequence[str] = ()) -> ResultTable:
    """Return the table of a kind of trials."""
    return ResultTable(
        name=kind, title=title, by=tuple(by), columns=columns, pooled=tuple(pooled),
        where=lambda row: row["kind"] == kind,
        words={
            "images": ("images", lambda path: path if path == OFFICE else Path(path).name),
            "window": ("window [m]", lambda size: "" if size is None else f"{size:g}"),
            "width": ("width [px]", str), "wanted": ("wanted landmarks", str), "angle": ("angle [°]", str),
            "ratio": ("distance", lambda ratio: f"x {ratio:g}"), "noise": ("noise", lambda noise: f"x {noise:g}"),
        },
    )  # fmt: skip


def share(name: str, heading: str, digits: int = 1) -> Column:
    """Return the column of a share."""
    return Column(name, heading, digits=digits, factor=100.0)


def _score(rows: Sequence[Row]) -> float:
    """Return the share of right matches."""
    return float(sum(row["right"] for row in rows) / max(sum(row["matches"] for row in rows), 1))


RECALL, PRECISION = Column("recall", "recall", digits=2), Column("precision", "precision", digits=2)

STUDY = Study(
    name="stereo",
    about="""Time rendering and the front end, and evaluate disparities, match checks and descriptors on image pairs.

    One process with one thread, for comparable times. Real images that cannot be measured are left out, with status 2
    at the end. Ctrl-C finishes the current measurement; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=lambda config: (lambda: trials(config),),
    timed=True,
    quick={"sizes": (320,), "landmarks": (100,), "walls": (40,), "steps": 30, "views": 15},
    tables=(
        table(
            "speed", "Time on one thread: least and median wall-clock time, mean processor time",
            ("width", "walls", "wanted", "descriptor"), Column("landmarks", digits=0),
            *(
                Column(f"{part}_{end}", f"{part.replace('_', ' ')}{words} [ms]", digits=2)
                for part in ("render", "front_end")
                for end, words in (("least_ms", ", least"), ("ms", ""), ("processor_ms", ", processor"))
            ),
        ),
        table(
            "checks", "Matches that remain after each match check", ("images", "descriptor", "check"),
            Column("matches", digits=0), share("outlier_share", "outliers > 1 px [%]", 2),
            Column("median_px", "median error [px]"), Column("rms_px", "RMS of inliers [px]"),
            Column("bias_px", "bias [px]"),
        ),
        table(
            "retrieval", "Retrieval by descriptor, by viewing angle and distance",
            ("style", "descriptor", "window", "angle", "ratio"), RECALL, PRECISION,
        ),
        table(
            "repeats", "Repeated views of a landmark: NEES with the default camera noise, and with twice this noise",
            ("noise",), Column("pairs", "pairs of views", digits=0), share("within", "within the 99.9 % gate [%]"),
            Column("anees", "ANEES of these", digits=2),
        ),
        table(
            "chessboard", "Chessboard rig: points on the board off its plane", ("images",), Column("pairs", digits=0),
            Column("calibration_px", "calibrated to [px]", digits=2), Column("points", digits=0),
            Column("median_squares", "median [squares]"),
            Column("median_percent_of_depth", "median [% of the depth]", digits=2),
            share("within_20th", "within 0.05 squares [%]"),
        ),
        table(
            "planar", "Planar pairs: right matches of mutual ones", ("images", "descriptor"),
            Column("right", "right", "sum", digits=0), Column("matches", "mutual", "sum", digits=0),
            Column("score", "score [%]", _score, digits=0, factor=100.0), pooled=("images",),
        ),
        table(
            "rig", "Stereo pairs with a calibration: mean number of matches after each check",
            ("images", "descriptor"),
            *(Column(name, name, digits=0) for name in ("pairs", "matches", *MATCH_CHECKS, "points")),
            Column("depth_m", "median depth [m]", digits=2), Column("ms", "front end [ms]", digits=1),
        ),
    ),
    chart=Chart(
        x="angle", label="viewing angle [°]", by="descriptor",
        where=lambda row: row["style"] == "distinct" and row["window"] is None and row["ratio"] == 1.0,
        words={"descriptor": ("descriptor", {"usurf": "u-SURF", "sift": "SIFT", "orb": "ORB"}.__getitem__)},
        panels=(Panel(column=RECALL, limits=(0.0, 1.02)), Panel(column=PRECISION, limits=(0.0, 1.02))),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
