"""Registration of matched landmarks: residuals, the rigid motion that fits them, and its covariance.

Functions take one motion (3,) or several (h, 3) at once, a_from_b [m, m, rad], and the table (k, 18) of `match_table`,
or one table per motion (h, k, 18).
"""

import math
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.geometry import cosine_sine, wrap_angle
from slam_backend.metrics import align_se2

MIN_VARIANCE = 1e-8  # [m^2], (0.1 mm)^2: keeps exact landmarks (Sigma = 0) solvable
MEDIAN_CHI2_3 = 2.3659738843753377
MAX_ROUNDS = 30
LEVELS, ZOOMS = 16, 3  # of a variance between 1e-8 and 1e-2 m^2, on the log scale: to 0.3 %
# Matches shape the fit up to 99.9 % where the inliers' gate is 99 %: a hard limit there would cost 5 % of the variance.
FIT_GATE = 16.27 / 11.34
# The median of k squared residuals of 3 degrees of freedom is above 1 + 2.2 / sqrt(k) times its own by chance in 2.5 %.
CHANCE_EXCESS = 2.2
# Shares of the information about the rotation that one, two and three matches may hold among at least 4, 8 and 12:
# beyond these the others cannot vouch for them.
MOST_LEVERAGE = (0.5, 0.65, 0.75)
MATCHES_PER_LEVER = 4
FITS = 10  # rounds of fitting a rigid motion to the landmarks within the gate
OUTSIDE = 1e-3  # weight of those beyond it; never nothing: the fit stays defined


class Residuals(NamedTuple):
    """Residuals r of k matches under motions (...), with covariances S.

    Attributes:
        distances: (..., k) squared Mahalanobis distances, D = r^T S^-1 r.
        pulls: Three (..., k) components of S^-1 r [1/m].
        wxx, wxy, wyy: (..., k) planar part of S^-1 [1/m^2].
        determinants: (..., k) |S| [m^6].
    """

    distances: FloatArray
    pulls: tuple[FloatArray, FloatArray, FloatArray]
    wxx: FloatArray
    wxy: FloatArray
    wyy: FloatArray
    determinants: FloatArray


def residuals(table: FloatArray, motions: FloatArray, floor: FloatArray | float) -> Residuals:
    """Return the residuals of all matches under p_a = R p_b + t, with S = Sigma_a + R Sigma_b R^T + floor I.

    The height is eliminated first, so that a 2x2 system remains.

    Args:
        table: (..., k, 18) matches.
        motions: (..., 3) [m, m, rad].
        floor: Added to each variance [m^2]; (..., 1) or a number.
    """
    ax, ay, az, bx, by, bz, axx, axy, axz, ayy, ayz, azz, bxx, bxy, bxz, byy, byz, bzz = np.moveaxis(table, -1, 0)
    cos, sin = cosine_sine(motions[..., 2:])
    rx, ry, rz = ax - cos * bx + sin * by - motions[..., :1], ay - sin * bx - cos * by - motions[..., 1:2], az - bz
    half_sum, half_difference = 0.5 * (bxx + byy) + floor, 0.5 * (bxx - byy)
    cos2, sin2 = cos * cos - sin * sin, 2.0 * cos * sin  # of twice the angle
    turned = cos2 * half_difference - sin2 * bxy  # Eqs. 16-17, corrected
    sxx, sxy, syy = axx + half_sum + turned, axy + sin2 * half_difference + cos2 * bxy, ayy + half_sum - turned
    sxz, syz, szz = axz + cos * bxz - sin * byz, ayz + sin * bxz + cos * byz, azz + bzz + floor
    kx, ky = sxz / szz, syz / szz
    x, y, sxx, sxy, syy = rx - kx * rz, ry - ky * rz, sxx - kx * sxz, sxy - kx * syz, syy - ky * syz
    determinant = sxx * syy - sxy * sxy
    wxx, wxy, wyy = syy / determinant, -sxy / determinant, sxx / determinant
    vx, vy = wxx * x + wxy * y, wxy * x + wyy * y
    pulls = vx, vy, rz / szz - kx * vx - ky * vy
    return Residuals(rz * rz / szz + vx * x + vy * y, pulls, wxx, wxy, wyy, determinant * szz)


