"""What a fit may be given beside thickness maps: readings of the total force, displacements inside the layer."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import Leaf, as_leaf, check_finite, check_positive


class ForceReading(eqx.Module):
    """A reading of the total force that presses sample and layer together.

    Args:
        force: Along z [N], positive in compression.
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
        values: At the mesh's nodes, of the unloaded layer's points `(nz+1, ny+1, nx+1)` [mm]; negative towards
            the window.
        std: Its standard deviation [mm], a number or of the same shape.
        mask: True where there is no datum, of the same shape; None: nowhere.

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
