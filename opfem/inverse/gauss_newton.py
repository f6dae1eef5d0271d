"""Gauss–Newton steps for optimistix, their linear systems solved by preconditioned conjugate gradients.

What their iterations find out of the Gauss–Newton matrix preconditions the next system. The curvature of
the residuals, which Gauss–Newton leaves out, is learnt from the steps taken (BFGS on top of the Gauss–Newton matrix):
where a layer slips and opens, it is several times what Gauss–Newton knows.
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

# A point is accepted where the least of the sum of squares along the way lies beyond this part of it; else the next is
# that least, but between these parts of the last.
_BEYOND = 0.6
_SHORTEST, _LONGEST = 0.1, 0.5
# Steps shorter than this may raise the sum of squares by this part.
_SHORT, _RISE = 0.05, 5e-3
# A system is solved no closer than its last direction changed the residuals, but at least to this.
_ROUGHEST = 0.03
# No direction of Gauss–Newton changes the residuals by more than their norm, but for rounding.
_MOST_PROMISED = 1.01
# Steps whose curvature is remembered, and iterations of linear systems.
_MEMORY = 20
_MEMORY_OF_ITERATIONS = 60


class _Direction(eqx.Module):
    newton: Any
    change: Array  # that it makes to the residuals, over their norm
    iterations: Array  # of all systems so far
    point: Any
    gradient: Any
    secants: Secants
    iterated: Secants  # with the Gauss–Newton matrix
    result: optx.RESULTS


def _known(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> Secants:
    """Add the last step to what is known of the curvature; nothing is, once it is forgotten."""
    known = state.secants.followed_by(plus(y, state.point, -1.0), plus(gradient, state.gradient, -1.0))
    return jax.tree.map(lambda v: jnp.where(tries == 0, v, 0.0), known)


def _curved(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> PyTree:
    """Compute what the curvature adds to the right-hand side of the linear system."""
    return plus(_known(y, state, tries, gradient).before(gradient)[0], gradient, -1.0)


@QuickJit
def _direction(
    y: PyTree, state: _Direction, tries: Array, residual: PyTree, solved: LeastSquares, iterations: Array
) -> _Direction:
    """Make the direction from the solution of the linear system."""
    assert solved.secants is not None
    gradient = solved.gradient
    known = _known(y, state, tries, gradient)
    newton = known.after(solved.x, known.before(gradient)[1])
    change = jnp.sqrt(jnp.maximum(dot(gradient, newton), 0.0) / dot(residual, residual))
    iterations = iterations + solved.iterations
    return _Direction(newton, change, iterations, y, gradient, known, solved.secants, optx.RESULTS.successful)


class PreconditionedDescent(optx.AbstractDescent):
    """The Gauss–Newton direction.

    Attributes:
        precondition: Makes, from J, an approximate inverse of JᵀJ.
        rtol: Relative tolerance of linear systems near the optimum; far from it they are solved less closely.
        most: Most iterations of each.
        negligible: What is left to go, over the posterior's standard deviation along it, below which a direction is
            not refined [-].
        hopeless: Half sum of squares from which on no direction is looked for.
    """

    precondition: Callable[[Any], Callable[[PyTree], PyTree]]
    rtol: Array
    most: Array
    negligible: Array
    hopeless: Array

    def init(self, y, f_info_struct):
        """Start without a direction."""
        del f_info_struct
        secants, iterated = (Secants.none(y, memory) for memory in (_MEMORY, _MEMORY_OF_ITERATIONS))
        infinite, none = jnp.full((), jnp.inf, float), jnp.zeros((), int)
        return _Direction(y, infinite, none, y, y, secants, iterated, optx.RESULTS.successful)

    def query(self, y, f_info, state):
        """Solve for the direction at an accepted point."""
        J, residual = f_info.jac, f_info.residual
        most = jnp.where(0.5 * dot(residual, residual) < self.hopeless, self.most, 0)
        rtol = jnp.clip(state.change, self.rtol, _ROUGHEST)
        precondition = self.precondition(J)

        # Where what was learnt of the curvature makes a direction promise too much, it is forgotten, and the system
        # solved again.
        def promises_too_much(carry):
            tries, direction = carry
            return (tries == 0) | ((tries == 1) & (direction.change > _MOST_PROMISED))

        def solve(carry):
            tries, last = carry
            further = eqx.Partial(_curved, y, state, tries)
            solved = least_squares(
                J.mv, J.T.mv, precondition, residual, rtol, most, self.negligible, further, last.iterated
            )
            return tries + 1, _direction(y, state, tries, residual, solved, last.iterations)

        carry = jnp.zeros((), int), state
        if is_traced((residual, state)):
            return jax.lax.while_loop(promises_too_much, solve, carry)[1]
        while promises_too_much(carry):
            carry = solve(carry)
        return carry[1]

    def step(self, step_size, state):
        """Go a part of the way."""
        return jax.tree.map(lambda v: -step_size * v, state.newton), state.result


class _Search(eqx.Module):
    step_size: Array
    change: Array  # `_Direction.change`


class Interpolating(optx.AbstractSearch):
    """Whole steps; where the sum of squares falls by much less than the Jacobian says, back to its least.

    The next direction is first looked along as far as the least of the last one lay. A direction costs tens of
    products, a look along it one solve. What the Jacobian says comes with the direction: unlike in
    `optimistix.BacktrackingArmijo`, it is not multiplied with once more.

    The sum of squares jumps where a forward solve cuts an increment back: friction remembers another path. A point that
    a jump put lower than its surroundings would never be left, so the shortest steps may rise a little.
    """

    def init(self, y, f_info_struct):
        """Start with whole steps."""
        del y, f_info_struct
        return _Search(jnp.ones(()), jnp.zeros(()))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Accept a point that is no worse, and not far beyond the least of the parabola through it; or one close by."""
        del y, y_eval
        length, before, now = state.step_size, f_info.as_min(), f_eval_info.as_min()
        fall = state.change**2 * before  # that a whole step promises; the slope is twice it
        curvature = (now - before + 2.0 * fall * length) / length**2
        least = jnp.where(jnp.isfinite(now), fall / jnp.where(curvature > 0, curvature, fall), 0.0)
        lower = (now <= before) & (least >= _BEYOND * length)
        close = (length < _SHORT) & (now <= (1.0 + _RISE) * before)
        accept = first_step | lower | close
        shorter = jnp.clip(least, _SHORTEST * length, _LONGEST * length)
        length = jnp.where(accept, jnp.where(lower, jnp.minimum(least, 1.0), 1.0), shorter)
        return length, accept, optx.RESULTS.successful, _Search(length, state.change)


