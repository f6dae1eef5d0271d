"""An OCT volume as in the microscope's files: samples `[y, x, z]`, their scale, spacing and history.

First link of the chain from the microscope: readers make it, `find_interface` takes it. Depth is stored optical, as in
air, because a file cannot know the layer's index; `OctSystem` turns it geometric.
"""

import mmap
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from ..._checks import check_finite, check_positive, concrete
from ..._types import Pair, Scalar
from ..grid import AbstractGrid, kept, pair
from ..thickness import Step
from .system import check_wavelength

Scale = Literal["db", "linear", "complex"]
SCALES = ("db", "linear", "complex")
_SPACING = (5e-4, 0.5)  # mm: below, the unit is µm by mistake as likely as not; above, nothing is resolved
_OPTICAL_SPACING = (2e-4, 2e-2)  # mm
_MOST_NEPERS = np.float32(80.0)  # of power: float32 ends at 88


class OctVolume(AbstractGrid):
    """Backscattered light at every point of a volume.

    Attributes:
        values: Samples `[y, x, z]`, z from the window into the sample; may be an array that lies in a file.
        spacing: Distance between A-lines (dx, dy) [mm].
        origin: (x, y) of the first A-line [mm].
        optical_spacing: Distance between samples in depth, as in air [mm].
        depth_origin: Optical depth of the first sample [mm]; 0 is the zero delay.
        wavelength: Central wavelength in vacuum [mm], or None.
        scale: "db" (10 log10 of power), "linear" (power) or "complex" (field); static.
        phase_sign: +1 where the phase grows as a scatterer moves away from the window, -1 where it falls, None where
            that is not known; static.
        steps: Processing steps of the volume, in order.

    Example:
        >>> import numpy as np
        >>> import opfem as op
        >>> volume = op.OctVolume(np.ones((4, 5, 300), np.float32), (0.01, 0.01), 2.5e-3, "linear")
        >>> float(volume.depth(index=1.4)[-1])
        0.5339...
    """

    values: Shaped[np.ndarray | Array, "ny nx nz"]
    spacing: Pair
    origin: Pair
    optical_spacing: Scalar
    depth_origin: Scalar
    wavelength: Scalar | None
    scale: Scale = eqx.field(static=True)
    phase_sign: int | None = eqx.field(static=True)
    steps: tuple[Step, ...]

    def __init__(
        self,
        values: Any,
        spacing: Any,
        optical_spacing: Any,
        scale: Scale,
        *,
        origin: Any = (0.0, 0.0),
        depth_origin: Any = 0.0,
        wavelength: Any = None,
        phase_sign: int | None = None,
        steps: tuple[Step, ...] = (),
    ):
        """Make a volume from an array and its grid; the array is not copied.

        Args:
            values: Samples, shape (ny, nx, nz), real or complex.
            spacing: (dx, dy) between A-lines [mm], or one number for both.
            optical_spacing: Distance between samples in depth, as in air [mm].
            scale: "db", "linear" or "complex".
            origin: (x, y) of the first A-line [mm].
            depth_origin: Optical depth of the first sample [mm].
            wavelength: Central wavelength in vacuum [mm].
            phase_sign: +1, -1 or None.
            steps: Previous processing steps.

        Raises:
            ValueError: For a wrong shape, type or scale, and a spacing that is not in mm.
        """
        self.values = values if isinstance(values, np.ndarray) else jnp.asarray(values)
        check_values(self.values, scale)
        check_positive("OctVolume.spacing (dx, dy)", "mm", spacing)
        check_positive("OctVolume.optical_spacing", "mm", optical_spacing)
        check_finite("OctVolume.depth_origin", "mm", depth_origin)
        _check_range("spacing (dx, dy)", spacing, _SPACING)
        _check_range("optical_spacing", optical_spacing, _OPTICAL_SPACING)
        if phase_sign not in (None, 1, -1):
            raise ValueError(f"OctVolume.phase_sign must be 1, -1 or None, got {phase_sign!r}.")
        if wavelength is not None:
            check_wavelength("OctVolume.wavelength", wavelength)
        self.spacing = pair("OctVolume.spacing (dx, dy)", spacing)
        self.origin = pair("OctVolume.origin (x, y)", origin)
        self.optical_spacing = jnp.asarray(optical_spacing, float)
        self.depth_origin = jnp.asarray(depth_origin, float)
        self.wavelength = None if wavelength is None else jnp.asarray(wavelength, float)
        self.scale = scale
        self.phase_sign = phase_sign
        self.steps = steps

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples (ny, nx, nz)."""
        ny, nx, nz = self.values.shape
        return ny, nx, nz

    def depth(self, index: Any) -> Float[Array, " nz"]:
        """Geometric depths of the samples [mm] in a layer of group index `index` [-]."""
        return (self.depth_origin + self.optical_spacing * jnp.arange(self.shape[2])) / index

    def intensity(self) -> Float[np.ndarray, "ny nx nz"]:
        """Linear power of all samples, float32; of a volume in a file, this reads it into memory."""
        return power(self.values, self.scale)

    def cropped(
        self,
        x: tuple[float, float] | None = None,
        y: tuple[float, float] | None = None,
        depth: tuple[float, float] | None = None,
    ) -> "OctVolume":
        """Keep the samples within the given ranges; they stay where they are.

        Args:
            x: (first, last) position [mm], both included; None keeps all.
            y: The same along rows [mm].
            depth: The same along optical depth [mm].

        Raises:
            ValueError: When fewer than 2 samples remain along an axis.
        """
        depths = self.depth(1.0)
        columns, rows, levels = kept("x", x, self.x), kept("y", y, self.y), kept("depth", depth, depths)
        origin = jnp.stack([self.x[columns][0], self.y[rows][0]])
        return OctVolume(
            self.values[rows, columns, levels],
            self.spacing,
            self.optical_spacing,
            self.scale,
            origin=origin,
            depth_origin=depths[levels][0],
            wavelength=self.wavelength,
            phase_sign=self.phase_sign,
            steps=(*self.steps, Step("cropped", origin=origin, depth_origin=depths[levels][0])),
        )

    def release(self) -> None:
        """Drop the pages of a volume in a file from memory; they are read again on access."""
        mapped = getattr(self.values, "_mmap", None)
        if mapped is not None and hasattr(mmap, "MADV_DONTNEED"):
            mapped.madvise(mmap.MADV_DONTNEED)


def power(values: Any, scale: Scale) -> Float[np.ndarray, "*shape"]:
    """Convert samples to linear power, float32; what is NaN or infinite has none."""
    values = np.asarray(values)
    if scale == "complex":
        linear = values.real.astype(np.float32) ** 2 + values.imag.astype(np.float32) ** 2
    elif scale == "linear":
        linear = values.astype(np.float32)
    else:
        linear = values.astype(np.float32)
        linear *= np.float32(np.log(10.0) / 10.0)
        np.minimum(linear, _MOST_NEPERS, out=linear)
        np.exp(linear, out=linear)
    missing = ~np.isfinite(linear)
    if missing.any():
        linear[missing] = 0.0
    return linear


def check_values(values: Any, scale: str) -> None:
    """Refuse samples that are not a volume of at least 8 depths, or of another type than their scale says."""
    if values.ndim != 3 or 0 in values.shape or values.shape[2] < 8:
        raise ValueError(
            f"OctVolume.values must be 3-D (ny, nx, nz) with at least 8 samples in depth, got shape {values.shape}."
        )
    if scale not in SCALES:
        raise ValueError(f"OctVolume.scale must be one of {', '.join(SCALES)}, got {scale!r}.")
    if (scale == "complex") != (values.dtype.kind == "c") or values.dtype.kind not in "fiuc":
        raise ValueError(f"OctVolume.values of scale {scale!r} cannot be of type {values.dtype}.")


def _check_range(field: str, value: Any, bounds: tuple[float, float]) -> None:
    known = concrete(value)
    if known is not None and not np.all((known >= bounds[0]) & (known <= bounds[1])):
        raise ValueError(
            f"OctVolume.{field} [mm] must lie between {bounds[0]:g} and {bounds[1]:g}, got {known.tolist()}; "
            "is it in µm?"
        )
