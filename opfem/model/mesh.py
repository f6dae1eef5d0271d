"""Structured hexahedral meshes: a regular grid in x and y, upright columns of nodes in z.

The layer's columns have equal elements from the window to the interface; those of any other block stand at stated
heights. Nodal fields are `(…, nz+1, ny+1, nx+1)`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractBlockMesh(eqx.Module):
    """A block cut into nx × ny × nz hexahedra; `heights` are z of its nodes `(nz+1, ny+1, nx+1)` [mm].

    Attributes:
        extent: Lx, Ly [mm].
    """

    extent: eqx.AbstractVar[Float[Array, "2"]]

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a nodal field, (nz+1, ny+1, nx+1)."""
        raise NotImplementedError

    @property
    def elements(self) -> tuple[int, int, int]:
        """Counts (nx, ny, nz)."""
        mz, my, mx = self.node_shape
        return mx - 1, my - 1, mz - 1

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
        """Compute reference x and y [mm] of the nodes of a face."""
        nx, ny, _ = self.elements
        hx, hy = self.spacing
        y, x = jnp.meshgrid(hy * jnp.arange(ny + 1), hx * jnp.arange(nx + 1), indexing="ij")
        return x, y

    def node_heights(self) -> Float[Array, "mz my mx"]:
        """Compute z [mm] of all nodes."""
        raise NotImplementedError

    def positions(self) -> Float[Array, "3 mz my mx"]:
        """Compute the reference positions X [mm] of all nodes."""
        x, y = self.plane()
        z = self.node_heights()
        return jnp.stack([jnp.broadcast_to(x, z.shape), jnp.broadcast_to(y, z.shape), z])


class LayerMesh(AbstractBlockMesh):
    """A layer on the window cut into nx × ny × nz hexahedra: node k of a column stands at z = L0(x, y) k/nz.

    Attributes:
        thickness: Unloaded thickness at the nodes `(ny+1, nx+1)` [mm].
        extent: Lx, Ly [mm].
        layers: nz, elements through the thickness.
    """

    thickness: Float[Array, "my mx"]
    extent: Float[Array, "2"]
    layers: int = eqx.field(static=True)

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a nodal field, (nz+1, ny+1, nx+1)."""
        ny, nx = self.thickness.shape
        return self.layers + 1, ny, nx

    def node_heights(self) -> Float[Array, "mz my mx"]:
        """Compute z [mm] of all nodes."""
        return jnp.arange(self.layers + 1)[:, None, None] / self.layers * self.thickness


class BlockMesh(AbstractBlockMesh):
    """A block with nodes at stated heights.

    Attributes:
        heights: z of the nodes `(nz+1, ny+1, nx+1)` [mm], rising along the columns.
        extent: Lx, Ly [mm].
    """

    heights: Float[Array, "mz my mx"]
    extent: Float[Array, "2"]

    @property
    def node_shape(self) -> tuple[int, int, int]:
        """Shape of a nodal field, (nz+1, ny+1, nx+1)."""
        mz, my, mx = self.heights.shape
        return mz, my, mx

    @property
    def layers(self) -> int:
        """Elements through the thickness, nz."""
        return self.heights.shape[0] - 1

    @property
    def thickness(self) -> Float[Array, "my mx"]:
        """Height of the columns `(ny+1, nx+1)` [mm]."""
        return self.heights[-1] - self.heights[0]

    def node_heights(self) -> Float[Array, "mz my mx"]:
        """Return z [mm] of all nodes."""
        return self.heights
