"""Communication between robots: contacts limited by range, line of sight and random failures."""

import math

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray


def outage_rates(loss: float, outage_ticks: float) -> tuple[float, float]:
    """Return the probabilities that an outage begins and ends in a tick.

    Durations are those of an exponential distribution, in whole ticks, and the share of time in outages is `loss`.

    Args:
        loss: Share of the time in which a link fails, in (0, 1).
        outage_ticks: Mean duration of an outage [ticks].

    >>> begin, end = outage_rates(0.5, 100.0)
    >>> round(begin, 4) == round(end, 4) == 0.01
    True
    """
    end = -math.expm1(-1.0 / outage_ticks)
    return end * loss / (1.0 - loss), end


def next_failures(
    failing: BoolArray | None, count: int, loss: float, outage_ticks: float, rng: np.random.Generator
) -> BoolArray:
    """Draw which links between robots fail in a tick.

    Args:
        failing: (K, K) bool. Links that failed in the tick before, of which those above the diagonal count; None at
            first.
        count: Number of robots K.
        loss: Share of the time in which a link fails, independently of the others.
        outage_ticks: Mean duration of an outage [ticks]; 0: each tick is drawn by itself.
        rng: Source of the draws, equally many in each tick.

    Returns:
        (K, K) bool, symmetric.
    """
    one, other = np.triu_indices(count, 1)
    draws = rng.random(len(one))
    fails = draws < loss
    if failing is not None and outage_ticks > 0.0:
        begin, end = outage_rates(loss, outage_ticks)
        fails = np.where(failing[one, other], draws >= end, draws < begin)
    matrix = np.zeros((count, count), np.bool_)
    matrix[one, other] = matrix[other, one] = fails
    return matrix


def contacts(
    poses: FloatArray, walls: FloatArray, comm_range: float | None, line_of_sight: bool, failing: BoolArray | None
) -> BoolArray:
    """Return the contacts of a tick.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. True poses.
        walls: (S, 4) float64 [m], world frame, rows (x1, y1, x2, y2).
        comm_range: Largest length of a link [m]; None: unlimited.
        line_of_sight: Whether walls block links. Robots never do.
        failing: (K, K) bool. Links that fail in this tick, see `next_failures`; None: none.

    Returns:
        (K, K) bool. Symmetric matrix of contacts; each robot is in contact with itself.
    """
    count = len(poses)
    one, other = np.triu_indices(count, 1)
    linked = np.ones(len(one), dtype=np.bool_)
    if comm_range is not None:
        linked &= np.hypot(*(poses[one, :2] - poses[other, :2]).T) <= comm_range
    if line_of_sight and linked.any():
        linked[linked] = ~crosses_wall(poses[one[linked], :2], poses[other[linked], :2], walls)
    if failing is not None:
        linked &= ~failing[one, other]
    matrix = np.eye(count, dtype=np.bool_)
    matrix[one, other] = matrix[other, one] = linked
    return matrix


def crosses_wall(starts: FloatArray, ends: FloatArray, walls: FloatArray) -> BoolArray:
    """Return which segments, from (n, 2) to (n, 2) [m], cross or touch any of the walls (S, 4) [m].

    >>> wall = np.array([[1.0, -1.0, 1.0, 1.0]])
    >>> crosses_wall(np.zeros((3, 2)), np.array([[2.0, 0.0], [0.5, 0.0], [2.0, 5.0]]), wall).tolist()
    [True, False, False]
    """
    along = (ends - starts)[:, None]  # p + t r = q + u s
    corner, edge = walls[None, :, :2], walls[None, :, 2:] - walls[None, :, :2]
    across = _cross(along, edge)
    gap = corner - starts[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = _cross(gap, edge) / across, _cross(gap, along) / across  # parallel: NaN or infinite, so no crossing
    return np.asarray(((t >= 0.0) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)).any(axis=1))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
