"""The fit's preconditioner: the layer as its transfer function, as thick as it was measured.

Indentation grows about with the cube of the local thickness where the layer is thin against the waves of the
pressure; nodes on edges press with half of an element, at corners with a quarter; and a layer under load is stiffer
for long waves, friction or not. With that, and with what is masked, the normal matrix is no longer diagonal in
cosines, but its products cost four transforms: its systems are solved by conjugate gradients of their own. Fitted
numbers, coupled to everything but few, are added as a coarse space of exact products with the Jacobian.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import Bonded, Palpation
from ..solvers.compiling import QuickJit
from .conjugate_gradients import dot, plus
from .estimates import response
from .observation import Nodes, Observation
from .prior import AbstractPrior, Spacing, cosine_transform, from_cosines
from .transfer import wave_numbers

_RTOL = 1e-3
_STEPS = 200
# How a layer that slips on its window indents at finite strain: this part as at small strain, the rest as a bonded one.
# The tangent of 40×40×4 elements at 12 % of strain has 0.46 for the mean and 0.40 for waves as long as 2π thicknesses,
# but the first direction to 3e-2 takes fewer iterations where it is taken for stiffer: 5 at 0.2, 8 at 0.4, 14 at 1.
_SLIPPING = 0.2


class Unknowns(NamedTuple):
    """White unknowns of a fit: every number standard normal under the prior.

    Attributes:
        normal: Of the normal traction of every map `(maps, ny+1, nx+1)`.
        lateral: Of the lateral traction `(maps, 2, ny+1, nx+1)`; None where it follows friction.
        numbers: Of the experiment's fitted numbers, by name.
    """

    normal: Float[Array, "maps my mx"]
    lateral: Float[Array, "maps 2 my mx"] | None
    numbers: dict[str, Array]


def indentation(gain: Nodes, softness: Nodes, normal: Nodes) -> Nodes:
    """Compute the small-strain indentation [mm] under a normal traction [MPa], of a layer as thick as it is locally."""
    parts = [np.r_[0.5, np.ones(n - 2), 0.5] for n in normal.shape]
    return softness * from_cosines(gain * cosine_transform(normal * np.outer(*parts)))


class LayerNormal(eqx.Module):
    """Approximate normal matrix of misfit and prior for each map; calling that of one multiplies with its inverse.

    Attributes:
        prior: The prior.
        spacing: Node spacing (dx, dy) [mm].
        gain: Indentation per pressure of every cosine mode [mm/MPa].
        softness: Local indentation over that of the mean thickness [-].
        precision: Of the measured surface at the nodes [1/mm²].
    """

    prior: AbstractPrior
    spacing: Spacing
    gain: Float[Array, "*maps my mx"]
    softness: Float[Array, "*maps my mx"]
    precision: Float[Array, "*maps my mx"]

    def __call__(self, gradient: Nodes) -> Nodes:
        """Multiply with the inverse, to 1e-3."""
        held = jnp.asarray(self.prior.penalised(gradient.shape)) ** 2
        spread = self.prior.mode_std(wave_numbers(gradient.shape, self.spacing), self.spacing)
        diagonal = held + (spread * self.gain) ** 2 * jnp.mean(self.softness**2 * self.precision)

        def indented(white):
            return indentation(self.gain, self.softness, self.prior.expand(white, self.spacing))

        _, pull = jax.vjp(indented, jnp.zeros_like(gradient))

        def multiply(white):
            return held * white + pull(self.precision * indented(white))[0]

        return jax.scipy.sparse.linalg.cg(
            multiply, gradient, tol=_RTOL, atol=0.0, maxiter=_STEPS, M=lambda r: r / diagonal
        )[0]


class FitNormal(eqx.Module):
    """The preconditioner of a whole fit; calling it with the Jacobian J makes that of JᵀJ.

    Attributes:
        maps: One `LayerNormal` per map, stacked.
    """

    maps: LayerNormal

    def __call__(self, J: Any) -> "Preconditioner":
        """Add fitted numbers, by products with J: two forward and one transposed for each."""
        whole = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), J.in_structure())
        names = list(whole.numbers)
        if not names:
            return Preconditioner(self.maps, None, None)
        maps = Preconditioner(self.maps, None, None)

        # What change of the tractions a number calls for, and what both do together.
        def direction(name):
            alone = whole._replace(numbers={**whole.numbers, name: jnp.ones(())})
            followed = maps(J.T.mv(J.mv(alone)))
            z = plus(alone, followed._replace(numbers=whole.numbers), -1.0)
            return z, J.mv(z)

        directions, images = jax.tree.map(lambda *v: jnp.stack(v), *(direction(name) for name in names))
        return Preconditioner(self.maps, directions, _inverse_gram(images))


class Preconditioner(eqx.Module):
    """Approximate inverse of a normal matrix.

    Attributes:
        maps: One `LayerNormal` per map, stacked.
        directions: Of fitted numbers, with what the tractions do about them, stacked; None without.
        coarse: Inverse of the normal matrix between these.
    """

    maps: LayerNormal
    directions: Unknowns | None
    coarse: Float[Array, "numbers numbers"] | None

    @QuickJit
    def __call__(self, gradient: Unknowns) -> Unknowns:
        """Multiply with the inverse."""

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
def fit_normal(palpation: Palpation, observations: Observation, prior: AbstractPrior) -> FitNormal:
    """Build the preconditioner of a fit from its stacked observations."""
    mesh = palpation.mesh()

    def one(observation):
        pressed = observation.surface / jnp.mean(observation.surface)
        softness = jnp.clip(pressed, 0.1, 10.0) ** 3
        return _gain(palpation, jnp.mean(observation.surface)), softness, observation.precision

    return FitNormal(LayerNormal(prior, mesh.spacing, *jax.vmap(one)(observations)))


def _gain(palpation: Palpation, thickness: Array) -> Float[Array, "my mx"]:
    """Compute the indentation per pressure of every cosine mode [mm/MPa] at finite strain."""
    if isinstance(palpation.window, Bonded):
        return response(palpation, thickness)
    slipping, bonded = (response(palpation, thickness, base) for base in ("slip", "bonded"))
    return _SLIPPING * slipping + (1.0 - _SLIPPING) * bonded
