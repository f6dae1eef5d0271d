"""The assembled tangent as a block stencil: 27 blocks of 3×3 per node, no scatter.

Element matrices are `(nz, 8 a, 8 b, 3, 3, ny, nx)`; assembly sums them one axis at a time. `S[dz, 3 dy + dx, i, j]`
couples component i of a node with component j of its neighbour at offset (dz - 1, dy - 1, dx - 1).
"""

import itertools
import operator
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.hex8 import pad_axis
from ..mechanics.unfused import unfused

Stencil = Float[Array, "3 9 3 3 mz my mx"]
ElementMatrices = Float[Array, "nz 8 8 3 3 ny nx"]
Nodal = Float[Array, "3 mz my mx"]
# A stencil of one, two or three components, and a field of as many.
PartStencil = Float[Array, "3 9 c c mz my mx"]
PartNodal = Float[Array, "c mz my mx"]


def assemble_stencil(K: ElementMatrices) -> Stencil:
    """Assemble element matrices into the stencil."""
    return unfused(_assembled, K)


def _assembled(K: ElementMatrices) -> Stencil:
    nz, *_, ny, nx = K.shape
    K = K.reshape(nz, 2, 2, 2, 2, 2, 2, 3, 3, ny, nx)  # nz, az, ay, ax, bz, by, bx, i, k, ny, nx
    S = overlap(K, a=3, b=6, cell=-1)  # dx, nz, az, ay, bz, by, i, k, ny, nx+1
    S = overlap(S, a=3, b=5, cell=-2)  # dy, dx, nz, az, bz, i, k, ny+1, nx+1
    S = overlap(S, a=3, b=4, cell=2)  # dz, dy, dx, nz+1, i, k, ny+1, nx+1
    S = jnp.moveaxis(S, 3, 5)
    return S.reshape(3, 9, *S.shape[3:])


def overlap(K: Array, a: int, b: int, cell: int) -> Array:
    """Convert pairs of cell ends (a, b) along one axis to node offsets -1, 0, +1, on the first axis."""
    pair = {(i, j): jnp.take(jnp.take(K, j, axis=b), i, axis=a) for i in (0, 1) for j in (0, 1)}
    if cell > 0:
        cell -= sum(axis < cell for axis in (a, b))
    return jnp.stack(
        [
            pad_axis(pair[1, 0], cell, (1, 0)),
            pad_axis(pair[0, 0], cell, (0, 1)) + pad_axis(pair[1, 1], cell, (1, 0)),
            pad_axis(pair[0, 1], cell, (0, 1)),
        ]
    )


def apply_stencil(S: PartStencil, u: PartNodal) -> PartNodal:
    """Compute the product of the assembled matrix with a nodal field.

    On the flattened nodes every neighbour is a shift, and loops are long. Values shifted across a border meet a block
    of zeros.
    """
    components, shape = len(u), u.shape[1:]
    nodes = int(np.prod(shape))
    furthest = shape[1] * shape[2] + shape[2] + 1
    padded = jnp.pad(u.reshape(components, nodes), ((0, 0), (furthest, furthest)))
    # All pairs of components at once: row by row compiles four times as many instructions.
    pairs = unfused(
        partial(_sum_over_neighbours, shape=shape), S.reshape(27, -1, nodes), jnp.tile(padded, (components, 1))
    )
    pairs = pairs.reshape(components, components, *shape)
    return reduce(operator.add, (pairs[:, j] for j in range(components)))


def _sum_over_neighbours(blocks: Array, padded: Array, shape: tuple[int, ...]) -> Array:
    along_z, along_y, nodes = shape[1] * shape[2], shape[2], int(np.prod(shape))
    shifts = [dz * along_z + dy * along_y + dx for dz, dy, dx in itertools.product(range(3), repeat=3)]
    products = [blocks[k] * padded[:, shift : shift + nodes] for k, shift in enumerate(shifts)]
    return reduce(operator.add, products)


def with_unit_diagonal(S: Stencil, scale: Array) -> Stencil:
    """Set the diagonal of zero rows, of fixed and ghost unknowns, to `scale`."""
    eye = np.eye(3, dtype=S.dtype)[:, :, None, None, None]
    centre = S[1, 4]
    diagonal = jnp.sum(eye * centre, axis=1, keepdims=True)
    missing = jnp.where(diagonal == 0.0, scale, 0.0).astype(S.dtype)
    return jax.lax.dynamic_update_slice(S, (centre + eye * missing)[None, None], (1, 4, 0, 0, 0, 0, 0))


