"""Energy, internal force and element stiffness of the layer.

Two element forms share everything but the volume they measure: `full` takes J at each Gauss
point, `mean_dilatation` takes the element's mean (energy of F with the element-mean J: symmetric,
free of volumetric locking). Source: Simo, Taylor & Pister, CMAME 51 (1985) 177.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import AbstractMaterial, LayerMesh
from ..model.deformation import Kinematics, kinematics, outer
from .hex8 import GRADIENTS, assemble, gather
from .kinematics import ElementGeometry, contract, displacement_gradient, element_geometry

ElementForm = Literal["mean_dilatation", "full"]

# D_aα D_bβ summed over Gauss points by one matrix product: `(8 a, 8 b, 8 q · 3 α · 3 β)`.
_PAIRS = np.einsum("qma,qnb->abqmn", GRADIENTS, GRADIENTS).reshape(8, 8, 72)


class LayerBody(eqx.Module):
    """The deformable layer: its material, geometry and element form."""

    material: AbstractMaterial
    geometry: ElementGeometry
    form: ElementForm = eqx.field(static=True)

    def energy(self, u: Float[Array, "3 mz my mx"]) -> Float[Array, ""]:
        """Compute the strain energy [N mm]."""
        k = kinematics(displacement_gradient(self.geometry, gather(u)))
        return jnp.sum(self._energy_density(k) * self.geometry.weight)

    def internal_force(self, u: Float[Array, "3 mz my mx"]) -> tuple[Float[Array, "3 mz my mx"], Array]:
        """Compute dEnergy/du [N] and the smallest J of any Gauss point."""
        k = kinematics(displacement_gradient(self.geometry, gather(u)))
        P = self.material.first_piola(k, self.material.volumetric_stress(self._volume_change(k)))
        flux = self.geometry.to_reference(P * self.geometry.weight)
        by_point = jnp.transpose(flux, (2, 1, 0, 3, 4, 5))
        nodal = contract(_FROM_POINTS, by_point.reshape(24, *by_point.shape[2:]))
        return assemble(nodal), jnp.min(k.J)

    def stiffness(self, u: Float[Array, "3 mz my mx"]) -> Float[Array, "nz 8 8 3 3 ny nx"]:
        """Compute the element stiffness [N/mm]: K[a, b, i, k] = df[a, i]/du[b, k].

        One layer of elements at a time, so that the tangent moduli stay in the cache.
        """

        def one_layer(inputs):
            nodal, slope_x, slope_y = inputs
            geometry = ElementGeometry(self.geometry.spacing, self.geometry.depth, slope_x[:, None], slope_y[:, None])
            return self._layer_stiffness(geometry, nodal[:, :, None])

        nodal = gather(u)
        per_layer = (
            jnp.moveaxis(nodal, 2, 0),
            *(jnp.moveaxis(s, 1, 0) for s in (self.geometry.slope_x, self.geometry.slope_y)),
        )
        return jax.lax.map(one_layer, per_layer)

    def _layer_stiffness(self, geometry: ElementGeometry, nodal: Array) -> Float[Array, "8 8 3 3 ny nx"]:
        k = kinematics(displacement_gradient(geometry, nodal))
        mean_stress = self.material.volumetric_stress(self._volume_change(k, geometry))
        A = self.material.tangent(k, mean_stress)
        if self.form == "full":
            A = A + (self.material.bulk * k.J**2) * outer(k.G, k.G)
        A = geometry.to_reference(A * geometry.weight, axis=1)
        A = geometry.to_reference(A, axis=3)[:, :, :, :, :, 0]  # (i, α, k, β, q, ny, nx)
        A = jnp.transpose(A, (4, 1, 3, 0, 2, 5, 6))
        K = contract(_PAIRS, A.reshape(72, *A.shape[3:]))
        if self.form == "full":
            return K
        flux = geometry.to_reference(k.J * k.G * geometry.weight)[:, :, :, 0]
        by_point = jnp.transpose(flux, (2, 1, 0, 3, 4))
        dv = contract(_FROM_POINTS, by_point.reshape(24, *by_point.shape[2:]))  # (a, i, ny, nx)
        volume = jnp.sum(geometry.weight, axis=0)[0]
        return K + (self.material.bulk / volume) * (dv[:, None, :, None] * dv[None, :, None, :])

    def _volume_change(self, k: Kinematics, geometry: ElementGeometry | None = None) -> Array:
        if self.form == "full":
            return k.volume_change
        weight = (geometry or self.geometry).weight
        return jnp.sum(k.volume_change * weight, axis=0) / jnp.sum(weight, axis=0)

    def cauchy(self, u: Float[Array, "3 mz my mx"]) -> Float[Array, "3 3 8 nz ny nx"]:
        """Compute Cauchy stress [MPa] at the Gauss points, tension positive."""
        return self._cauchy(kinematics(displacement_gradient(self.geometry, gather(u))))

    def fields(self, u: Float[Array, "3 mz my mx"]) -> tuple[Array, Array, Float[Array, "8 nz ny nx"]]:
        """Compute F [-], Cauchy stress [MPa] and energy per reference volume [MPa] at the Gauss points."""
        k = kinematics(displacement_gradient(self.geometry, gather(u)))
        return k.F, self._cauchy(k), self._energy_density(k)

    def _cauchy(self, k: Kinematics) -> Float[Array, "3 3 8 nz ny nx"]:
        P = self.material.first_piola(k, self.material.volumetric_stress(self._volume_change(k)))
        return sum(P[:, j, None] * k.F[None, :, j] for j in range(3)) / k.J

    def _energy_density(self, k: Kinematics) -> Float[Array, "8 nz ny nx"]:
        return self.material.isochoric_energy(k) + self.material.volumetric_energy(self._volume_change(k))


# dN_a/dξ_α with points first: `(8 a, 8 q · 3 α)`.
_FROM_POINTS = np.transpose(GRADIENTS, (2, 0, 1)).reshape(8, 24)


def layer_body(mesh: LayerMesh, material: AbstractMaterial, form: ElementForm) -> LayerBody:
    """Build the deformable layer."""
    return LayerBody(material, element_geometry(mesh), form)
