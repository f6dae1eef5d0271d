"""Gauss–Newton with quasi-Newton secants; its linear systems are solved by preconditioned conjugate gradients.

CG iterations of one system precondition the next one. The curvature of the residuals, which Gauss–Newton neglects, is
approximated by BFGS updates on top of the Gauss–Newton matrix: with friction, the coin on 40×40×4
elements has five times the curvature of that matrix along the last directions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, PyTree

from ..solvers.compiling import QuickJit, is_traced
from .conjugate_gradients import LeastSquares, Secants, dot, least_squares, plus
from .line_search import ParabolicBacktracking, SearchState

# Largest CG tolerance, far from the optimum. The coin's fit takes 159 CG iterations in 14 solves with 0.2, 191 in 13
# with 0.03.
_LARGEST_RTOL = 0.2
# A Gauss–Newton direction changes the residuals by at most their norm; 1 % for inexact products. Secants without
# the restart predicted up to 11 times that. Fits of friction and C10 take 13 to 29 forward solves, not 24 to 69.
_LARGEST_CHANGE = 1.01
# BFGS pairs kept from steps, and from CG iterations: as many as one system takes at most.
_STEP_PAIRS = 20
_ITERATION_PAIRS = 60


class _Direction(eqx.Module):
    newton: Any
    change: Array  # predicted change of the residuals over their norm
    iterations: Array  # CG iterations of all systems so far
    point: Any
    gradient: Any
    secants: Secants  # of the steps
    iterated: Secants  # of CG iterations with the Gauss–Newton matrix
    result: optx.RESULTS


def _updated(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> Secants:
    """Append the secant pair of the last step; all pairs are zero in the second try."""
    secants = state.secants.appended(plus(y, state.point, -1.0), plus(gradient, state.gradient, -1.0))
    return jax.tree.map(lambda v: jnp.where(tries == 0, v, 0.0), secants)


def _secant_term(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> PyTree:
    """Compute the change of the right-hand side due to the secants."""
    return plus(_updated(y, state, tries, gradient).before(gradient)[0], gradient, -1.0)


@QuickJit
def _direction(
    y: PyTree, state: _Direction, tries: Array, residual: PyTree, solved: LeastSquares, iterations: Array
) -> _Direction:
    """Compute the direction from the solution of the linear system."""
    assert solved.secants is not None
    gradient = solved.gradient
    secants = _updated(y, state, tries, gradient)
    newton = secants.after(solved.x, secants.before(gradient)[1])
    change = jnp.sqrt(jnp.maximum(dot(gradient, newton), 0.0) / dot(residual, residual))
    iterations = iterations + solved.iterations
    return _Direction(newton, change, iterations, y, gradient, secants, solved.secants, optx.RESULTS.successful)


class PreconditionedDescent(optx.AbstractDescent):
    """The Gauss–Newton direction by CGLS.

    Attributes:
        precondition: Makes, from J, an approximate inverse of JᵀJ.
        rtol: CG tolerance near the optimum. Forcing term of the inexact Newton method: elsewhere the tolerance is the
            relative residual change of the previous step.
        most: Limit of CG iterations of each system.
        negligible: Remaining error of a direction over the posterior's standard deviation along it at which CG stops
            [-].
        infeasible: Half sum of squares at which no direction is computed, because no equilibrium exists.
    """

    precondition: Callable[[Any], Callable[[PyTree], PyTree]]
    rtol: Array
    most: Array
    negligible: Array
    infeasible: Array

    def init(self, y, f_info_struct):
        """Start without a direction."""
        del f_info_struct
        secants, iterated = (Secants.none(y, pairs) for pairs in (_STEP_PAIRS, _ITERATION_PAIRS))
        infinite, none = jnp.full((), jnp.inf, float), jnp.zeros((), int)
        return _Direction(y, infinite, none, y, y, secants, iterated, optx.RESULTS.successful)

    def query(self, y, f_info, state):
        """Solve for the direction at an accepted point."""
        J, residual = f_info.jac, f_info.residual
        most = jnp.where(0.5 * dot(residual, residual) < self.infeasible, self.most, 0)
        rtol = jnp.clip(state.change, self.rtol, _LARGEST_RTOL)
        precondition = self.precondition(J)

        # Restart: where secants predict an impossible reduction, discard them and solve the system again.
        def needs_solve(carry):
            tries, direction = carry
            return (tries == 0) | ((tries == 1) & (direction.change > _LARGEST_CHANGE))

        def solve(carry):
            tries, last = carry
            added = eqx.Partial(_secant_term, y, state, tries)
            solved = least_squares(
                J.mv, J.T.mv, precondition, residual, rtol, most, self.negligible, added, last.iterated
            )
            return tries + 1, _direction(y, state, tries, residual, solved, last.iterations)

        carry = jnp.zeros((), int), state
        if is_traced((residual, state)):
            return jax.lax.while_loop(needs_solve, solve, carry)[1]
        while needs_solve(carry):
            carry = solve(carry)
        return carry[1]

    def step(self, step_size, state):
        """Return the step of length `step_size` along the direction."""
        return jax.tree.map(lambda v: -step_size * v, state.newton), state.result


class Iterate(NamedTuple):
    """State of the iteration; names as in the state of `optimistix.GaussNewton`."""

    first_step: Array
    y_eval: PyTree
    search_state: SearchState
    f_info: Any  # None before the first evaluation
    aux: Any
    descent_state: _Direction
    num_accepted_steps: int


class GaussNewton(optx.AbstractGaussNewton):
    """Gauss–Newton for `optimistix.least_squares`, or driven from the host (`begin`, `advance`).

    It converges when the next step would change the residuals by less than `rtol` of their norm: in a fit, about the
    root-mean-square error of the unknowns over the posterior's standard deviations. The change of the unknowns is no
    criterion: it does not vanish along poorly identified directions.
    """

    rtol: Array
    descent: PreconditionedDescent
    search: ParabolicBacktracking = ParabolicBacktracking()
    norm: Callable = eqx.field(static=True, default=optx.two_norm)
    verbose: Callable = eqx.field(static=True, default=lambda **_: None)

    @property
    def atol(self) -> float:
        """Absolute tolerance that optimistix requires; `terminate` uses `rtol` alone."""
        return 0.0

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the trial point; if it is accepted, compute the next direction."""
        state = eqx.tree_at(lambda s: s.search_state.change, state, state.descent_state.change)
        return super().step(fn, y, args, options, state, tags)

    def begin(self, y: PyTree) -> Iterate:
        """Initialise the iteration that is driven from the host: what `init` does."""
        return Iterate(jnp.asarray(True), y, self.search.init(y, None), None, None, self.descent.init(y, None), 0)

    def advance(self, evaluate: Callable, y: PyTree, state: Iterate) -> tuple[PyTree, Iterate]:
        """Do one `step` from the host, where each forward solve and product is a separate program.

        Args:
            evaluate: Computes, at a point, the residuals, auxiliary values, and a function that linearises.
            y: The point accepted last.
            state: State after the last evaluation.
        """
        residual, aux, linearise = evaluate(state.y_eval)
        before = None if state.f_info is None else state.f_info.residual
        change = state.descent_state.change
        accept, search_state = _searched(self.search, state.first_step, before, residual, change, state.search_state)
        f_info, descent_state, accepted = state.f_info, state.descent_state, state.num_accepted_steps
        if accept:
            y, f_info, accepted = state.y_eval, optx.FunctionInfo.ResidualJac(residual, linearise()), accepted + 1
            descent_state = self.descent.query(y, f_info, descent_state)
        y_eval = _trial_point(self.descent, y, search_state.step_size, descent_state)
        aux = aux if accept else state.aux
        return y, Iterate(jnp.asarray(False), y_eval, search_state, f_info, aux, descent_state, accepted)

    def terminate(self, fn, y, args, options, state, tags):
        """Return whether the iteration has converged."""
        del fn, y, args, options, tags
        return self.converged(state), optx.RESULTS.successful

    def converged(self, state: Any) -> Array:
        """Return whether the predicted change of the residuals is at most `rtol`."""
        return state.descent_state.change <= self.rtol


@QuickJit
def _searched(
    search: ParabolicBacktracking,
    first_step: Array,
    before: PyTree,
    now: PyTree,
    change: Array,
    state: SearchState,
) -> tuple[Array, SearchState]:
    """Run the line search: whether the point is accepted, and the next step length."""
    old, new = (optx.FunctionInfo.Residual(residual) for residual in (before, now))
    last = eqx.tree_at(lambda s: s.change, state, change)
    _, accept, _, state = search.step(first_step, None, None, old, new, last)
    return accept, state


@QuickJit
def _trial_point(descent: PreconditionedDescent, y: PyTree, step_size: Array, state: _Direction) -> PyTree:
    return plus(y, descent.step(step_size, state)[0])
