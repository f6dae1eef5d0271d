"""A smooth (C¹) surface through the nodes of a deformable face: Catmull–Rom, with its derivatives.

Places are in cells of the face's grid, and move with it: material points of the body. On flat facets the normal jumps
at every edge, and contact does not converge.

Source:
    Catmull and Rom, A class of local interpolating splines (1974).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Coefficients of 1, t, t², t³ in the weight of each of the four nodes around a cell, and of its derivative.
_WEIGHTS = np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]) / 2
_SLOPES = np.pad(_WEIGHTS[:, 1:] * np.arange(1, 4), np.array([(0, 0), (0, 1)]))
# Continuation of the surface beyond its rim, in cells: more than half the width of a quadrature point.
BEYOND = 0.5

Place = Float[Array, "2 *points"]


class SurfacePoint(NamedTuple):
    """Positions [mm] of points of the surface, and their derivatives by place [mm per cell]."""

    position: Float[Array, "3 *points"]
    along_x: Float[Array, "3 *points"]
    along_y: Float[Array, "3 *points"]

    def step_towards(self, xy: Float[Array, "2 *points"]) -> Place:
        """Compute the Newton step of places towards x and y [mm]; none where the surface is folded."""
        off = xy - self.position[:2]
        (a, c), (b, d) = self.along_x[:2], self.along_y[:2]
        determinant = a * d - b * c
        step = jnp.stack([d * off[0] - b * off[1], a * off[1] - c * off[0]])
        return jnp.where(determinant > 0, step / jnp.where(determinant > 0, determinant, 1.0), 0.0)

    @property
    def slope(self) -> Float[Array, "2 *points"]:
        """Slope of the surface along x and y [-]."""
        (a, c), (b, d) = self.along_x[:2], self.along_y[:2]
        determinant = a * d - b * c
        up = jnp.stack([d * self.along_x[2] - c * self.along_y[2], a * self.along_y[2] - b * self.along_x[2]])
        return up / jnp.where(determinant > 0, determinant, 1.0)


class Patch(NamedTuple):
    """The nodes around points, `(3, 4 y, 4 x, *points)` [mm], and the cells that the points are in, x then y."""

    nodes: Float[Array, "3 4 4 *points"]
    cell: Int[Array, "2 *points"]

    def at(self, place: Place) -> SurfacePoint:
        """Evaluate the surface; points may be a little outside their cells."""
        (x, y), (by_x, by_y) = (_weights(place - self.cell, basis) for basis in (_WEIGHTS, _SLOPES))
        rows, rising = (_sum(weights, self.nodes, 2) for weights in (x, by_x))
        return SurfacePoint(_sum(y, rows, 1), _sum(y, rising, 1), _sum(by_y, rows, 1))


def patch(whole: Float[Array, "3 wy wx"], place: Place) -> Patch:
    """Collect the nodes [mm] around places, of a face that is `continued` or `mirrored`."""
    my, mx = (n - 2 for n in whole.shape[1:])
    cell = jnp.stack([jnp.clip(jnp.floor(at), 0, n - 2) for at, n in zip(place, (mx, my), strict=True)]).astype(int)
    around = np.arange(4).reshape(4, *[1] * (place.ndim - 1))
    rows, columns = cell[1] + around, cell[0] + around
    return Patch(whole[:, rows[:, None], columns], cell)


def continued(nodes: Float[Array, "3 my mx"], rims: tuple[bool, bool, bool, bool]) -> Float[Array, "3 wy wx"]:
    """Continue a face by one node on each side: with its curvature beyond a rim, as its mirror image elsewhere.

    Args:
        nodes: Of the face [mm].
        rims: Whether the face ends at x0, x1, y0, y1; else there is a plane of symmetry.
    """
    for axis, ends in ((2, rims[:2]), (1, rims[2:])):
        odd = jnp.asarray(np.arange(3).reshape(3, 1, 1) == 2 - axis, nodes.dtype)  # the coordinate across the plane

        def ghost(row, is_rim, axis=axis, odd=odd):
            a, b, *more = row[:3]
            if is_rim:
                return 3.0 * a - 3.0 * b + more[0] if more else 2.0 * a - b
            return odd * (2.0 * a - b) + (1.0 - odd) * b

        rows = jnp.split(nodes, nodes.shape[axis], axis=axis)
        nodes = jnp.concatenate([ghost(rows, ends[0]), nodes, ghost(rows[::-1], ends[1])], axis=axis)
    return nodes


def mirrored(nodes: Float[Array, "3 my mx"]) -> Float[Array, "3 wy wx"]:
    """Continue a face by its mirror image: forces so distributed are, of a uniform pressure, those of its elements."""
    return jnp.pad(nodes, ((0, 0), (1, 1), (1, 1)), mode="reflect")


def _weights(t: Float[Array, "2 *points"], basis: np.ndarray) -> Float[Array, "2 4 *points"]:
    powers = jnp.stack([jnp.ones_like(t), t, t * t, t * t * t])
    return jnp.moveaxis(jnp.tensordot(jnp.asarray(basis, t.dtype), powers, 1), 1, 0)


def _sum(weights: Float[Array, "4 *points"], values: Array, axis: int) -> Array:
    """Sum four values along an axis, by weights of the points."""
    parts = [weights[k] * jnp.take(values, k, axis=axis) for k in range(4)]
    return parts[0] + parts[1] + parts[2] + parts[3]
