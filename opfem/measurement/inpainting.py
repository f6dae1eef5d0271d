"""Smooth filling of the pixels that a map has no data for.

`ThicknessMap.filled` is built on it. The filled surface is harmonic: a membrane stretched over each
hole from its rim. It lies between the rim's values, so it is positive and never overshoots noise.
"""

from functools import partial

import jax
import jax.numpy as jnp
import jax.scipy.sparse.linalg as jsl

from .._types import Map, Mask, ScalarLike


def _neighbour_sum(values: Map, weight_x: ScalarLike, weight_y: ScalarLike) -> Map:
    """Add each pixel's four neighbours, weighted; neighbours beyond the map count for nothing."""
    padded = jnp.pad(values, 1)
    along_x = padded[1:-1, :-2] + padded[1:-1, 2:]
    along_y = padded[:-2, 1:-1] + padded[2:, 1:-1]
    return weight_x * along_x + weight_y * along_y


@partial(jax.jit, static_argnames="max_iterations")
def harmonic_fill(
    values: Map, mask: Mask, spacing: tuple[ScalarLike, ScalarLike], max_iterations: int | None = None
) -> Map:
    """Replace masked pixels by the solution of Laplace's equation, free of slope at the map's edges.

    Differentiable in `values`, forward and reverse, at the cost of one solve each.

    Args:
        values: Thickness [mm]; values of masked pixels have no influence.
        mask: True where `values` is not data.
        spacing: Distance between samples (dx, dy) [mm].
        max_iterations: Bound on conjugate-gradient iterations; None allows as many as the largest hole can need.

    Returns:
        The filled map [mm]; NaN in masked pixels if the solve did not converge.
    """
    # The stencil's weights 1/dx² and 1/dy², scaled to be near one.
    weight_x, weight_y = spacing[1] / spacing[0], spacing[0] / spacing[1]
    known = jnp.where(mask, 0.0, 1.0)
    mean = (known * values).sum() / jnp.maximum(known.sum(), 1.0)
    # Working about the mean keeps the stop rule relative to the map's relief instead of its thickness.
    relief = jnp.where(mask, 0.0, values - mean)
    degree = _neighbour_sum(jnp.ones_like(values), weight_x, weight_y)

    def laplacian(field: Map) -> Map:
        inside = jnp.where(mask, field, 0.0)
        return jnp.where(mask, degree * inside - _neighbour_sum(inside, weight_x, weight_y), field)

    source = jnp.where(mask, _neighbour_sum(relief, weight_x, weight_y), 0.0)
    tolerance = 1e-10 if values.dtype == jnp.float64 else 1e-5
    limit = 20 * sum(values.shape) if max_iterations is None else max_iterations
    fill, _ = jsl.cg(laplacian, source, tol=tolerance, maxiter=limit)
    residual = jnp.linalg.norm(laplacian(fill) - source)
    converged = residual <= 10 * tolerance * jnp.linalg.norm(source) + jnp.finfo(values.dtype).tiny
    return jnp.where(mask, jnp.where(converged, fill + mean, jnp.nan), values)
