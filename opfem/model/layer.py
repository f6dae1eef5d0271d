"""The silicone layer: its unloaded thickness and its material."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_leaf, check_positive
from .._repr import with_units
from ..measurement import ThicknessMap
from .material import AbstractMaterial
from .plausible import check_unloaded


class Layer(eqx.Module):
    """A soft layer on the window, 0 ≤ z ≤ thickness(x, y).

    Args:
        thickness: Unloaded thickness L0 [mm]: one number, or a `ThicknessMap`.
        material: Hyperelastic law with an explicit bulk modulus.

    Raises:
        ValueError: If the thickness is not positive, not within 0.02 to 20 mm, or is a bare array without its extent.
    """

    thickness: Array | ThicknessMap = eqx.field(metadata={"unit": "mm"})
    material: AbstractMaterial

    def __init__(self, thickness, material: AbstractMaterial):
        if not isinstance(material, AbstractMaterial):
            raise ValueError(f"Layer.material must be a material such as MooneyRivlin(...), got {material!r}.")
        if not isinstance(thickness, ThicknessMap):
            if np.ndim(thickness) != 0:
                raise ValueError(
                    f"Layer.thickness [mm] must be a number or a ThicknessMap, got an array of shape "
                    f"{np.shape(thickness)}. Pass ThicknessMap(values, extent=(Lx, Ly))."
                )
            thickness = as_leaf(thickness, "Layer.thickness", "mm")
            check_positive("Layer.thickness", "mm", thickness)
        check_unloaded(thickness)
        self.thickness = thickness
        self.material = material

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def thickness_at(self, x: Float[Array, "*shape"], y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Sample the unloaded thickness [mm] at positions [mm]."""
        if isinstance(self.thickness, ThicknessMap):
            return self.thickness.sample(x, y)
        return self.thickness + 0.0 * x
