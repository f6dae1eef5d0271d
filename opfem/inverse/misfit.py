"""What a fit minimises: misfit and priors, as a function of white unknowns."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.face import nodal_area_vector, tributary_area
from ..model import Palpation, Traction
from ..solvers import Newton
from ..solvers.compiling import QuickJit
from .bed import Bed
from .data import AxialDisplacement, ForceReading
from .forward import press_exactly
from .observation import Nodes, Observation, interface_heights
from .parameters import INDEX, AbstractNumberPrior, with_numbers
from .posterior import Posterior
from .preconditioner import Unknowns
from .prior import AbstractPrior, on_nodes

# Standardised misfit [-] of every pixel where the layer does not carry the traction: the step is then shortened.
_NOT_CARRIED = 1e4
# Weight of displacements [1/mm] and tractions [1/MPa] that ride along among the residuals, so that products with the
# Jacobian give their change too: it weighs nothing.
_RIDES_ALONG = 1e-9


class Misfit(eqx.Module):
    """What a fit minimises, as a function of white unknowns.

    Attributes:
        palpation: The experiment, fitted numbers at their priors' centres.
        observations: Of every map, stacked.
        prior: Of the normal traction.
        lateral: Of each component of the lateral traction; None: it is not fitted.
        known_lateral: Lateral traction `(2, ny+1, nx+1)` [MPa] where it is not fitted; None: it follows friction.
        parameters: Priors of fitted numbers, by name.
        forces: Force readings, stacked; None without.
        inside: Displacements inside the layer, stacked; None without.
        softness: Pressure [MPa] below which a non-negative traction bends towards zero; None: any sign.
        bed: Springs between the load and the layer; of stiffness 0 for a dead load.
        solver: Settings of the forward solve.
    """

    palpation: Palpation
    observations: Observation
    prior: AbstractPrior
    lateral: AbstractPrior | None
    known_lateral: Array | None
    parameters: dict[str, AbstractNumberPrior]
    forces: ForceReading | None
    inside: AxialDisplacement | None
    softness: Array | None
    bed: Bed
    solver: Newton

    @property
    def hopeless(self) -> float:
        """The half sum of squares [-] of one map whose traction is not carried."""
        return 0.5 * _NOT_CARRIED**2 * self.observations.certainty[0].size

    def experiment(self, white: Unknowns) -> Palpation:
        """Put the fitted numbers into the experiment."""
        return with_numbers(self.palpation, self.numbers(white))

    def numbers(self, white: Unknowns) -> dict[str, Array]:
        """Compute the fitted numbers."""
        return {name: prior.number(white.numbers[name]) for name, prior in self.parameters.items()}

    def asked(self, white: Unknowns) -> Float[Array, "maps my mx"]:
        """Compute the normal tractions [MPa] per reference area that are asked for: a dead load's are carried."""
        return self.latent_to_normal(self.latent(white))

    def latent(self, white: Unknowns) -> Float[Array, "maps my mx"]:
        """Compute what the prior speaks of [MPa]: the normal tractions, unless those are kept above zero."""
        spacing = self.palpation.mesh().spacing
        mean = on_nodes(self.prior, white.normal.shape[1:])
        return mean + jax.vmap(lambda part: self.prior.expand(part, spacing))(white.normal)

    def latent_to_normal(self, latent: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
        """Keep tractions above zero, where that is asked for."""
        return latent if self.softness is None else self.softness * jax.nn.softplus(latent / self.softness)

    @QuickJit
    def white(self, normal: Float[Array, "maps my mx"]) -> Unknowns:
        """Find unknowns that ask for normal tractions [MPa], the others at their priors' centres."""
        maps, *shape = normal.shape
        if self.softness is not None:
            # The inverse of softplus, from a little above zero.
            ratio = jnp.maximum(normal / self.softness, 1e-2)
            normal = self.softness * (ratio + jnp.log(-jnp.expm1(-ratio)))
        spacing = self.palpation.mesh().spacing
        deviation = normal - on_nodes(self.prior, tuple(shape))
        lateral = None if self.lateral is None else jnp.zeros((maps, 2, *shape))
        numbers = {name: jnp.zeros(()) for name in self.parameters}
        return Unknowns(jax.vmap(lambda part: self.prior.whiten(part, spacing))(deviation), lateral, numbers)

    def tractions(self, white: Unknowns) -> Traction:
        """Compute the load of every map, stacked."""
        dead, stiffness = self.bed.load(self.asked(white)), self.bed.stiffness
        if self.lateral is None or white.lateral is None:
            return jax.vmap(lambda normal: Traction(normal, self.known_lateral, stiffness))(dead)
        spacing, prior = self.palpation.mesh().spacing, self.lateral
        mean = on_nodes(prior, white.lateral.shape[1:])
        lateral = mean + jax.vmap(jax.vmap(lambda part: prior.expand(part, spacing)))(white.lateral)
        return jax.vmap(lambda normal, lateral: Traction(normal, lateral, stiffness))(dead, lateral)

    def informed(self, draws: list[Unknowns]) -> dict[str, Array]:
        """Tell how much of the variance of a fitted lateral traction the maps took away, from draws of deviations."""
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
        pressed = [press_exactly(palpation, self.load(white, i), self.solver) for i in range(white.normal.shape[0])]
        pressed = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pressed)
        return self.residuals(white, pressed.u, pressed.reached)[0]

    def residuals(
        self, white: Unknowns, u: Float[Array, "maps 3 mz my mx"], reached: Float[Array, " maps"]
    ) -> tuple[dict[str, Any], Float[Array, "maps my mx"]]:
        """Compute standardised residuals by source, and heights of the interface [mm].

        Args:
            white: The unknowns.
            u: Displacement under each of their loads [mm].
            reached: Load fraction that it is for [-].
        """
        mesh = self.experiment(white).mesh()
        spacing, index = mesh.spacing, self.numbers(white).get(INDEX, 1.0)
        heights = jax.vmap(lambda u: interface_heights(mesh, u[:, -1]))(u) * index
        misfit = jax.vmap(lambda observation, heights: observation.misfit(heights))(self.observations, heights)
        normal = self.bed.carried(self.tractions(white).normal, u[:, 2, -1])
        # Springs add to what is asked for.
        added = jax.vmap(lambda part: self.prior.whiten(part, spacing))(normal - self.asked(white))
        residuals = {
            "maps": jnp.where(reached[:, None, None] >= 1.0, misfit, _NOT_CARRIED),
            "prior": jax.vmap(lambda part: self.prior.held(part, spacing))(white.normal + added),
            "numbers": white.numbers,
            "moved": _RIDES_ALONG * u[:, :, -1],
            "normal": _RIDES_ALONG * normal,
        }
        if self.lateral is not None:
            prior = self.lateral
            residuals["lateral"] = jax.vmap(jax.vmap(lambda part: prior.held(part, spacing)))(white.lateral)
        if self.forces is not None:
            total = jnp.sum(normal * tributary_area(mesh.positions()[:, -1]), axis=(1, 2))
            residuals["forces"] = (total - self.forces.force) / self.forces.std
        if self.inside is not None:
            std = self.inside.std
            std = std.reshape(std.shape + (1,) * (4 - std.ndim))
            off = (u[:, 2] - self.inside.values) / std
            residuals["inside"] = jnp.where(self.inside.mask, 0.0, off)
        return residuals, heights


