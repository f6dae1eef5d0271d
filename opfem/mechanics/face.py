"""The two faces of the layer, window and interface: quadrature, gather, assembly, areas.

Face nodes run x fastest, then y. A quadrature rule of contact has 2×2 or 3×3 Gauss points,
or the nodes.
"""

import itertools
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .hex8 import shifted_sum
from .kinematics import contract

FaceRule = Literal["gauss2", "gauss3", "nodes"]
CORNERS = tuple((x, y) for y, x in itertools.product((0, 1), repeat=2))


class Quadrature(NamedTuple):
    """A rule on the unit square: `N` (points, 4), `dN` (points, 2, 4), `weights` (points,)."""

    N: np.ndarray
    dN: np.ndarray
    weights: np.ndarray


def quadrature(rule: FaceRule) -> Quadrature:
    """Build a quadrature rule on the unit square."""
    if rule == "nodes":
        points, weights = np.array([0.0, 1.0]), np.array([0.5, 0.5])
    else:
        points, weights = np.polynomial.legendre.leggauss(2 if rule == "gauss2" else 3)
        points, weights = 0.5 + 0.5 * points, 0.5 * weights
    y, x = (v.ravel() for v in np.meshgrid(points, points, indexing="ij"))
    wy, wx = np.meshgrid(weights, weights, indexing="ij")
    ends = [(1 - x, x), (1 - y, y)]
    N = np.stack([ends[0][cx] * ends[1][cy] for cx, cy in CORNERS], axis=1)
    d_xi = np.stack([(2 * cx - 1) * ends[1][cy] for cx, cy in CORNERS], axis=1)
    d_eta = np.stack([ends[0][cx] * (2 * cy - 1) for cx, cy in CORNERS], axis=1)
    return Quadrature(N, np.stack([d_xi, d_eta], axis=1), (wy * wx).ravel())


def node_shares(cells: str, elements: tuple[int, int]) -> np.ndarray | None:
    """Compute the nodal weights of the corners of each face, over a quarter of it: `(4, ny, nx)`.

    Nodal forces of a uniform pressure on triangles: linear ones have the diagonal of `kuhn_tetrahedra`; quadratic ones
    have forces at edge midpoints only.

    Args:
        cells: "hex8" (None: all alike), "tet4" or "tet10".
        elements: Faces (ny, nx).
    """
    if cells == "hex8":
        return None
    if cells == "tet4":
        return np.broadcast_to([[[4 / 3 if x == y else 2 / 3]] for x, y in CORNERS], (4, *elements)).copy()
    row, column = np.indices(elements)
    return np.stack([np.where((row + y) % 2 + (column + x) % 2 == 0, 0.0, 4 / 3) for x, y in CORNERS])


def filled_vertices(values: Float[Array, "*c my mx"], cells: str) -> Float[Array, "*c my mx"]:
    """Set nodes of zero weight, the vertices of quadratic triangles, to the sum of their neighbours."""
    if cells != "tet10":
        return values
    my, mx = values.shape[-2:]
    row, column = np.indices((my, mx))
    around = jnp.pad(values, [(0, 0)] * (values.ndim - 2) + [(1, 1), (1, 1)])
    neighbours = around[..., :-2, 1:-1] + around[..., 2:, 1:-1] + around[..., 1:-1, :-2] + around[..., 1:-1, 2:]
    return jnp.where((row % 2 == 0) & (column % 2 == 0), neighbours, values)


def gather_face(values: Float[Array, "c my mx"]) -> Float[Array, "4 c ny nx"]:
    """Gather the nodal values of every face."""
    ny, nx = values.shape[1] - 1, values.shape[2] - 1
    return jnp.stack([values[:, y : y + ny, x : x + nx] for x, y in CORNERS])


def assemble_face(values: Float[Array, "4 *c ny nx"]) -> Float[Array, "*c my mx"]:
    """Assemble face nodal values at nodes."""
    pairs = values.reshape(2, 2, *values.shape[1:])
    rows = shifted_sum(pairs[:, 0], pairs[:, 1], axis=-1)
    return shifted_sum(rows[0], rows[1], axis=-2)


def to_corners(values: Float[Array, "points *c_faces"], rule: FaceRule) -> Float[Array, "4 *c_faces"]:
    """Integrate a density per unit of (ξ, η) with the shape functions of each face's corners."""
    q = quadrature(rule)
    return contract((q.N * q.weights[:, None]).T, values)


def to_nodes(values: Float[Array, "points *c ny nx"], rule: FaceRule) -> Float[Array, "*c my mx"]:
    """Integrate a density per unit of (ξ, η) with the nodal shape functions."""
    return assemble_face(to_corners(values, rule))


def surface_tangents(corners: Float[Array, "4 3 *faces"], rule: FaceRule) -> tuple[Array, Array, Array]:
    """Compute position and tangents dx/dξ, dx/dη at the points, each `(3, points, *faces)`."""
    q = quadrature(rule)
    both = np.concatenate([q.N[:, None], q.dN], axis=1)
    at_points = contract(both, corners)
    position, xi, eta = (jnp.moveaxis(at_points[:, k], 1, 0) for k in range(3))
    return position, xi, eta


def area_vector(xi: Float[Array, "3 *points"], eta: Float[Array, "3 *points"]) -> Float[Array, "3 *points"]:
    """Compute n da per unit of (ξ, η) [mm²]; it points along +z on an undeformed face."""
    return jnp.stack([xi[(k + 1) % 3] * eta[(k + 2) % 3] - xi[(k + 2) % 3] * eta[(k + 1) % 3] for k in range(3)])


def nodal_area_vector(x: Float[Array, "3 my mx"], cells: str = "hex8") -> Float[Array, "3 my mx"]:
    """Integrate n da with the nodal shape functions [mm²]."""
    my, mx = x.shape[1:]
    shares = node_shares(cells, (my - 1, mx - 1))
    rule: FaceRule = "gauss2" if shares is None else "nodes"
    _, xi, eta = surface_tangents(gather_face(x), rule)
    vector = jnp.moveaxis(area_vector(xi, eta), 1, 0)
    return to_nodes(vector if shares is None else vector * shares[:, None], rule)


def tributary_area(x: Float[Array, "3 my mx"], cells: str = "hex8") -> Float[Array, "my mx"]:
    """Compute each node's share of the area [mm²], lumped at the nodes."""
    my, mx = x.shape[1:]
    shares = node_shares(cells, (my - 1, mx - 1))
    _, xi, eta = surface_tangents(gather_face(x), "nodes")
    area = size(area_vector(xi, eta))
    return to_nodes(area if shares is None else area * shares, "nodes")


def size(v: Float[Array, "3 *points"]) -> Float[Array, "*points"]:
    """Compute the norm of a field of non-zero vectors."""
    return jnp.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
