"""How strong a prior should be, told by the data: its most likely hyper-parameters, or the discrepancy principle."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .misfit import Misfit
from .prior import AbstractPrior, Matern, Tikhonov, TotalVariation
from .transfer import wave_numbers

P = TypeVar("P", bound=AbstractPrior)
# Most steps of the search.
_MOST_STEPS = 200
# χ² falls about with this power of a prior's standard deviation, at least with the next; longest step of its logarithm.
_POWER, _LEAST_POWER, _LONGEST = -2.0, -0.5, np.log(8.0)


def rescaled(prior: P, factor: float | Array) -> P:
    """Multiply a prior's standard deviation."""
    if isinstance(prior, Matern):
        return eqx.tree_at(lambda p: p.std, prior, prior.std * factor)
    if isinstance(prior, Tikhonov):
        return eqx.tree_at(lambda p: p.weight, prior, prior.weight / factor)
    assert isinstance(prior, TotalVariation)
    return eqx.tree_at(lambda p: p.weight, prior, prior.weight / factor**2)


def next_factor(tried: list[tuple[float, float]]) -> float:
    """Find what a standard deviation is to be multiplied with so that χ² of the map is its number of data.

    By the secant through the last two fits, between those of too large and those of too small a χ².

    Args:
        tried: Of each fit so far, the logarithms of the factor and of χ² over the number of data [-].

    Returns:
        Logarithm of the factor.
    """
    factor, excess = tried[-1]
    power = _POWER
    if len(tried) > 1:
        before, other = tried[-2]
        power = min((excess - other) / (factor - before), _LEAST_POWER)
    target = factor - float(np.clip(excess / power, -_LONGEST, _LONGEST))
    low = max((f for f, e in tried if e > 0.0), default=-np.inf)
    high = min((f for f, e in tried if e <= 0.0), default=np.inf)
    return target if low < target <= high else 0.5 * (low + high)


def most_likely(
    prior: AbstractPrior, deviations: Float[Array, "samples my mx"], misfit: Misfit
) -> tuple[AbstractPrior, float]:
    """Find the hyper-parameters under which samples of the posterior are most likely.

    One step of expectation–maximisation. Of a `Matern` its std and length, of a `Tikhonov` its weight.

    Args:
        prior: The prior that the samples were fitted with.
        deviations: Samples of the posterior, less the prior's mean [MPa].
        misfit: The fit, for its mesh.

    Returns:
        The prior, and by how much the logarithm of a hyper-parameter changed at most.

    Raises:
        ValueError: For a prior that has no likelihood to maximise.

    Source:
        Dempster, Laird & Rubin, J. R. Stat. Soc. B 39 (1977) 1.
    """
    spacing, shape = misfit.palpation.mesh().spacing, deviations.shape[1:]
    k = wave_numbers(shape, spacing)
    if isinstance(prior, Tikhonov):
        white = jax.vmap(lambda d: prior.whiten(d, spacing))(deviations)
        # The mean is not the prior's.
        factor = jnp.sqrt(jnp.sum(white.at[:, 0, 0].set(0.0) ** 2) / (white.size - white.shape[0]))
        return rescaled(prior, factor), float(jnp.abs(jnp.log(factor)))
    if not isinstance(prior, Matern):
        raise ValueError(
            f'fit_traction(hyperparameters="evidence") needs Matern(...) or Tikhonov(...), got {type(prior).__name__}: '
            'its density has no known norm. Use "discrepancy".'
        )
    shortest, longest = jnp.max(jnp.stack(spacing)), jnp.max(misfit.palpation.extent)

    def changed(x):
        length = shortest + (longest - shortest) * jax.nn.sigmoid(x[1])
        return eqx.tree_at(lambda p: (p.std, p.length), prior, (prior.std * jnp.exp(x[0]), length))

    def unlikely(x, _):
        candidate = changed(x)
        white = jax.vmap(lambda d: candidate.whiten(d, spacing))(deviations)
        log_norm = jnp.sum(jnp.log(candidate.mode_std(k, spacing))) + jnp.sum(
            jnp.log(jnp.broadcast_to(candidate.scale(shape, spacing), shape))
        )
        return 0.5 * jnp.mean(jnp.sum(white**2, axis=(1, 2))) + log_norm

    share = jnp.clip((prior.length - shortest) / (longest - shortest), 1e-3, 1.0 - 1e-3)
    start = jnp.stack([jnp.zeros(()), jnp.log(share / (1.0 - share))])
    found = optx.minimise(unlikely, optx.BFGS(1e-5, 1e-5), start, max_steps=_MOST_STEPS, throw=False).value
    chosen = changed(found)
    change = jnp.maximum(jnp.abs(jnp.log(chosen.std / prior.std)), jnp.abs(jnp.log(chosen.length / prior.length)))
    return chosen, float(change)
