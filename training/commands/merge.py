"""Command `vslam merge`: two landmark maps from files, of unknown relative frame."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.commands.helpers.options import Json, naming
from training.commands.helpers.run_folder import write_json
from training.experiments.output.console import make_console

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from slam_backend.maps.alignment_types import Alignment
    from slam_backend.maps.landmark_map import LandmarkMap

REFUSED = 3  # exit status where maps are not merged


def merge(
    one: Annotated[Path, typer.Argument(help="Map, .npz of this project.")],
    other: Annotated[Path, typer.Argument(help="Map that is moved into the frame of the first.")],
    out: Annotated[
        Path, typer.Option(help="File of the merged map, .npz, .csv or .ply; a picture goes beside it.")
    ] = Path("merged.npz"),
    min_inliers: Annotated[int, typer.Option(help="Fewest common landmarks.", min=3)] = 8,
    appearance: Annotated[bool, typer.Option(help="Whether descriptors decide which landmarks may be equal.")] = True,
    json: Json = None,
) -> None:  # fmt: skip
    """Align two landmark maps from files and merge them, or say why not.

    Prints the motion from the second map to the first with its standard deviations. If the maps are not aligned, it
    prints the reason, writes no map, and exits with status 3.
    """
    from slam_backend.core.files import check_writable
    from slam_backend.maps.alignment import AlignmentOptions, align_maps
    from slam_backend.maps.fusion import fuse_maps
    from slam_backend.maps.landmark_map import LandmarkMap, check_suffix
    from training.experiments.output.map_figure import draw_maps
    from training.experiments.run_folder import plain, to_json

    check_suffix(out, "out")
    check_writable(out, "out")
    with naming(path="one"):
        map_a = LandmarkMap.load(one)
    with naming(path="other"):
        map_b = LandmarkMap.load(other)
    found = align_maps(map_a, map_b, options=AlignmentOptions(min_inliers=min_inliers, appearance=appearance))
    console, picture = make_console(), out.with_suffix(".png")
    console.print(described(found, map_a, map_b), soft_wrap=True)
    if json is not None:
        write_json(json, to_json(plain(metrics(found))))
    draw_maps(picture, map_a, map_b, found)
    console.print(f"Picture: {picture}", soft_wrap=True)
    if not found.success:
        raise typer.Exit(REFUSED)
    merged = fuse_maps(map_a, map_b, found)
    merged.save(out)
    console.print(f"Map of {len(merged)} landmarks: {out}", soft_wrap=True)


def described(found: "Alignment", map_a: "LandmarkMap", map_b: "LandmarkMap") -> str:
    """Return an alignment, or the reason of a refusal, as text."""
    import numpy as np

    sizes = f"Maps of {len(map_a)} and {len(map_b)} landmarks"
    if found.success:
        x, y, turn = np.sqrt(np.diag(found.covariance))
        return (
            f"{sizes}: aligned on {len(found.inliers)} of them.\nMotion from the second to the first: "
            f"x {found.tx:.3f} +- {x:.3f} m, y {found.ty:.3f} +- {y:.3f} m, "
            f"turn {np.degrees(found.theta):.2f} +- {np.degrees(turn):.2f} deg (one sigma)."
        )
    missed = f"; {found.missed} is {found.excess:.1f} times its limit" if found.missed else ""
    return f"{sizes}: not aligned. Reason: {found.reason}{missed} (docs/reference/metrics.md#refusals-of-alignments)."


def metrics(found: "Alignment") -> dict[str, object]:
    """Return an alignment as plain values: metres and radians, first_from_second."""
    motion = {"x_m": found.tx, "y_m": found.ty, "theta_rad": found.theta, "covariance": found.covariance}
    return {
        "success": found.success, "reason": found.reason, "missed": found.missed, "excess": found.excess,
        "first_from_second": motion if found.success else None, "inliers": found.inliers,
    }  # fmt: skip
