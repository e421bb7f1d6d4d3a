"""Occupancy grids in arrays of fixed shape: each robot paints its own scans around its start.

Cells get the same evidence as in `vslam_env.navigation.OccupancyGrid`, which grows; here what lies beyond the grid is
ignored, and grids of teammates are not exchanged.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vslam_env.batched.belief import rotation, wrapped
from vslam_env.navigation._grid_kernels import CELL, GRID_SIZE, HALF_WIDTH, MOST_FREE, MOST_OCCUPIED
from vslam_env.navigation._grid_kernels.occupancy import HIT
from vslam_env.navigation._grid_kernels.scan_update import (
    LEAST,
    SAME_SURFACE_GAP,
    STRAIGHT_GAP,
    STRAIGHT_TOLERANCE,
    WALL_HALF_THICKNESS,
)

Angles = tuple[float, ...]


class Survey(NamedTuple):
    """What a scan of R rays says, robot frame; see `vslam_env.navigation._grid_kernels.scan_geometry`.

    Attributes:
        ends: (R, 2) [m]. Ends of the rays.
        is_hit: (R,) bool. Whether a ray met something.
        normals, offsets: (R + 1, 2) [-], (R + 1,) [m]. Surface that both rays k - 1 and k see; infinitely far off
            without one, as before the first and after the last.
        wall_above: (R + 1,) [m]. Distance before the surface from which all is wall.
        free_below: (R + 1,) [m^2]. Squared distance below which all before the surface is free.
        is_jump: (R + 1,) bool. Whether the range jumps between two rays.
    """

    ends: Array
    is_hit: Array
    normals: Array
    offsets: Array
    wall_above: Array
    free_below: Array
    is_jump: Array


def survey(ranges: Array, angles: Angles, max_range: float) -> Survey:
    """Return what ranges (R,) [m] along rays say."""
    reach, is_hit = jnp.minimum(ranges, max_range), ranges < max_range
    ends = reach[:, None] * jnp.stack([jnp.cos(jnp.asarray(angles)), jnp.sin(jnp.asarray(angles))], axis=1)
    chord, step = ends[2:] - ends[:-2], ends[1:-1] - ends[:-2]
    off_line = jnp.abs(chord[:, 0] * step[:, 1] - chord[:, 1] * step[:, 0])
    straight = off_line <= STRAIGHT_TOLERANCE * jnp.linalg.norm(chord, axis=1)
    in_line = jnp.pad(is_hit[:-2] & is_hit[1:-1] & is_hit[2:] & straight, 1)
    along = ends[1:] - ends[:-1]
    gap = jnp.maximum(jnp.linalg.norm(along, axis=1), LEAST)
    is_surface = is_hit[:-1] & is_hit[1:] & ((gap <= SAME_SURFACE_GAP) | in_line[:-1] | in_line[1:])
    is_jump = (is_hit[:-1] | is_hit[1:]) & ~is_surface
    offsets = (along[:, 1] * ends[:-1, 0] - along[:, 0] * ends[:-1, 1]) / gap
    above = jnp.where(gap <= STRAIGHT_GAP, -WALL_HALF_THICKNESS, WALL_HALF_THICKNESS)
    nearer = jnp.minimum(reach[:-1], reach[1:]) - jnp.where(is_jump, WALL_HALF_THICKNESS, 0.0)
    normals = jnp.stack([-along[:, 1], along[:, 0]], axis=1) / gap[:, None]

    def of_surface(values: Array, without: Array | float) -> Array:
        """Return values of intervals with a surface, and of those without one."""
        return jnp.pad(jnp.where(is_surface, values, without), 1, constant_values=jnp.inf)

    return Survey(
        ends, is_hit, jnp.pad(jnp.where(is_surface[:, None], normals, 0.0), ((1, 1), (0, 0))),
        of_surface(offsets, jnp.inf), of_surface(above, jnp.inf),
        of_surface(jnp.full_like(gap, jnp.inf), jnp.maximum(nearer, 0.0) ** 2), jnp.pad(is_jump, 1),
    )  # fmt: skip


def paint(
    evidence: Array, pose: Array, ranges: Array, blocked: Array, angles: Angles, max_range: float, radius: float
) -> Array:
    """Return the evidence (S, S) int8 after a scan, the floor that a robot covers, and its bump.

    Args:
        evidence: (S, S) int8, rows with y and columns with x. 0: unknown; below: free; above: occupied.
        pose: (3,) [m, m, rad], start frame.
        ranges, angles, max_range: Scan (R,) [m] along ascending angles [rad], robot frame.
        blocked: () bool. Whether an obstacle blocked the motion.
        radius: Radius of the robot [m].
    """
    width = min(2 * round(max_range / CELL + 2.0), GRID_SIZE)
    corner = jnp.floor((pose[1::-1] + HALF_WIDTH) / CELL).astype(jnp.int32) - width // 2
    corner = jnp.clip(corner, 0, GRID_SIZE - width)
    old = jax.lax.dynamic_slice(evidence, corner, (width, width)).astype(jnp.int32)
    middles = (corner[:, None] + jnp.arange(width) + 0.5) * CELL - HALF_WIDTH - pose[1::-1, None]
    v, u = jnp.meshgrid(*middles, indexing="ij")
    change = _changes(survey(ranges, angles, max_range), pose[2], u, v, jnp.asarray(angles))
    new = jnp.clip(old + change, MOST_FREE, MOST_OCCUPIED)
    new = jnp.where(change == 0, old, jnp.where(new == 0, -1, new))
    distance = jnp.sqrt(u**2 + v**2)
    covered = (distance <= max(radius - 0.5 * CELL, 0.0)) | ((new == 0) & (distance <= radius))
    new = jnp.where(covered, jnp.minimum(new, -1), new)
    ahead = pose[:2] + (radius + 0.5 * CELL) * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    row, column = jnp.floor((ahead[::-1] + HALF_WIDTH) / CELL).astype(jnp.int32) - corner
    bumped = new.at[row, column].max(2 * HIT, mode="drop")
    return jax.lax.dynamic_update_slice(evidence, jnp.where(blocked, bumped, new).astype(jnp.int8), corner)


def _changes(told: Survey, heading: Array, u: Array, v: Array, angles: Array) -> Array:
    """Return the evidence (W, W) that a scan adds to cells at (u, v) [m] from the robot."""
    bearing = wrapped(jnp.arctan2(v, u) - heading)
    between = (bearing[..., None] >= angles).sum(axis=-1)  # the cell lies between the rays k - 1 and k
    turned = rotation(heading)
    normals, ends = told.normals @ turned.T, told.ends @ turned.T

    def before(k: Array) -> Array:
        """Return how far the cells lie before the surfaces of intervals [m]."""
        return normals[k, 0] * u + normals[k, 1] * v + told.offsets[k]

    ahead = before(between)
    is_free = (ahead > WALL_HALF_THICKNESS) & (u**2 + v**2 < told.free_below[between])
    change = jnp.where(is_free, -1, jnp.where(ahead > told.wall_above[between], HIT, 0))
    right, left = jnp.maximum(between - 1, 0), jnp.minimum(between, len(angles) - 1)
    goes_on = jnp.minimum(jnp.abs(before(right)), jnp.abs(before(left + 1))) < WALL_HALF_THICKNESS
    holds_hit = jnp.zeros_like(is_free)
    for ray in (right, left):
        off = jnp.maximum(jnp.abs(u - ends[ray, 0]), jnp.abs(v - ends[ray, 1]))
        holds_hit |= told.is_hit[ray] & (off <= 0.5 * CELL)
    at_jump = jnp.where(change < 0, jnp.where(goes_on, 0, change), jnp.where(holds_hit, HIT, 0))
    inside = (between > 0) & (between < len(angles))
    return jnp.where(inside, jnp.where(told.is_jump[between], at_jump, change), 0)


def sample(evidence: Array, pose: Array, places: Array) -> Array:
    """Return the evidence (...) int8 at places (..., 2) [m], robot frame; 0 beyond the grid."""
    at = (places @ rotation(pose[2]).T + pose[:2] + HALF_WIDTH) / CELL
    column, row = jnp.moveaxis(jnp.floor(at).astype(jnp.int32), -1, 0)
    inside = (jnp.minimum(row, column) >= 0) & (jnp.maximum(row, column) < GRID_SIZE)
    return jnp.where(inside, evidence[row, column], 0)
