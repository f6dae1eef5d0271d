"""Geometry of the structured elements, and gradients at their Gauss points.

An element's map is X = hx (i + ξ), Y = hy (j + η), Z = L0(ξ, η)(k + ζ)/nz, so its inverse
gradient has five entries, all known in closed form.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import LayerMesh
from .hex8 import GAUSS_POINTS, GRADIENTS


class ElementGeometry(eqx.Module):
    """The inverse map of every element at its Gauss points, and their weights.

    Attributes:
        spacing: Element sizes in x and y [mm], `(2,)`.
        depth: Element height dZ/dζ at the Gauss points `(8, 1, ny, nx)` [mm].
        slope_x: (dZ/dξ)/(dZ/dζ) `(8, nz, ny, nx)` [-].
        slope_y: (dZ/dη)/(dZ/dζ) `(8, nz, ny, nx)` [-].
    """

    spacing: Float[Array, "2"]
    depth: Float[Array, "8 1 ny nx"]
    slope_x: Float[Array, "8 nz ny nx"]
    slope_y: Float[Array, "8 nz ny nx"]

    @property
    def weight(self) -> Float[Array, "8 1 ny nx"]:
        """Reference volume of the Gauss points [mm³]."""
        return self.depth * (self.spacing[0] * self.spacing[1] / 8.0)

    def from_reference(self, gradient: Array) -> Array:
        """Turn d/dξ `(8, 3, c, nz, ny, nx)` into d/dX `(c, 3, 8, nz, ny, nx)`."""
        xi, eta, zeta = gradient[:, 0], gradient[:, 1], gradient[:, 2]
        sx, sy = self.slope_x[:, None], self.slope_y[:, None]
        d_dx = (xi - sx * zeta) / self.spacing[0]
        d_dy = (eta - sy * zeta) / self.spacing[1]
        return jnp.moveaxis(jnp.stack([d_dx, d_dy, zeta / self.depth[:, None]]), 2, 0)

    def to_reference(self, flux: Array, axis: int = 1) -> Array:
        """Turn a flux along X `(…, 8, nz, ny, nx)`, X at `axis`, into one along ξ: `from_reference` transposed."""
        x, y, z = (jnp.take(flux, k, axis=axis) for k in range(3))
        x, y = x / self.spacing[0], y / self.spacing[1]
        return jnp.stack([x, y, z / self.depth - self.slope_x * x - self.slope_y * y], axis=axis)


def element_geometry(mesh: LayerMesh) -> ElementGeometry:
    """Compute the inverse map of every element of the mesh."""
    nz = mesh.layers
    L0 = mesh.thickness
    low_x, high_x = _ends(L0, 1)
    corners = [_ends(low_x, 0), _ends(high_x, 0)]  # [x][y]
    xi, eta, zeta = (GAUSS_POINTS[:, k, None, None] for k in range(3))
    south = (1 - xi) * corners[0][0] + xi * corners[1][0]
    north = (1 - xi) * corners[0][1] + xi * corners[1][1]
    thickness = (1 - eta) * south + eta * north
    d_xi = (1 - eta) * (corners[1][0] - corners[0][0]) + eta * (corners[1][1] - corners[0][1])
    fraction = np.arange(nz)[None, :, None, None] + zeta[:, None]
    return ElementGeometry(
        spacing=jnp.stack(mesh.spacing),
        depth=jnp.asarray(thickness[:, None] / nz),
        slope_x=jnp.asarray(fraction * (d_xi / thickness)[:, None]),
        slope_y=jnp.asarray(fraction * ((north - south) / thickness)[:, None]),
    )


def displacement_gradient(
    geometry: ElementGeometry, nodal: Float[Array, "8 3 nz ny nx"]
) -> Float[Array, "3 3 8 nz ny nx"]:
    """Compute H[i, J] = du_i/dX_J at the Gauss points from element nodal displacements."""
    return geometry.from_reference(contract(GRADIENTS, nodal))


def contract(matrix: np.ndarray, values: Array) -> Array:
    """Multiply the leading axis of an array by the last axis of a constant, as one matrix product."""
    flat = jnp.asarray(matrix.reshape(-1, matrix.shape[-1]), values.dtype) @ values.reshape(values.shape[0], -1)
    return flat.reshape(*matrix.shape[:-1], *values.shape[1:])


def _ends(values: Array, axis: int) -> tuple[Array, Array]:
    n = values.shape[axis]
    return jnp.take(values, np.arange(n - 1), axis), jnp.take(values, np.arange(1, n), axis)