def column_blocks(S: PartStencil) -> Float[Array, "m m my mx"]:
    """Extract the diagonal block of each column: m = c (nz+1) unknowns in the order (component, z)."""
    components, nodes = S.shape[3:5]
    blocks = jnp.zeros((components, nodes, components, nodes, *S.shape[5:]), S.dtype)
    for dz in range(3):
        places = jnp.eye(nodes, k=dz - 1, dtype=S.dtype)[None, :, None, :, None, None]
        blocks = blocks + places * jnp.swapaxes(S[dz, 4], 1, 2)[:, :, :, None]  # i, z, j, y, x
    return blocks.reshape(components * nodes, components * nodes, *S.shape[5:])


def dense_matrix(S: Stencil) -> Float[Array, "n n"]:
    """Expand a small stencil to a dense matrix of nodal fields."""
    shape = S.shape[-3:]
    nodes = int(np.prod(shape))
    z, y, x = np.indices(shape).reshape(3, -1)
    dz, dy, dx = (along[None, :] - along[:, None] + 1 for along in (z, y, x))
    near = np.maximum(np.maximum(abs(dz - 1), abs(dy - 1)), abs(dx - 1)) <= 1
    place = np.where(near, ((3 * dz + dy) * 3 + dx) * nodes + np.arange(nodes)[:, None], 0)
    by_pair = jnp.moveaxis(S.reshape(27, 9, nodes), 1, 2).reshape(27 * nodes, 9)
    blocks = by_pair[place] * near[:, :, None].astype(S.dtype)
    return jnp.transpose(blocks.reshape(nodes, nodes, 3, 3), (2, 0, 3, 1)).reshape(3 * nodes, 3 * nodes)


def coarsen_stencil(S: Stencil, axis: int) -> Array:
    """Coarsen along one axis by two: Galerkin product with linear interpolation.

    An even number of nodes is extended by a ghost node, whose row has interpolated entries only.

    Args:
        S: The stencil.
        axis: -1 for x, -2 for y.
    """
    n = S.shape[axis]
    coarse = n // 2 + 1
    S = S.reshape(3, 3, 3, *S.shape[2:])
    widths = [(0, 0)] * S.ndim
    widths[axis] = (1, 2 * coarse - n)
    S = jnp.pad(S, widths)
    offset = axis + 3  # of the three by three by three
    total = None
    for p, d in itertools.product((-1, 0, 1), repeat=2):
        start, limit, stride = [0] * S.ndim, list(S.shape), [1] * S.ndim
        start[axis], limit[axis], stride[axis] = p + 1, p + 2 * coarse, 2
        start[offset], limit[offset] = d + 1, d + 2
        # Row 2I + p meets column 2I + p + d = 2(I + D) + q: of weight w(p) w(q) in the coarse offset D.
        weights = [_hat(p) * _hat(p + d - 2 * D) for D in (-1, 0, 1)]
        shape = [3 if a == offset else 1 for a in range(S.ndim)]
        part = jax.lax.slice(S, start, limit, stride) * np.reshape(weights, shape).astype(S.dtype)
        total = part if total is None else total + part
    assert total is not None
    return total.reshape(3, 9, *total.shape[3:])


def _hat(offset: int) -> float:
    return max(0.0, 1.0 - 0.5 * abs(offset))


def neighbours(values: Float[Array, "c mz my mx"]) -> Float[Array, "3 9 c mz my mx"]:
    """Gather the values of the 27 neighbours of every node; zero beyond the border."""
    around = jnp.pad(values, [(0, 0), (1, 1), (1, 1), (1, 1)])
    for axis in (-1, -2, -3):
        n = values.shape[axis]
        around = jnp.stack([jax.lax.slice_in_dim(around, k, k + n, axis=around.ndim + axis) for k in range(3)])
    return around.reshape(3, 9, *values.shape)


def mask_stencil(free: np.ndarray) -> np.ndarray:
    """Mark the entries of a stencil whose two unknowns are both free: `(3, 9, 3, 3, mz, my, mx)`."""
    mz, my, mx = free.shape[1:]
    padded = np.pad(free, np.array([(0, 0), (1, 1), (1, 1), (1, 1)]))
    offsets = itertools.product(range(3), repeat=3)
    around = np.stack([padded[:, z : z + mz, y : y + my, x : x + mx] for z, y, x in offsets])
    return around.reshape(3, 9, 1, *free.shape) * free[:, None]
