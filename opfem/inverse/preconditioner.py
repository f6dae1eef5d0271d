"""Preconditioner of a fit: the normal matrix of the linear layer, of the measured local thickness.

Local thickness, masks and the smaller tributary areas of edges make this matrix dense in cosine modes. Its products
cost four cosine transforms, and inner conjugate gradients invert it. Fitted numbers, few but coupled to all modes, are
deflated by a coarse space of exact Jacobian products.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import Bonded, Palpation
from ..optimise.conjugate_gradients import dot, plus
from ..solvers.compiling import QuickJit
from .linear_layer import response
from .measured_surface import MeasuredSurface, Nodes
from .prior import AbstractPrior, Spacing, cosine_transform, from_cosines, wave_numbers

# Tolerance of the inner conjugate gradients: nearly linear, as flexible CG requires; and their limit of iterations.
_RTOL = 1e-3
_STEPS = 200
# Finite-strain compliance of a layer that slips on its window: this share of the slipping one, the rest bonded. The
# tangent of 40×40×4 elements at 12 % strain has 0.46 for the mean and 0.40 for waves of 2π thicknesses. CG iterations
# of the first direction to 3e-2 are fewer with a stiffer layer: 5 at 0.2, 8 at 0.4, 14 at 1.
_SLIPPING = 0.2
# Bounds of the local over the mean thickness: splines oscillate where pixels are masked.
_THINNEST, _THICKEST = 0.1, 10.0


class Unknowns(NamedTuple):
    """White unknowns of a fit: each is standard normal under its prior.

    Attributes:
        normal: Unknowns of the normal traction of every map `(maps, ny+1, nx+1)`.
        lateral: Unknowns of the lateral traction `(maps, 2, ny+1, nx+1)`; None where it follows friction.
        numbers: Unknowns of fitted numbers, by name.
    """

    normal: Float[Array, "maps my mx"]
    lateral: Float[Array, "maps 2 my mx"] | None
    numbers: dict[str, Array]


def indentation(gain: Nodes, softness: Nodes, normal: Nodes) -> Nodes:
    """Compute the small-strain indentation [mm] of the layer, of its local thickness, under a normal traction [MPa]."""
    parts = [np.r_[0.5, np.ones(n - 2), 0.5] for n in normal.shape]
    return softness * from_cosines(gain * cosine_transform(normal * np.outer(*parts)))


class LayerNormal(eqx.Module):
    """Approximate normal matrix of misfit and prior of each map; a call computes the product with its inverse.

    Attributes:
        prior: The prior.
        spacing: Node spacing (dx, dy) [mm].
        gain: Indentation per pressure of every cosine mode [mm/MPa].
        softness: Local indentation over that of the mean thickness [-].
        precision: Precision of the measured surface at the nodes [1/mm²].
    """

    prior: AbstractPrior
    spacing: Spacing
    gain: Float[Array, "*maps my mx"]
    softness: Float[Array, "*maps my mx"]
    precision: Float[Array, "*maps my mx"]

    def __call__(self, gradient: Nodes) -> Nodes:
        """Compute the product with the inverse, to 1e-3."""
        weight = jnp.asarray(self.prior.mode_weight(gradient.shape)) ** 2
        spread = self.prior.mode_std(wave_numbers(gradient.shape, self.spacing), self.spacing)
        diagonal = weight + (spread * self.gain) ** 2 * jnp.mean(self.softness**2 * self.precision)

        def indented(white):
            return indentation(self.gain, self.softness, self.prior.expand(white, self.spacing))

        _, pull = jax.vjp(indented, jnp.zeros_like(gradient))

        def multiply(white):
            return weight * white + pull(self.precision * indented(white))[0]

        return jax.scipy.sparse.linalg.cg(
            multiply, gradient, tol=_RTOL, atol=0.0, maxiter=_STEPS, M=lambda r: r / diagonal
        )[0]


class FitNormal(eqx.Module):
    """Preconditioner of a fit, fitted numbers included; a call with the Jacobian J returns that of JᵀJ.

    Attributes:
        maps: One `LayerNormal` per map, stacked.
    """

    maps: LayerNormal

    def __call__(self, J: Any) -> "Preconditioner":
        """Add the coarse space of fitted numbers, at two forward and one transposed product each."""
        whole = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), J.in_structure())
        names = list(whole.numbers)
        if not names:
            return Preconditioner(self.maps, None, None)
        maps = Preconditioner(self.maps, None, None)

        # A change of the number, with the change of the tractions that compensates it to first order.
        def direction(name):
            alone = whole._replace(numbers={**whole.numbers, name: jnp.ones(())})
            compensation = maps(J.T.mv(J.mv(alone)))
            z = plus(alone, compensation._replace(numbers=whole.numbers), -1.0)
            return z, J.mv(z)

        directions, images = jax.tree.map(lambda *v: jnp.stack(v), *(direction(name) for name in names))
        return Preconditioner(self.maps, directions, _inverse_gram(images))


class Preconditioner(eqx.Module):
    """Approximate inverse of a normal matrix.

    Attributes:
        maps: One `LayerNormal` per map, stacked.
        directions: Basis of the coarse space, one direction per fitted number, stacked; None without.
        coarse: Inverse of the Galerkin normal matrix of the coarse space.
    """

    maps: LayerNormal
    directions: Unknowns | None
    coarse: Float[Array, "numbers numbers"] | None

    @QuickJit
    def __call__(self, gradient: Unknowns) -> Unknowns:
        """Compute the product with the inverse."""

        def one(gain, softness, precision, part):
            return LayerNormal(self.maps.prior, self.maps.spacing, gain, softness, precision)(part)

        maps = self.maps
        change = gradient._replace(normal=jax.vmap(one)(maps.gain, maps.softness, maps.precision, gradient.normal))
        if self.directions is None or self.coarse is None:
            return change
        along = self.coarse @ jax.vmap(lambda z: dot(z, gradient))(self.directions)
        fitted = jax.tree.map(lambda z: jnp.tensordot(along, z, 1), self.directions)
        return plus(change._replace(numbers=jax.tree.map(jnp.zeros_like, change.numbers)), fitted)


@QuickJit
def _inverse_gram(images: Any) -> Float[Array, "numbers numbers"]:
    return jnp.linalg.inv(jax.vmap(lambda a: jax.vmap(lambda b: dot(a, b))(images))(images))


@QuickJit
def fit_normal(palpation: Palpation, surfaces: MeasuredSurface, prior: AbstractPrior) -> FitNormal:
    """Build the preconditioner of a fit from its stacked measured surfaces."""
    mesh = palpation.mesh()

    def one(measured):
        relative = measured.surface / jnp.mean(measured.surface)
        # A layer thin against the wavelength indents with the cube of its thickness.
        softness = jnp.clip(relative, _THINNEST, _THICKEST) ** 3
        return _gain(palpation, jnp.mean(measured.surface)), softness, measured.precision

    return FitNormal(LayerNormal(prior, mesh.spacing, *jax.vmap(one)(surfaces)))


def _gain(palpation: Palpation, thickness: Array) -> Float[Array, "my mx"]:
    """Compute the indentation per pressure of every cosine mode [mm/MPa] at finite strain."""
    if isinstance(palpation.window, Bonded):
        return response(palpation, thickness)
    slipping, bonded = (response(palpation, thickness, base) for base in ("slip", "bonded"))
    return _SLIPPING * slipping + (1.0 - _SLIPPING) * bonded
