"""Merges of a team's groups, and landmarks that are held twice."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.team.merge_scheduler import MIN_IMPROVEMENT
from vslam_env.batched.alignment import align, best_pair, copies, look_alikes
from vslam_env.batched.belief import Assumed, Belief
from vslam_env.batched.merging import fused, lever_of, moved_group

WAIT = 100  # [ticks] after which a pair that was too uncertain tries again


class Waits(NamedTuple):
    """Pairs of groups that wait for less uncertain starts, by their first robots a < b.

    Attributes:
        until: (K, K) int32. Tick of the next attempt.
        excess: (K, K) float32 [-]. Standard deviation at the last attempt over its limit; inf before.
    """

    until: Array
    excess: Array


def no_waits(num_robots: int) -> Waits:
    """Return the waits of a team at its start."""
    shape = num_robots, num_robots
    return Waits(jnp.zeros(shape, jnp.int32), jnp.full(shape, jnp.inf))


def merged(
    belief: Belief, waits: Waits, tick: Array, key: Array, in_contact: Array, assumed: Assumed,
    options: AlignmentOptions, min_sigmas: float,
) -> tuple[Belief, Waits]:  # fmt: skip
    """Return the belief after an attempt to merge two groups, with landmarks that are held twice fused.

    A pair merges if the motion between its frames is certain enough, or if waiting no longer makes it more certain, see
    `slam_backend.team.MergeOptions`.

    Args:
        tick: () int32.
        key: Key of the random search.
        in_contact: (K, K) bool. Pairs of groups that can exchange maps, by their first robots.
        assumed, options, min_sigmas: Gates and limits.
    """
    alike = look_alikes(belief, assumed.descriptor_gate)
    a, b = best_pair(belief, alike, in_contact & (waits.until <= tick))
    found = align(belief, alike, a, b, key, options, min_sigmas)
    last = waits.excess[a, b]
    stays = jnp.isfinite(last) & (found.excess >= MIN_IMPROVEMENT * last)
    success = found.success & ((found.excess <= 1.0) | stays)
    is_refused = found.success & ~success
    waits = Waits(
        waits.until.at[a, b].set(jnp.where(is_refused, tick + WAIT, waits.until[a, b])),
        waits.excess.at[a, b].set(jnp.where(is_refused, found.excess, last)),
    )  # fmt: skip
    pairs, valid = copies(belief, alike, options)
    pairs, valid = jnp.where(success, found.pairs, pairs), jnp.where(success, found.valid, valid)
    moved = moved_group(belief, b, jnp.where(success, found.motion, 0.0))
    centre = jnp.where(valid[:, None], moved.places[pairs[:, 1]], 0.0).sum(axis=0) / jnp.maximum(valid.sum(), 1)
    together = fused(moved, pairs, valid, jnp.where(success, lever_of(moved, b, centre), 0.0))
    return together._replace(
        owners=jnp.where(success & (belief.owners == b), a, belief.owners),
        groups=jnp.where(success & (belief.groups == b), a, belief.groups),
    ), waits