class Looking(NamedTuple):
    """How far Gauss–Newton has come; names as in the state of `optimistix.GaussNewton`."""

    first_step: Array
    y_eval: PyTree
    search_state: _Search
    f_info: Any  # None before the first look
    aux: Any
    descent_state: _Direction
    num_accepted_steps: int


class GaussNewton(optx.AbstractGaussNewton):
    """Gauss–Newton for `optimistix.least_squares`, or driven from the host (`begin`, `look`).

    It ends where its next step would change the residuals by less than `rtol` of their norm: in a fit, about what is
    left to go over the posterior's standard deviations, root mean square. Their own change would be the wrong measure:
    directions that the data do not tell are never at rest.
    """

    rtol: Array
    descent: PreconditionedDescent
    search: Interpolating = Interpolating()
    norm: Callable = eqx.field(static=True, default=optx.two_norm)
    verbose: Callable = eqx.field(static=True, default=lambda **_: None)

    @property
    def atol(self) -> float:
        """What optimistix asks for; `terminate` measures the next step by `rtol` alone."""
        return 0.0

    def step(self, fn, y, args, options, state, tags):
        """Look at the next point, and go on from there if it is accepted."""
        state = eqx.tree_at(lambda s: s.search_state.change, state, state.descent_state.change)
        return super().step(fn, y, args, options, state, tags)

    def begin(self, y: PyTree) -> Looking:
        """Start to look for the least from the host: what `init` does."""
        return Looking(jnp.asarray(True), y, self.search.init(y, None), None, None, self.descent.init(y, None), 0)

    def look(self, evaluate: Callable, y: PyTree, state: Looking) -> tuple[PyTree, Looking]:
        """Do what `step` does, from the host: a solve or a product that takes long is then a program by itself.

        Args:
            evaluate: Computes, at a point, the residuals, what to keep with them, and how to make their Jacobian.
            y: The point accepted last.
            state: What came of the last look.
        """
        residual, aux, linearise = evaluate(state.y_eval)
        before = None if state.f_info is None else state.f_info.residual
        change = state.descent_state.change
        accept, search_state = _searched(self.search, state.first_step, before, residual, change, state.search_state)
        f_info, descent_state, accepted = state.f_info, state.descent_state, state.num_accepted_steps
        if accept:
            y, f_info, accepted = state.y_eval, optx.FunctionInfo.ResidualJac(residual, linearise()), accepted + 1
            descent_state = self.descent.query(y, f_info, descent_state)
        y_eval = _beside(self.descent, y, search_state.step_size, descent_state)
        aux = aux if accept else state.aux
        return y, Looking(jnp.asarray(False), y_eval, search_state, f_info, aux, descent_state, accepted)

    def terminate(self, fn, y, args, options, state, tags):
        """Tell whether the next step is small."""
        del fn, y, args, options, tags
        return self.settled(state), optx.RESULTS.successful

    def settled(self, state: Any) -> Array:
        """Tell whether the next step is small."""
        return state.descent_state.change <= self.rtol


@QuickJit
def _searched(
    search: Interpolating, first_step: Array, before: PyTree, now: PyTree, change: Array, state: _Search
) -> tuple[Array, _Search]:
    """Tell whether a point is accepted, and how far to go next."""
    old, new = (optx.FunctionInfo.Residual(residual) for residual in (before, now))
    last = eqx.tree_at(lambda s: s.change, state, change)
    _, accept, _, state = search.step(first_step, None, None, old, new, last)
    return accept, state


@QuickJit
def _beside(descent: PreconditionedDescent, y: PyTree, step_size: Array, state: _Direction) -> PyTree:
    return plus(y, descent.step(step_size, state)[0])
