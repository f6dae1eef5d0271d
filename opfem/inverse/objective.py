"""Objective of a fit: standardised residuals of maps, priors and other data as a function of white unknowns."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.face import tributary_area
from ..model import Palpation, Traction
from ..solvers import Newton
from ..solvers.compiling import QuickJit
from .elastic_foundation import ElasticFoundation
from .forward import traced_solve
from .measured_surface import MeasuredSurface, interface_heights
from .observations import AxialDisplacement, ForceReading
from .parameters import INDEX, AbstractNumberPrior, with_numbers
from .preconditioner import Unknowns
from .prior import AbstractPrior, on_nodes

# Standardised misfit [-] of every pixel where no equilibrium exists under the load: larger than that of any solved
# state, so that the line search shortens the step.
_NO_EQUILIBRIUM = 1e4
# The residual vector also holds displacement [mm] and normal traction [MPa], scaled by this: a Jacobian product then
# returns their derivatives. Squared, it is below round-off of the sum of squares.
_STATE_SCALE = 1e-9


class Objective(eqx.Module):
    """Residuals whose sum of squares a fit minimises, as a function of white unknowns.

    Attributes:
        palpation: The experiment, fitted numbers at their priors' centres.
        surfaces: Measured surface of every map, stacked.
        prior: Prior of the normal traction.
        lateral: Prior of each component of the lateral traction; None: it is not fitted.
        known_lateral: Lateral traction under every map [MPa] where it is known; None: it is fitted, or follows
            friction.
        parameters: Priors of fitted numbers, by name.
        forces: Force readings, stacked; None without.
        inside: Displacements inside the layer, stacked; None without.
        softness: Pressure scale [MPa] of the softplus that makes the traction non-negative; None: any sign.
        foundation: Elastic foundation between load and layer; of stiffness 0 for a dead load.
        solver: Settings of the forward solve.
    """

    palpation: Palpation
    surfaces: MeasuredSurface
    prior: AbstractPrior
    lateral: AbstractPrior | None
    known_lateral: Float[Array, "maps 2 my mx"] | None
    parameters: dict[str, AbstractNumberPrior]
    forces: ForceReading | None
    inside: AxialDisplacement | None
    softness: Array | None
    foundation: ElasticFoundation
    solver: Newton

    @property
    def infeasible(self) -> float:
        """Half sum of squares [-] of one map under whose load no equilibrium exists."""
        return 0.5 * _NO_EQUILIBRIUM**2 * self.surfaces.certainty[0].size

    def experiment(self, white: Unknowns) -> Palpation:
        """Insert the fitted numbers into the experiment."""
        return with_numbers(self.palpation, self.numbers(white))

    def numbers(self, white: Unknowns) -> dict[str, Array]:
        """Compute the fitted numbers."""
        return {name: prior.number(white.numbers[name]) for name, prior in self.parameters.items()}

    def applied(self, white: Unknowns) -> Float[Array, "maps my mx"]:
        """Compute the applied normal tractions per reference area [MPa]; a dead load transmits them unchanged."""
        return self.latent_to_normal(self.latent(white))

    def latent(self, white: Unknowns) -> Float[Array, "maps my mx"]:
        """Compute the Gaussian field of the prior [MPa]: the normal traction, before the softplus if there is one."""
        spacing = self.palpation.mesh().spacing
        mean = on_nodes(self.prior, white.normal.shape[1:])
        return mean + jax.vmap(lambda part: self.prior.expand(part, spacing))(white.normal)

    def latent_to_normal(self, latent: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
        """Map the Gaussian field to the normal traction: by a softplus where it is non-negative."""
        return latent if self.softness is None else self.softness * jax.nn.softplus(latent / self.softness)

    @QuickJit
    def white(self, normal: Float[Array, "maps my mx"]) -> Unknowns:
        """Compute the unknowns of applied normal tractions [MPa], the others at their priors' centres."""
        maps, *shape = normal.shape
        if self.softness is not None:
            # Inverse softplus; the ratio is bounded below, where the inverse diverges.
            ratio = jnp.maximum(normal / self.softness, 1e-2)
            normal = self.softness * (ratio + jnp.log(-jnp.expm1(-ratio)))
        spacing = self.palpation.mesh().spacing
        deviation = normal - on_nodes(self.prior, tuple(shape))
        lateral = None if self.lateral is None else jnp.zeros((maps, 2, *shape))
        numbers = {name: jnp.zeros(()) for name in self.parameters}
        return Unknowns(jax.vmap(lambda part: self.prior.whiten(part, spacing))(deviation), lateral, numbers)

    def tractions(self, white: Unknowns) -> Traction:
        """Compute the load of every map, stacked."""
        dead, stiffness = self.foundation.dead_load(self.applied(white)), self.foundation.stiffness
        lateral = self.known_lateral
        if self.lateral is not None and white.lateral is not None:
            spacing, prior = self.palpation.mesh().spacing, self.lateral
            mean = on_nodes(prior, white.lateral.shape[1:])
            lateral = mean + jax.vmap(jax.vmap(lambda part: prior.expand(part, spacing)))(white.lateral)
        return jax.vmap(lambda normal, lateral: Traction(normal, lateral, stiffness))(dead, lateral)

    def informed(self, draws: list[Unknowns]) -> dict[str, Array]:
        """Compute the variance reduction of a fitted lateral traction from posterior draws of its deviation."""
        if self.lateral is None:
            return {}
        drawn = jnp.stack([white.lateral for white in draws if white.lateral is not None])
        return {"lateral_informed": 1.0 - jnp.mean(drawn**2)}

    def load(self, white: Unknowns, i: int | Array) -> Traction:
        """Compute the load of one map."""
        return jax.tree.map(lambda leaf: leaf[i], self.tractions(white))

    def __call__(self, white: Unknowns) -> dict[str, Any]:
        """Compute standardised residuals by source, inside a trace, with exact derivatives."""
        palpation = self.experiment(white)
        states = [traced_solve(palpation, self.load(white, i), self.solver) for i in range(white.normal.shape[0])]
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        return self.residuals(white, states.u, states.fraction)[0]

    def residuals(
        self, white: Unknowns, u: Float[Array, "maps 3 mz my mx"], fraction: Float[Array, " maps"]
    ) -> tuple[dict[str, Any], Float[Array, "maps my mx"]]:
        """Compute standardised residuals by source, and heights of the interface [mm].

        Args:
            white: The unknowns.
            u: Displacement under each of their loads [mm].
            fraction: Load fraction at which u is in equilibrium [-].
        """
        mesh = self.experiment(white).mesh()
        spacing, index = mesh.spacing, self.numbers(white).get(INDEX, 1.0)
        heights = jax.vmap(lambda u: interface_heights(mesh, u[:, -1]))(u) * index
        misfit = jax.vmap(lambda surface, heights: surface.misfit(heights))(self.surfaces, heights)
        normal = self.foundation.transmitted(self.tractions(white).normal, u[:, 2, -1])
        # The prior applies to the transmitted traction, which differs from the applied one by the foundation's part.
        added = jax.vmap(lambda part: self.prior.whiten(part, spacing))(normal - self.applied(white))
        residuals = {
            "maps": jnp.where(fraction[:, None, None] >= 1.0, misfit, _NO_EQUILIBRIUM),
            "prior": jax.vmap(lambda part: self.prior.residual(part, spacing))(white.normal + added),
            "numbers": white.numbers,
            "moved": _STATE_SCALE * u[:, :, -1],
            "normal": _STATE_SCALE * normal,
        }
        if self.lateral is not None:
            prior = self.lateral
            residuals["lateral"] = jax.vmap(jax.vmap(lambda part: prior.residual(part, spacing)))(white.lateral)
        if self.forces is not None:
            total = jnp.sum(normal * tributary_area(mesh.positions()[:, -1]), axis=(1, 2))
            residuals["forces"] = (total - self.forces.force) / self.forces.std
        if self.inside is not None:
            std = self.inside.std
            std = std.reshape(std.shape + (1,) * (4 - std.ndim))
            off = (u[:, 2] - self.inside.values) / std
            residuals["inside"] = jnp.where(self.inside.mask, 0.0, off)
        return residuals, heights


def interface_displacement(residuals: dict[str, Any]) -> Float[Array, "maps 3 my mx"]:
    """Extract the interface's displacement, or its derivative [mm], from residuals or a Jacobian product."""
    return residuals["moved"] / _STATE_SCALE


def normal_traction(residuals: dict[str, Any]) -> Float[Array, "maps my mx"]:
    """Extract the transmitted normal traction, or its derivative [MPa], from residuals or a Jacobian product."""
    return residuals["normal"] / _STATE_SCALE


def normal_weights(weights: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
    """Scale weights of the normal traction to weights of its residuals: transpose of `normal_traction`."""
    return weights / _STATE_SCALE
