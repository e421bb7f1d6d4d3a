"""One Gaussian in place of a robot's particles: errors of the belief of batched teams, on the readings of episodes.

python -m studies.gaussian --worlds office,loops --presets hard --seeds 3
"""

from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import argument_error
from studies import losses
from studies.bounds.episodes import RecordedEpisode, replay
from training.commands.study import run_program
from training.experiments.config import NoisePreset, option
from training.experiments.study import Column, ResultTable, Study

ROWS = 384  # landmarks for which a belief has room


class Config(losses.Config):
    """Episodes of single robots."""

    presets: tuple[NoisePreset, ...] = option(("standard", "hard"), "Noise presets: easy, standard, hard.")
    policies: tuple[str, ...] = option(
        ("next_best_view@continuous",), "Policies of the robots: name, path of a model, MODULE:NAME, or LABEL= and one "
        "of these; @discrete selects the action type.",
    )  # fmt: skip

    def check(self) -> None:
        """Refuse teams, whose maps no belief of this kind merges, and a missing package."""
        if self.robots != (1,):
            raise argument_error("robots", "1", self.robots, "Teams are not merged here.")
        if find_spec("jax") is None:
            raise argument_error("jax", "the package jax", "no such package", 'Install it: pip install "jax>=0.5".')
        super().check()


@single_threaded_blas
def play(config: Config, trial: losses.Trial) -> dict[str, Any]:
    """Run an episode, and the Gaussian belief on its readings.

    Returns:
        `filter` and `gaussian`: RMS position error [m] over the ticks, start frame; their `ratio`; `copies`: landmarks
        that were measured twice, for each true one among them.

    Raises:
        PolicyError: If the policy fails.
    """
    episode = losses.recorded(config, trial)
    path, true_ids = gaussian_path(episode)
    track = replay(episode, episode.config.belief.filter)
    own, other = (
        float(np.sqrt((losses.errors_of(p, episode)[..., :2] ** 2).sum(-1).mean())) for p in (track.paths, path[None])
    )
    real = true_ids[true_ids >= 0]
    return {
        "filter": own, "gaussian": other, "ratio": losses.ratio(other, own),
        "copies": len(real) / max(len(np.unique(real)), 1),
    }  # fmt: skip


def gaussian_path(episode: RecordedEpisode) -> tuple[Any, Any]:
    """Return the path (T, 3) [m, m, rad] of a robot by the Gaussian belief, and the true landmarks (n,) of its map."""
    import jax
    import jax.numpy as jnp

    from vslam_env.batched.belief import Assumed, Frame, start, step

    assumed = Assumed.of(episode.config.belief.filter)
    seen = [tick[0].measurements for tick in episode.readings]
    most, size = max(map(len, seen)), seen[0].descriptors.shape[1]
    points, descriptors = np.zeros((len(seen), 1, most, 3)), np.zeros((len(seen), 1, most, size))
    points[..., 2] = 1.0
    true_ids, valid = np.full((len(seen), 1, most), -1), np.zeros((len(seen), 1, most), bool)
    for tick, (own, ids) in enumerate(zip(seen, episode.true_ids, strict=True)):
        count = len(own)
        points[tick, 0, :count], descriptors[tick, 0, :count] = own.points, own.descriptors
        true_ids[tick, 0, :count], valid[tick, 0, :count] = ids[0], True
    frames = Frame(*map(jnp.asarray, (points, descriptors, true_ids, valid)))
    odometry = np.vstack([np.zeros((1, 3)), episode.odometry[0]])[:, None]

    def after_tick(belief: Any, reading: Any) -> Any:
        after = step(belief, reading[0], reading[1], assumed)
        return after, after.robots[0, :3]

    first = start(1, ROWS, size, assumed)
    last, path = jax.jit(partial(jax.lax.scan, after_tick))(first, (jnp.asarray(odometry), frames))
    return np.asarray(path, np.float64), np.asarray(last.true_ids)[np.asarray(last.counts) > 1]


STUDY = Study(
    name="gaussian",
    about="""Run the Gaussian belief of batched teams on the readings of single robots, beside the filter.

    It needs the package jax. Associations are unknown to both.
    """,
    config=Config,
    trial=losses.Trial,
    trials=losses.trials,
    play=play,
    checks=losses.checks,
    quick={"worlds": ("office",), "seeds": 1, "duration": 20.0, "particles": (20,)},
    tables=(
        ResultTable(
            name="gaussian", title="Position RMS of the Gaussian belief and of the filter", by=("preset", "world"),
            columns=(
                Column("filter", "filter [m]", "geometric mean"), Column("gaussian", "Gaussian [m]", "geometric mean"),
                Column("ratio", "ratio", "geometric mean", digits=2, interval=True),
                Column("ratio", "worst", "worst", digits=2), Column("copies", digits=2),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
