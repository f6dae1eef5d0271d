"""Levenberg–Marquardt steps of optimistix on the host, for a few numbers whose every evaluation is a solve.

A traced loop would compile all solves as one program.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array

from ..solvers.progress import Progress
from .loaded_states import LoadPath, SolvedStates

# Predicted change of the residuals over their norm below which the mesh error is estimated: it varies little with the
# numbers, and then allows for larger residuals.
_ROUGH = 0.05
# Share of the predicted reduction above which damping falls, and the factor. Increments under friction reach the
# default share of 0.99 near the optimum only: a fit of three numbers was at half of its way after 14 steps.
_TRUST_REGION = {"high_cutoff": 0.75, "high_constant": 10.0}
# Longest step, in standard deviations of the priors [-]. Without a limit the first steps leave the priors by far: C10
# for 30 steps; or a friction for ever, at values so small that nothing depends on it.
_LONGEST = 1.0
# Refused steps in a row after which the fit ends, and the largest error of its numbers, over standard deviations that
# explain the misfit, that is converged then: the error of the solves keeps steps from reducing the misfit. It adds 12 %
# to a standard deviation at most.
_MOST_REFUSED, _STALLED = 4, 0.5


@runtime_checkable
class Objective(Protocol):
    """Residuals of solved states by white numbers, and their Jacobian."""

    def solve(self, white: Array) -> LoadPath | SolvedStates:
        """Solve the states."""
        ...

    def residuals(self, white: Array, states: Any) -> Array:
        """Compute the residuals of the states [-]."""
        ...

    def jacobian(self, white: Array, path: LoadPath | SolvedStates) -> Array:
        """Compute their derivative by the white numbers."""
        ...


class Optimum(NamedTuple):
    """Where an iteration ended.

    Attributes:
        white: White numbers.
        residual: Residuals there [-].
        J: Their derivative.
        converged: Whether it converged.
        stalled: Whether no step reduced the misfit.
        steps: Number of steps.
    """

    white: Array
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
    objective: Objective, white: Array, rtol: float, max_steps: int, bar: Progress, rough: bool = False
) -> Optimum:
    """Minimise by Levenberg–Marquardt on the host: a traced loop would compile all solves as one program.

    The first step is damped by the mean squared residual, as if the noise explained the misfit.

    Args:
        objective: What is minimised.
        white: The first point, where all states can be solved.
        rtol: Error of the numbers over their standard deviations at which it ends [-].
        max_steps: Limit of steps, shortened ones included.
        bar: Progress.
        rough: Whether to end as well where a step changes the residuals by little.
    """
    search = optx.ClassicalTrustRegion(**_TRUST_REGION)
    path, converged = objective.solve(white), False
    here = _linearised(objective.residuals(white, path.states()), objective.jacobian(white, path))
    first = search.init(white, here)
    trust = eqx.tree_at(lambda s: s.step_size, first, 1.0 / jnp.mean(here.residual**2))
    steps, refused, ended, stalled = 0, 0, False, False
    while not ended and steps < max_steps:
        step, trust = _limited_step(here, trust)
        path, steps = objective.solve(white + step), steps + 1
        lost = jnp.full_like(here.residual, jnp.inf)
        there = objective.residuals(white + step, path.states()) if path.reached else lost
        tried = optx.FunctionInfo.Residual(there)
        _, accept, _, trust = search.step(jnp.asarray(False), white, white + step, here, tried, trust)
        refused = 0 if accept else refused + 1
        if accept:
            white = white + step
            here = _linearised(there, objective.jacobian(white, path))
        left, misfit = _remaining_change(here), float(here.as_min())
        bar.show(f"step {steps}, misfit {misfit:.5g}, numbers to {left:.2g} standard deviations")
        stalled = refused >= _MOST_REFUSED
        unexplained = max(1.0, float(np.sqrt(2.0 * misfit / here.residual.size)))
        converged = left <= (_STALLED * unexplained if stalled else rtol)
        ended = converged or stalled or (rough and left**2 <= 2.0 * _ROUGH**2 * misfit)
    return Optimum(white, here.residual, here.jac.as_matrix(), converged or (rough and ended), stalled, steps)


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


def _remaining_change(here: optx.FunctionInfo.ResidualJac) -> float:
    """Compute the change of the residuals by an undamped step: error of the numbers over standard deviations."""
    J = here.jac.as_matrix()
    return float(jnp.linalg.norm(J @ jnp.linalg.lstsq(J, here.residual)[0]))
