"""Commands `vslam paper ...`: figures of the paper, reproduced in simulation."""

from typing import TYPE_CHECKING, Any

import typer

from training.commands._options import Check, Workers, options
from training.commands._progress import TrialSet, run_trial_sets
from training.commands._run_folder import Call
from training.paper.config import Fig1Config, Fig2Config, Fig5Config, Fig6Config, PairConfig

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.paper.fig3 import AlignedPair

paper = typer.Typer(help="Reproduce figures of the paper.", no_args_is_help=True)


@paper.command("fig1")
@options(Fig1Config, "paper fig1")
def fig1(call: Call[Fig1Config]) -> None:
    """Reproduce Fig. 1: particles along the paths of three robots, with odometry only and with measurements."""
    from training.paper.fig1 import draw_clouds, draw_fig1, path_errors, simulate_fig1

    console, folder = call.begin()
    run = simulate_fig1(call.config)
    moved, measured = (draw_clouds(run, call.config, with_measurements) for with_measurements in (False, True))
    panels = [("motion model alone (Eq. 4)", "odometry", moved), ("with measurements", "estimate", measured)]
    draw_fig1(folder.path / "fig1.png", run, panels)
    found = {"odometry": path_errors(run, moved), "measurements": path_errors(run, measured)}
    for name, rows in found.items():
        for robot, row in enumerate(rows, 1):
            text = f"robot {robot}, {name}: path RMS {row['path_rms_m']:.2f} m, final error"
            console.print(f"{text} {row['end_error_m']:.2f} m, final spread {row['end_spread_m']:.2f} m")
    call.write(found)
    call.finish()


@paper.command("fig2")
@options(Fig2Config, "paper fig2", continues=True, quick={"seeds": 3, "length": 40.0}, quick_help="3 runs of 40 m.")
def fig2(call: Call[Fig2Config], check: Check = False) -> None:
    """Reproduce Fig. 2: error of SVD, ICP, ImpICP, RANSAC and our method over the size of two robots' maps.

    The paper's four methods run without refinement and refusal. The paper's claim, that RANSAC is best with practically
    zero error for any size, is checked. The same command with --out FOLDER resumes a run that Ctrl-C has
    stopped.
    """
    from training.experiments.run_folder import plain
    from training.experiments.tables import number
    from training.paper import fig2 as figure

    console, folder = call.begin()
    part = TrialSet(
        file=figure.TRIALS_FILE, kind=figure.Fig2Trial, play=figure.play, trials=call.config.trials(),
        tell=lambda row: f"seed {row['seed']}",
    )  # fmt: skip
    (rows,) = run_trial_sets(console, folder, part)
    lines, poor = figure.summarise(rows), figure.refusals(rows)
    claims = plain(figure.check_claims(lines))
    for claim in claims:
        held = "holds" if claim["holds"] else "does not hold"
        shown = f"{number(claim['measured'])}, at most {claim['at_most']:g}: {held}"
        console.print(f"{claim['claim']}: {shown}")
    text = f"At {poor['share_too_little']} stages the maps share too little; false alignments of ours: {poor['false']}."
    console.print(text)
    call.write({"summary": lines, "claims": claims} | poor)
    folder.write_text("fig2.csv", figure.to_csv(rows))
    figure.draw_fig2(folder.path / "fig2.png", plain(lines))
    call.finish(check, [claim["holds"] for claim in claims])


@paper.command("fig3")
@options(PairConfig, "paper fig3")
def fig3(call: Call[PairConfig]) -> None:
    """Reproduce Fig. 3: maps of two robots, the matches between them, and the estimated transform."""
    from training.paper.fig3 import draw_fig3, matches_csv

    pair = _align(call)
    figures = pair.figures()
    call.console.print(
        f"{figures['inliers']} matches, {figures['true_inliers']} of them true; transform error "
        f"{figures['translation_error_m']:.3f} m and {figures['rotation_error_deg']:.2f} degrees"
    )
    call.folder.write_text("fig3.csv", matches_csv(pair))
    draw_fig3(call.folder.path / "fig3.png", pair)
    call.write(figures)
    call.finish()


