"""The command `vslam paper fig5`."""

from typing import Annotated

import typer

from training.commands._options import Config, Json, Out, Seed
from training.commands._run_folder import begin, choose, finish


def fig5(
    seed: Seed = None,
    robots: Annotated[int | None, typer.Option(help="How many.", show_default="3")] = None,
    decisions: Annotated[int | None, typer.Option(help="Seconds that they explore before.", show_default="30")] = None,
    measurements: Annotated[int | None, typer.Option(help="Number B of each in a tick.", show_default="5")] = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 5: robots in a room with landmarks on its walls; what they see, and what walls hide from them."""
    from training.paper.fig5 import COMMAND, Fig5Config, simulate_fig5
    from training.paper.fig5_figure import draw_fig5

    given = {"seed": seed, "robots": robots, "decisions": decisions, "measurements": measurements}
    chosen = choose(Fig5Config, COMMAND, given, config=config, json=json, out=out)
    console, folder = begin(COMMAND, chosen, out)
    found = simulate_fig5(chosen)
    draw_fig5(folder.path / "fig5.png", found)
    folder.write_text("fig5.csv", found.to_csv())
    rows = found.figures()
    for robot, row in enumerate(rows):
        console.print(
            f"robot {robot}: {row['in_view']} landmarks in view, {row['hidden']} of them hidden; "
            f"{row['measured']} of {row['seen']} measured in this tick",
            highlight=False,
        )
    hidden, in_view = sum(row["hidden"] for row in rows), sum(row["in_view"] for row in rows)
    console.print(f"Walls and robots hide {hidden} of {in_view} landmarks in view.", highlight=False)
    finish(console, folder, folder.write_metrics({"robots": rows, "landmarks": len(found.landmarks)}), json)
