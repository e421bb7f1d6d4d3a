"""The Gaussian belief of batched teams (`vslam_env.batched`) on the readings of an episode."""

from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, argument_error
from slam_backend.geometry import between, wrap_angle
from studies.bounds.episodes import RecordedEpisode
from training.episodes.runner import is_false_merge

ROWS = 768  # landmarks for which a belief has room
ATTEMPT_EVERY = 10  # [ticks]


class GaussianTeam(NamedTuple):
    """What a Gaussian belief of a team tells in T ticks.

    Attributes:
        paths: (K, T, 3) float64 [m, m, rad]. Poses as estimated at each tick, own start frames.
        map_errors: (K, 2) float64 [m]. Map error E of each robot after the first tick and after the last.
        map_rmses, map_recalls: (K,) float64. Errors [m] and recall of the maps at the end.
        merges: Ticks of the merges.
        false_merges: Number of merges that were off by more than 0.5 m or 5 degrees when made.
    """

    paths: FloatArray
    map_errors: FloatArray
    map_rmses: FloatArray
    map_recalls: FloatArray
    merges: list[int]
    false_merges: int


def check_jax() -> None:
    """Raise if the package is missing."""
    if find_spec("jax") is None:
        raise argument_error("jax", "the package jax", "no such package", 'Install it: pip install "jax>=0.5".')


def gaussian_team(episode: RecordedEpisode) -> GaussianTeam:
    """Run the belief on the readings; robots are in contact all the time."""
    import jax
    import jax.numpy as jnp

    from vslam_env.batched.belief import START, Assumed, start, step
    from vslam_env.batched.scoring import Truth, score
    from vslam_env.batched.team import merged, no_waits

    config = episode.config
    assumed, options = Assumed.of(config.belief.filter), config.belief.alignment
    odometry, frames = _arrays(episode)
    observable = np.zeros(len(episode.landmarks), bool)
    observable[episode.observable] = True
    truth = Truth(*map(jnp.asarray, (episode.landmarks, observable, episode.true_paths[:, 0])))
    scores = partial(score, truth=truth, confirm_after=config.belief.confirm_after, cutoff=config.map_error_cutoff)

    def tick(belief: Any, reading: Any) -> Any:
        after = step(belief, reading[0], reading[1], assumed)
        return after, after.robots

    def attempt(belief: Any, waits: Any, readings: Any, now: Any, key: Any) -> Any:
        belief, robots = jax.lax.scan(tick, belief, readings)
        belief, waits = merged(belief, waits, now, key, assumed, options, config.belief.merging.min_sigmas)
        return belief, waits, jnp.concatenate([robots[:-1], belief.robots[None]])

    run, count = jax.jit(attempt), len(episode.true_paths)
    belief, waits = start(count, ROWS, frames.descriptors.shape[-1], assumed), no_waits(count)
    ends = [*range(0, len(odometry) - 1, ATTEMPT_EVERY), len(odometry) - 1]  # ticks at which groups may merge
    keys, begin = jax.random.split(jax.random.key(0), len(ends)), 0
    robots, merges, false, errors = [], [], 0, []
    for end, key in zip(ends, keys, strict=True):
        readings = jax.tree.map(lambda values, at=slice(begin, end + 1): values[at], (odometry, frames))
        before, begin = np.asarray(belief.groups), end + 1
        belief, waits, after = run(belief, waits, readings, end, key)
        robots.append(np.asarray(after, np.float64))
        groups = np.asarray(belief.groups)
        for b in before[groups != before][:1].tolist():
            a, starts = int(groups[b]), robots[-1][-1, :, START:]
            off = between(starts[a], starts[b]) - between(episode.true_paths[a, 0], episode.true_paths[b, 0])
            merges.append(end)
            false += is_false_merge(float(np.hypot(*off[:2])), float(np.degrees(abs(wrap_angle(off[2])))))
        if end in (ends[0], ends[-1]):
            errors.append(np.asarray(scores(belief).map_errors))
    every, last = np.concatenate(robots).swapaxes(0, 1), scores(belief)
    return GaussianTeam(
        between(every[..., START:], every[..., :3]), np.stack(errors, axis=1), np.asarray(last.map_rmses),
        np.asarray(last.map_recalls), merges, false,
    )  # fmt: skip


def _arrays(episode: RecordedEpisode) -> tuple[Any, Any]:
    """Return the odometry (T, K, 3) and the frames of all ticks and robots."""
    import jax.numpy as jnp

    from vslam_env.batched.belief import Frame

    ticks, count = len(episode.readings), len(episode.true_paths)
    seen = [[own.measurements for own in tick] for tick in episode.readings]
    most, size = max(len(own) for tick in seen for own in tick), seen[0][0].descriptors.shape[1]
    shape = (ticks, count, most)
    points, descriptors = np.zeros((*shape, 3)), np.zeros((*shape, size))
    points[..., 2] = 1.0
    true_ids, valid = np.full(shape, -1), np.zeros(shape, bool)
    for tick, of_robots in enumerate(seen):
        for robot, own in enumerate(of_robots):
            at = tick, robot, slice(len(own))
            points[at], descriptors[at] = own.points, own.descriptors
            true_ids[at], valid[at] = episode.true_ids[tick][robot], True
    odometry = np.concatenate([np.zeros((1, count, 3)), episode.odometry.swapaxes(0, 1)])
    return jnp.asarray(odometry), Frame(*map(jnp.asarray, (points, descriptors, true_ids, valid)))
