"""The posterior around the optimum (Laplace): draws, and what they say of every derived number."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._checks import concrete
from ..solvers.compiling import QuickJit, is_traced
from .conjugate_gradients import LeastSquares, least_squares, plus

# Most iterations of each linear system, and the relative gradient that it is solved to.
MOST_ITERATIONS = 200
_RTOL = 1e-2


class Posterior(eqx.Module):
    """The Gaussian posterior of white unknowns, by its square root: the Jacobian of all residuals at the optimum.

    Attributes:
        white: The optimum.
        jacobian: Of all standardised residuals, those of the prior included, by white unknowns: a `Jacobian`, or any
            linear operator of lineax.
        precondition: Approximate inverse of its normal matrix.
        rtol: Relative gradient of the linear system of each draw or product.
    """

    white: PyTree
    jacobian: Any
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
        traced = is_traced((self, residual, gradient))
        solved = (QuickJit(_solve) if traced else _solve)(self, residual, gradient)
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
        return self.jacobian.mv(change)

    def pull(self, residuals: PyTree) -> PyTree:
        """Multiply residuals with its transpose."""
        return self.jacobian.T.mv(residuals)

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
        noise = _noise(self.residual_structure(), key)
        solved = self.solve(noise)
        return solved.x, plus(noise, solved.rest, -1.0), solved.iterations


def _solve(posterior: Posterior, residual: PyTree, gradient: PyTree) -> LeastSquares:
    J, rtol = posterior.jacobian, posterior.rtol
    further = eqx.Partial(_given, gradient)
    solved = least_squares(J.mv, J.T.mv, posterior.precondition, residual, rtol, MOST_ITERATIONS, further=further)
    return _if_solved(solved)


def _given(gradient: PyTree, _: PyTree) -> PyTree:
    return gradient


@QuickJit
def _if_solved(solved: LeastSquares) -> LeastSquares:
    # Products that are not exact enough make the iteration diverge.
    good = solved.relative_gradient <= 1.0
    return jax.tree.map(lambda v: jnp.where(good, v, jnp.nan) if eqx.is_inexact_array(v) else v, solved)


@QuickJit
def _noise(structure: PyTree, key: PRNGKeyArray) -> PyTree:
    """Draw white noise."""
    leaves, tree = jax.tree.flatten(structure)
    keys = jax.random.split(key, len(leaves))
    each = [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, each)
