"""Registration of matched landmarks: residuals, the rigid motion that fits them, and its covariance."""

import math

import numpy as np

from slam_backend.core.jit import device, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray


@device
@jit
def residual(
    table: FloatArray, i: int, cos: float, sin: float, tx: float, ty: float, floor: float
) -> tuple[float, float, float, float, float, float]:
    """Return (D, rx, ry, wxx, wxy, wyy) of one candidate under p_a = R p_b + t.

    S = Sigma_a + R Sigma_b R^T + floor I. The height is eliminated first, so that a 2x2 system remains: (rx, ry) is
    the planar residual given the height's, w the inverse of its covariance, and D = r^T S^-1 r in all three axes.
    """
    rx = table[i, 0] - cos * table[i, 3] + sin * table[i, 4] - tx
    ry = table[i, 1] - sin * table[i, 3] - cos * table[i, 4] - ty
    rz = table[i, 2] - table[i, 5]
    bxx, bxy, bxz, byy, byz = table[i, 12], table[i, 13], table[i, 14], table[i, 15], table[i, 16]
    sxx = table[i, 6] + cos * cos * bxx - 2.0 * cos * sin * bxy + sin * sin * byy + floor  # Eqs. 16-17, corrected
    sxy = table[i, 7] + cos * sin * (bxx - byy) + (cos * cos - sin * sin) * bxy
    syy = table[i, 9] + sin * sin * bxx + 2.0 * cos * sin * bxy + cos * cos * byy + floor
    sxz = table[i, 8] + cos * bxz - sin * byz
    syz = table[i, 10] + sin * bxz + cos * byz
    wzz = 1.0 / (table[i, 11] + table[i, 17] + floor)
    kx, ky = sxz * wzz, syz * wzz
    rx -= kx * rz
    ry -= ky * rz
    sxx -= kx * sxz
    sxy -= kx * syz
    syy -= ky * syz
    scale = 1.0 / (sxx * syy - sxy * sxy)
    wxx, wxy, wyy = scale * syy, -scale * sxy, scale * sxx
    distance = rz * rz * wzz + wxx * rx * rx + 2.0 * wxy * rx * ry + wyy * ry * ry
    return distance, rx, ry, wxx, wxy, wyy


