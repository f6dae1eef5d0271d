"""Cells of an unstructured mesh: hexahedra, linear and quadratic tetrahedra, by their list of nodes.

Curved and graded verification meshes go through here, a layer never does. Gathering is an index into
nodal values; assembling gathers too, from a padded table of the cells around each node: no scatter.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import concrete
from ..model.deformation import ProductSum, cofactor
from .hex8 import GAUSS_POINTS, GRADIENTS
from .kinematics import AbstractCells
from .tet import FOUR_POINTS, linear_gradients, quadratic_gradients

CellKind = Literal["hex8", "tet4", "tet10"]

_UNIT_TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
# dN_a/dξ_α `(points, 3, a)`; every point of a cell has the same share of the unit cell's volume.
_GRADIENTS = {
    "hex8": GRADIENTS,
    "tet4": linear_gradients(_UNIT_TETRAHEDRON).T[None],
    "tet10": np.stack([quadratic_gradients(_UNIT_TETRAHEDRON, point).T for point in FOUR_POINTS]),
}
_POINT_VOLUME = {"hex8": 1.0 / len(GAUSS_POINTS), "tet4": 1.0 / 6.0, "tet10": 1.0 / 24.0}
_LISTED = 8


class UnstructuredCells(AbstractCells):
    """Cells, their integration points, and who shares a node with whom.

    Attributes:
        point_volume: Reference volume of the integration points [mm³].
        dN_dX: Gradients of the shape functions at the integration points [1/mm].
        cells: Nodes of every cell.
        incidence: For every node the places `a * elements + e` of its cells' values; unused places
            hold `a * elements`, one past the last.
    """

    point_volume: Float[Array, "points elements"]
    dN_dX: Float[Array, "a 3 points elements"]
    cells: Int[np.ndarray | Array, "a elements"]
    incidence: Int[np.ndarray | Array, "nodes sharing"]

    @property
    def weight(self) -> Float[Array, "points elements"]:
        """Reference volume of the integration points [mm³]."""
        return self.point_volume

    def gather(self, u: Float[Array, "3 nodes"]) -> Float[Array, "a 3 elements"]:
        """Collect the nodal values of every cell."""
        return jnp.moveaxis(jnp.take(u, jnp.asarray(self.cells), axis=1), 0, 1)

    def displacement_gradient(self, u: Float[Array, "3 nodes"]) -> Float[Array, "3 3 points elements"]:
        """Compute H[i, J] = du_i/dX_J [-] from nodal displacements [mm]."""
        nodal = self.gather(u)
        terms = (v[:, None, None, :] * d[None] for v, d in zip(nodal, self.dN_dX, strict=True))
        return sum(terms, start=jnp.zeros((), u.dtype))

    def nodal_vectors(self, stress: Float[Array, "3 3 points elements"]) -> Float[Array, "a 3 elements"]:
        """Sum stress[i, J] dN_a/dX_J over the points.

        Args:
            stress: First Piola–Kirchhoff stress times `weight` [N mm].

        Returns:
            Forces on the nodes of every cell [N].
        """
        return jnp.stack([jnp.sum(stress * d[None], axis=(1, 2)) for d in self.dN_dX])

    def assemble(self, vectors: Float[Array, "a 3 elements"]) -> Float[Array, "3 nodes"]:
        """Add cell values into nodes, in the same order every time: the transpose of `gather`."""
        flat = jnp.moveaxis(vectors, 1, 0).reshape(3, -1)
        padded = jnp.pad(flat, ((0, 0), (0, 1)))
        return jnp.sum(jnp.take(padded, jnp.asarray(self.incidence), axis=1), axis=-1)

    def referred(self, tangent: ProductSum) -> ProductSum:
        """Leave the axes of X as they are."""
        return tangent

    def matrices(self, tangent: ProductSum) -> Float[Array, "a b 3 3 elements"]:
        """Sum dN_a/dX_J tangent[i, J, k, L] dN_b/dX_L over the points of each cell."""
        # Letters: a, b nodes; i, k current axes; J, L reference axes; q points; e cells.
        by_node = jnp.einsum("aJqe,iJkLqe->aikLqe", self.dN_dX, tangent.entries())
        return jnp.einsum("aikLqe,bLqe->abike", by_node, self.dN_dX)


def unstructured_cells(
    points: Float[np.ndarray | Array, "3 nodes"], cells: np.ndarray, kind: CellKind
) -> UnstructuredCells:
    """Build the cells of a mesh from its points and its list of nodes.

    Args:
        points: Reference positions of the nodes [mm].
        cells: Nodes of every cell, `(elements, 8 | 4 | 10)`. Hexahedra run x fastest, then y, then z, as
            `hex8.CORNERS`; the middles of a quadratic tetrahedron follow `tet.EDGES`.
        kind: "hex8" with 2×2×2 points, "tet4" with one, "tet10" with four, isoparametric.

    Returns:
        The cells.

    Raises:
        ValueError: If the list does not fit the kind or the points, or a cell is folded, inverted or flat at
            one of its points.
    """
    if kind not in _GRADIENTS:
        raise ValueError(f"kind must be one of {', '.join(_GRADIENTS)}, got {kind!r}.")
    gradients = _GRADIENTS[kind]
    cells = np.asarray(cells)
    count, nodes = gradients.shape[-1], points.shape[1]
    if cells.ndim != 2 or cells.shape[1] != count or not np.issubdtype(cells.dtype, np.integer):
        raise ValueError(
            f"cells of {kind} must be integers of shape (elements, {count}), got {cells.shape} {cells.dtype}."
        )
    if cells.size == 0 or cells.min() < 0 or cells.max() >= nodes:
        raise ValueError(f"cells must name nodes 0 to {nodes - 1}; they must not be empty either.")
    nodal = jnp.asarray(points)[:, cells.T]  # (3, a, e)
    # dX_J/dξ_α, `(3, 3, points, elements)`.
    jacobian = jnp.einsum("qma,Jae->Jmqe", jnp.asarray(gradients, nodal.dtype), nodal)
    cof = cofactor(jacobian)
    volume = jnp.sum(jacobian[0] * cof[0], axis=0)
    _check_volume(concrete(volume))
    return UnstructuredCells(
        point_volume=volume * _POINT_VOLUME[kind],
        dN_dX=jnp.einsum("qma,Jmqe->aJqe", jnp.asarray(gradients, nodal.dtype), cof / volume),
        cells=cells.T.astype(np.int32),
        incidence=_incidence(cells, nodes),
    )


def _check_volume(volume: np.ndarray | None) -> None:
    if volume is None:
        return
    smallest = volume.min(axis=0)
    wrong = np.flatnonzero(~(smallest > 0.0))
    if wrong.size:
        listed = ", ".join(f"{e} ({smallest[e]:.3g})" for e in wrong[:_LISTED])
        more = f" and {wrong.size - _LISTED} more" if wrong.size > _LISTED else ""
        raise ValueError(
            f"Cells are folded, inverted or flat: det(dX/dξ) [mm³] must be positive, got it for cells {listed}{more}. "
            "Check the order of their nodes."
        )


def _incidence(cells: np.ndarray, nodes: int) -> np.ndarray:
    elements, count = cells.shape
    flat = cells.T.ravel()  # place a * elements + e
    order = np.argsort(flat, kind="stable")
    sharing = np.bincount(flat, minlength=nodes)
    start = np.concatenate([[0], np.cumsum(sharing)[:-1]])
    column = np.arange(flat.size) - np.repeat(start, sharing)
    table = np.full((nodes, max(int(sharing.max()), 1)), count * elements, np.int32)
    table[flat[order], column] = order
    return table
