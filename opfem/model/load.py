"""Loads of the sample on the layer at the interface, or of the plate of a virtual experiment on both."""

from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._checks import Leaf, check_finite, check_non_negative, check_positive, concrete
from .._repr import with_units
from ..measurement import ThicknessMap
from .surface import INTERPOLATIONS, Interpolation


class Imprint(eqx.Module):
    """Press the measured loaded surface into the layer as a rigid body (route A).

    The rigid surface moves from L0 to L1 along z, with x and y fixed, offset by the sample
    law's zero-pressure clearance. The map is sampled at mesh spacing and continued at its
    edge values.

    Args:
        thickness: Loaded thickness L1 [mm], masked pixels filled.
        correct_approach: Compensate the approach that the pressure causes as well.
        interpolation: How the rigid surface runs between its mesh-spaced nodes: "cubic" (C²),
            "catmull-rom" (C¹) or "bilinear" (C⁰; facets, as a meshed rigid body has them).

    Raises:
        ValueError: If the map has masked pixels that are not filled, or the interpolation is
            unknown.
    """

    thickness: ThicknessMap
    correct_approach: bool = eqx.field(static=True, default=False)
    interpolation: Interpolation = eqx.field(static=True, default="cubic")

    def __check_init__(self):
        if not isinstance(self.thickness, ThicknessMap):
            raise ValueError(f"Imprint.thickness must be a ThicknessMap, got {type(self.thickness).__name__}.")
        missing = concrete(self.thickness.mask)
        if missing is not None and missing.any() and not self.thickness.is_filled:
            raise ValueError(
                f"Imprint.thickness must have no masked pixels, got {int(missing.sum())} of {missing.size} "
                "(mask=True means not data). Fill them first: thickness.filled()."
            )
        if self.interpolation not in INTERPOLATIONS:
            raise ValueError(f"Imprint.interpolation must be one of {INTERPOLATIONS}, got {self.interpolation!r}.")

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)


class Traction(eqx.Module):
    """Apply a load to the interface: force on the layer per reference area, fixed axes.

    A dead load; with a stiffness, an elastic foundation in addition, which prevents snap-through of a layer that is
    unstable under the dead load.

    Args:
        normal: Pressure-like part [MPa], positive in compression (its force points to -z):
            a number, or interface nodes `(ny+1, nx+1)`.
        lateral: `(2, ny+1, nx+1)` [MPa], x then y. None: Coulomb friction against a sample
            fixed in x and y, bounded by the sample's friction × normal.
        stiffness: Foundation stiffness [MPa/mm]: at a displacement u_z the normal part is normal + stiffness × u_z.
            None: a dead load.

    Raises:
        ValueError: If a value is not finite, a shape is wrong, or the stiffness is negative.
    """

    normal: Array = eqx.field(converter=Leaf("Traction.normal", "MPa"))
    lateral: Array | None = eqx.field(converter=Leaf("Traction.lateral", "MPa", optional=True), default=None)
    stiffness: Array | None = eqx.field(converter=Leaf("Traction.stiffness", "MPa/mm", optional=True), default=None)

    def __check_init__(self):
        check_finite("Traction.normal", "MPa", self.normal)
        if self.normal.ndim not in (0, 2):
            raise ValueError(f"Traction.normal [MPa] must be a number or (ny+1, nx+1), got shape {self.normal.shape}.")
        if self.lateral is not None:
            check_finite("Traction.lateral", "MPa", self.lateral)
            if self.lateral.ndim != 3 or self.lateral.shape[0] != 2:
                raise ValueError(
                    f"Traction.lateral [MPa] must be (2, ny+1, nx+1), x then y, got shape {self.lateral.shape}."
                )
        if self.stiffness is not None:
            check_non_negative("Traction.stiffness", "MPa/mm", self.stiffness)

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)


class Displacement(eqx.Module):
    """Impose u_z on the interface nodes.

    Args:
        uz: Displacement along z [mm], negative in compression: a number, or interface nodes
            `(ny+1, nx+1)`.
        lateral: "free", or "fixed" (u_x = u_y = 0 there).

    Raises:
        ValueError: If a value is not finite, a shape is wrong, or `lateral` is unknown.
    """

    uz: Array = eqx.field(converter=Leaf("Displacement.uz", "mm"))
    lateral: Literal["free", "fixed"] = eqx.field(static=True, default="free")

    def __check_init__(self):
        check_finite("Displacement.uz", "mm", self.uz)
        if np.ndim(self.uz) not in (0, 2):
            raise ValueError(f"Displacement.uz [mm] must be a number or (ny+1, nx+1), got shape {self.uz.shape}.")
        if self.lateral not in ("free", "fixed"):
            raise ValueError(f'Displacement.lateral must be "free" or "fixed", got {self.lateral!r}.')

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)


class Compression(eqx.Module):
    """Press layer and sample together: the plate of an `Experiment` approaches the window.

    Args:
        approach: Travel of the plate along z [mm], from first contact of the bodies; positive.

    Raises:
        ValueError: If it is not positive.
    """

    approach: Array = eqx.field(converter=Leaf("Compression.approach", "mm"))

    def __check_init__(self):
        check_positive("Compression.approach", "mm", self.approach)

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)


Load = Imprint | Traction | Displacement
