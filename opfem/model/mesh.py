"""The structured hexahedral mesh of the layer: a regular grid in x and y, equal layers in z.

Node k of a column stands at z = L0(x, y) k/nz, so the mesh is described by the thickness at
the nodes, two spacings and three counts. Nodal fields are `(…, nz+1, ny+1, nx+1)`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LayerMesh(eqx.Module):
    """A layer cut into nx × ny × nz hexahedra.

    Attributes:
        thickness: Unloaded thickness at the nodes `(ny+1, nx+1)` [mm].
        extent: Lx, Ly [mm].
        layers: nz, elements through the thickness.
    """

    thickness: Float[Array, "my mx"]
    extent: Float[Array, "2"]
    layers: int = eqx.field(static=True)

    @property
    def elements(self) -> tuple[int, int, int]:
        """Counts (nx, ny, nz)."""
        ny, nx = self.thickness.shape
        return nx - 1, ny - 1, self.layers

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a nodal field, (nz+1, ny+1, nx+1)."""
        ny, nx = self.thickness.shape
        return self.layers + 1, ny, nx

    @property
    def spacing(self) -> tuple[Array, Array]:
        """Element sizes in x and y [mm]."""
        nx, ny, _ = self.elements
        return self.extent[0] / nx, self.extent[1] / ny

    @property
    def element_size(self) -> Array:
        """Square root of an element's area on the faces [mm]."""
        hx, hy = self.spacing
        return jnp.sqrt(hx * hy)

    def plane(self) -> tuple[Float[Array, "my mx"], Float[Array, "my mx"]]:
        """Compute reference x and y [mm] of the interface nodes."""
        nx, ny, _ = self.elements
        hx, hy = self.spacing
        y, x = jnp.meshgrid(hy * jnp.arange(ny + 1), hx * jnp.arange(nx + 1), indexing="ij")
        return x, y

    def positions(self) -> Float[Array, "3 mz my mx"]:
        """Compute the reference positions X [mm] of all nodes."""
        x, y = self.plane()
        fraction = jnp.arange(self.layers + 1)[:, None, None] / self.layers
        z = fraction * self.thickness
        return jnp.stack([jnp.broadcast_to(x, z.shape), jnp.broadcast_to(y, z.shape), z])
