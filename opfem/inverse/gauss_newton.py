"""Gauss–Newton steps for optimistix, their linear systems solved by preconditioned conjugate gradients.

Nothing is materialised: one iteration multiplies once with the Jacobian and once with its transpose.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, PyTree

# What is left to go, over the posterior's standard deviation along it, below which a direction is not refined [-].
_NEGLIGIBLE = 0.03


class LeastSquares(NamedTuple):
    """Solution of a linear least-squares problem, its relative gradient and iterations."""

    x: Array
    relative_gradient: Array
    iterations: Array


def least_squares(
    jacobian: Callable[[Array], PyTree],
    transpose: Callable[[PyTree], Array],
    precondition: Callable[[Array], Array],
    b: PyTree,
    rtol: float | Array,
    most: int | Array,
    negligible: float | Array = 0.0,
) -> LeastSquares:
    """Minimise |J x - b|² by conjugate gradients on the normal equations.

    Args:
        jacobian: Multiply with J.
        transpose: Multiply with its transpose.
        precondition: Approximate inverse of JᵀJ, symmetric positive; only nearly linear is enough.
        b: What J x is to match.
        rtol: Relative tolerance of the gradient Jᵀ(b - J x), in the preconditioner's norm.
        most: Most iterations.
        negligible: Enough is also a gradient of this norm: the length of what is left to go, measured by J.

    Source:
        Björck, Numerical Methods for Least Squares Problems, algorithm 7.4.1 (CGLS), preconditioned;
        Notay, SIAM J. Sci. Comput. 22 (2000) 1444 for a preconditioner that is not quite linear.
    """
    like = jax.eval_shape(transpose, b)
    zero, none = jnp.zeros(like.shape, like.dtype), jnp.zeros((), int)

    def unfinished(carry):
        *_, size, first, count = carry
        return (count == 0) | ((size > jnp.maximum(rtol**2 * first, negligible**2)) & (count <= most))

    # The first pass only finds the gradient: so each product appears, and is compiled, once.
    def iterate(carry):
        x, rest, gradient, p, size, first, count = carry
        q = jacobian(p)
        squared = sum(jnp.vdot(part, part) for part in jax.tree.leaves(q))
        step = jnp.where(squared > 0, size / jnp.where(squared > 0, squared, 1.0), 0.0)
        x, rest = x + step * p, jax.tree.map(lambda r, part: r - step * part, rest, q)
        before, gradient = gradient, transpose(rest)
        z = precondition(gradient)
        new, change = jnp.vdot(gradient, z), jnp.vdot(gradient - before, z)
        p = z + jnp.where(size > 0, change / jnp.where(size > 0, size, 1.0), 0.0) * p
        return x, rest, gradient, p, new, jnp.where(count == 0, new, first), count + 1

    start = (zero, b, zero, zero, jnp.zeros((), like.dtype), jnp.zeros((), like.dtype), none)
    x, *_, size, first, count = jax.lax.while_loop(unfinished, iterate, start)
    return LeastSquares(x, jnp.sqrt(size / jnp.where(first > 0, first, 1.0)), count - 1)


class _Direction(eqx.Module):
    newton: Any
    iterations: Array  # of all systems so far
    result: optx.RESULTS


class PreconditionedDescent(optx.AbstractDescent):
    """The Gauss–Newton direction.

    Attributes:
        precondition: Approximate inverse of JᵀJ.
        rtol: Relative tolerance of each linear system.
        most: Most iterations of each.
    """

    precondition: Callable[[Array], Array]
    rtol: Array
    most: Array

    def init(self, y, f_info_struct):
        """Start without a direction."""
        del f_info_struct
        return _Direction(y, jnp.zeros((), int), optx.RESULTS.successful)

    def query(self, y, f_info, state):
        """Solve for the direction at an accepted point."""
        del y
        J = f_info.jac
        residual = f_info.residual
        solved = least_squares(J.mv, J.T.mv, self.precondition, residual, self.rtol, self.most, _NEGLIGIBLE)
        return _Direction(solved.x, state.iterations + solved.iterations, optx.RESULTS.successful)

    def step(self, step_size, state):
        """Go a part of the way."""
        return -step_size * state.newton, state.result


class _StepSize(eqx.Module):
    step_size: Array


class Halving(optx.AbstractSearch):
    """Whole steps, halved until the sum of squares falls.

    Unlike `optimistix.BacktrackingArmijo` it does not multiply with the Jacobian once more to know by how much.
    """

    def init(self, y, f_info_struct):
        """Start with whole steps."""
        del y, f_info_struct
        return _StepSize(jnp.ones(()))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Accept a point that is no worse."""
        del y, y_eval
        accept = first_step | (f_eval_info.as_min() <= f_info.as_min())
        step_size = jnp.where(accept, 1.0, 0.5 * state.step_size)
        return step_size, accept, optx.RESULTS.successful, _StepSize(step_size)


class GaussNewton(optx.AbstractGaussNewton):
    """Gauss–Newton for `optimistix.least_squares`, or for stepping through it."""

    rtol: Array
    atol: Array
    descent: PreconditionedDescent
    search: Halving = Halving()
    norm: Callable = eqx.field(static=True, default=optx.two_norm)
    verbose: Callable = eqx.field(static=True, default=lambda **_: None)
