"""An episode of a batched team: state, reset and step as pure functions, with the rewards of the environment."""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from slam_backend.core.validation import argument_error
from slam_backend.maps.alignment_types import AlignmentOptions
from vslam_env.batched import belief as beliefs
from vslam_env.batched.belief import Assumed, Belief
from vslam_env.batched.grids import paint
from vslam_env.batched.observation import KEYS, in_start_frame, observe
from vslam_env.batched.scoring import Scores, Truth, score
from vslam_env.batched.team import Waits, merged, no_waits
from vslam_env.batched.world import Hardware, Scene, drive, measure, read_odometry, scan
from vslam_env.config import TICK, EnvConfig
from vslam_env.navigation import GRID_SIZE

ATTEMPT_EVERY = 10  # [ticks], at the end of a step
CANNOT = {  # options of the environment with the only value that batched teams know
    "sensor": "landmark", "oracle_pose": False, "oracle_association": False, "oracle_merge": False,
    "oracle_floor": False, "shared_start_view": False, "shared_reward": False, "comm_range": None,
    "comm_line_of_sight": False, "comm_outage_seconds": 0.0, "stop_at_recall": None, "observe_images": False,
    "reward": {"map_error": 1.0},
}  # fmt: skip


class Rules(NamedTuple):
    """What is constant over all episodes; it is hashable, so that compiled functions take it as a static argument."""

    hardware: Hardware
    assumed: Assumed
    alignment: AlignmentOptions
    min_sigmas: float
    confirm_after: int
    cutoff: float
    comm_loss: float
    ticks: int
    cycles: int
    keys: tuple[str, ...]
    rows: int

    @classmethod
    def of(cls, config: EnvConfig, rows: int) -> Self:
        """Return the rules of an environment, with room for R landmarks in a team's belief.

        Raises:
            ValueError: If an option has a value that batched teams do not know.
        """
        for name, known in CANNOT.items():
            if (value := getattr(config, name)) != known:
                raise argument_error(name, repr(known), value, "Batched teams know nothing else.")
        if config.action_type == "goal":
            hint = "Candidates have no fixed shape yet."
            raise argument_error("action_type", "'continuous' or 'discrete'", config.action_type, hint)
        if unknown := [key for key in config.observed if key not in KEYS]:
            raise argument_error("observation_keys", f"some of {KEYS}", unknown[0], 'For example "driver".')
        belief = config.belief
        return cls(
            Hardware.of(config), Assumed.of(belief.filter), belief.alignment, belief.merging.min_sigmas,
            belief.confirm_after, config.map_error_cutoff, config.comm_loss, config.ticks_per_step, config.num_cycles,
            config.observed, rows,
        )  # fmt: skip


class Episode(NamedTuple):
    """State of a team's episode.

    Attributes:
        poses: (K, 3) float32 [m, m, rad], world frame. True poses.
        blocked: (K,) bool. Robots whose motion was blocked in the last tick.
        scans: (K, R) float32 [m]. Last scans.
        grids: (K, S, S) int8. Evidence of the robots' grids; (K, 0, 0) if `local_grid` is not observed.
        belief, waits: Belief of the team, and pairs of groups that wait.
        scores: Errors of the maps.
        tick: () int32. Ticks since the reset.
    """

    poses: Array
    blocked: Array
    scans: Array
    grids: Array
    belief: Belief
    waits: Waits
    scores: Scores
    tick: Array


def reset(scene: Scene, key: Array, rules: Rules) -> Episode:
    """Return the state at the starts, after the first frames: robots know their starts, so that all is new."""
    count, side = len(scene.starts), GRID_SIZE if "local_grid" in rules.keys else 0
    of_frames, of_scans = jax.random.split(key)
    frames = _frames(scene.starts, scene, of_frames, rules)
    empty = beliefs.start(count, rules.rows, scene.descriptors.shape[1], rules.assumed)
    belief, blocked = beliefs.insert(empty, frames, frames.valid, rules.assumed), jnp.zeros(count, jnp.bool_)
    scans = _scans(scene.starts, scene, of_scans, rules)
    grids = _painted(jnp.zeros((count, side, side), jnp.int8), belief, scans, blocked, rules)
    return Episode(
        scene.starts, blocked, scans, grids, belief, no_waits(count), _scores(belief, scene, rules),
        jnp.zeros((), jnp.int32),
    )  # fmt: skip


