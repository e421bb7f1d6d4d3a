"""Losses of teams: map error of the filters over that of an ideal team on the same readings, and what merges lose.

python -m studies.merging.team_losses --worlds office,loops --presets hard --seeds 4
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from slam_backend.core.blas import single_threaded_blas
from studies.bounds.episodes import replay
from studies.bounds.ideal_team import NO_CONTACT, NOT_TRIED, ideal_team, waits_by_reason
from studies.filters import losses
from studies.filters.losses import Trial, checks, errors_of, recorded, trials
from training.commands.study import run_program
from training.experiments.config import NoisePreset, option
from training.experiments.study import Column, ResultTable, Row, Study
from vslam_env.config import TICK


class Config(losses.TeamConfig):
    """Episodes of teams in worlds with hard noise."""

    presets: tuple[NoisePreset, ...] = option(("hard",), "Noise presets: easy, standard, hard.")


@single_threaded_blas
def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode, and compare its filters with the ideal team.

    Returns:
        `map_error` at the end, mean over the robots, `ideal_map_error`, and the `excess` of the former; position RMS
        [m] of both, and their ratio `over_ideal`; `merges` that were not undone, `ideal_merges`; `false_merges` among
        the former; `waits`: seconds from ideal merges to those of the filters, by what kept the groups apart, and their
        sum `wait_s`.

    Raises:
        PolicyError: If the policy fails.
    """
    episode = recorded(config, trial)
    track, ideal = replay(episode, episode.config.belief.filter), ideal_team(episode)
    own, best = (
        float(np.sqrt((errors_of(p, episode)[..., :2] ** 2).sum(-1).mean())) for p in (track.paths, ideal.paths)
    )
    held = float(np.mean([float(info["map_error"]) for info in episode.record.infos]))
    waits = {reason: TICK * ticks for reason, ticks in waits_by_reason(episode, ideal.merges, track.events).items()}
    kept = [merge for merge in episode.record.merges if merge.undone is None]
    return {
        "map_error": held, "ideal_map_error": float(ideal.map_errors.mean()),
        "excess": held - float(ideal.map_errors.mean()), "position_rms_m": own, "ideal_position_rms_m": best,
        "over_ideal": losses.ratio(own, best), "merges": len(track.merges), "ideal_merges": len(ideal.merges),
        "false_merges": sum(merge.is_false for merge in kept), "waits": waits, "wait_s": sum(waits.values()),
    }  # fmt: skip


def _wait_for(reason: str, rows: Sequence[Row]) -> float:
    """Return the mean wait of an episode for a reason [s]: the first of `REASONS` that its name begins with."""
    waits = [
        seconds
        for row in rows
        for name, seconds in row["waits"].items()
        if reason == next((each for each in REASONS if name.startswith(each)), "")
    ]
    return float(sum(waits)) / len(rows)


REASONS = {  # what kept groups apart, with headings
    "too uncertain: paths": "paths [s]", "too uncertain": "landmarks [s]", "too few inliers": "few inliers [s]",
    "ambiguous": "ambiguous [s]", NOT_TRIED: "not tried [s]", NO_CONTACT: "no contact [s]",
}  # fmt: skip

STUDY = Study(
    name="team_losses",
    about="""Compare the filters of teams with an ideal team on the same readings, and name what their merges lose.

    The ideal team has all readings up to now at once, true identities and noise, and merges groups in contact as soon
    as they share eight landmarks. Options that accept several values take them comma-separated; all combinations are
    run. Ctrl-C finishes the current episode and summarises the finished ones; the same command with --out FOLDER
    resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    quick={"worlds": ("office",), "seeds": 2, "duration": 30.0, "particles": (30,)},
    tables=(
        ResultTable(
            name="teams", title="Filters and the ideal team on the same readings", by=("preset", "world", "robots"),
            columns=(
                Column("map_error", "E [m]", digits=3), Column("ideal_map_error", "E ideal [m]", digits=3),
                Column("excess", "excess [cm]", digits=1, factor=100.0, interval=True),
                Column("over_ideal", "position over ideal", "geometric mean", digits=2, interval=True),
                Column("merges", digits=2), Column("ideal_merges", "ideal", digits=2),
                Column("false_merges", "false", "sum", digits=0),
            ),
        ),
        ResultTable(
            name="waits", title="Waits from ideal merges to those of the filters, by what kept the groups apart",
            by=("preset", "world", "robots"),
            columns=(
                Column("wait_s", "all [s]", digits=1),
                *(Column("waits", name, partial(_wait_for, reason), digits=1) for reason, name in REASONS.items()),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
