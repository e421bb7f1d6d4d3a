"""An episode of a batched team: state, reset and step as pure functions, with the rewards of the environment."""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from slam_backend.core.validation import argument_error
from slam_backend.maps.alignment_types import AlignmentOptions
from vslam_env.batched import belief as beliefs
from vslam_env.batched.belief import Assumed, Belief
from vslam_env.batched.scoring import Scores, Truth, score
from vslam_env.batched.team import Waits, merged, no_waits
from vslam_env.batched.world import Hardware, Scene, drive, measure, read_odometry
from vslam_env.config import EnvConfig

ATTEMPT_EVERY = 10  # [ticks]
CANNOT = {  # options of the environment with the only value that batched teams know
    "oracle_pose": False, "oracle_association": False, "oracle_merge": False, "shared_start_view": False,
    "shared_reward": False, "comm_range": None, "comm_line_of_sight": False, "action_type": "continuous",
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
    rows: int

    @classmethod
    def of(cls, config: EnvConfig, rows: int) -> Self:
        """Return the rules of an environment, with room for R landmarks in a team's belief.

        Contacts that are lost for a tick (`comm_loss`) are not simulated: robots are always in contact.

        Raises:
            ValueError: If an option has a value that batched teams do not know.
        """
        for name, known in CANNOT.items():
            if (value := getattr(config, name)) != known:
                raise argument_error(name, repr(known), value, "Batched teams know nothing else.")
        belief = config.belief
        return cls(
            Hardware.of(config), Assumed.of(belief.filter), belief.alignment, belief.merging.min_sigmas,
            belief.confirm_after, config.map_error_cutoff, rows,
        )  # fmt: skip


class Episode(NamedTuple):
    """State of a team's episode.

    Attributes:
        poses: (K, 3) float32 [m, m, rad], world frame. True poses.
        blocked: (K,) bool. Robots whose motion was blocked in the last tick.
        belief, waits: Belief of the team, and pairs of groups that wait.
        scores: Errors of the maps.
        tick: () int32. Ticks since the reset.
    """

    poses: Array
    blocked: Array
    belief: Belief
    waits: Waits
    scores: Scores
    tick: Array


def reset(scene: Scene, key: Array, rules: Rules) -> Episode:
    """Return the state at the starts, after the first frames."""
    count = len(scene.starts)
    belief = beliefs.start(count, rules.rows, scene.descriptors.shape[1], rules.assumed)
    frames = _frames(scene.starts, scene, key, rules)
    belief = beliefs.step(belief, jnp.zeros((count, 3)), frames, rules.assumed)
    return Episode(
        scene.starts, jnp.zeros(count, jnp.bool_), belief, no_waits(count), _scores(belief, scene, rules),
        jnp.zeros((), jnp.int32),
    )  # fmt: skip


def step(episode: Episode, commands: Array, scene: Scene, key: Array, rules: Rules) -> tuple[Episode, Array]:
    """Return the state after a tick, and the rewards (K,): by how much each map's error E has fallen [m].

    Args:
        commands: (K, 2) [m/s, rad/s]. Forward speeds and turn rates.
        key: Key of what the tick draws.
    """
    of_odometry, of_frames, of_merge = jax.random.split(key, 3)
    poses, blocked = drive(episode.poses, commands, scene, rules.hardware)
    draws = jax.random.normal(of_odometry, (len(poses), 2))
    odometry = read_odometry(episode.poses, poses, scene, draws, rules.hardware)
    belief = beliefs.step(episode.belief, odometry, _frames(poses, scene, of_frames, rules), rules.assumed)
    tick = episode.tick + 1
    belief, waits = jax.lax.cond(
        tick % ATTEMPT_EVERY == 0,
        lambda: merged(
            belief, episode.waits, tick, of_merge, rules.assumed, rules.alignment, rules.min_sigmas
        ),
        lambda: (belief, episode.waits),
    )  # fmt: skip
    scores = _scores(belief, scene, rules)
    rewards = episode.scores.map_errors - scores.map_errors
    return Episode(poses, blocked, belief, waits, scores, tick), rewards


def _frames(poses: Array, scene: Scene, key: Array, rules: Rules) -> beliefs.Frame:
    """Return the frames of all robots."""
    robots, keys = jnp.arange(len(poses)), jax.random.split(key, len(poses))
    frames: beliefs.Frame = jax.vmap(measure, (None, 0, None, 0, None))(poses, robots, scene, keys, rules.hardware)
    return frames


def _scores(belief: Belief, scene: Scene, rules: Rules) -> Scores:
    """Return the errors of the maps."""
    truth = Truth(scene.landmarks, scene.observable, scene.starts)
    return score(belief, truth, rules.confirm_after, rules.cutoff)
