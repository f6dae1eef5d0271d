"""Discrepancy principle: the prior's strength at which χ² of the maps equals its expectation."""

import numpy as np

# Exponent of χ² over the prior's standard deviation in the first step: that of misfits due to the prior alone.
_EXPONENT = -2.0
# Shallowest exponent of a secant: χ² levels off at the noise, where a secant would step too far.
_SHALLOWEST = -0.5
# Largest change of the standard deviation in one fit: a factor of 8.
_LARGEST_STEP = np.log(8.0)


def next_factor(tried: list[tuple[float, float]]) -> float:
    """Compute the factor of the prior's standard deviation for the next fit, by safeguarded secants.

    Secants of log χ² over the log factor; bisection where a secant leaves the bracket of fits with too large and too
    small a χ².

    Args:
        tried: Log factor and log of χ² over the number of data of each fit so far [-].

    Returns:
        Logarithm of the factor.
    """
    factor, excess = tried[-1]
    power = _EXPONENT
    if len(tried) > 1:
        before, other = tried[-2]
        power = min((excess - other) / (factor - before), _SHALLOWEST)
    target = factor - float(np.clip(excess / power, -_LARGEST_STEP, _LARGEST_STEP))
    low = max((f for f, e in tried if e > 0.0), default=-np.inf)
    high = min((f for f, e in tried if e <= 0.0), default=np.inf)
    return target if low < target <= high else 0.5 * (low + high)
