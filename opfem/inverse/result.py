"""What a fit returns: traction, its uncertainty, and how well it explains the map."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..measurement import ThicknessMap
from ..solvers import Solution
from .observation import Nodes
from .posterior import Posterior
from .prior import AbstractPrior


class FitStatus(eqx.Enumeration):
    """How a fit ended."""

    successful = ""
    max_steps_reached = (
        "The fit took fit_traction(max_steps=...) Gauss–Newton steps without settling. Raise it, or start closer: "
        "a prior with a mean, a longer length or a smaller std."
    )
    not_carried = (
        "The layer does not carry the traction that the fit starts from. Give the prior a smaller std or a longer "
        "length, or smooth the map."
    )
    nonfinite = "A derivative of the layer's response is not finite: a linear solve did not converge. Smooth the map."


class TractionFit(eqx.Module):
    """The traction fitted to a measured map.

    Attributes:
        solution: The layer under the fitted traction, solved to the solver's own tolerance.
        pressure_std: Posterior standard deviation of `pressure`, on the current area [MPa].
        normal_std: The same of the normal traction, per reference area [MPa].
        chi2: Sum of squared misfits between interface and measured surface over their noise [-].
        effective_dof: How many degrees of freedom the data determine [-].
        observed: How many the map could have determined [-]: its independent numbers on the mesh's splines.
        residual: Interface minus measured surface at the mesh's own grid in space [mm].
        stats: `gauss_newton_steps`, `forward_solves`, `inner_iterations` (each one product with the Jacobian and one
            with its transpose), `posterior_iterations`, `draws`, `std_error` (relative standard error of the standard
            deviations [-]), `representation_rms` [mm] (what the map has beyond mesh-spaced splines),
            `misfit_rms` [mm].
        result: How the fit ended.
        posterior: The posterior of the white unknowns.
        prior: The prior.
        deviations: Draws of the normal traction minus the optimum, which standard deviations come from [MPa].
    """

    solution: Solution
    pressure_std: Nodes
    normal_std: Nodes
    chi2: Array
    effective_dof: Array
    observed: Array
    residual: Nodes
    stats: dict[str, Any]
    result: FitStatus
    posterior: Posterior
    prior: AbstractPrior
    deviations: Float[Array, "draws my mx"]

    @property
    def traction(self) -> Float[Array, "3 my mx"]:
        """Force on the layer at the interface per reference area [MPa]."""
        return self.solution.traction

    @property
    def normal(self) -> Nodes:
        """Normal traction per reference area, positive in compression [MPa]: what was fitted."""
        return -self.solution.traction[2]

    @property
    def pressure(self) -> Nodes:
        """Pressure on the sample, on the current area [MPa]."""
        return self.solution.pressure

    @property
    def thickness(self) -> ThicknessMap:
        """Thickness of the layer under the fitted traction, as a spatial map [mm]."""
        return self.solution.thickness

    @property
    def reduced_chi2(self) -> Array:
        """χ² over the degrees of freedom that are left to judge it by: near 1 where model and noise are right."""
        return self.chi2 / (self.observed - self.effective_dof)

    def draws(self, key: PRNGKeyArray, n: int) -> Float[Array, "n my mx"]:
        """Draw normal tractions from the posterior [MPa].

        Args:
            key: Random key.
            n: How many.
        """
        spacing = self.solution.palpation.mesh().spacing

        def one(key):
            return self.prior.expand(self.posterior.draw(key)[0], spacing)

        return self.normal + jax.lax.map(one, jax.random.split(key, n))

    def covariance(self, weights: Nodes) -> Nodes:
        """Multiply the posterior covariance of the normal traction with weights: Cov(p, Σ weights p).

        The variance of the weighted sum Σ weights p is the sum of weights times the answer.

        Args:
            weights: Of every node `(ny+1, nx+1)` [-].
        """
        spacing = self.solution.palpation.mesh().spacing
        _, pull = jax.vjp(lambda white: self.prior.expand(white, spacing), jnp.zeros_like(weights))
        return self.prior.expand(self.posterior.covariance(pull(weights)[0]), spacing)
