"""The fitted traction as a differentiable function of what it was fitted to."""

import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import concrete
from ..measurement import ThicknessMap
from .misfit import Misfit, carried
from .noise import noise_std
from .observation import observe
from .posterior import Posterior
from .preconditioner import Unknowns
from .prior import AbstractPrior
from .result import TractionFit

# Relative gradient at which the optimum counts as found again, and most steps towards it.
_RTOL = 1e-7
_MOST_STEPS = 30
# Relative residual of the linear systems that a derivative needs, and most iterations.
_DERIVATIVE_RTOL = 1e-6
_DERIVATIVE_STEPS = 200


def refitted(
    fit: TractionFit, thickness: ThicknessMap | None = None, prior: AbstractPrior | None = None
) -> Float[Array, "my mx"]:
    """Find the optimum again under slightly other data or another prior, differentiably.

    It goes on from a fit by exact gradients; derivatives come from the implicit function at the optimum, forward and
    reverse, second derivatives of the layer's response included. Works under `jit`, `grad` and `jvp`.

    Args:
        fit: A fit of one map.
        thickness: The map, on the same pixels; None: that of the fit.
        prior: The prior, of the same kind; None: that of the fit.

    Returns:
        Normal traction per reference area [MPa]; NaN where it was not found again.
    """
    misfit = fit.misfit
    if thickness is not None:
        model_std = misfit.observations.model_std[0]
        one = observe(misfit.palpation.mesh(), thickness, noise_std("refitted", thickness), model_std)
        misfit = eqx.tree_at(lambda m: m.observations, misfit, jax.tree.map(lambda leaf: leaf[None], one))
    if prior is not None:
        misfit = eqx.tree_at(lambda m: m.prior, misfit, prior)
    # The preconditioner's prior is the fit's: that only has to be near.
    posterior = _frozen(fit.posterior)
    asked = fit.misfit.asked(posterior.white)
    start = misfit.white(asked)._replace(lateral=posterior.white.lateral, numbers=posterior.white.numbers)
    white = _optimum(misfit, posterior, _frozen(start))
    if concrete(misfit.bed.stiffness) == 0.0:  # a dead load: what is asked for is carried, without another solve
        return misfit.asked(white)[0]
    return carried(misfit(white))[0]


def _optimum(misfit: Misfit, posterior: Posterior, start: Unknowns) -> Unknowns:
    """Find the optimum without derivatives, then take a Newton step: its derivative is the implicit function's."""
    fixed = _frozen(misfit)

    def closer(carry):
        white, g, count = carry
        white = jax.tree.map(jnp.subtract, white, posterior.covariance(g))
        return white, _gradient(fixed, white), count + 1

    def far(carry):
        white, g, count = carry
        return (_size(g) > _RTOL * _size(white)) & (count < _MOST_STEPS)

    white, g, _ = _frozen(jax.lax.while_loop(far, closer, (start, _gradient(fixed, start), 0)))
    found = _size(g) <= _RTOL * _size(white)
    hessian = jax.linearize(lambda w: _gradient(fixed, w), white)[1]
    step, _ = jax.scipy.sparse.linalg.cg(
        hessian, _gradient(misfit, white), tol=_DERIVATIVE_RTOL, maxiter=_DERIVATIVE_STEPS, M=posterior.precondition
    )
    return jax.tree.map(lambda w, s: jnp.where(found, w - s, jnp.nan), white, step)


def _gradient(misfit: Misfit, white: Unknowns) -> Unknowns:
    return jax.grad(lambda w: _half_squares(misfit(w)))(white)


def _frozen(tree: Any) -> Any:
    return jax.tree.map(lambda v: jax.lax.stop_gradient(v) if eqx.is_inexact_array(v) else v, tree)


def _half_squares(residuals: Any) -> Array:
    return 0.5 * functools.reduce(operator.add, (jnp.sum(part**2) for part in jax.tree.leaves(residuals)))


def _size(tree: Any) -> Array:
    return jnp.sqrt(2.0 * _half_squares(tree))