@paper.command("fig4")
@options(PairConfig, "paper fig4")
def fig4(call: Call[PairConfig]) -> None:
    """Reproduce Fig. 4: covariance ellipses of landmarks of two aligned maps, before and after fusion."""
    import numpy as np

    from training.paper.fig3 import draw_fig4, ellipses_csv, fuse_pair

    fused = fuse_pair(_align(call))
    areas = 1e4 * np.sqrt(np.linalg.det(fused.covariances[..., :2, :2]))
    for name, one, two, both in zip(fused.true_ids.tolist(), *areas, strict=True):
        text = f"landmark {name}: {one:.2f} and {two:.2f} square centimetres before, {both:.2f} after fusion"
        call.console.print(text)
    call.folder.write_text("fig4.csv", ellipses_csv(fused))
    draw_fig4(call.folder.path / "fig4.png", fused)
    areas_cm2 = dict(zip(("map_1", "map_2", "fused"), areas, strict=True))
    call.write({"names": fused.true_ids, "sqrt_det_cm2": areas_cm2})
    call.finish()


def _align(call: Call[PairConfig]) -> "AlignedPair":
    """Start fig3 or fig4: return two maps and the transform between them, computed before the folder is created."""
    from training.paper.fig3 import align_pair

    found: list[AlignedPair] = []
    call.begin(lambda: found.append(align_pair(call.config)))
    return found[0]


@paper.command("fig5")
@options(Fig5Config, "paper fig5")
def fig5(call: Call[Fig5Config]) -> None:
    """Reproduce Fig. 5: robots in a room with landmarks on its walls, which landmarks they see and which are hidden."""
    from training.paper.fig5 import draw_fig5, simulate_fig5

    console, folder = call.begin()
    found = simulate_fig5(call.config)
    draw_fig5(folder.path / "fig5.png", found)
    folder.write_text("fig5.csv", found.to_csv())
    rows: list[dict[str, Any]] = found.figures()
    for robot, row in enumerate(rows):
        console.print(
            f"robot {robot}: {row['in_view']} landmarks in view, {row['hidden']} of them hidden; "
            f"{row['measured']} of {row['seen']} visible measured in this tick"
        )
    hidden, in_view = sum(row["hidden"] for row in rows), sum(row["in_view"] for row in rows)
    console.print(f"Walls and robots hide {hidden} of {in_view} landmarks in view.")
    call.write({"robots": rows, "landmarks": len(found.landmarks)})
    call.finish()


@paper.command("fig6")
@options(
    Fig6Config, "paper fig6", continues=True, quick={"particles": (1, 10, 100), "seeds": 3, "length": 25.0},
    quick_help="3 seeds, M = 1, 10, 100, and 25 m.",
)  # fmt: skip
def fig6(call: Call[Fig6Config], workers: Workers = 1, check: Check = False) -> None:
    """Reproduce Fig. 6: step time and map error of one to three robots that share B measurements.

    The filter is the paper's (`fastslam1`, unknown association, random resampling at every step), with large noise
    relative to the odometry. Further regimes: similar landmarks with false points, and good stereo with both proposals
    and with rejuvenation, for M = 10, 100, 1000. Map errors run in --workers at a time, times in one process. The
    paper's claims are checked. Ctrl-C finishes the current trial and summarises the finished ones; the same command
    with --out FOLDER resumes the run.
    """
    from training.experiments.run_folder import plain
    from training.paper.fig6.claims import check_claims, robots_ratios, summarise, to_csv
    from training.paper.fig6.report import draw_fig6, print_result
    from training.paper.fig6.trials import ERRORS_FILE, TIMES_FILE, ErrorTrial, TimeTrial, cost, play_error, play_time

    console, folder = call.begin()
    parts = (
        TrialSet(
            file=ERRORS_FILE, kind=ErrorTrial, play=play_error, trials=call.config.error_trials(), workers=workers,
            tell=lambda row: f"map errors: seed {row['seed']}, M={row['particles']}", cost=cost,
        ),
        TrialSet(
            file=TIMES_FILE, kind=TimeTrial, play=play_time, trials=call.config.time_trials(),
            tell=lambda row: f"times: seed {row['seed']}, M={row['particles']}", cost=cost,
        ),
    )  # fmt: skip
    errors, times = run_trial_sets(console, folder, *parts, timed=True)
    lines, ratios, claims = plain(summarise(errors, times)), plain(robots_ratios(errors)), check_claims(errors, times)
    print_result(console, lines, ratios, claims)
    call.write({"summary": lines, "robots_ratios": ratios, "claims": [claim.to_mapping() for claim in claims]})
    folder.write_text("fig6.csv", to_csv(lines))
    if lines:
        draw_fig6(folder.path / "fig6.png", lines)
    call.finish(check, [claim.holds for claim in claims])
