"""The 8-node hexahedron on the structured mesh: shape functions, gather and assembly.

Nodes and Gauss points of an element run x fastest, then y, then z. Gathering is eight shifted
slices and assembling is padded adds, one axis after the other: no scatter.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))
CORNERS = tuple((x, y, z) for z, y, x in itertools.product((0, 1), repeat=3))
# Gauss points (ξ, η, ζ) on the unit cube, each of weight 1/8.
GAUSS_POINTS = np.array([[_GAUSS[c] for c in corner] for corner in CORNERS])


def shape_gradients(points: np.ndarray) -> np.ndarray:
    """Compute dN_a/dξ_α on the unit cube: `(points, 3, 8)`."""
    gradients = np.ones((len(points), 3, 8))
    for a, corner in enumerate(CORNERS):
        for axis, other in itertools.product(range(3), repeat=2):
            t = points[:, other]
            if other == axis:
                gradients[:, axis, a] *= 1.0 if corner[other] else -1.0
            else:
                gradients[:, axis, a] *= t if corner[other] else 1.0 - t
    return gradients


# dN_a/dξ_α at the Gauss points `(8 points, 3, 8 nodes)`.
GRADIENTS = shape_gradients(GAUSS_POINTS)


def gather(u: Float[Array, "c mz my mx"]) -> Float[Array, "8 c nz ny nx"]:
    """Collect the nodal values of every element."""
    nz, ny, nx = (n - 1 for n in u.shape[1:])
    return jnp.stack([u[:, z : z + nz, y : y + ny, x : x + nx] for x, y, z in CORNERS])


def assemble(f: Float[Array, "8 c nz ny nx"]) -> Float[Array, "c mz my mx"]:
    """Add element nodal values into nodes: the transpose of `gather`."""
    f = f.reshape((2, 2, 2, *f.shape[1:]))
    f = shifted_sum(f[:, :, 0], f[:, :, 1], axis=-1)
    f = shifted_sum(f[:, 0], f[:, 1], axis=-2)
    return shifted_sum(f[0], f[1], axis=-3)


def shifted_sum(low: Array, high: Array, axis: int) -> Array:
    """Add cell values into the nodes at their low and high ends along one axis."""
    return pad_axis(low, axis, (0, 1)) + pad_axis(high, axis, (1, 0))


def pad_axis(values: Array, axis: int, width: tuple[int, int]) -> Array:
    """Pad one axis with zeros."""
    widths = [(0, 0)] * values.ndim
    widths[axis] = width
    return jnp.pad(values, widths)
