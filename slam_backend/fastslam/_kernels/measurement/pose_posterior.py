"""The pose given its matches: Gauss-Newton in xi, and the Gaussian from which it is sampled."""

import math

from slam_backend.core.jit import device, simd, simd_inline, stack_array
from slam_backend.core.simd_math import inverted, log_of, quadratic_form, sine_cosine, wrapped
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.measurement.measurement_model import Terms, total_log_likelihood


@device
@simd
def set_linearisation_point(work: FloatArray) -> None:
    """Write the pose rows X .. SIN of x0 + C xi, and start the system of xi from its prior N(0, I)."""
    for i in range(LANES):
        xi0, xi1, xi2 = work[L.XI0 + i], work[L.XI1 + i], work[L.XI2 + i]
        theta = work[L.T0 + i] + work[L.C20 + i] * xi0 + work[L.C21 + i] * xi1 + work[L.C22 + i] * xi2
        work[L.X + i] = work[L.X0 + i] + work[L.C00 + i] * xi0 + work[L.C01 + i] * xi1
        work[L.Y + i] = work[L.Y0 + i] + work[L.C10 + i] * xi0 + work[L.C11 + i] * xi1
        work[L.T + i] = theta
        work[L.SIN + i], work[L.COS + i] = sine_cosine(theta)
    for i in range(LANES):
        work[L.INFO00 + i] = 1.0
        work[L.INFO01 + i] = 0.0
        work[L.INFO02 + i] = 0.0
        work[L.INFO11 + i] = 1.0
        work[L.INFO12 + i] = 0.0
        work[L.INFO22 + i] = 1.0
        work[L.GRAD0 + i] = work[L.XI0 + i]
        work[L.GRAD1 + i] = work[L.XI1 + i]
        work[L.GRAD2 + i] = work[L.XI2 + i]


@simd_inline
def add_terms(work: FloatArray, i: int, on: bool, w: float, terms: Terms) -> None:
    """Where `on`, add a match's share of the Gauss-Newton system, times w; elsewhere it may be NaN."""
    work[L.INFO00 + i] += w * terms[0] if on else 0.0
    work[L.INFO01 + i] += w * terms[1] if on else 0.0
    work[L.INFO02 + i] += w * terms[2] if on else 0.0
    work[L.INFO11 + i] += w * terms[3] if on else 0.0
    work[L.INFO12 + i] += w * terms[4] if on else 0.0
    work[L.INFO22 + i] += w * terms[5] if on else 0.0
    work[L.GRAD0 + i] += w * terms[6] if on else 0.0
    work[L.GRAD1 + i] += w * terms[7] if on else 0.0
    work[L.GRAD2 + i] += w * terms[8] if on else 0.0


@device
@simd
def sum_matches(work: FloatArray, record: FloatArray, chosen: FloatArray, q: float, gate: float) -> int:
    """Add the share of candidate q in the Gauss-Newton system where it was chosen; return in how many lanes that is.

    It is weighed by Cauchy's 1 / (1 + D / gate): an infinite gate weighs all alike.
    """
    weights, count = stack_array(LANES), 0
    for i in range(len(chosen)):
        on = chosen[i] == q
        weights[i] = 1.0 / (1.0 + record[L.Q_D + i] / gate) if on else 0.0
        count += 1 if on else 0
    if count > 0:
        for i in range(LANES):
            terms = (
                record[L.Q_INFO00 + i], record[L.Q_INFO01 + i], record[L.Q_INFO02 + i], record[L.Q_INFO11 + i],
                record[L.Q_INFO12 + i], record[L.Q_INFO22 + i],
                record[L.Q_GRAD0 + i], record[L.Q_GRAD1 + i], record[L.Q_GRAD2 + i],
            )  # fmt: skip
            add_terms(work, i, weights[i] > 0.0, weights[i], terms)
    return count


@device
@simd
def gauss_newton_step(work: FloatArray, only_wide: bool) -> None:
    """Take one step of Gauss-Newton from the sums: xi <- xi - J^-1 G, with covariance J^-1."""
    for i in range(LANES):
        go = work[L.IS_WIDE + i] > 0.0 or not only_wide
        inverse, _ = inverted(
            (
                work[L.INFO00 + i],
                work[L.INFO01 + i],
                work[L.INFO02 + i],
                work[L.INFO11 + i],
                work[L.INFO12 + i],
                work[L.INFO22 + i],
            )
        )
        i00, i01, i02, i11, i12, i22 = inverse
        g0, g1, g2 = work[L.GRAD0 + i], work[L.GRAD1 + i], work[L.GRAD2 + i]
        work[L.XI0 + i] -= i00 * g0 + i01 * g1 + i02 * g2 if go else 0.0
        work[L.XI1 + i] -= i01 * g0 + i11 * g1 + i12 * g2 if go else 0.0
        work[L.XI2 + i] -= i02 * g0 + i12 * g1 + i22 * g2 if go else 0.0
        work[L.COV_XI00 + i] = i00 if go else work[L.COV_XI00 + i]
        work[L.COV_XI01 + i] = i01 if go else work[L.COV_XI01 + i]
        work[L.COV_XI02 + i] = i02 if go else work[L.COV_XI02 + i]
        work[L.COV_XI11 + i] = i11 if go else work[L.COV_XI11 + i]
        work[L.COV_XI12 + i] = i12 if go else work[L.COV_XI12 + i]
        work[L.COV_XI22 + i] = i22 if go else work[L.COV_XI22 + i]