def squared_distances(table: FloatArray, motions: FloatArray, floor: FloatArray | float) -> FloatArray:
    """Return the squared Mahalanobis residuals (..., k) of all matches under motions (..., 3)."""
    return residuals(table, motions, floor).distances


def lever_arms(table: FloatArray, motions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return dR/dtheta p_b, both coordinates (..., k) [m]."""
    cos, sin = cosine_sine(motions[..., 2:])
    bx, by = table[..., 3], table[..., 4]
    return -sin * bx - cos * by, cos * bx - sin * by


def shares(table: FloatArray, motions: FloatArray, floor: FloatArray | float) -> list[FloatArray]:
    """Return the parts of J^T S^-1 J, by rows, and of J^T S^-1 r, each (..., k), with J = [e_x, e_y, dR/dtheta p_b]."""
    _, (x, y, _), wxx, wxy, wyy, _ = residuals(table, motions, floor)
    jx, jy = lever_arms(table, motions)
    vx, vy = wxx * jx + wxy * jy, wxy * jx + wyy * jy
    return [wxx, wxy, vx, wxy, wyy, vy, vx, vy, jx * vx + jy * vy, x, y, jx * x + jy * y]


def information(
    table: FloatArray, members: BoolArray, motions: FloatArray, floor: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return H = sum J^T S^-1 J (..., 3, 3) and g = sum J^T S^-1 r (..., 3) over the members (..., k)."""
    sums = np.stack([np.einsum("...k,...k->...", part, members) for part in shares(table, motions, floor)], axis=-1)
    return sums[..., :9].reshape(*sums.shape[:-1], 3, 3), sums[..., 9:]


def gauss_newton_step(
    table: FloatArray, members: BoolArray, motions: FloatArray, floor: FloatArray | float
) -> FloatArray:
    """Return the motions (..., 3) after a weighted Gauss-Newton step; unchanged where members leave the rotation open.

    The translation is eliminated first: u = H_tt^-1 H_t,theta and v = H_tt^-1 g_t.
    """
    h, g = information(table, members, motions, floor)
    hxx, hxy, hyy, hx, hy, turning = (h[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    determinant = hxx * hyy - hxy * hxy
    with np.errstate(divide="ignore", invalid="ignore"):
        ux, uy = (hyy * hx - hxy * hy) / determinant, (hxx * hy - hxy * hx) / determinant
        vx = (hyy * g[..., 0] - hxy * g[..., 1]) / determinant
        vy = (hxx * g[..., 1] - hxy * g[..., 0]) / determinant
        remaining = turning - hx * ux - hy * uy
        turn = (g[..., 2] - hx * vx - hy * vy) / remaining
    step = np.stack([vx - ux * turn, vy - uy * turn, turn], axis=-1)
    moved = motions + np.where(((determinant > 0.0) & (remaining > 1e-12 * turning))[..., None], step, 0.0)
    moved[..., 2] = wrap_angle(moved[..., 2])
    return moved


def between_map_variance(table: FloatArray, members: BoolArray, motion: FloatArray, floor: float) -> float:
    """Return the added variance, at most `floor`, under which the members' median D is that of 3 degrees of freedom.

    Covariances that explain the residuals, up to what chance may do, get almost nothing added, so that weights stay
    efficient and the result's covariance honest; over-confident ones get what their residuals show.
    """
    chosen = table[members]
    if not len(chosen):
        return floor
    target = MEDIAN_CHI2_3 * (1.0 - 1.0 / max(len(chosen), 2))  # three of the 3 k residuals went into the fit
    low, high = min(MIN_VARIANCE, floor), floor
    for level in range(ZOOMS):
        variances = np.geomspace(low, high, LEVELS + 1)
        medians = np.median(squared_distances(chosen, motion[None], variances[:, None]), axis=1)
        if not level and medians[0] <= target * (1.0 + CHANCE_EXCESS / math.sqrt(len(chosen))):
            return low
        first = int((medians <= target).argmax()) if medians[-1] < target else LEVELS
        low, high = float(variances[max(first - 1, 0)]), float(variances[first])
    return high


def drop_unverified(table: FloatArray, members: BoolArray, motion: FloatArray, floor: float) -> None:
    """Take out, one after the other, members of which one to three say more about the rotation than all others.

    Where landmarks lie close together, a few wrong matches far away would turn the fit until they fit themselves.
    """
    _, _, wxx, wxy, wyy, _ = residuals(table, motion, floor)
    arm_x, arm_y = lever_arms(table, motion)
    while count := np.count_nonzero(members):
        hxx, hxy, hyy = ((weights * members).sum() for weights in (wxx, wxy, wyy))
        hx, hy = ((weights * members).sum() for weights in (wxx * arm_x + wxy * arm_y, wxy * arm_x + wyy * arm_y))
        determinant = hxx * hyy - hxy * hxy
        if determinant <= 1e-12 * hxx * hyy:
            return
        jx = arm_x - (hyy * hx - hxy * hy) / determinant
        jy = arm_y - (hxx * hy - hxy * hx) / determinant
        own = np.where(members, wxx * jx * jx + 2.0 * wxy * jx * jy + wyy * jy * jy, 0.0)
        largest = np.cumsum(np.sort(own)[::-1][: len(MOST_LEVERAGE)])
        levers = zip(largest.tolist(), MOST_LEVERAGE, strict=False)
        if not any(
            count >= MATCHES_PER_LEVER * (m + 1) and together > most * own.sum()
            for m, (together, most) in enumerate(levers)
        ):
            return
        members[own.argmax()] = False


def largest_influence(table: FloatArray, members: BoolArray, motion: FloatArray, floor: float) -> tuple[float, float]:
    """Return how far the translation [m], and the rotation [rad], would go at most if one member were left out.

    To first order: the step from `motion`, at which all members together rest, with one's information taken away.
    """
    parts = np.stack(shares(table[members], motion, floor), axis=-1)
    own, pulls = parts[:, :9].reshape(-1, 3, 3), parts[:, 9:]
    h = own.sum(axis=0)
    rest = h - own
    if not len(own) or (np.linalg.det(rest) <= 1e-9 * h[0, 0] * h[1, 1] * h[2, 2]).any():
        return math.inf, math.inf
    steps = np.linalg.solve(rest, pulls[..., None])[..., 0]
    return float(np.hypot(steps[:, 0], steps[:, 1]).max()), float(np.abs(steps[:, 2]).max())


def refine(table: FloatArray, start: FloatArray, floor: float, gate: float) -> tuple[FloatArray, BoolArray, float]:
    """Alternate inliers, added variance and Gauss-Newton steps until the motion rests.

    Returns:
        The motion (3,); the members (k,) that shaped it; the added variance [m^2]. Members lie within 1.4 times `gate`
        under the fitted variance.
    """
    motion, members, variance = start, np.zeros(len(table), np.bool_), floor
    for _ in range(MAX_ROUNDS):
        variance = between_map_variance(table, squared_distances(table, motion, floor) <= gate, motion, floor)
        members = squared_distances(table, motion, variance) <= FIT_GATE * gate
        drop_unverified(table, members, motion, variance)
        moved = gauss_newton_step(table, members, motion, variance)
        rests = np.abs(moved - motion).max() < 1e-10
        motion = moved
        if rests:
            break
    return motion, members, variance


def count_moved_away(table: FloatArray, floor: float, gate: float) -> int:
    """Return how many landmarks lie beyond the gate at the rigid motion that those within it agree on.

    Args:
        table: (k, 18) landmarks of the map as it is now, a, and as it was, b.
        floor: Added to each variance [m^2].
        gate: Largest squared Mahalanobis residual [-].
    """
    a, b, inside = table[:, :2], table[:, 3:5], np.ones(len(table), np.bool_)
    for _ in range(FITS):
        motion = align_se2(a, b, np.where(inside, 1.0, OUTSIDE))
        far = squared_distances(table, motion, floor) > gate
        if not (far == inside).any():  # the next fit would be the same
            break
        inside = ~far
    return int(np.count_nonzero(far))
