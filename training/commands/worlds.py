"""Commands `vslam worlds ...`: list, preview, check and import worlds."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from training.experiments.output.console import make_console

worlds = typer.Typer(help="List, preview, check and import worlds.", no_args_is_help=True)

Source = Annotated[
    str,
    typer.Argument(
        help="World family, or path of a floor plan, ROS map, .json file or folder; options follow: rooms:extent=120."
    ),
]
FirstSeed = Annotated[int, typer.Option(help="First world seed.")]
Seeds = Annotated[int, typer.Option(help="Number of world seeds.")]
Robots = Annotated[int, typer.Option(help="Number of robots to place.")]
Outside = Annotated[
    str | None,
    typer.Option(help="drop or keep the free space around the building of a plan.", show_default="drop"),
]


@worlds.command("list")
def list_worlds(seeds: Annotated[int, typer.Option(help="Number of worlds measured per family.")] = 5) -> None:
    """List the world families with their typical size."""
    from rich.table import Table

    from slam_backend.core.validation import check_int
    from training.episodes.world_survey import survey
    from vslam_env.world import SPLITS, WORLD_FAMILIES

    check_int("seeds", seeds, 1, "Use at least one world.")
    table = Table("family", "what", "walls", "landmarks", "floor", "size")
    for name, maker in WORLD_FAMILIES.items():
        surveys = [survey(name, seed) for seed in range(seeds)]
        what = (sys.modules[maker.__module__].__doc__ or "").split("\n")[0].rstrip(".")
        table.add_row(
            name, what, _span([world.walls for world in surveys]), _span([world.landmarks for world in surveys]),
            f"{_span([round(world.floor_m2) for world in surveys])} m²",
            f"{_span([round(world.width_m) for world in surveys])} x {_span([round(w.height_m) for w in surveys])} m",
        )  # fmt: skip
    console = make_console()
    console.print(table)
    for split, (first, end) in SPLITS.items():
        console.print(f"{split}: world seeds {first} to {end - 1}")
    console.print("Options follow the name: rooms:extent=120:room=8, office:extent=100, campus:extent=200.")
    console.print("Paths work too: .png .jpg .pgm .yaml (ROS) .json, or a folder of these.")


@worlds.command("preview")
def preview(
    world: Source, out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("worlds.png"),
    first_seed: FirstSeed = 0, seeds: Seeds = 4, robots: Robots = 3, outside: Outside = None,
) -> None:  # fmt: skip
    """Draw the worlds of some seeds, with landmarks and start poses, into one picture."""
    import imageio.v3 as imageio

    from slam_backend.core.files import check_writable, write_file
    from slam_backend.core.validation import argument_error
    from training.episodes.world_survey import contact_sheet
    from training.experiments.output.compilation import compilation_progress

    if out.suffix.lower() != ".png":
        raise argument_error("out", "a name that ends in .png", out, "Pictures are written as PNG.")
    check_writable(out, "out")
    with compilation_progress(make_console(stderr=True)):
        picture = contact_sheet(_with_outside(world, outside), first_seed, seeds, robots)
    write_file(out, imageio.imwrite("<bytes>", picture, extension=".png"), "out")
    make_console().print(f"Picture: {out}", soft_wrap=True)


@worlds.command("validate")
def validate(
    world: Source, first_seed: FirstSeed = 0, seeds: Seeds = 20, robots: Robots = 3, outside: Outside = None
) -> None:
    """Build the worlds of some seeds and place robots in them; a failure gives exit status 2."""
    from rich.table import Table

    from slam_backend.core.validation import check_int
    from training.episodes.world_survey import survey_all

    check_int("seeds", seeds, 1, "Use at least one world.")
    check_int("first_seed", first_seed, 0, "Use 0 or a positive number.")
    surveys = survey_all(_with_outside(world, outside), range(first_seed, first_seed + seeds), robots)
    table = Table("figure", "least", "most", title=f"{surveys[0].name}: {seeds} of {seeds} worlds are valid")
    gaps = [("smallest distance between starts, m", [each.start_gap_m for each in surveys])] if robots > 1 else []
    for title, values in (
        ("walls", [float(each.walls) for each in surveys]),
        ("observable landmarks", [float(each.landmarks) for each in surveys]),
        ("floor, m²", [each.floor_m2 for each in surveys]),
        ("width, m", [each.width_m for each in surveys]),
        ("height, m", [each.height_m for each in surveys]),
        *gaps,
    ):
        table.add_row(title, f"{min(values):.4g}", f"{max(values):.4g}")
    make_console().print(table)


@worlds.command("import")
def import_world(
    plan: Annotated[Path, typer.Argument(help="Floor plan (.png, .jpg, .pgm) or ROS map (.yaml).")],
    out: Annotated[Path, typer.Argument(help=".json file to write.")],
    metres_per_pixel: Annotated[
        float | None, typer.Option(help="Resolution of a floor plan; ROS maps contain theirs.", show_default="0.045")
    ] = None,
    tolerance_px: Annotated[
        float, typer.Option(help="Tolerance of the polygon approximation of outlines in pixels.")
    ] = 1.0,
    outside: Outside = None,
) -> None:
    """Trace the walls of a map and write them as .json, which can be edited."""
    from slam_backend.core.validation import argument_error
    from vslam_env.world import FreeSpace, load_floorplan, load_ros_map, save_walls_json

    if plan.suffix.lower() in (".yaml", ".yml"):
        if metres_per_pixel is not None:
            hint = "Change resolution in the file instead."
            raise argument_error("metres_per_pixel", "no value for a ROS map", metres_per_pixel, hint)
        traced = load_ros_map(plan, tolerance_px, outside=outside or "drop")
    else:
        traced = load_floorplan(
            plan, 0.045 if metres_per_pixel is None else metres_per_pixel, tolerance_px, outside=outside or "drop"
        )
    FreeSpace(traced)  # refuses a world without room for a robot
    if out.suffix.lower() != ".json":
        raise argument_error("out", "a name that ends in .json", out, "The suffix determines the format.")
    save_walls_json(traced, out)
    x_min, y_min, x_max, y_max = traced.bounds
    size = f"{x_max - x_min:.1f} x {y_max - y_min:.1f} m"
    make_console().print(f"{out}: {len(traced.walls)} walls, {size}", soft_wrap=True)


def _with_outside(world: str, outside: str | None) -> str:
    """Add the option `--outside` to the path of a plan."""
    return world if outside is None else f"{world}:outside={outside}"


def _span(values: list[int]) -> str:
    """Format the range of some numbers."""
    return str(min(values)) if min(values) == max(values) else f"{min(values)}-{max(values)}"
