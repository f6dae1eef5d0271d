"""Bilinear interpolation of a map at any points, continued at its edge values.

`ThicknessMap.sample` and `ThicknessMap.resampled` are built on it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._types import Points, ScalarLike


def _interval(
    position: Points, start: ScalarLike, spacing: ScalarLike, count: int
) -> tuple[Int[Array, "*points"], Points]:
    """Locate points in a line of samples: index of the sample before, and the weight of the one after."""
    index = jnp.clip((position - start) / spacing, 0, count - 1)
    before = jnp.clip(jnp.floor(index).astype(int), 0, count - 2)
    return before, index - before


@jax.jit
def bilinear(
    values: Float[Array, "ny nx"],
    origin: Float[Array, "2"],
    spacing: tuple[ScalarLike, ScalarLike],
    x: Points,
    y: Points,
) -> Points:
    """Interpolate `values` bilinearly at points (x, y).

    Args:
        values: Samples, indexed [y, x].
        origin: (x, y) of `values[0, 0]` [mm].
        spacing: Distance between samples (dx, dy) [mm].
        x: Positions along image columns [mm]; outside the samples the edge value holds.
        y: Positions along image rows [mm]; shape of `x`.
    """
    ny, nx = values.shape
    i, a = _interval(x, origin[0], spacing[0], nx)
    j, b = _interval(y, origin[1], spacing[1], ny)
    before = (1 - a) * values[j, i] + a * values[j, i + 1]
    after = (1 - a) * values[j + 1, i] + a * values[j + 1, i + 1]
    return (1 - b) * before + b * after