@device
@simd
def posterior(work: FloatArray, log_likelihood: FloatArray, first: int) -> None:
    """Weigh by the predictive likelihood and sample the pose, from the sums of the second pass (Laplace's formula).

    Rows DRAW0 .. DRAW2 hold what is drawn. Rows X0 .. T0 then hold the mean x^, COV_XI00 .. COV_XI22 the covariance
    P^, X .. SIN the sample, theta wrapped.

    Args:
        work: Rows of the block.
        log_likelihood: (P,), added to.
        first: First particle of the block.
    """
    own = log_likelihood[first : first + LANES]
    for i in range(LANES):
        inverse, det = inverted(
            (
                work[L.INFO00 + i],
                work[L.INFO01 + i],
                work[L.INFO02 + i],
                work[L.INFO11 + i],
                work[L.INFO12 + i],
                work[L.INFO22 + i],
            )
        )
        i00, i01, i02, i11, i12, i22 = inverse
        g0, g1, g2 = work[L.GRAD0 + i], work[L.GRAD1 + i], work[L.GRAD2 + i]
        xi0, xi1, xi2 = work[L.XI0 + i], work[L.XI1 + i], work[L.XI2 + i]
        gain = quadratic_form(inverse, g0, g1, g2)
        own[i] += total_log_likelihood(work, i) - 0.5 * (xi0 * xi0 + xi1 * xi1 + xi2 * xi2 - gain + log_of(det))
        xi0 -= i00 * g0 + i01 * g1 + i02 * g2
        xi1 -= i01 * g0 + i11 * g1 + i12 * g2
        xi2 -= i02 * g0 + i12 * g1 + i22 * g2
        c00, c01, c10, c11 = work[L.C00 + i], work[L.C01 + i], work[L.C10 + i], work[L.C11 + i]
        c20, c21, c22 = work[L.C20 + i], work[L.C21 + i], work[L.C22 + i]
        x0, y0, t0 = work[L.X0 + i], work[L.Y0 + i], work[L.T0 + i]
        work[L.X0 + i] = x0 + c00 * xi0 + c01 * xi1
        work[L.Y0 + i] = y0 + c10 * xi0 + c11 * xi1
        work[L.T0 + i] = t0 + c20 * xi0 + c21 * xi1 + c22 * xi2
        # P^ = C J^-1 C^T
        h00, h01 = c00 * i00 + c01 * i01, c00 * i01 + c01 * i11
        h10, h11 = c10 * i00 + c11 * i01, c10 * i01 + c11 * i11
        h20, h21, h22 = (
            c20 * i00 + c21 * i01 + c22 * i02, c20 * i01 + c21 * i11 + c22 * i12, c20 * i02 + c21 * i12 + c22 * i22
        )  # fmt: skip
        work[L.COV_XI00 + i] = h00 * c00 + h01 * c01
        work[L.COV_XI01 + i] = h10 * c00 + h11 * c01
        work[L.COV_XI02 + i] = h20 * c00 + h21 * c01
        work[L.COV_XI11 + i] = h10 * c10 + h11 * c11
        work[L.COV_XI12 + i] = h20 * c10 + h21 * c11
        work[L.COV_XI22 + i] = h20 * c20 + h21 * c21 + h22 * c22
        n0, n1, n2 = work[L.DRAW0 + i], work[L.DRAW1 + i], work[L.DRAW2 + i]
        l00 = math.sqrt(i00)
        l10, l20 = i01 / l00, i02 / l00
        l11 = math.sqrt(i11 - l10 * l10)
        l21 = (i12 - l20 * l10) / l11
        l22 = math.sqrt(i22 - l20 * l20 - l21 * l21)
        xi0 += l00 * n0
        xi1 += l10 * n0 + l11 * n1
        xi2 += l20 * n0 + l21 * n1 + l22 * n2
        theta = t0 + c20 * xi0 + c21 * xi1 + c22 * xi2
        work[L.X + i] = x0 + c00 * xi0 + c01 * xi1
        work[L.Y + i] = y0 + c10 * xi0 + c11 * xi1
        work[L.T + i] = wrapped(theta)
        work[L.SIN + i], work[L.COS + i] = sine_cosine(theta)
