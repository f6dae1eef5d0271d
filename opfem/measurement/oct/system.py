"""OCT system: resolution, wavelength, and the layer's refractive index.

The one place where optical lengths become geometric: depth in the layer = optical depth / `index`.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._checks import check_positive, concrete
from ..._types import Scalar
from ..filtering import FWHM_PER_STD

_WAVELENGTHS = (3e-4, 2e-3)  # mm: ultraviolet to infrared


class OctSystem(eqx.Module):
    """An OCT microscope that images a layer.

    In a common-path microscope the window–layer interface is the zero delay, and the thickness is the depth of the
    next interface. An error of 0.01 in `index` scales every thickness by 0.7 %; a strain of two thicknesses from
    OCT does not notice. A window tilted by 2° in air changes 500 µm by 0.16 µm, by 5° 1.0 µm.

    Attributes:
        wavelength: Central wavelength in vacuum [mm]; 845 nm is 845e-6.
        axial_fwhm: FWHM of the intensity of a point along depth, geometric, in the layer [mm].
        lateral_fwhm: The same across [mm].
        index: Group index of the layer, which scales depth [-].
        phase_index: Phase index at `wavelength` [-]; of silicone some 0.012 below the group index.

    Example:
        >>> import opfem as op
        >>> op.OctSystem(845e-6, axial_fwhm=7.8e-3, lateral_fwhm=11e-3, index=1.4).index.item()
        1.4
    """

    wavelength: Scalar
    axial_fwhm: Scalar
    lateral_fwhm: Scalar
    index: Scalar
    phase_index: Scalar

    def __init__(self, wavelength: Any, axial_fwhm: Any, lateral_fwhm: Any, index: Any = 1.4, phase_index: Any = None):
        """State a microscope.

        Args:
            wavelength: Central wavelength in vacuum [mm].
            axial_fwhm: FWHM of the intensity of a point along depth, in the layer [mm].
            lateral_fwhm: The same across [mm].
            index: Group index of the layer [-].
            phase_index: Phase index [-]; None takes `index`.

        Raises:
            ValueError: For a number that is not positive, a wavelength outside 0.3 to 2 µm, an index outside 1 to 2.
        """
        phase_index = index if phase_index is None else phase_index
        for field, unit, value in (
            ("wavelength", "mm", wavelength),
            ("axial_fwhm", "mm", axial_fwhm),
            ("lateral_fwhm", "mm", lateral_fwhm),
            ("index", "-", index),
            ("phase_index", "-", phase_index),
        ):
            check_positive(f"OctSystem.{field}", unit, value)
        check_wavelength("OctSystem.wavelength", wavelength)
        known = concrete(index)
        if known is not None and not 1.0 <= known <= 2.0:
            raise ValueError(f"OctSystem.index [-] must lie between 1 and 2, got {known:g}; silicone has 1.4.")
        numbers = (wavelength, axial_fwhm, lateral_fwhm, index, phase_index)
        self.wavelength, self.axial_fwhm, self.lateral_fwhm, self.index, self.phase_index = (
            jnp.asarray(number, float) for number in numbers
        )

    @property
    def axial_std(self) -> float:
        """Standard deviation of the Gaussian intensity of a point along depth [mm]."""
        return float(self.axial_fwhm) / FWHM_PER_STD

    @property
    def lateral_std(self) -> float:
        """The same across [mm]."""
        return float(self.lateral_fwhm) / FWHM_PER_STD

    @property
    def half_angle(self) -> float:
        """Half-angle of the focused beam in air [rad], by which a mirror may tilt and still be seen as one."""
        waist = float(self.lateral_fwhm) / math.sqrt(2.0 * math.log(2.0))
        return float(self.wavelength) / (math.pi * waist)


def check_wavelength(field: str, wavelength: Any) -> None:
    """Refuse a wavelength [mm] that light of an OCT microscope cannot have."""
    known = concrete(wavelength)
    if known is not None and not np.all((known >= _WAVELENGTHS[0]) & (known <= _WAVELENGTHS[1])):
        raise ValueError(
            f"{field} [mm] must lie between {_WAVELENGTHS[0]:g} and {_WAVELENGTHS[1]:g}, got {known:g}; "
            "is it in nm or µm? 845 nm is 845e-6."
        )


UWA_845NM = OctSystem(845e-6, axial_fwhm=7.8e-3, lateral_fwhm=11e-3, index=1.4)
"""Common-path microscope of the published maps: 845 nm, 7.8 µm axial, 11 µm lateral (Wijesinghe et al.)."""