@jit
def squared_distances(table: FloatArray, pose: FloatArray, floor: float) -> FloatArray:
    """Return the squared Mahalanobis residuals (k,) of all candidates under `pose` (3,) = a_from_b."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    result = np.empty(len(table))
    for i in range(len(table)):
        result[i] = residual(table, i, cos, sin, pose[0], pose[1], floor)[0]
    return result


@device
@jit
def support(table: FloatArray, pose: FloatArray, floor: float, gate: float, members: BoolArray) -> tuple[int, float]:
    """Mark the candidates within `gate`; return their number and the score, sum of 1 - D / gate over them."""
    cos, sin, tx, ty = math.cos(pose[2]), math.sin(pose[2]), pose[0], pose[1]
    count, score = 0, 0.0
    for i in range(len(table)):
        members[i] = False
        rx = table[i, 0] - cos * table[i, 3] + sin * table[i, 4] - tx
        ry = table[i, 1] - sin * table[i, 3] - cos * table[i, 4] - ty
        # No direction's variance exceeds the sum of the traces: this alone rules out most outliers.
        largest = table[i, 6] + table[i, 9] + table[i, 11] + table[i, 12] + table[i, 15] + table[i, 17] + floor
        if rx * rx + ry * ry <= gate * largest:
            distance = residual(table, i, cos, sin, tx, ty, floor)[0]
            if distance <= gate:
                members[i] = True
                count += 1
                score += 1.0 - distance / gate
    return count, score


@jit
def own_support(table: FloatArray, poses: FloatArray, claimed: BoolArray, floor: float, gate: float) -> IntArray:
    """Return how many candidates each of `poses` (h, 3) has within `gate`, those that are `claimed` (k,) left out."""
    found = np.zeros(len(poses), np.int64)
    members = np.zeros(len(table), np.bool_)
    rest = table[~claimed]
    for h in range(len(poses)):
        found[h] = support(rest, poses[h], floor, gate, members)[0]
    return found


MIN_VARIANCE = 1e-8  # [m^2], (0.1 mm)^2: keeps exact landmarks (Sigma = 0) solvable
MEDIAN_CHI2_3 = 2.3659738843753377
MAX_ROUNDS = 30
BISECTIONS = 12  # of a variance between 1e-8 and 1e-2 m^2, on the log scale: to 0.3 %
# Matches shape the fit up to 99.9 % where the inliers' gate is 99 %: a hard limit there would cost 5 % of the variance.
FIT_GATE = 16.27 / 11.34
# The median of k squared residuals of 3 degrees of freedom is above 1 + 2.2 / sqrt(k) times its own by chance in 2.5 %.
CHANCE_EXCESS = 2.2
# Shares of the information about the rotation that one, two and three matches may hold among at least 4, 8 and 12:
# beyond these the others cannot vouch for them.
MOST_LEVERAGE = (0.5, 0.65, 0.75)
MATCHES_PER_LEVER = 4


@jit
def information(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> tuple[FloatArray, FloatArray]:
    """Return H = sum J^T S^-1 J (3, 3) and g = sum J^T S^-1 r (3,) over the members, J = [e_x, e_y, dR/dtheta p_b]."""
    cos, sin, tx, ty = math.cos(pose[2]), math.sin(pose[2]), pose[0], pose[1]
    h, g = np.zeros((3, 3)), np.zeros(3)
    for i in range(len(table)):
        if members[i]:
            _, rx, ry, wxx, wxy, wyy = residual(table, i, cos, sin, tx, ty, floor)
            jx = -sin * table[i, 3] - cos * table[i, 4]
            jy = cos * table[i, 3] - sin * table[i, 4]
            wx, wy = wxx * rx + wxy * ry, wxy * rx + wyy * ry
            vx, vy = wxx * jx + wxy * jy, wxy * jx + wyy * jy
            h[0, 0] += wxx
            h[0, 1] += wxy
            h[1, 1] += wyy
            h[0, 2] += vx
            h[1, 2] += vy
            h[2, 2] += jx * vx + jy * vy
            g[0] += wx
            g[1] += wy
            g[2] += jx * wx + jy * wy
    h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
    return h, g


@device
@jit
def gauss_newton_step(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> FloatArray:
    """Return `pose` after one weighted Gauss-Newton step; unchanged if the members leave the rotation open."""
    h, g = information(table, members, pose, floor)
    determinant = h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1]
    if determinant <= 0.0:
        return pose.copy()
    # The translation is eliminated first: u = H_tt^-1 H_t,theta and v = H_tt^-1 g_t.
    ux = (h[1, 1] * h[0, 2] - h[0, 1] * h[1, 2]) / determinant
    uy = (h[0, 0] * h[1, 2] - h[0, 1] * h[0, 2]) / determinant
    vx = (h[1, 1] * g[0] - h[0, 1] * g[1]) / determinant
    vy = (h[0, 0] * g[1] - h[0, 1] * g[0]) / determinant
    remaining = h[2, 2] - h[0, 2] * ux - h[1, 2] * uy
    if remaining <= 1e-12 * h[2, 2]:
        return pose.copy()
    turn = (g[2] - h[0, 2] * vx - h[1, 2] * vy) / remaining
    heading = (pose[2] + turn + math.pi) % (2.0 * math.pi) - math.pi
    return np.array([pose[0] + vx - ux * turn, pose[1] + vy - uy * turn, heading])


@device
@jit
def between_map_variance(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> float:
    """Return the added variance, at most `floor`, under which the members' median D is that of 3 degrees of freedom.

    Covariances that explain the residuals, up to what chance may do, get almost nothing added, so that weights stay
    efficient and the result's covariance honest; over-confident ones get what their residuals show.
    """
    chosen = table[members]
    target = MEDIAN_CHI2_3 * (1.0 - 1.0 / max(len(chosen), 2))  # three of the 3 k residuals went into the fit
    low, high = min(MIN_VARIANCE, floor), floor
    by_chance = 1.0 + CHANCE_EXCESS / math.sqrt(max(len(chosen), 1))
    if np.median(squared_distances(chosen, pose, low)) <= target * by_chance:
        return low
    if np.median(squared_distances(chosen, pose, floor)) >= target:
        return floor
    for _ in range(BISECTIONS):
        middle = math.sqrt(low * high)
        if np.median(squared_distances(chosen, pose, middle)) > target:
            low = middle
        else:
            high = middle
    return high


@device
@jit
def drop_unverified(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> None:
    """Take out, one after the other, members of which one to three say more about the rotation than all others.

    Where landmarks lie close together, a few wrong matches far away would turn the fit until they fit themselves.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for _ in range(len(table)):
        h = information(table, members, pose, floor)[0]
        scale = h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1]
        if scale <= 1e-12 * h[0, 0] * h[1, 1]:
            return
        ux = (h[1, 1] * h[0, 2] - h[0, 1] * h[1, 2]) / scale
        uy = (h[0, 0] * h[1, 2] - h[0, 1] * h[0, 2]) / scale
        whole, count = 0.0, 0
        first, second, third, worst = 0.0, 0.0, 0.0, -1
        for i in range(len(table)):
            if members[i]:
                _, _, _, wxx, wxy, wyy = residual(table, i, cos, sin, pose[0], pose[1], floor)
                jx = -sin * table[i, 3] - cos * table[i, 4] - ux
                jy = cos * table[i, 3] - sin * table[i, 4] - uy
                own = wxx * jx * jx + 2.0 * wxy * jx * jy + wyy * jy * jy
                whole += own
                count += 1
                if own > first:
                    first, second, third, worst = own, first, second, i
                elif own > second:
                    second, third = own, second
                elif own > third:
                    third = own
        together = 0.0
        verified = True
        for m, share in enumerate((first, second, third)):
            together += share
            if count >= MATCHES_PER_LEVER * (m + 1) and together > MOST_LEVERAGE[m] * whole:
                verified = False
        if verified:
            return
        members[worst] = False


