"""Observations other than thickness maps: force readings, displacements inside the layer, the bulge of a side."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import Leaf, as_leaf, check_finite, check_positive


class ForceReading(eqx.Module):
    """Measured force between sample and layer.

    Args:
        force: Force along z [N], positive in compression.
        std: Its standard deviation [N].

    Raises:
        ValueError: If the force is not finite or the standard deviation is not positive.
    """

    force: Array = eqx.field(converter=Leaf("ForceReading.force", "N"))
    std: Array = eqx.field(converter=Leaf("ForceReading.std", "N"))

    def __check_init__(self):
        check_finite("ForceReading.force", "N", self.force)
        check_positive("ForceReading.std", "N", self.std)


class AxialDisplacement(eqx.Module):
    """Displacement along z inside the layer, as phase-sensitive OCT measures it.

    Args:
        values: Displacement of the mesh's nodes `(nz+1, ny+1, nx+1)` [mm]; negative towards the window.
        std: Its standard deviation [mm], a number or of the same shape.
        mask: True for missing data, of the same shape; None: no missing data.

    Raises:
        ValueError: If a shape differs, a value is not finite or the standard deviation is not positive.
    """

    values: Float[Array, "mz my mx"]
    std: Array
    mask: Array

    def __init__(self, values, std, mask=None):
        self.values = as_leaf(values, "AxialDisplacement.values", "mm")
        check_finite("AxialDisplacement.values", "mm", self.values)
        self.std = as_leaf(std, "AxialDisplacement.std", "mm")
        check_positive("AxialDisplacement.std", "mm", self.std)
        self.mask = jnp.zeros(self.values.shape, bool) if mask is None else jnp.asarray(mask)
        for name, part in (("std", self.std), ("mask", self.mask)):
            if part.shape not in ((), self.values.shape):
                raise ValueError(
                    f"AxialDisplacement.{name} must have the shape of values, {self.values.shape}, got {part.shape}."
                )


class SideBulge(eqx.Module):
    """Outward displacement of a free side of the layer, at the middle of that side.

    Attributes:
        depth: Spatial distances from the window `(n,)` [mm].
        displacement: Outward `(n,)` [mm].
        std: Its standard deviation [mm], a number or `(n,)`.
        side: "x0", "x1", "y0" or "y1"; static.
    """

    depth: Float[Array, " n"]
    displacement: Float[Array, " n"]
    std: Array
    side: str = eqx.field(static=True)

    def __init__(self, side: Literal["x0", "x1", "y0", "y1"], depth: Any, displacement: Any, std: Any):
        """Check and store the measurement.

        Args:
            side: Which side.
            depth: Distances from the window [mm], shape (n,).
            displacement: Outward [mm], shape (n,).
            std: Standard deviation [mm], a number or shape (n,).

        Raises:
            ValueError: For an unknown side, and shapes that do not match.
        """
        if side not in ("x0", "x1", "y0", "y1"):
            raise ValueError(f"SideBulge.side must be x0, x1, y0 or y1, got {side!r}.")
        self.side = side
        self.depth = as_leaf(depth, "SideBulge.depth", "mm")
        self.displacement = as_leaf(displacement, "SideBulge.displacement", "mm")
        self.std = as_leaf(std, "SideBulge.std", "mm")
        if self.depth.ndim != 1 or self.depth.shape != self.displacement.shape:
            raise ValueError(
                f"SideBulge.depth and displacement [mm] must be two lists of one length, got shapes {self.depth.shape} "
                f"and {self.displacement.shape}."
            )
        check_finite("SideBulge.displacement", "mm", self.displacement)
        check_positive("SideBulge.std", "mm", self.std)
