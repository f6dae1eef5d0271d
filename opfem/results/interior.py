"""Stress, strain and energy inside the layer: at Gauss points, as element means, recovered at nodes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.hex8 import CORNERS, GAUSS_POINTS, assemble
from ..mechanics.internal import layer_body
from ..mechanics.kinematics import contract
from ..model.deformation import identity_like, product, transpose
from ..solvers import Solution

# Values at the nodes of the trilinear field through the Gauss points: N_q at the corners `(8 nodes, 8 points)`.
_EXTRAPOLATE = np.array(
    [
        [
            np.prod([(x - other) / (own - other) for x, own, other in zip(corner, point, 1.0 - point, strict=True)])
            for point in GAUSS_POINTS
        ]
        for corner in CORNERS
    ]
)


class LayerFields(eqx.Module):
    """Fields at the eight Gauss points of every element, x fastest, of the deformed layer.

    Attributes:
        deformation_gradient: F [-].
        stress: Cauchy stress [MPa], tension positive.
        energy_density: Strain energy per reference volume [MPa].
        volume: Reference volume of each point [mm³], the same in every layer of elements.
    """

    deformation_gradient: Float[Array, "3 3 8 nz ny nx"]
    stress: Float[Array, "3 3 8 nz ny nx"]
    energy_density: Float[Array, "8 nz ny nx"]
    volume: Float[Array, "8 1 ny nx"]

    @property
    def green_strain(self) -> Float[Array, "3 3 8 nz ny nx"]:
        """Green–Lagrange strain (FᵀF - I)/2 [-]."""
        F = self.deformation_gradient
        return 0.5 * (product(transpose(F), F) - identity_like(F))

    def element_mean(self, values: Float[Array, "*components 8 nz ny nx"]) -> Float[Array, "*components nz ny nx"]:
        """Average a field of Gauss points over the reference volume of each element.

        Args:
            values: One of the fields, or any like it.
        """
        return jnp.sum(values * self.volume, axis=-4) / jnp.sum(self.volume, axis=0)

    def at_nodes(self, values: Float[Array, "*components 8 nz ny nx"]) -> Float[Array, "*components mz my mx"]:
        """Recover a field at the nodes: extrapolated in each element, then averaged by reference volume.

        It is exact for a field that is linear in the reference position, and reaches the surfaces, where
        an element mean lies half an element below.

        Args:
            values: One of the fields, or any like it.
        """
        components = values.shape[:-4]
        flat = values.reshape(-1, *values.shape[-4:])
        share = jnp.broadcast_to(jnp.sum(self.volume, axis=0), flat.shape[-3:])
        nodal = contract(_EXTRAPOLATE, jnp.moveaxis(flat, 1, 0)) * share
        total = assemble(jnp.broadcast_to(share, (8, 1, *share.shape)))
        return (assemble(nodal) / total).reshape(*components, *total.shape[1:])


def layer_fields(solution: Solution) -> LayerFields:
    """Compute stress, strain and energy inside the layer of a solution; NaN where the solve failed.

    In `mean_dilatation` elements the mean stress is that of the element's mean volume change.

    Args:
        solution: What `solve` returned; works under jit, vmap and grad.
    """
    palpation = solution.palpation
    body = layer_body(palpation.mesh(), palpation.layer.material, palpation.element)
    return LayerFields(*body.fields(solution.displacement), body.geometry.weight)