@jit
def largest_influence(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> tuple[float, float]:
    """Return how far the translation [m], and the rotation [rad], would go at most if one member were left out.

    To first order: the step from `pose`, at which all members together rest, with one's information taken away.
    """
    h, _ = information(table, members, pose, floor)
    alone = np.zeros(len(table), np.bool_)
    farthest, widest = 0.0, 0.0
    for i in range(len(table)):
        if members[i]:
            alone[i] = True
            own, pull = information(table, alone, pose, floor)
            alone[i] = False
            rest = h - own
            if np.linalg.det(rest) <= 1e-9 * h[0, 0] * h[1, 1] * h[2, 2]:
                return np.inf, np.inf
            step = np.linalg.solve(rest, pull)
            farthest = max(farthest, math.hypot(step[0], step[1]))
            widest = max(widest, abs(step[2]))
    return farthest, widest


@jit
def refine(table: FloatArray, start: FloatArray, floor: float, gate: float) -> tuple[FloatArray, BoolArray, float]:
    """Alternate inliers, added variance and Gauss-Newton steps until the pose rests.

    Returns:
        The pose (3,); the members (k,) that shaped it; the added variance [m^2]. Members lie within 1.4 times `gate`
        under the fitted variance.
    """
    pose = start.copy()
    members = np.zeros(len(table), np.bool_)
    variance = floor
    for _ in range(MAX_ROUNDS):
        support(table, pose, floor, gate, members)
        variance = between_map_variance(table, members, pose, floor)
        support(table, pose, variance, FIT_GATE * gate, members)
        drop_unverified(table, members, pose, variance)
        moved = gauss_newton_step(table, members, pose, variance)
        rests = np.abs(moved - pose).max() < 1e-10
        pose = moved
        if rests:
            break
    return pose, members, variance