def pressure_change(
    palpation: Palpation, traction: Float[Array, "3 my mx"], u: Float[Array, "3 my mx"], change: Nodes, moved: Array
) -> Nodes:
    """Compute how the pressure on the current area changes with the normal traction and with where its points are.

    Args:
        palpation: The experiment.
        traction: Force on the layer per reference area [MPa]; its lateral part keeps its ratio to the normal one.
        u: Displacement of the interface [mm].
        change: Of the normal traction [MPa].
        moved: Change of the displacement [mm].
    """
    X = palpation.mesh().positions()[:, -1]
    normal = -traction[2]
    pushes = jnp.abs(normal) > 1e-12 * jnp.max(jnp.abs(normal))
    direction = jnp.where(pushes, traction / jnp.where(pushes, normal, 1.0), jnp.array([0.0, 0.0, -1.0])[:, None, None])
    area = tributary_area(X)

    def pressure(normal, u):
        outward = nodal_area_vector(X + u)
        return -jnp.sum(direction * (normal * area) * outward, axis=0) / jnp.sum(outward**2, axis=0)

    return jax.jvp(pressure, (normal, u), (change, moved))[1]


def moved(residuals: dict[str, Any]) -> Float[Array, "maps 3 my mx"]:
    """Take the interface's displacement, or its change [mm], from residuals or their change."""
    return residuals["moved"] / _RIDES_ALONG


def carried(residuals: dict[str, Any]) -> Float[Array, "maps my mx"]:
    """Take the normal traction that the layer carries, or its change [MPa], from residuals or their change."""
    return residuals["normal"] / _RIDES_ALONG


def normal_covariance(posterior: Posterior, weights: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
    """Multiply the posterior covariance of the normal traction with weights [-]."""
    nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), posterior.residual_structure())
    pulled = posterior.pull({**nothing, "normal": weights / _RIDES_ALONG})
    return carried(posterior.push(posterior.covariance(pulled)))


def number_covariance(posterior: Posterior) -> Float[Array, "numbers numbers"]:
    """Compute the posterior covariance of the fitted numbers' white unknowns [-]."""
    names = list(posterior.white.numbers)
    if not names:
        return jnp.zeros((0, 0))
    nothing = jax.tree.map(jnp.zeros_like, posterior.white)

    def column(one):
        weights = nothing._replace(numbers=dict(zip(names, one, strict=True)))
        pulled = posterior.covariance(weights).numbers
        return jnp.stack([pulled[name] for name in names])

    columns = jnp.stack([column(one) for one in jnp.eye(len(names))])
    return 0.5 * (columns + columns.T)
