"""Inverse of the layer's in-plane motion: the point of the interface at a spatial position.

Fields are functions of material points, which move sideways; maps, pictures and fits need them at spatial positions.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Limit of Newton steps. A step that increases the error is halved: bilinear motion has kinks at cell edges.
_STEPS = 40
# The interface is folded where its projected area ratio is below this.
_FOLDED = 1e-3
# Tolerance of a found position, in elements, and target of the search; in round-off of the layer's length for single
# precision.
_FOUND, _CLOSE, _ROUNDINGS = 1e-6, 1e-9, 8.0

Motion = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Displacement along x and y `(2, *points)` [mm] at reference points, and its derivatives by x and by y; a PyTree."""


class Located(NamedTuple):
    """Points of the interface.

    Attributes:
        at: Their reference x and y [mm]; on the layer's edge where the place lies beyond it.
        found: Whether the point has the spatial position, along x and along y.
    """

    at: Float[Array, "2 *points"]
    found: Bool[Array, "2 *points"]


def locate(
    motion: Motion, place: Float[Array, "2 *points"], far: Float[Array, "2"], size: Float[Array, "2"]
) -> Located:
    """Find the points of the interface at spatial positions, with first and second derivatives.

    Args:
        motion: In-plane displacement of interface points.
        place: Spatial x and y [mm].
        far: End of the layer, which starts at 0, along x and y [mm].
        size: Size of an element along x and y [mm].
    """
    far, size = (v.reshape(2, *[1] * (place.ndim - 1)) for v in (far, size))
    frozen, target, end, cell = jax.lax.stop_gradient((motion, place, far, size))
    rounding = _ROUNDINGS * jnp.finfo(place.dtype).eps * jnp.max(end / cell)

    def unsettled(search):
        return (search.count < _STEPS) & ~(jnp.max(search.left) < jnp.maximum(_CLOSE, rounding))

    def closer(search):
        moved, *slopes = frozen(*search.at)
        off = target - search.at - moved
        # A position beyond an edge is projected onto the edge.
        on_layer = ((search.at > 0.0) | (off > 0.0)) & ((search.at < end) | (off < 0.0))
        left = jnp.max(jnp.abs(jnp.where(on_layer, off, 0.0)) / cell, axis=0)
        worse = left > search.left
        base = jnp.where(worse, search.base, search.at)
        step = jnp.where(worse, 0.5 * search.step, _newton(off, slopes, on_layer))
        at = jnp.clip(base + step, 0.0, end)
        return _Search(search.count + 1, at, off, base, step, jnp.where(worse, search.left, left))

    start, far_off = jnp.clip(target, 0.0, end), jnp.full(place.shape, jnp.inf, place.dtype)
    search = _Search(jnp.zeros((), int), start, far_off, start, jnp.zeros_like(place), far_off[0])
    search = jax.lax.while_loop(unsettled, closer, search)
    found = jnp.abs(search.off) < jnp.maximum(_FOUND, rounding) * cell

    def derived(_, at):
        moved, *slopes = motion(*at)
        return at + _newton(place - at - moved, slopes, found)

    # Each Newton step adds one order of derivatives; across an edge that the position lies beyond they are zero.
    return Located(jax.lax.fori_loop(0, 2, derived, search.at), found)


class _Search(NamedTuple):
    """State of a search.

    Attributes:
        count: Number of evaluations.
        at: Next trial point [mm].
        off: Residual at the last evaluation [mm].
        base: Base point of the step.
        step: Step from `base` to the trial point [mm].
        left: Residual at `base`, in elements.
    """

    count: Array
    at: Array
    off: Array
    base: Array
    step: Array
    left: Array


def _newton(off: Array, slopes: Sequence[Array], counted: Array) -> Array:
    """Compute the Newton step along the active axes; the slopes have no derivative."""
    off = jnp.where(counted, off, 0.0)
    (a, c), (b, d) = (jax.lax.stop_gradient(jnp.where(counted, slope, 0.0)) for slope in slopes)
    determinant = (1.0 + a) * (1.0 + d) - b * c
    determinant = jnp.where(determinant > _FOLDED, determinant, 1.0)
    return jnp.stack([(1.0 + d) * off[0] - b * off[1], (1.0 + a) * off[1] - c * off[0]]) / determinant


class NodalField(eqx.Module):
    """Nodal values on the layer's regular grid, bilinear between nodes and continued at their edge values.

    Attributes:
        values: At the interface's nodes.
        size: Of an element along x and y [mm].
    """

    values: Float[Array, "fields my mx"]
    size: Float[Array, "2"]

    def __call__(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Evaluate the fields and their derivatives by x and by y at reference points [mm]."""
        my, mx = self.values.shape[1:]
        i, j = jnp.clip(x / self.size[0], 0.0, mx - 1.0), jnp.clip(y / self.size[1], 0.0, my - 1.0)
        a, b = jnp.clip(jnp.floor(i), 0, mx - 2).astype(int), jnp.clip(jnp.floor(j), 0, my - 2).astype(int)
        s, t = i - a, j - b
        # One gather of all four nodes: each compiles to dozens of instructions.
        corner = np.arange(2).reshape(2, *[1] * x.ndim)
        nodes = self.values[:, (b + corner)[:, None], a + corner]
        along = nodes[:, :, 1] - nodes[:, :, 0]
        rows = nodes[:, :, 0] + s * along
        across = rows[:, 1] - rows[:, 0]
        by_x = along[:, 0] + t * (along[:, 1] - along[:, 0])
        return rows[:, 0] + t * across, by_x / self.size[0], across / self.size[1]
