"""The commands `vslam paper fig2`, `fig3` and `fig4`: how maps are aligned and fused."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands._options import Check, Config, FirstSeed, Json, Out, OutToGoOn, Seed
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish
from training.experiments.tables import number

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.experiments.run_folder import RunFolder
    from training.paper.fig3 import AlignedPair

QUICK: dict[str, Any] = {"seeds": 3, "length": 40.0}
Length = Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="30")]
Landmarks = Annotated[int | None, typer.Option(help="Of the office.", show_default="300")]
Particles = Annotated[int | None, typer.Option(help="Of each robot's filter.", show_default="100")]


def fig2(
    seeds: Annotated[int | None, typer.Option(help="How many runs.", show_default="20")] = None,
    first_seed: FirstSeed = None,
    length: Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="80")] = None,
    every: Annotated[float | None, typer.Option(help="Metres between two alignments.", show_default="5")] = None,
    landmarks: Landmarks = None,
    particles: Particles = None,
    quick: Annotated[bool, typer.Option("--quick", help="3 runs of 40 m.")] = False,
    check: Check = False,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 2: error of SVD, ICP, ImpICP, RANSAC and ours against the size of two robots' own maps.

    The paper's four are shown as they come, without refinement or refusal. Its statement, RANSAC is best and
    practically zero whatever the size, is asked of the data. The same command with --out FOLDER goes on with a run
    that Ctrl-C has stopped.
    """
    from training.experiments.run_folder import plain
    from training.paper.fig2 import (
        COMMAND,
        TRIALS_FILE,
        Fig2Config,
        Fig2Trial,
        check_claims,
        play,
        refusals,
        summarise,
        to_csv,
    )
    from training.paper.fig2_figure import draw_fig2

    given = {
        "seeds": seeds, "seed": first_seed, "length": length, "every": every, "landmarks": landmarks,
        "particles": particles,
    }  # fmt: skip
    fast = QUICK if quick else None
    chosen = choose(Fig2Config, COMMAND, given, config=config, json=json, out=out, quick=fast)
    console, folder = begin(COMMAND, chosen, out, goes_on=True)
    part = KeptPart(
        file=TRIALS_FILE, kind=Fig2Trial, play=play, trials=chosen.trials(), tell=lambda row: f"seed {row['seed']}"
    )
    (rows,) = play_kept(console, folder, part)
    lines, claims, poor = plain(summarise(rows)), plain(check_claims(summarise(rows))), refusals(rows)
    for claim in claims:
        held = "holds" if claim["holds"] else "does not hold"
        shown = number(claim["measured"])
        console.print(f"{claim['claim']}: {shown}, at most {claim['at_most']:g}: {held}", highlight=False, markup=False)
    console.print(
        f"At {poor['share_too_little']} stages maps share too little; ours was false {poor['false']} times.",
        highlight=False,
    )
    metrics = folder.write_metrics({"summary": lines, "claims": claims} | poor)
    folder.write_text("fig2.csv", to_csv(rows))
    draw_fig2(folder.path / "fig2.png", lines)
    finish(console, folder, metrics, json, check, [claim["holds"] for claim in claims])


def fig3(
    seed: Seed = None,
    length: Length = None,
    landmarks: Landmarks = None,
    particles: Particles = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 3: two robots' own maps, what matches between them, and the motion found."""
    from training.paper.fig3 import FIG3, matches_csv
    from training.paper.fig3_figure import draw_fig3

    given = {"seed": seed, "length": length, "landmarks": landmarks, "particles": particles}
    console, folder, pair = _align(FIG3, given, out, json, config)
    figures = pair.figures()
    console.print(
        f"{figures['inliers']} matches, {figures['true_inliers']} of them true; motion off by "
        f"{figures['translation_error_m']:.3f} m and {figures['rotation_error_deg']:.2f} degrees",
        highlight=False,
    )
    folder.write_text("fig3.csv", matches_csv(pair))
    draw_fig3(folder.path / "fig3.png", pair)
    finish(console, folder, folder.write_metrics(figures), json)


def fig4(
    seed: Seed = None,
    length: Length = None,
    landmarks: Landmarks = None,
    particles: Particles = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 4: ellipses of a few landmarks of two aligned maps, before and after fusion."""
    import numpy as np

    from training.paper.fig3 import FIG4, ellipses_csv, fuse_pair
    from training.paper.fig3_figure import draw_fig4

    given = {"seed": seed, "length": length, "landmarks": landmarks, "particles": particles}
    console, folder, pair = _align(FIG4, given, out, json, config)
    fused = fuse_pair(pair)
    areas = 1e4 * np.sqrt(np.linalg.det(fused.covariances[..., :2, :2]))
    for name, one, two, both in zip(fused.names.tolist(), *areas, strict=True):
        text = f"landmark {name}: {one:.2f} and {two:.2f} square centimetres become {both:.2f}"
        console.print(text, highlight=False)
    folder.write_text("fig4.csv", ellipses_csv(fused))
    draw_fig4(folder.path / "fig4.png", fused)
    areas_cm2 = dict(zip(("map_1", "map_2", "fused"), areas, strict=True))
    finish(console, folder, folder.write_metrics({"names": fused.names, "sqrt_det_cm2": areas_cm2}), json)


def _align(
    command: str, given: dict[str, Any], out: Path | None, json: Path | None, config: Path | None
) -> tuple[Console, "RunFolder", "AlignedPair"]:
    """Begin fig3 or fig4: return console, run folder, and the two maps with the motion between them."""
    from training.paper.fig3 import PairConfig, align_pair

    chosen = choose(PairConfig, command, given, config=config, json=json, out=out)
    found: list[AlignedPair] = []
    console, folder = begin(command, chosen, out, lambda: found.append(align_pair(chosen)))  # refused before a folder
    return console, folder, found[0]
