"""Cells and their quadrature points: geometry, gradients, forces and matrices of the layer.

A cell is the support of one set of shape functions: an element, or for tetrahedra the box of six of them. A cell's map
is X = hx (i + ξ), Y = hy (j + η), with upright columns of nodes. Its inverse gradient has five entries, all in closed
form.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import BlockMesh, LayerMesh
from ..model.deformation import ProductSum
from .hex8 import CORNERS, GAUSS_POINTS, GRADIENTS, assemble, gather
from .tet import EDGES, FOUR_POINTS, kuhn_tetrahedra, linear_gradients, quadratic_gradients
from .unfused import mapped, unfused


class CellKind(NamedTuple):
    """Shape functions of a cell on the unit cube.

    Attributes:
        nodes: Places of the nodes (x, y, z), in elements, `(nodes, 3)`.
        points: Quadrature points (ξ, η, ζ) `(points, 3)`.
        gradients: dN_a/dξ_α at the points `(points, 3, nodes)`.
        weights: Weights of the points, of sum 1 `(points,)`.
    """

    nodes: np.ndarray
    points: np.ndarray
    gradients: np.ndarray
    weights: np.ndarray

    @property
    def span(self) -> int:
        """Elements that the cell covers along each axis."""
        return int(self.nodes.max())

    @property
    def from_points(self) -> np.ndarray:
        """dN_a/dξ_α with points first: `(nodes a, points q · 3 α)`."""
        return np.transpose(self.gradients, (2, 0, 1)).reshape(len(self.nodes), -1)

    @property
    def pairs(self) -> np.ndarray:
        """D_aα D_bβ by points: sums over points are one matrix product: `(a, b, 3 α · 3 β · q)`."""
        n = len(self.nodes)
        return np.einsum("qma,qnb->abmnq", self.gradients, self.gradients).reshape(n, n, -1)


def _tetrahedra(span: int) -> CellKind:
    """Fill a cell with six tetrahedra, linear (span 1) or quadratic (span 2)."""
    nodes = np.array(CORNERS) if span == 1 else np.indices((3, 3, 3)).reshape(3, -1)[::-1].T
    place = {tuple(node): a for a, node in enumerate(nodes)}
    points, gradients = [], []
    for vertices in kuhn_tetrahedra():
        corners = span * vertices
        middles = [(corners[a] + corners[b]) // 2 for a, b in EDGES]
        own = [place[tuple(node)] for node in [*corners, *(middles if span == 2 else [])]]
        for point in FOUR_POINTS if span == 2 else np.full((1, 4), 0.25):
            d = quadratic_gradients(vertices, point) if span == 2 else linear_gradients(vertices)
            whole = np.zeros((3, len(nodes)))
            whole[:, own] = d.T
            points.append(point @ vertices)
            gradients.append(whole)
    return CellKind(nodes, np.array(points), np.array(gradients), np.full(len(points), 1.0 / len(points)))


CELLS = {
    "hex8": CellKind(np.array(CORNERS), GAUSS_POINTS, GRADIENTS, np.full(8, 1.0 / 8.0)),
    "tet4": _tetrahedra(1),
    "tet10": _tetrahedra(2),
}


class AbstractCells(eqx.Module):
    """Cells that a body is integrated over; the caller multiplies stresses and tangents with `weight`."""

    @property
    def weight(self) -> Float[Array, "points *cells"]:
        """Reference volume of the points [mm³]."""
        raise NotImplementedError

    def displacement_gradient(self, u: Array) -> Float[Array, "3 3 points *cells"]:
        """Compute H[i, J] = du_i/dX_J at the points."""
        raise NotImplementedError

    def nodal_vectors(self, stress: Float[Array, "3 3 points *cells"]) -> Float[Array, "a 3 *cells"]:
        """Sum stress[i, J] dN_a/dX_J over the points of each cell."""
        raise NotImplementedError

    def assemble(self, vectors: Float[Array, "a 3 *cells"]) -> Array:
        """Assemble nodal values of the cells at nodes."""
        raise NotImplementedError

    def referred(self, tangent: ProductSum) -> ProductSum:
        """Transform the axes J and L of tangent[i, J, k, L] to those that `matrices` sums over."""
        raise NotImplementedError

    def matrices(self, tangent: ProductSum) -> Float[Array, "a b 3 3 *cells"]:
        """Sum dN_a/dX_J tangent[i, J, k, L] dN_b/dX_L over the points of each cell.

        Args:
            tangent: `referred`, times `weight` [N mm]; symmetric, as an energy's is.

        Returns:
            Stiffness of every cell [N/mm]: force on (a, i) by displacement of (b, k).
        """
        raise NotImplementedError

    def in_parts(self, prepare: Callable, finish: Callable, u: Array, *fields: Any) -> Any:
        """Evaluate finish(cells, prepare(cells, displacement gradient, fields)) for parts of the mesh: here in one."""
        return finish(self, prepare(self, self.displacement_gradient(u), *fields))

    def mean(self, values: Float[Array, "*components_points_cells"], components: int = 0) -> Array:
        """Average over the reference volume of each cell, keeping an axis of one point."""
        return jnp.sum(values * self.weight, axis=components, keepdims=True) / self.volume

    @property
    def volume(self) -> Float[Array, "1 *cells"]:
        """Reference volume of the cells [mm³]."""
        return jnp.sum(self.weight, axis=0, keepdims=True)


class LayerCells(AbstractCells):
    """The inverse map of every cell of the layer at its points, and their weights.

    Attributes:
        spacing: Cell sizes in x and y [mm], `(2,)`.
        depth: Cell height dZ/dζ at the points `(points, 1 or nz, ny, nx)` [mm].
        slope_x: (dZ/dξ)/(dZ/dζ) `(points, nz, ny, nx)` [-].
        slope_y: (dZ/dη)/(dZ/dζ) `(points, nz, ny, nx)` [-].
        name: "hex8", "tet4" or "tet10".
    """

    spacing: Float[Array, "2"]
    depth: Float[Array, "points _ ny nx"]
    slope_x: Float[Array, "points nz ny nx"]
    slope_y: Float[Array, "points nz ny nx"]
    name: str = eqx.field(static=True, default="hex8")

    @property
    def kind(self) -> CellKind:
        """Shape functions and points of the cells."""
        return CELLS[self.name]

    @property
    def weight(self) -> Float[Array, "points _ ny nx"]:
        """Reference volume of the points [mm³]."""
        share = jnp.asarray(self.kind.weights, self.depth.dtype)[:, None, None, None]
        return self.depth * (self.spacing[0] * self.spacing[1] * share)

    @property
    def element_spacing(self) -> Float[Array, "2"]:
        """Element sizes in x and y [mm]."""
        return self.spacing / self.kind.span

    @property
    def element_depth(self) -> Array:
        """Mean height of an element [mm]."""
        return jnp.mean(self.depth) / self.kind.span

    def gather(self, u: Float[Array, "c mz my mx"]) -> Float[Array, "a c nz ny nx"]:
        """Gather the nodal values of every cell."""
        if self.name == "hex8":
            return gather(u)
        span = self.kind.span
        ends = [(n - 1) // span * span for n in u.shape[1:]]
        return jnp.stack(
            [
                u[:, z : z + ends[0] : span, y : y + ends[1] : span, x : x + ends[2] : span]
                for x, y, z in self.kind.nodes.tolist()
            ]
        )

    def assemble(self, vectors: Float[Array, "a c nz ny nx"]) -> Float[Array, "c mz my mx"]:
        """Add the nodal values of the cells into nodes: the transpose of `gather`."""
        if self.kind.span == 1:
            return assemble(vectors)
        span, zero = self.kind.span, jnp.zeros((), vectors.dtype)

        def placed(values, node):
            # Values are `span` nodes apart, from the node's position in the first cell on.
            widths = [(at, span - at, span - 1) for at in node]
            shape = [n * span + 1 for n in values.shape[1:]]
            spread = jax.lax.pad(values, zero, [(0, 0, 0), *widths])
            return spread[:, : shape[0], : shape[1], : shape[2]]

        parts = [placed(values, node[::-1]) for values, node in zip(vectors, self.kind.nodes.tolist(), strict=True)]
        return functools.reduce(jnp.add, parts)

    def displacement_gradient(self, u: Float[Array, "3 mz my mx"]) -> Float[Array, "3 3 points nz ny nx"]:
        """Compute H[i, J] = du_i/dX_J at the points."""
        return self._gradient(self.gather(u))

    def nodal_vectors(self, stress: Float[Array, "3 3 points nz ny nx"]) -> Float[Array, "a 3 nz ny nx"]:
        """Sum stress[i, J] dN_a/dX_J over the points of each cell."""
        flux = jnp.transpose(self._to_reference(stress), (2, 1, 0, 3, 4, 5))
        return contract(self.kind.from_points, flux.reshape(-1, *flux.shape[2:]))

    def referred(self, tangent: ProductSum) -> ProductSum:
        """Turn the axes J and L of tangent[i, J, k, L] into ξ."""
        return tangent.referred(self._to_reference)

    def matrices(self, tangent: ProductSum) -> Float[Array, "a b 3 3 nz ny nx"]:
        """Sum dN_a/dX_J tangent[i, J, k, L] dN_b/dX_L over the points of each cell: six blocks of nine, in a loop."""

        def block(pair):
            A = tangent.block(pair[0], pair[1])
            return contract(self.kind.pairs, A.reshape(-1, *A.shape[3:]))

        rows, columns = np.triu_indices(3)
        upper = mapped(block, np.stack([rows, columns], axis=1))
        place = {(i, k): at for at, (i, k) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True))}
        lower = jnp.swapaxes(upper, 1, 2)
        blocks = [[upper[place[i, k]] if i <= k else lower[place[k, i]] for k in range(3)] for i in range(3)]
        return jnp.stack([jnp.stack(row, axis=2) for row in blocks], axis=2)

    def in_parts(self, prepare: Callable, finish: Callable, u: Float[Array, "3 mz my mx"], *fields: Any) -> Any:
        """Evaluate finish(cells, prepare(cells, displacement gradient, fields)) one layer of cells at a time.

        Intermediate results then fit the cache; cells lie along one axis, so that loops are long. Results have
        layers first.
        """
        nz, ny, nx = self.slope_x.shape[1:]
        whole = [self.gather(u), self.slope_x, self.slope_y, *fields]
        if self.depth.shape[1] > 1:
            whole.append(self.depth)
        flat = [jnp.moveaxis(v, -3, 0).reshape(nz, *v.shape[:-3], 1, 1, ny * nx) for v in whole]
        depth = self.depth.reshape(-1, self.depth.shape[1], 1, ny * nx)

        def at_gradient(cells, nodal, *fields):
            return prepare(cells, cells._gradient(nodal), *fields)

        def one_layer(layer):
            nodal, slope_x, slope_y, *rest = layer
            own = rest.pop() if self.depth.shape[1] > 1 else depth
            cells = LayerCells(self.spacing, own, slope_x, slope_y, self.name)
            return finish(cells, unfused(at_gradient, cells, nodal, *rest))

        results = mapped(one_layer, flat)
        return jax.tree.map(lambda v: v.reshape(*v.shape[:-3], ny, nx), results)

    def element_mean(self, values: Float[Array, "*components points cz cy cx"], volume: Array) -> Array:
        """Average a field over the reference volume [mm³] of each cell: `(*components, nz, ny, nx)`.

        All elements of a cell have its value.
        """
        mean = jnp.sum(values * volume, axis=-4) / jnp.sum(volume, axis=0)
        for axis in (-3, -2, -1):
            mean = jnp.repeat(mean, self.kind.span, axis=axis)
        return mean

    def _gradient(self, nodal: Float[Array, "a 3 nz ny nx"]) -> Float[Array, "3 3 points nz ny nx"]:
        """Compute d/dX at the points from nodal values of the cells."""
        gradient = contract(self.kind.gradients, nodal)
        xi, eta, zeta = gradient[:, 0], gradient[:, 1], gradient[:, 2]
        sx, sy = self.slope_x[:, None], self.slope_y[:, None]
        d_dx = (xi - sx * zeta) / self.spacing[0]
        d_dy = (eta - sy * zeta) / self.spacing[1]
        return jnp.moveaxis(jnp.stack([d_dx, d_dy, zeta / self.depth[:, None]]), 2, 0)

    def _to_reference(self, flux: Array, axis: int = 1) -> Array:
        """Convert a flux along X `(…, points, nz, ny, nx)`, X at `axis`, into one along ξ: `_gradient` transposed."""
        x, y, z = (jnp.take(flux, k, axis=axis) for k in range(3))
        x, y = x / self.spacing[0], y / self.spacing[1]
        return jnp.stack([x, y, z / self.depth - self.slope_x * x - self.slope_y * y], axis=axis)


def layer_cells(mesh: LayerMesh | BlockMesh, name: str = "hex8") -> LayerCells:
    """Compute the inverse map of every cell of the mesh at its points.

    Args:
        mesh: The mesh.
        name: "hex8", "tet4", or "tet10" for cells of 2 × 2 × 2 elements.
    """
    if name != "hex8" or isinstance(mesh, BlockMesh):
        return _from_positions(mesh, name)
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
    return LayerCells(
        spacing=jnp.stack(mesh.spacing),
        depth=jnp.asarray(thickness[:, None] / nz),
        slope_x=jnp.asarray(fraction * (d_xi / thickness)[:, None]),
        slope_y=jnp.asarray(fraction * ((north - south) / thickness)[:, None]),
    )


def _from_positions(mesh: LayerMesh | BlockMesh, name: str) -> LayerCells:
    """Take the map's gradient from the nodes: isoparametric."""
    spacing = jnp.stack(mesh.spacing) * CELLS[name].span
    one = jnp.ones((1, 1, 1, 1), mesh.extent.dtype)
    gather = LayerCells(spacing, one, one, one, name).gather
    dZ = contract(CELLS[name].gradients, gather(mesh.positions()[2:]))[:, :, 0]
    return LayerCells(spacing, dZ[:, 2], dZ[:, 0] / dZ[:, 2], dZ[:, 1] / dZ[:, 2], name)


def contract(matrix: np.ndarray, values: Array) -> Array:
    """Multiply the leading axis of an array by the last axis of a constant, as one matrix product."""
    flat = jnp.asarray(matrix.reshape(-1, matrix.shape[-1]), values.dtype) @ values.reshape(values.shape[0], -1)
    return flat.reshape(*matrix.shape[:-1], *values.shape[1:])


def _ends(values: Array, axis: int) -> tuple[Array, Array]:
    n = values.shape[axis]
    return jnp.take(values, np.arange(n - 1), axis), jnp.take(values, np.arange(1, n), axis)
