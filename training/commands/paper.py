"""Commands `vslam paper ...`: figures of the paper, reproduced in simulation."""

from typing import TYPE_CHECKING

import typer

from training.commands.helpers.options import Check, Workers, options
from training.commands.helpers.run_folder import Call
from training.commands.study import run_study, write_tables
from training.paper.config import Fig1Config, Fig2Config, Fig5Config, Fig6Config, PairConfig

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.paper.fig3 import AlignedPair

paper = typer.Typer(help="Reproduce figures of the paper.", no_args_is_help=True)


@paper.command("fig1")
@options(Fig1Config, "paper fig1")
def fig1(call: Call[Fig1Config]) -> None:
    """Reproduce Fig. 1: particles along the paths of three robots, with odometry only and with measurements."""
    from training.paper.fig1 import TABLE, draw_clouds, draw_fig1, path_errors, simulate_fig1

    _, folder = call.begin()
    run = simulate_fig1(call.config)
    moved, measured = (draw_clouds(run, call.config, with_measurements) for with_measurements in (False, True))
    panels = [("motion model alone (Eq. 4)", "odometry", moved), ("with measurements", "estimate", measured)]
    write_tables(call, [TABLE], [row for _, name, clouds in panels for row in path_errors(run, clouds, name)])
    draw_fig1(folder.path / "fig1.png", run, panels)
    call.finish()


@paper.command("fig2")
@options(Fig2Config, "paper fig2", continues=True, quick={"seeds": 3, "length": 40.0}, quick_help="3 runs of 40 m.")
def fig2(call: Call[Fig2Config], check: Check = False) -> None:
    """Reproduce Fig. 2: error of SVD, ICP, ImpICP, RANSAC and our method over the size of two robots' maps.

    The paper's four methods run without refinement and refusal. The paper's claim, that RANSAC is best with practically
    zero error for any size, is checked. The same command with --out FOLDER resumes a run that Ctrl-C has
    stopped.
    """
    from training.paper.fig2 import STUDY

    run_study(call, STUDY, check=check)


@paper.command("fig3")
@options(PairConfig, "paper fig3")
def fig3(call: Call[PairConfig]) -> None:
    """Reproduce Fig. 3: maps of two robots, the matches between them, and the estimated transform."""
    from training.paper.fig3 import MATCHES, draw_fig3, matches

    pair = _align(call)
    errors = dict(zip(("translation_m", "rotation_deg"), pair.errors(), strict=True)) | {"seed": call.config.seed}
    write_tables(call, [MATCHES], [row | errors for row in matches(pair)])
    draw_fig3(call.folder.path / "fig3.png", pair)
    call.finish()


@paper.command("fig4")
@options(PairConfig, "paper fig4")
def fig4(call: Call[PairConfig]) -> None:
    """Reproduce Fig. 4: covariance ellipses of landmarks of two aligned maps, before and after fusion."""
    from training.paper.fig3 import ELLIPSES, draw_fig4, ellipses, fuse_pair

    fused = fuse_pair(_align(call))
    write_tables(call, [ELLIPSES], ellipses(fused))
    draw_fig4(call.folder.path / "fig4.png", fused)
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
    from training.paper.fig5 import TABLE, draw_fig5, simulate_fig5

    _, folder = call.begin()
    found = simulate_fig5(call.config)
    write_tables(call, [TABLE], found.rows(), landmarks=len(found.landmarks))
    draw_fig5(folder.path / "fig5.png", found)
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
    and with rejuvenation, for M = 10, 100, 1000. Times are processor times; with more --workers they also depend on
    what shares the caches. The paper's claims are checked. Ctrl-C finishes the current trial and summarises the
    finished ones; the same command with --out FOLDER resumes the run.
    """
    from training.paper.fig6.report import STUDY

    run_study(call, STUDY, workers, check=check)
