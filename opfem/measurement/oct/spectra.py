"""Raw spectra of a spectral-domain microscope, and the complex volume they hold.

One step before the volume: each A-line is an interferogram over the pixels of a spectrometer, which are not evenly
spaced in wavenumber. Reference, resampling, dispersion, window and Fourier transform make a volume of it.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from scipy.interpolate import make_interp_spline

from ..._checks import check_positive
from ..._types import Pair, Scalar
from ..errors import MeasurementError
from ..grid import AbstractGrid, pair
from ..thickness import Step
from .system import check_wavelength
from .volume import OctVolume

Window = Literal["hann", "none"]

_LEAST_REFERENCE = 0.02  # of the brightest pixel of the reference: darker ones hold noise, and are not divided by
_ROWS = 8  # B-scans that are transformed at once


class Spectra(AbstractGrid):
    """Interferograms `[y, x, pixel]` as the camera counts them.

    Attributes:
        values: Counts, offset of the camera not yet taken off.
        reference: Spectrum without sample, counts of the camera [pixel], offset taken off.
        offset: Counts without light [pixel].
        chirp: Place of each pixel on a grid that is even in wavenumber, in steps of that grid.
        spacing: Distance between A-lines (dx, dy) [mm].
        origin: (x, y) of the first A-line [mm].
        optical_spacing: Distance between samples in depth of the volume, as in air [mm].
        wavelength: Central wavelength in vacuum [mm], or None.
        is_ascending: Whether wavenumber grows along the chirp's grid; static.
        steps: What was done before.
    """

    values: Shaped[np.ndarray | Array, "ny nx n"]
    reference: Float[Array, " n"]
    offset: Float[Array, " n"]
    chirp: Float[Array, " n"]
    spacing: Pair
    origin: Pair
    optical_spacing: Scalar
    wavelength: Scalar | None
    is_ascending: bool = eqx.field(static=True)
    steps: tuple[Step, ...]

    def __init__(
        self,
        values: Any,
        spacing: Any,
        optical_spacing: Any,
        *,
        reference: Any = None,
        offset: Any = 0.0,
        chirp: Any = None,
        origin: Any = (0.0, 0.0),
        wavelength: Any = None,
        is_ascending: bool = False,
        steps: tuple[Step, ...] = (),
    ):
        """State interferograms and the spectrometer they come from.

        Args:
            values: Counts, shape (ny, nx, n).
            spacing: (dx, dy) between A-lines [mm], or one number for both.
            optical_spacing: Distance between samples in depth of the volume [mm]: π over the range of wavenumbers.
            reference: Spectrum without sample, offset taken off; None takes the mean of all interferograms.
            offset: Counts without light.
            chirp: Place of each pixel in wavenumber, 0 to n - 1, monotone; None is even.
            origin: (x, y) of the first A-line [mm].
            wavelength: Central wavelength [mm].
            is_ascending: Whether wavenumber grows along the pixels.
            steps: What was done before.

        Raises:
            ValueError: For a wrong shape, a chirp that is not monotone, a dark reference.
        """
        self.values = values if isinstance(values, np.ndarray) else jnp.asarray(values)
        if self.values.ndim != 3 or 0 in self.values.shape or self.values.shape[2] < 16:
            raise ValueError(
                f"Spectra.values must be 3-D (ny, nx, n) of at least 16 pixels, got shape {self.values.shape}."
            )
        check_positive("Spectra.spacing (dx, dy)", "mm", spacing)
        check_positive("Spectra.optical_spacing", "mm", optical_spacing)
        if wavelength is not None:
            check_wavelength("Spectra.wavelength", wavelength)
        pixels = self.values.shape[2]
        self.offset = jnp.broadcast_to(jnp.asarray(offset, float), (pixels,))
        if reference is None:
            reference = np.mean(self.values, axis=(0, 1), dtype=float) - np.asarray(self.offset)
        self.reference = jnp.asarray(reference, float)
        self.chirp = jnp.arange(pixels, dtype=float) if chirp is None else jnp.asarray(chirp, float)
        for name in ("reference", "chirp"):
            if getattr(self, name).shape != (pixels,):
                raise ValueError(
                    f"Spectra.{name} must have one number a pixel, {pixels}, got shape {getattr(self, name).shape}."
                )
        places = np.asarray(self.chirp)
        if not (np.isfinite(places).all() and (np.diff(places) > 0).all()):
            raise ValueError("Spectra.chirp must grow from pixel to pixel; turn a falling one round, and the spectra.")
        if not np.max(np.asarray(self.reference)) > 0:
            raise ValueError("Spectra.reference must be positive somewhere; is it dark?")
        self.spacing = pair("Spectra.spacing (dx, dy)", spacing)
        self.origin = pair("Spectra.origin (x, y)", origin)
        self.optical_spacing = jnp.asarray(optical_spacing, float)
        self.wavelength = None if wavelength is None else jnp.asarray(wavelength, float)
        self.is_ascending = is_ascending
        self.steps = steps

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of interferograms and pixels (ny, nx, n)."""
        ny, nx, n = self.values.shape
        return ny, nx, n

    def to_volume(self, window: Window = "hann", dispersion: tuple[float, float] = (0.0, 0.0)) -> OctVolume:
        """Transform to a complex volume.

        Args:
            window: What the spectrum is shaped by: "hann", or "none", which keeps the reference's.
            dispersion: Second and third order of the phase [rad] at the ends of the spectrum, to be taken out.

        Raises:
            MeasurementError: When the volume does not fit 2 GB: crop the spectra, or take fewer B-scans.
        """
        ny, nx, pixels = self.shape
        depths = pixels // 2
        if ny * nx * depths * 8 > 2**31:
            raise MeasurementError(
                f"The volume of {ny} × {nx} spectra of {pixels} pixels takes {ny * nx * depths * 8 / 2**30:.1f} GB, "
                "above 2 GB; take fewer B-scans at a time."
            )
        reference, offset, places = (np.asarray(field) for field in (self.reference, self.offset, self.chirp))
        even = np.arange(pixels, dtype=float)
        bright = reference > _LEAST_REFERENCE * reference.max()
        lit = np.interp(even, places, bright.astype(float)) > 0.5
        span = np.linspace(-1.0, 1.0, pixels)
        shape = np.where(lit, np.hanning(pixels) if window == "hann" else np.interp(even, places, reference), 0.0)
        factor = shape / shape.sum() * np.exp(-1j * (dispersion[0] * span**2 + dispersion[1] * span**3))
        values = np.empty((ny, nx, depths), np.complex64)
        for first in range(0, ny, _ROWS):
            rows = slice(first, first + _ROWS)
            counts = np.asarray(self.values[rows], float) - offset
            fringes = np.where(bright, counts / np.where(bright, reference, 1.0) - 1.0, 0.0)
            # Cubic: linear interpolation loses half of the fringes near the end of the depth range.
            resampled = make_interp_spline(places, fringes, k=3, axis=2)(np.clip(even, places[0], places[-1]))
            values[rows] = np.fft.fft(resampled * factor, axis=2)[..., :depths]
        # Phase of the central wavenumber: of one reflector it is the same in all samples that see it.
        centre = float(np.sum(shape * even) / shape.sum())
        phase = 2.0 * np.pi * np.arange(depths) * centre / pixels
        values *= np.exp(1j * phase).astype(np.complex64)
        return OctVolume(
            values,
            self.spacing,
            self.optical_spacing,
            "complex",
            origin=self.origin,
            wavelength=self.wavelength,
            phase_sign=1 if self.is_ascending else -1,
            steps=(*self.steps, Step("spectra", pixels=pixels, dispersion=jnp.asarray(dispersion))),
        )
