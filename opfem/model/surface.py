"""Rigid surfaces as height fields z = s(x, y) on a regular grid, with values and gradients.

The grid has the spacing of the layer's mesh and reaches past the layer, so that the layer
stays confined as it spreads; outside, the surface continues at its edge value.
"""

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
        my, mx = self.coefficients.shape
        i, tx, inside_x = _locate((x - self.origin[0]) / self.spacing[0], mx)
        j, ty, inside_y = _locate((y - self.origin[1]) / self.spacing[1], my)
        around = np.arange(-1, 3).reshape(4, *[1] * tx.ndim)
        rows, columns = jnp.clip(j + around, 0, my - 1), jnp.clip(i + around, 0, mx - 1)
        values = self.coefficients[rows[:, None], columns]
        (wx, dx), (wy, dy) = (_weights(self.interpolation, t) for t in (tx, ty))
        along = jnp.sum(wx * values, axis=1)
        slope_x = jnp.sum(wy * jnp.sum(dx * values, axis=1), axis=0) / self.spacing[0]
        slope_y = jnp.sum(dy * along, axis=0) / self.spacing[1]
        return jnp.sum(wy * along, axis=0), jnp.where(inside_x, slope_x, 0.0), jnp.where(inside_y, slope_y, 0.0)


def height_field(values: Float[Array, "my mx"], origin, spacing, interpolation: Interpolation) -> HeightField:
    """Build the surface through node values [mm] on a regular grid.

    Args:
        values: Heights at the nodes `(my, mx)` [mm].
        origin: Position (x, y) of `values[0, 0]` [mm].
        spacing: Node spacing (dx, dy) [mm].
        interpolation: How the surface runs between nodes.
    """
    if interpolation == "cubic":
        my, mx = values.shape
        values = jnp.asarray(_spline_prefilter(my)) @ values @ jnp.asarray(_spline_prefilter(mx)).T
    return HeightField(values, jnp.asarray(origin), jnp.asarray(spacing), interpolation)


def _locate(t: Array, n: int) -> tuple[Array, Array, Array]:
    inside = (t >= 0.0) & (t <= n - 1.0)
    t = jnp.clip(t, 0.0, n - 1.0)
    cell = jnp.clip(jnp.floor(t), 0, n - 2)
    return cell.astype(int), t - cell, inside


def _spline_prefilter(n: int) -> np.ndarray:
    """Return the matrix from node values to cubic B-spline coefficients, edge values repeated."""
    rows = np.eye(n) * 4 + np.eye(n, k=1) + np.eye(n, k=-1)
    rows[0, 0] += 1
    rows[-1, -1] += 1
    return np.linalg.inv(rows / 6)


def _weights(interpolation: str, t: Array) -> tuple[Array, Array]:
    """Weights of the four nodes around a point and their slopes `(4, …)`, at t in the cell [0, 1]."""
    cubics = jnp.asarray(_CUBICS[interpolation], t.dtype)
    powers = jnp.stack([jnp.ones_like(t), t, t**2, t**3])
    slopes = jnp.stack([jnp.ones_like(t), 2 * t, 3 * t**2])
    return jnp.tensordot(cubics, powers, 1), jnp.tensordot(cubics[:, 1:], slopes, 1)


# Coefficients of 1, t, t², t³ in the weight of each of the four nodes.
_CUBICS = {
    "cubic": np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6,
    "catmull-rom": np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]) / 2,
    "bilinear": np.array([[0, 0, 0, 0], [1, -1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], float),
}
