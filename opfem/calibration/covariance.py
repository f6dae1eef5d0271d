"""Covariance of a least-squares fit whose residuals are correlated along each curve, as those of a load frame are.

Residuals follow a first-order autoregression; restricted maximum likelihood estimates its correlation, without bias
from the fitted numbers. On the host, in NumPy.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter
from scipy.stats import t

# Residuals below this part of the data are round-off and no measure of noise.
_ROUNDOFF = 1e-11
_NORMAL = 1.959964  # of a normal number, 95 % within


class Covariance(NamedTuple):
    """Covariance of a fit from its residuals.

    Attributes:
        matrix: Covariance of the numbers; the square roots of its diagonal times 1.96 are 95 % intervals.
        correlation: Of neighbouring residuals [-].
        effective: Number of independent residuals of equal information.
        variance: Variance of one residual.
        deviance: Minus twice the log-likelihood of the residuals, up to a constant.
    """

    matrix: Float[np.ndarray, "k k"]
    correlation: float
    effective: float
    variance: float
    deviance: float


def correlated_covariance(
    residuals: Float[np.ndarray, " n"], jacobian: Float[np.ndarray, "n k"], curves: Sequence[slice], scale: float
) -> Covariance:
    """Estimate the covariance of ordinary least squares under first-order autoregressive residuals.

    Args:
        residuals: At the optimum.
        jacobian: Of the residuals by the numbers.
        curves: Rows of each curve; curves are independent.
        scale: Size of the data, for the limit of round-off.

    Source:
        Patterson & Thompson, Biometrika 58 (1971) 545 (restricted likelihood). Intervals are widened from the normal
        distribution to Student's with the effective degrees of freedom.
    """
    n, k = jacobian.shape
    q, r = np.linalg.qr(jacobian)
    noise = np.sqrt(np.mean(residuals**2))
    highest = 1.0 - 2.0 / max(curve.stop - curve.start for curve in curves)

    def whitened(x, rho):
        x = x.reshape(n, -1)
        parts = [np.concatenate([x[c][:1], (x[c][1:] - rho * x[c][:-1]) / np.sqrt(1.0 - rho**2)]) for c in curves]
        return np.concatenate(parts)

    def restricted(rho):
        """Compute the residual sum of squares, and minus twice the restricted log-likelihood."""
        qw, rw = np.linalg.qr(whitened(q, rho))
        left = whitened(residuals, rho)
        left = left - qw @ (qw.T @ left)
        squares = float(np.sum(left**2))
        steps = n - len(curves)
        return squares, (n - k) * np.log(squares) + 2 * np.sum(np.log(np.abs(np.diag(rw)))) + steps * np.log(1 - rho**2)

    rho, variance = 0.0, noise**2 * n / max(n - k, 1)
    if noise > _ROUNDOFF * scale and n > k + 2:
        found: Any = minimize_scalar(lambda rho: restricted(rho)[1], bounds=(-0.5, highest), method="bounded")
        rho = max(float(found.x), 0.0)
        variance = restricted(rho)[0] / (n - k)
    spread = np.concatenate([_correlate(q[curve], rho) for curve in curves])
    inverse = np.linalg.inv(r)
    effective = n * (1.0 - rho) / (1.0 + rho)
    widened = t.ppf(0.975, max(effective - k, 1.0)) / _NORMAL
    matrix = widened**2 * variance * inverse @ (q.T @ spread) @ inverse.T
    tiny = (_ROUNDOFF * scale) ** 2
    deviance = n * math.log(max(variance * (n - k) / n, tiny)) + (n - len(curves)) * math.log(1.0 - rho**2)
    return Covariance(0.5 * (matrix + matrix.T), rho, effective, variance, deviance)


def _correlate(x: np.ndarray, rho: float) -> np.ndarray:
    """Compute the product with the correlation matrix rho^|i - j|."""
    ahead = lfilter([1.0], [1.0, -rho], x, axis=0)
    back = lfilter([1.0], [1.0, -rho], x[::-1], axis=0)[::-1]
    return np.asarray(ahead) + np.asarray(back) - x
