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
        wx, dx = _WEIGHTS[self.interpolation](tx)
        wy, dy = _WEIGHTS[self.interpolation](ty)
        height = slope_x = slope_y = jnp.zeros_like(tx)
        for b in range(4):
            row = jnp.clip(j + b - 1, 0, my - 1)
            values = [self.coefficients[row, jnp.clip(i + a - 1, 0, mx - 1)] for a in range(4)]
            along = sum(w * v for w, v in zip(wx, values, strict=True))
            height = height + wy[b] * along
            slope_x = slope_x + wy[b] * sum(d * v for d, v in zip(dx, values, strict=True))
            slope_y = slope_y + dy[b] * along
        slope_x = jnp.where(inside_x, slope_x / self.spacing[0], 0.0)
        return height, slope_x, jnp.where(inside_y, slope_y / self.spacing[1], 0.0)


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


def _b_spline(t):
    u = 1.0 - t
    weights = (u**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * u**2 + 3 * u**3) / 6, t**3 / 6)
    slopes = (-(u**2) / 2, (-4 * t + 3 * t**2) / 2, (4 * u - 3 * u**2) / 2, t**2 / 2)
    return weights, slopes


def _catmull_rom(t):
    weights = (
        (-t + 2 * t**2 - t**3) / 2,
        (2 - 5 * t**2 + 3 * t**3) / 2,
        (t + 4 * t**2 - 3 * t**3) / 2,
        (-(t**2) + t**3) / 2,
    )
    slopes = (
        (-1 + 4 * t - 3 * t**2) / 2,
        (-10 * t + 9 * t**2) / 2,
        (1 + 8 * t - 9 * t**2) / 2,
        (-2 * t + 3 * t**2) / 2,
    )
    return weights, slopes


def _bilinear(t):
    zero, one = jnp.zeros_like(t), jnp.ones_like(t)
    return (zero, 1.0 - t, t, zero), (zero, -one, one, zero)


_WEIGHTS = {"cubic": _b_spline, "catmull-rom": _catmull_rom, "bilinear": _bilinear}