def step(episode: Episode, commands: Array, scene: Scene, key: Array, rules: Rules) -> tuple[Episode, Array]:
    """Return the state after a step, and the rewards (K,): by how much each map's error E has fallen [m].

    Args:
        commands: (K, 2) [m/s, rad/s]. Forward speeds and turn rates.
        key: Key of what the step draws.
    """
    of_ticks, of_radio, of_merge = jax.random.split(key, 3)

    def next_tick(so_far: Episode, key: Array) -> tuple[Episode, None]:
        return _after_tick(so_far, commands, scene, key, rules), None

    after, _ = jax.lax.scan(next_tick, episode, jax.random.split(of_ticks, rules.ticks))
    # known when it is compiled if steps are long: batches then attempt no merges that they do not need
    is_due = jnp.array(True) if rules.ticks % ATTEMPT_EVERY == 0 else (
        after.tick // ATTEMPT_EVERY > episode.tick // ATTEMPT_EVERY
    )  # fmt: skip
    belief, waits = jax.lax.cond(
        is_due,
        lambda: merged(
            after.belief, after.waits, after.tick, of_merge, _in_contact(after.belief.groups, of_radio, rules),
            rules.assumed, rules.alignment, rules.min_sigmas,
        ),
        lambda: (after.belief, after.waits),
    )  # fmt: skip
    scores = _scores(belief, scene, rules)
    return after._replace(belief=belief, waits=waits, scores=scores), episode.scores.map_errors - scores.map_errors


def seen(episode: Episode, rules: Rules) -> dict[str, Array]:
    """Return what all robots observe by key, arrays with a first dimension K."""
    left = TICK * (rules.ticks * rules.cycles - episode.tick)
    return observe(episode.belief, episode.grids, episode.scans, left, rules.keys, rules.confirm_after)


def _after_tick(episode: Episode, commands: Array, scene: Scene, key: Array, rules: Rules) -> Episode:
    """Return the state after a tick, with the scores of before."""
    of_odometry, of_frames, of_scans = jax.random.split(key, 3)
    poses, blocked = drive(episode.poses, commands, scene, rules.hardware)
    draws = jax.random.normal(of_odometry, (len(poses), 2))
    odometry = read_odometry(episode.poses, poses, scene, draws, rules.hardware)
    belief = beliefs.step(episode.belief, odometry, _frames(poses, scene, of_frames, rules), rules.assumed)
    scans = _scans(poses, scene, of_scans, rules)
    grids = _painted(episode.grids, belief, scans, blocked, rules)
    return Episode(poses, blocked, scans, grids, belief, episode.waits, episode.scores, episode.tick + 1)


def _in_contact(groups: Array, key: Array, rules: Rules) -> Array:
    """Return which groups (K, K), by their first robots, can exchange maps: robots relay, and contacts may fail."""
    count = len(groups)
    kept = jnp.triu(jax.random.uniform(key, (count, count)) >= rules.comm_loss)
    reached = kept | kept.T | jnp.eye(count, dtype=jnp.bool_)
    for _ in range(count.bit_length()):
        reached = reached @ reached
    members = groups == jnp.arange(count)[:, None]
    return members @ reached @ members.T


def _frames(poses: Array, scene: Scene, key: Array, rules: Rules) -> beliefs.Frame:
    """Return the frames of all robots."""
    robots, keys = jnp.arange(len(poses)), jax.random.split(key, len(poses))
    frames: beliefs.Frame = jax.vmap(measure, (None, 0, None, 0, None))(poses, robots, scene, keys, rules.hardware)
    return frames


def _scans(poses: Array, scene: Scene, key: Array, rules: Rules) -> Array:
    """Return the scans (K, R) of all robots."""
    draws = jax.random.normal(key, (len(poses), len(rules.hardware.rays)))
    scans: Array = jax.vmap(scan, (None, 0, None, 0, None))(
        poses, jnp.arange(len(poses)), scene, draws, rules.hardware
    )  # fmt: skip
    return scans


def _painted(grids: Array, belief: Belief, scans: Array, blocked: Array, rules: Rules) -> Array:
    """Return the grids after the scans of a tick; those of no cells stay as they are."""
    if not grids.size:
        return grids
    robots, hardware = jnp.arange(len(scans)), rules.hardware
    poses = jax.vmap(in_start_frame, (None, 0, 0))(belief.robots, robots, robots)
    fixed = (None, None, None)
    painted: Array = jax.vmap(paint, (0, 0, 0, 0, *fixed))(
        grids, poses, scans, blocked, hardware.rays, hardware.scan_range, hardware.radius
    )
    return painted


def _scores(belief: Belief, scene: Scene, rules: Rules) -> Scores:
    """Return the errors of the maps."""
    truth = Truth(scene.landmarks, scene.observable, scene.starts)
    return score(belief, truth, rules.confirm_after, rules.cutoff)
