"""The assembled tangent as a block stencil: 27 blocks of 3×3 per node, no scatter.

Element matrices are `(nz, 8 a, 8 b, 3, 3, ny, nx)`; assembling overlaps them one axis after
the other. `S[dz, 3 dy + dx, i, j]` couples component i of a node with component j of its
neighbour at offset (dz - 1, dy - 1, dx - 1).
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.hex8 import gather, pad_axis
from ..mechanics.staging import apart

Stencil = Float[Array, "3 9 3 3 mz my mx"]
ElementMatrices = Float[Array, "nz 8 8 3 3 ny nx"]
Nodal = Float[Array, "3 mz my mx"]
# A stencil of one, two or three of the components, and a field that it multiplies.
PartStencil = Float[Array, "3 9 c c mz my mx"]
PartNodal = Float[Array, "c mz my mx"]


def assemble_stencil(K: ElementMatrices) -> Stencil:
    """Overlap element matrices into the stencil."""
    return apart(_assembled, K)


def _assembled(K: ElementMatrices) -> Stencil:
    nz, *_, ny, nx = K.shape
    K = K.reshape(nz, 2, 2, 2, 2, 2, 2, 3, 3, ny, nx)  # nz, az, ay, ax, bz, by, bx, i, k, ny, nx
    S = overlap(K, a=3, b=6, cell=-1)  # dx, nz, az, ay, bz, by, i, k, ny, nx+1
    S = overlap(S, a=3, b=5, cell=-2)  # dy, dx, nz, az, bz, i, k, ny+1, nx+1
    S = overlap(S, a=3, b=4, cell=2)  # dz, dy, dx, nz+1, i, k, ny+1, nx+1
    S = jnp.moveaxis(S, 3, 5)
    return S.reshape(3, 9, *S.shape[3:])


def overlap(K: Array, a: int, b: int, cell: int) -> Array:
    """Turn pairs of cell ends (a, b) along one axis into node offsets -1, 0, +1, placed first."""
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
    """Multiply the assembled matrix with a nodal field.

    Along one axis of all nodes a neighbour is a shift, whatever the direction, and loops are long. What a shift
    brings from beyond a border meets a block of zeros.
    """
    return apart(_product, S, u)


def _product(S: PartStencil, u: PartNodal) -> PartNodal:
    components, shape = len(u), u.shape[1:]
    along_z, along_y, nodes = shape[1] * shape[2], shape[2], int(np.prod(shape))
    furthest = along_z + along_y + 1
    padded = jnp.pad(u.reshape(components, nodes), ((0, 0), (furthest, furthest)))
    blocks = S.reshape(27, components, components, nodes)
    # All pairs of components at once: a third of the memory traffic more would be the sum over j within the loop of
    # neighbours; single rows are four times as many instructions to compile.
    shifts = [
        dz * along_z + dy * along_y + dx for dz, dy, dx in itertools.product(range(3), repeat=3)
    ]
    neighbours = (jax.lax.slice_in_dim(padded, shift, shift + nodes, axis=1) for shift in shifts)
    products = [block * neighbour for block, neighbour in zip(blocks, neighbours, strict=True)]
    pairs = sum(products[1:], start=products[0])
    return sum((pairs[:, j] for j in range(1, components)), start=pairs[:, 0]).reshape(u.shape)


def with_unit_diagonal(S: Stencil, scale: Array) -> Stencil:
    """Put `scale` on the diagonal of rows that are zero: held and ghost unknowns."""
    eye = jnp.eye(3, dtype=S.dtype)[:, :, None, None, None]
    centre = S[1, 4]
    diagonal = jnp.stack([centre[i, i] for i in range(3)])
    missing = jnp.where(diagonal == 0.0, scale, 0.0).astype(S.dtype)
    centre = centre + eye * missing[:, None]
    middle = jnp.concatenate([S[1, :4], centre[None], S[1, 5:]])
    return jnp.stack([S[0], middle, S[2]])


def held(K: ElementMatrices, free: Nodal) -> ElementMatrices:
    """Zero rows and columns of held unknowns (free = 0) in element matrices."""
    mask = jnp.moveaxis(gather(free.astype(K.dtype)), 2, 0)  # nz, a, i, ny, nx
    return K * mask[:, :, None, :, None] * mask[:, None, :, None, :]


def column_blocks(S: PartStencil) -> Float[Array, "m m my mx"]:
    """Collect each column's own matrix, m = c (nz+1) unknowns ordered as a nodal field's, (component, z)."""
    components, nodes = S.shape[3:5]
    blocks = jnp.zeros((components, nodes, components, nodes, *S.shape[5:]), S.dtype)
    for dz in range(3):
        places = jnp.eye(nodes, k=dz - 1, dtype=S.dtype)[None, :, None, :, None, None]
        blocks = blocks + places * jnp.swapaxes(S[dz, 4], 1, 2)[:, :, :, None]  # i, z, j, y, x
    return blocks.reshape(components * nodes, components * nodes, *S.shape[5:])


def dense_matrix(S: Stencil) -> Float[Array, "n n"]:
    """Write a small stencil out as a matrix of nodal fields."""
    shape = S.shape[-3:]
    nodes = int(np.prod(shape))
    z, y, x = np.indices(shape).reshape(3, -1)
    dz, dy, dx = (along[None, :] - along[:, None] + 1 for along in (z, y, x))
    near = (np.maximum(np.maximum(abs(dz - 1), abs(dy - 1)), abs(dx - 1)) <= 1).astype(S.dtype)
    place = np.where(near, ((3 * dz + dy) * 3 + dx), 0) * 9 * nodes + np.arange(nodes)[:, None]
    blocks = [[S.reshape(-1)[place + (3 * i + j) * nodes] * near for j in range(3)] for i in range(3)]
    return jnp.block(blocks)
