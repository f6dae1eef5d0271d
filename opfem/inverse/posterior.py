"""The posterior around the optimum (Laplace): draws, and what they say of every derived number."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, PRNGKeyArray

from .gauss_newton import LeastSquares, least_squares

# Relative gradient of each draw's linear system, and most iterations.
_RTOL = 1e-2
_STEPS = 200


class Posterior(eqx.Module):
    """The Gaussian posterior of white unknowns, by its square root: the Jacobian of all residuals at the optimum.

    Attributes:
        white: The optimum.
        jacobian: Of standardised misfit and prior by white unknowns: operator from unknowns to both.
        precondition: Approximate inverse of its normal matrix.
    """

    white: Array
    jacobian: lx.AbstractLinearOperator
    precondition: Callable[[Array], Array]

    def solve(self, b) -> LeastSquares:
        """Find the change of the unknowns that makes residuals change by b, as nearly as possible."""
        J = self.jacobian
        return least_squares(J.mv, J.T.mv, self.precondition, b, _RTOL, _STEPS)

    def covariance(self, weights: Array) -> Array:
        """Multiply the posterior covariance of the white unknowns with weights."""
        misfit, held = jax.eval_shape(self.jacobian.mv, self.white)
        # The prior's rows are diagonal: they turn a right-hand side into any gradient.
        rows = self.jacobian.mv(jnp.ones_like(self.white))[1]
        return self.solve((jnp.zeros(misfit.shape, misfit.dtype), (weights / rows).astype(held.dtype))).x

    def draw(self, key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        """Draw a deviation from the optimum.

        Least squares against white noise in every residual has exactly the posterior's covariance.

        Returns:
            The deviation of the white unknowns; how many degrees of freedom it takes from the data, whose
            mean over draws is their effective number; iterations.
        """
        structure = jax.eval_shape(self.jacobian.mv, self.white)
        keys = jax.random.split(key, len(jax.tree.leaves(structure)))
        leaves, tree = jax.tree.flatten(structure)
        noise = jax.tree.unflatten(
            tree, [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
        )
        solved = self.solve(noise)
        misfit, _ = self.jacobian.mv(solved.x)
        return solved.x, jnp.sum(misfit**2), solved.iterations
