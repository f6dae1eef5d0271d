"""Levenberg–Marquardt steps of optimistix on the host, for a few numbers whose every evaluation is a solve.

A traced loop would compile all solves as one program.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array

from ..solvers.progress import Progress
from .loaded_states import LoadPath, SolvedStates
from .objective import Objective

# Share of the predicted reduction above which damping falls, and the factor. Increments under friction reach the
# default share of 0.99 near the optimum only: a fit of three numbers was at half of its way after 14 steps.
_TRUST_REGION = {"high_cutoff": 0.75, "high_constant": 10.0}
# Longest step, in standard deviations of the priors [-]. Without a limit the first steps leave the priors by far: C10
# for 30 steps; or a friction for ever, at values so small that nothing depends on it.
_LONGEST = 1.0
# Refused steps in a row after which the fit ends, and the largest error of its numbers, over standard deviations that
# explain the misfit, that is converged then: nodes that begin to slip one after the other make the misfit a polygon, in
# whose corners no step reduces it. The remaining step counts as error of the numbers. Frictions of 0.05 and 0.01 end
# 1.5 standard deviations before the predicted optimum, 0.1 from the truth.
_MOST_REFUSED, _STALLED = 4, 2.0
# Reduction of the misfit below which an accepted step counts as refused [-]: along an edge of that polygon steps creep,
# 13 of them for 0.3 % and less than half of a standard deviation.
_CREEPS = 1e-3


class Optimum(NamedTuple):
    """Where an iteration ended.

    Attributes:
        white: White numbers.
        path: States there.
        residual: Residuals there [-].
        J: Their derivative.
        converged: Whether it converged.
        stalled: Whether no step reduced the misfit.
        steps: Number of steps.
    """

    white: Array
    path: LoadPath | SolvedStates
    residual: Array
    J: Array
    converged: bool
    stalled: bool
    steps: int

    @property
    def misfit(self) -> float:
        """Sum of squared residuals."""
        return float(jnp.sum(self.residual**2))


def minimise(
    objective: Objective,
    white: Array,
    path: LoadPath | SolvedStates,
    rtol: float,
    max_steps: int,
    bar: Progress,
) -> Optimum:
    """Minimise by Levenberg–Marquardt on the host: a traced loop would compile all solves as one program.

    The first step is damped by the mean squared residual, as if the noise explained the misfit.

    Args:
        objective: What is minimised.
        white: The first point.
        path: States there, all of them reached.
        rtol: Error of the numbers over their standard deviations at which it ends [-].
        max_steps: Limit of steps, shortened ones included.
        bar: Progress.
    """
    search = optx.ClassicalTrustRegion(**_TRUST_REGION)
    here = _linearised(objective.residuals(white, path.states()), objective.jacobian(white, path))
    first = search.init(white, here)
    trust = eqx.tree_at(lambda s: s.step_size, first, 1.0 / jnp.mean(here.residual**2))
    steps, refused = 0, 0
    while True:
        left, misfit = _remaining_error(objective, here), float(here.as_min())
        bar.show(f"step {steps}, misfit {misfit:.5g}, numbers to {left:.2g} standard deviations")
        stalled = refused >= _MOST_REFUSED
        unexplained = max(1.0, float(np.sqrt(2.0 * misfit / here.residual.size)))
        converged = left <= (_STALLED * unexplained if stalled else rtol)
        if converged or stalled or steps == max_steps:
            break
        step, trust = _limited_step(here, trust)
        ahead, steps = objective.solve(white + step), steps + 1
        lost = jnp.full_like(here.residual, jnp.inf)
        there = objective.residuals(white + step, ahead.states()) if ahead.reached else lost
        tried = optx.FunctionInfo.Residual(there)
        _, accept, _, trust = search.step(jnp.asarray(False), white, white + step, here, tried, trust)
        reduced = accept and tried.as_min() < (1.0 - _CREEPS) * here.as_min()
        refused = 0 if reduced else refused + 1
        if accept:
            white, path = white + step, ahead
            here = _linearised(there, objective.jacobian(white, path))
    return Optimum(white, path, here.residual, here.jac.as_matrix(), converged, stalled, steps)


def _linearised(residual: Array, J: Array) -> optx.FunctionInfo.ResidualJac:
    return optx.FunctionInfo.ResidualJac(residual, lx.MatrixLinearOperator(J))


def _limited_step(here: optx.FunctionInfo.ResidualJac, trust: Any) -> tuple[Array, Any]:
    """Compute a damped step of at most `_LONGEST`, damped more where it would be longer."""
    descent = optx.DampedNewtonDescent()
    state = descent.init(here.residual, here)
    while True:
        step, _ = descent.step(trust.step_size, descent.query(here.residual, here, state))
        if float(jnp.linalg.norm(step)) <= _LONGEST:
            return step, trust
        trust = eqx.tree_at(lambda s: s.step_size, trust, 0.5 * trust.step_size)


def undamped_step(residual: Array, J: Array) -> Array:
    """Compute the step to the predicted optimum."""
    return jnp.linalg.lstsq(J, -residual)[0]


def _remaining_error(objective: Objective, here: optx.FunctionInfo.ResidualJac) -> float:
    """Compute the largest part of that step over its standard deviation: the error of the numbers."""
    J = here.jac.as_matrix()
    std = jnp.sqrt(jnp.diag(objective.covariance(J)))
    return float(jnp.max(jnp.abs(undamped_step(here.residual, J)) / std))
