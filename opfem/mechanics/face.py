"""The two faces of the layer, window and interface: quadrature, gather, assembly, areas.

Face nodes run x fastest, then y. A rule names where contact is integrated: 2×2 or 3×3 Gauss
points, or the nodes themselves.
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


def gather_face(values: Float[Array, "c my mx"]) -> Float[Array, "4 c ny nx"]:
    """Collect the nodal values of every face."""
    ny, nx = values.shape[1] - 1, values.shape[2] - 1
    return jnp.stack([values[:, y : y + ny, x : x + nx] for x, y in CORNERS])


def assemble_face(values: Float[Array, "4 *c ny nx"]) -> Float[Array, "*c my mx"]:
    """Add face nodal values into nodes."""
    pairs = values.reshape(2, 2, *values.shape[1:])
    rows = shifted_sum(pairs[:, 0], pairs[:, 1], axis=-1)
    return shifted_sum(rows[0], rows[1], axis=-2)


def to_corners(values: Float[Array, "points *c_faces"], rule: FaceRule) -> Float[Array, "4 *c_faces"]:
    """Integrate a density per unit of (ξ, η) against the shape functions of each face's corners."""
    q = quadrature(rule)
    return contract((q.N * q.weights[:, None]).T, values)


def to_nodes(values: Float[Array, "points *c ny nx"], rule: FaceRule) -> Float[Array, "*c my mx"]:
    """Integrate a density per unit of (ξ, η) against the nodal shape functions."""
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


def nodal_area_vector(x: Float[Array, "3 my mx"]) -> Float[Array, "3 my mx"]:
    """Integrate n da against the nodal shape functions [mm²]."""
    _, xi, eta = surface_tangents(gather_face(x), "gauss2")
    return to_nodes(jnp.moveaxis(area_vector(xi, eta), 1, 0), "gauss2")


def tributary_area(x: Float[Array, "3 my mx"]) -> Float[Array, "my mx"]:
    """Compute each node's share of the area [mm²], lumped at the nodes."""
    _, xi, eta = surface_tangents(gather_face(x), "nodes")
    return to_nodes(size(area_vector(xi, eta)), "nodes")


def size(v: Float[Array, "3 *points"]) -> Float[Array, "*points"]:
    """Compute the length of a field of vectors that never vanish."""
    return jnp.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
