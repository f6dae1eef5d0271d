"""The posterior around the optimum (Laplace): draws, and what they say of every derived number."""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._checks import concrete
from .gauss_newton import LeastSquares, least_squares, plus

# Most iterations of each linear system, and the relative gradient that it is solved to.
MOST_ITERATIONS = 200
_RTOL = 1e-2


class Posterior(eqx.Module):
    """The Gaussian posterior of white unknowns, by its square root: the Jacobian of all residuals at the optimum.

    Attributes:
        white: The optimum.
        jacobian: Of all standardised residuals, those of the prior included, by white unknowns.
        precondition: Approximate inverse of its normal matrix.
        rtol: Relative gradient of the linear system of each draw or product.
    """

    white: PyTree
    jacobian: lx.AbstractLinearOperator
    precondition: Callable[[PyTree], PyTree]
    rtol: float | Array = _RTOL

    def solve(self, residual: PyTree, gradient: PyTree | None = None) -> LeastSquares:
        """Find the change of the unknowns that makes residuals change as asked, as nearly as possible.

        Args:
            residual: Change asked of each residual.
            gradient: What to add to the right-hand side of the normal equations; None: nothing.

        Returns:
            The solution; NaN where the iteration diverged. Where it was cut short, a warning says so, unless the number
            of iterations is traced.
        """
        if gradient is None:
            gradient = jax.tree.map(jnp.zeros_like, self.white)
        solved = _solve(self, residual, gradient)
        iterations = concrete(solved.iterations)
        if iterations is not None and iterations >= MOST_ITERATIONS:
            warnings.warn(
                f"A linear system of the posterior was cut short after {MOST_ITERATIONS} iterations: what is made from "
                "it (draws, standard deviations, covariances, degrees of freedom) is rough. Give the prior a smaller "
                "std or a longer length.",
                stacklevel=3,
            )
        return solved

    def push(self, change: PyTree) -> PyTree:
        """Multiply a change of the unknowns with the Jacobian."""
        return _push(self.jacobian, change)

    def pull(self, residuals: PyTree) -> PyTree:
        """Multiply residuals with its transpose."""
        return _pull(self.jacobian, residuals)

    def residual_structure(self) -> PyTree:
        """Return shapes and types of the residuals."""
        return self.jacobian.out_structure()

    def covariance(self, weights: PyTree) -> PyTree:
        """Multiply the posterior covariance of the white unknowns with weights."""
        nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), self.residual_structure())
        return self.solve(nothing, weights).x

    def draw(self, key: PRNGKeyArray) -> tuple[PyTree, PyTree, Array]:
        """Draw a deviation from the optimum.

        Least squares against white noise in every residual has exactly the posterior's covariance.

        Returns:
            The deviation of the white unknowns; of the residuals; iterations, `MOST_ITERATIONS` where they were cut
            short. The sum of squares of a part of the residuals, averaged over draws, is the number of degrees of
            freedom that they determine.
        """
        leaves, tree = jax.tree.flatten(self.residual_structure())
        keys = jax.random.split(key, len(leaves))
        noise = jax.tree.unflatten(
            tree, [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
        )
        solved = self.solve(noise)
        return solved.x, plus(noise, solved.rest, -1.0), solved.iterations


_push = eqx.filter_jit(lambda J, change: J.mv(change))
_pull = eqx.filter_jit(lambda J, residuals: J.T.mv(residuals))


# One compiled program for all that a posterior is asked: products with the Jacobian are large.
@eqx.filter_jit
def _solve(posterior: Posterior, residual: PyTree, gradient: PyTree) -> LeastSquares:
    J = posterior.jacobian
    precondition, rtol = posterior.precondition, posterior.rtol
    solved = least_squares(J.mv, J.T.mv, precondition, residual, rtol, MOST_ITERATIONS, further=lambda _: gradient)
    # Products that are not exact enough make the iteration diverge.
    good = solved.relative_gradient <= 1.0
    return jax.tree.map(lambda v: jnp.where(good, v, jnp.nan) if eqx.is_inexact_array(v) else v, solved)
