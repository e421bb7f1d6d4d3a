"""Batched teams (`vslam_env.batched`) beside an episode: on its readings, or with its actions in its world."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, wrap_angle
from studies.bounds.episodes import RecordedEpisode
from training.episodes.runner import is_false_merge

ROWS = 768  # landmarks for which a belief has room
ATTEMPT_EVERY = 10  # [ticks]


class GaussianTeam(NamedTuple):
    """What a Gaussian belief of a team tells in T ticks.

    Attributes:
        paths: (K, T, 3) float64 [m, m, rad]. Poses as estimated at each tick, own start frames.
        true_paths: (K, T, 3) float64 [m, m, rad]. True poses, world frame.
        map_errors: (K, 2) float64 [m]. Map error E of each robot after the first tick and after the last.
        map_rmses, map_recalls: (K,) float64. Errors [m] and recall of the maps at the end.
        merges: Ticks of the merges.
        false_merges: Number of merges that were off by more than 0.5 m or 5 degrees when made.
    """

    paths: FloatArray
    true_paths: FloatArray
    map_errors: FloatArray
    map_rmses: FloatArray
    map_recalls: FloatArray
    merges: list[int]
    false_merges: int


class Part(NamedTuple):
    """Ticks after which groups may have merged.

    Attributes:
        end: Last tick.
        robots, poses: (t, K, 8), (t, K, 3). Belief and truth of these ticks.
        groups: (K,) int32. First robots of the groups at the end.
        scores: Scores of the maps at the end.
    """

    end: int
    robots: FloatArray
    poses: FloatArray
    groups: Any
    scores: Any


def gaussian_team(episode: RecordedEpisode) -> GaussianTeam:
    """Run the belief on the readings; robots are in contact all the time."""
    import jax
    import jax.numpy as jnp

    from vslam_env.batched.belief import Assumed, start, step
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
        least = config.belief.merging.min_sigmas
        belief, waits = merged(belief, waits, now, key, jnp.array(True), assumed, options, least)
        return belief, waits, jnp.concatenate([robots[:-1], belief.robots[None]])

    run, count = jax.jit(attempt), len(episode.true_paths)
    belief, waits = start(count, ROWS, frames.descriptors.shape[-1], assumed), no_waits(count)
    ends = [*range(0, len(odometry) - 1, ATTEMPT_EVERY), len(odometry) - 1]  # ticks at which groups may merge
    keys, begin, parts = jax.random.split(jax.random.key(0), len(ends)), 0, []
    for end, key in zip(ends, keys, strict=True):
        ticks = slice(begin, end + 1)
        readings = jax.tree.map(lambda values, at=ticks: values[at], (odometry, frames))
        belief, waits, robots = run(belief, waits, readings, end, key)
        poses = episode.true_paths[:, ticks].swapaxes(0, 1)
        parts.append(Part(end, np.asarray(robots, float), poses, np.asarray(belief.groups), scores(belief)))
        begin = end + 1
    return joined(parts)


def simulated_team(episode: RecordedEpisode, seed: int, actions: Sequence[Mapping[str, Any]]) -> GaussianTeam:
    """Run the batched environment with given actions in the world of an episode, with its starts and biases."""
    import jax
    import jax.numpy as jnp

    from vslam_env.batched.environment import BatchedExploration

    config = episode.config.replace(observation_keys=("pose",), reward={"map_error": 1.0})
    env = BatchedExploration(config, num_worlds=1, first_seed=seed, rows=ROWS)

    def tick(state: Any, given: Any) -> Any:
        _, after, *_ = env.step_env(given[0], state, given[1])
        return after, (after.episode.belief.robots, after.episode.poses)

    def part(end: int, state: Any, told: Any) -> Part:
        robots, poses = (np.asarray(each, float) for each in told)
        return Part(end, robots, poses, np.asarray(state.episode.belief.groups), state.episode.scores)

    run: Callable[..., Any] = jax.jit(partial(jax.lax.scan, tick))
    _, state = env.reset(jax.random.key(seed))
    first = state.episode.belief.robots[None], state.episode.poses[None]
    parts, keys = [part(0, state, first)], jax.random.split(jax.random.key(seed + 1), len(actions))
    commands = {agent: jnp.asarray(np.array([each[agent] for each in actions])) for agent in env.agents}
    for begin in range(0, len(actions), ATTEMPT_EVERY):
        ticks = slice(begin, begin + ATTEMPT_EVERY)
        given = keys[ticks], {agent: values[ticks] for agent, values in commands.items()}
        state, told = run(state, given)
        parts.append(part(begin + len(given[0]), state, told))
    return joined(parts)


def joined(parts: Sequence[Part]) -> GaussianTeam:
    """Return what successive parts of an episode tell."""
    from vslam_env.batched.belief import START

    first, last = parts[0], parts[-1]
    merges, false = [], 0
    for before, after in pairwise(parts):
        for b in before.groups[after.groups != before.groups][:1].tolist():
            a, starts = int(after.groups[b]), after.robots[-1, :, START:]
            off = between(starts[a], starts[b]) - between(first.poses[0, a], first.poses[0, b])
            merges.append(after.end)
            false += is_false_merge(float(np.hypot(*off[:2])), float(np.degrees(abs(wrap_angle(off[2])))))
    every, poses = (
        np.concatenate([getattr(each, name) for each in parts]).swapaxes(0, 1) for name in ("robots", "poses")
    )
    return GaussianTeam(
        between(every[..., START:], every[..., :3]), poses,
        np.stack([np.asarray(each.scores.map_errors) for each in (first, last)], axis=1),
        np.asarray(last.scores.map_rmses), np.asarray(last.scores.map_recalls), merges, false,
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
