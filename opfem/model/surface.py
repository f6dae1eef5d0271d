"""Rigid surfaces as height fields z = s(x, y) on a regular grid, with values and gradients.

The grid has the spacing of the layer's mesh and reaches past the layer, so that the layer
stays confined as it spreads; outside, the surface continues at its edge value.
"""

import functools
import operator
from collections.abc import Iterable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Interpolation = Literal["cubic", "catmull-rom", "bilinear"]
INTERPOLATIONS = ("cubic", "catmull-rom", "bilinear")


class HeightField(eqx.Module):
    """A rigid surface z = s(x, y).

    Attributes:
        coefficients: Spline coefficients, or node values, `(my, mx)` [mm].
        origin: Position (x, y) of the first grid node [mm].
        spacing: Grid spacing (dx, dy) [mm].
        interpolation: "cubic" interpolating B-spline (C²), "catmull-rom" (C¹), or "bilinear" (C⁰).
    """

    coefficients: Float[Array, "my mx"]
    origin: Float[Array, "2"]
    spacing: Float[Array, "2"]
    interpolation: Interpolation = eqx.field(static=True)

    def __call__(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Evaluate height [mm] and slopes ds/dx, ds/dy [-] at spatial points [mm]."""
        d = self.derivatives(x, y, 1)
        return d[0, 0], d[0, 1], d[1, 0]

    def derivatives(self, x: Array, y: Array, order: int) -> Float[Array, "along_y along_x *points"]:
        """Evaluate height [mm] and its derivatives at spatial points [mm]; beyond the grid those across its edge are 0.

        Args:
            x: Of the points.
            y: Of the points.
            order: Highest order along x, and along y.
        """
        my, mx = self.coefficients.shape
        i, j = _cell(self._in_cells(x, 0), mx), _cell(self._in_cells(y, 1), my)
        along_x = self._weights(x, i, 0, order)
        along_y = self._weights(y, j, 1, order)
        values = self._around(i, j)
        rows = _total(along_x[:, None, n] * values[None, :, n] for n in range(4))  # order along x, row, points
        return _total(along_y[:, m, None] * rows[None, :, m] for m in range(4))

    def around(self, x: Array, y: Array) -> "Patches":
        """Gather the coefficients of the surface around points [mm], for repeated evaluation."""
        my, mx = self.coefficients.shape
        i, j = _cell(self._in_cells(x, 0), mx), _cell(self._in_cells(y, 1), my)
        basis = jnp.asarray(_CUBICS[self.interpolation], self.coefficients.dtype)
        powers = jnp.einsum("ma,nb,mn...->ab...", basis, basis, self._around(i, j))
        return Patches(self, powers, i, j)

    def _around(self, i: Array, j: Array) -> Float[Array, "4 4 *points"]:
        """Gather the 4 × 4 coefficients of a cell's polynomial."""
        my, mx = self.coefficients.shape
        around = np.arange(-1, 3).reshape(4, *[1] * i.ndim)
        rows, columns = jnp.clip(j + around, 0, my - 1), jnp.clip(i + around, 0, mx - 1)
        return self.coefficients[rows[:, None], columns]

    def _weights(self, position: Array, cell: Array, axis: int, order: int) -> Float[Array, "orders 4 *points"]:
        """Compute the weights of the four coefficients along an axis, and their derivatives by position."""
        t, inside = _local(self._in_cells(position, axis), cell, self.coefficients.shape[1 - axis])
        powers = jnp.stack([jnp.ones_like(t), t, t * t, t * t * t])
        basis = [_CUBICS[self.interpolation]]
        for _ in range(order):
            basis.append(np.pad(basis[-1][:, 1:] * np.arange(1, 4), np.array([(0, 0), (0, 1)])))
        weights = jnp.tensordot(jnp.asarray(np.stack(basis), t.dtype), powers, 1)
        per_length = 1.0 / self.spacing[axis]
        scales = jnp.stack([per_length**k for k in range(order + 1)]).reshape(order + 1, *[1] * (t.ndim + 1))
        across = np.arange(order + 1).reshape(scales.shape) > 0
        return jnp.where(across & ~inside, 0.0, weights * scales)

    def _in_cells(self, position: Array, axis: int) -> Array:
        return (position - self.origin[axis]) / self.spacing[axis]


class Patches(eqx.Module):
    """The surface around points, each with the polynomial of its grid cell.

    Outside of its cell a point has the value of the continued polynomial: accurate to third order in the distance
    (second for "catmull-rom", first for "bilinear"). Patches serve while points move by a small part of a cell.

    Attributes:
        field: The surface.
        powers: Coefficients [mm] of tyᵃ txᵇ, tx and ty from 0 to 1 across the cell, `(4 a, 4 b, *points)`.
        i: Columns of the cells.
        j: Rows of the cells.
    """

    field: HeightField
    powers: Float[Array, "4 4 *points"]
    i: Array
    j: Array

    def __call__(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Evaluate height [mm] and slopes ds/dx, ds/dy [-] at points [mm]."""
        tx, ty, inside_x, inside_y = self._local(x, y)
        rows = [_horner(self.powers[a], tx) for a in range(4)]
        along_x = _horner([_horner_slope(self.powers[a], tx) for a in range(4)], ty) / self.field.spacing[0]
        along_y = _horner_slope(rows, ty) / self.field.spacing[1]
        return _horner(rows, ty), jnp.where(inside_x, along_x, 0.0), jnp.where(inside_y, along_y, 0.0)

    def height(self, x: Array, y: Array) -> Array:
        """Evaluate the height alone [mm]."""
        tx, ty, _, _ = self._local(x, y)
        return _horner([_horner(self.powers[a], tx) for a in range(4)], ty)

    def _local(self, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        my, mx = self.field.coefficients.shape
        tx, inside_x = _local(self.field._in_cells(x, 0), self.i, mx)
        ty, inside_y = _local(self.field._in_cells(y, 1), self.j, my)
        return tx, ty, inside_x, inside_y


def height_field(values: Float[Array, "my mx"], origin, spacing, interpolation: Interpolation) -> HeightField:
    """Build the surface through node values [mm] on a regular grid.

    Args:
        values: Heights at the nodes `(my, mx)` [mm].
        origin: Position (x, y) of `values[0, 0]` [mm].
        spacing: Node spacing (dx, dy) [mm].
        interpolation: Interpolation between nodes.
    """
    if interpolation == "cubic":
        my, mx = values.shape
        values = jnp.asarray(_spline_prefilter(my)) @ values @ jnp.asarray(_spline_prefilter(mx)).T
    return HeightField(values, jnp.asarray(origin), jnp.asarray(spacing), interpolation)


def _cell(t: Array, n: int) -> Array:
    return jnp.clip(jnp.floor(t), 0, n - 2).astype(int)


def _local(t: Array, cell: Array, n: int) -> tuple[Array, Array]:
    inside = (t >= 0.0) & (t <= n - 1.0)
    return jnp.clip(t, 0.0, n - 1.0) - cell.astype(t.dtype), inside


def _spline_prefilter(n: int) -> np.ndarray:
    """Return the matrix from node values to cubic B-spline coefficients, edge values repeated."""
    rows = np.eye(n) * 4 + np.eye(n, k=1) + np.eye(n, k=-1)
    rows[0, 0] += 1
    rows[-1, -1] += 1
    return np.linalg.inv(rows / 6)


def _total(parts: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, parts)


def _horner(c, t: Array) -> Array:
    """Evaluate c0 + c1 t + c2 t² + c3 t³."""
    return c[0] + t * (c[1] + t * (c[2] + t * c[3]))


def _horner_slope(c, t: Array) -> Array:
    return c[1] + t * (2.0 * c[2] + t * (3.0 * c[3]))


# Coefficients of 1, t, t², t³ in the weight of each of the four nodes.
_CUBICS = {
    "cubic": np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6,
    "catmull-rom": np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]) / 2,
    "bilinear": np.array([[0, 0, 0, 0], [1, -1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], float),
}
