"""The fitted traction as a differentiable function of map and prior, by the implicit function theorem."""

import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import concrete
from ..measurement import ThicknessMap
from .measured_surface import noise_std, project_map
from .objective import Objective, normal_traction
from .preconditioner import Unknowns
from .prior import AbstractPrior
from .result import TractionFit
from .uncertainty import Posterior

# Relative gradient of the converged optimum, and limit of steps.
_RTOL = 1e-7
_MOST_STEPS = 30
# Relative residual of the linear system of a derivative, and limit of CG iterations.
_DERIVATIVE_RTOL = 1e-6
_DERIVATIVE_STEPS = 200


def refitted(
    fit: TractionFit, thickness: ThicknessMap | None = None, prior: AbstractPrior | None = None
) -> Float[Array, "my mx"]:
    """Update a fit to slightly changed data or prior, differentiably.

    Newton steps with exact gradients continue from the fit. Derivatives follow from the implicit function theorem at
    the optimum, second derivatives of the layer's response included, forward and reverse. Works under `jit`, `grad`
    and `jvp`.

    Args:
        fit: A fit of one map.
        thickness: The map, on the same pixels; None: that of the fit.
        prior: The prior, of the same kind; None: that of the fit.

    Returns:
        Normal traction per reference area [MPa]; NaN where the iteration did not converge.
    """
    objective = fit.objective
    if thickness is not None:
        model_std = objective.surfaces.model_std[0]
        one = project_map(objective.palpation.mesh(), thickness, noise_std("refitted", thickness), model_std)
        objective = eqx.tree_at(lambda m: m.surfaces, objective, jax.tree.map(lambda leaf: leaf[None], one))
    if prior is not None:
        objective = eqx.tree_at(lambda m: m.prior, objective, prior)
    # The preconditioner has the fit's prior, which is close enough.
    posterior = _frozen(fit.posterior)
    applied = fit.objective.applied(posterior.white)
    start = objective.white(applied)._replace(lateral=posterior.white.lateral, numbers=posterior.white.numbers)
    white = _optimum(objective, posterior, _frozen(start))
    if concrete(objective.foundation.stiffness) == 0.0:  # a dead load is transmitted unchanged: no solve is needed
        return objective.applied(white)[0]
    return normal_traction(objective(white))[0]


def _optimum(objective: Objective, posterior: Posterior, start: Unknowns) -> Unknowns:
    """Find the optimum without derivatives, then take a Newton step: its derivative is the implicit function's."""
    fixed = _frozen(objective)

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
        hessian, _gradient(objective, white), tol=_DERIVATIVE_RTOL, maxiter=_DERIVATIVE_STEPS, M=posterior.precondition
    )
    return jax.tree.map(lambda w, s: jnp.where(found, w - s, jnp.nan), white, step)


def _gradient(objective: Objective, white: Unknowns) -> Unknowns:
    return jax.grad(lambda w: _half_squares(objective(w)))(white)


def _frozen(tree: Any) -> Any:
    return jax.tree.map(lambda v: jax.lax.stop_gradient(v) if eqx.is_inexact_array(v) else v, tree)


def _half_squares(residuals: Any) -> Array:
    return 0.5 * functools.reduce(operator.add, (jnp.sum(part**2) for part in jax.tree.leaves(residuals)))


def _size(tree: Any) -> Array:
    return jnp.sqrt(2.0 * _half_squares(tree))
