"""Sampling grid of a measurement: spacing, origin and unit of its points, and interpolation between them.

`ThicknessMap` and OCT volumes are both sampled on one, in x along image columns and y along image rows.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import as_leaf, concrete
from .._types import Pair, Points, ScalarLike

LENGTH_UNITS = {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "m": 1e3}  # both code points of µ
"""Size of each unit of length that is accepted [mm]."""


class AbstractGrid(eqx.Module):
    """Something sampled at points of a regular grid in x and y.

    Attributes:
        spacing: Distance between samples (dx, dy) [mm].
        origin: (x, y) of the first sample [mm].
    """

    spacing: eqx.AbstractVar[Any]
    origin: eqx.AbstractVar[Pair]

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Number of samples (ny, nx), and more where there are more axes."""

    @property
    def x(self) -> Float[Array, " nx"]:
        """Positions of the image columns [mm]."""
        return self.origin[0] + self.spacing[0] * jnp.arange(self.shape[1])

    @property
    def y(self) -> Float[Array, " ny"]:
        """Positions of the image rows [mm]."""
        return self.origin[1] + self.spacing[1] * jnp.arange(self.shape[0])


def pair(field: str, value: Any) -> Pair:
    """Convert one or two lengths [mm] to (x, y); `field` names them in the error."""
    numbers = as_leaf(value, field, "mm")
    if numbers.shape not in ((), (2,)):
        raise ValueError(f"{field} [mm] must be two numbers, got shape {numbers.shape}.")
    return jnp.broadcast_to(numbers, (2,))


def kept(axis: str, bounds: tuple[float, float] | None, positions: Float[Array, " n"]) -> slice:
    """Find the samples of a line that `cropped` keeps.

    Args:
        axis: Name of the line, for the error.
        bounds: (first, last) position [mm], both included; None keeps all.
        positions: Positions of the samples [mm].

    Raises:
        ValueError: When fewer than 2 remain, and under jit.
    """
    if bounds is None:
        return slice(None)
    known, first, last = concrete(positions), concrete(bounds[0]), concrete(bounds[1])
    if known is None or first is None or last is None:
        raise ValueError("cropped needs known positions; crop before jit, grad or vmap.")
    margin = 1e-6 * (known[1] - known[0])
    inside = np.flatnonzero((known >= first - margin) & (known <= last + margin))
    if inside.size < 2:
        raise ValueError(
            f"cropped.{axis} [mm] must keep at least 2 samples of {known[0]:g} to {known[-1]:g} mm, "
            f"got ({float(first):g}, {float(last):g}), which keeps {inside.size}."
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)


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
        x: Positions along image columns [mm]; outside the samples the edge value continues.
        y: Positions along image rows [mm]; shape of `x`.
    """
    ny, nx = values.shape
    i, a = _interval(x, origin[0], spacing[0], nx)
    j, b = _interval(y, origin[1], spacing[1], ny)
    before = (1 - a) * values[j, i] + a * values[j, i + 1]
    after = (1 - a) * values[j + 1, i] + a * values[j + 1, i + 1]
    return (1 - b) * before + b * after
