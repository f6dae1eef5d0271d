"""Raw spectra of a spectral-domain microscope, and their conversion to a complex volume.

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

_LEAST_REFERENCE = 0.02  # of the brightest pixel of the reference: darker ones are noise, and no divisor
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
        dispersion: Second and third order of the phase [rad] that the microscope adds at the ends of the spectrum.
        is_ascending: Whether wavenumber grows along the chirp's grid; static.
        repeats: How many B-scans and A-lines follow one another at each place; static.
        steps: Previous processing steps.
    """

    values: Shaped[np.ndarray | Array, "ny nx n"]
    reference: Float[Array, " n"]
    offset: Float[Array, " n"]
    chirp: Float[Array, " n"]
    spacing: Pair
    origin: Pair
    optical_spacing: Scalar
    wavelength: Scalar | None
    dispersion: Pair
    is_ascending: bool = eqx.field(static=True)
    repeats: tuple[int, int] = eqx.field(static=True)
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
        dispersion: Any = (0.0, 0.0),
        is_ascending: bool = False,
        repeats: tuple[int, int] = (1, 1),
        steps: tuple[Step, ...] = (),
    ):
        """State interferograms and the spectrometer they come from.

        Args:
            values: Counts, shape (ny, nx, n), repeats counted.
            spacing: (dx, dy) between A-lines, or places where they repeat [mm]; or one number for both.
            optical_spacing: Distance between samples in depth of the volume [mm]: π over the range of wavenumbers.
            reference: Spectrum without sample, offset taken off; None takes the mean of all interferograms.
            offset: Counts without light.
            chirp: Place of each pixel in wavenumber, 0 to n - 1, monotone; None is even.
            origin: (x, y) of the first A-line [mm].
            wavelength: Central wavelength [mm].
            dispersion: Second and third order of the phase [rad] at the ends of the spectrum.
            is_ascending: Whether wavenumber grows along the pixels.
            repeats: How many B-scans and A-lines follow one another at each place.
            steps: Previous processing steps.

        Raises:
            ValueError: For a wrong shape, a chirp that is not monotone, a dark reference, repeats that do not divide.
        """
        self.values = values if isinstance(values, np.ndarray) else jnp.asarray(values)
        if self.values.ndim != 3 or 0 in self.values.shape or self.values.shape[2] < 16:
            raise ValueError(
                f"Spectra.values must be 3-D (ny, nx, n) of at least 16 pixels, got shape {self.values.shape}."
            )
        for name, lines, times in zip(("B-scans", "A-lines"), self.values.shape, repeats, strict=False):
            if times < 1 or lines % times:
                raise ValueError(f"Spectra.repeats must divide the {name}, got {lines} of them and {times} repeats.")
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
        self.dispersion = jnp.asarray(dispersion, float)
        if self.dispersion.shape != (2,) or not np.isfinite(np.asarray(self.dispersion)).all():
            raise ValueError(f"Spectra.dispersion [rad] must be two numbers, got {dispersion}.")
        self.is_ascending, self.repeats = is_ascending, repeats
        self.steps = steps

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of places and pixels (ny, nx, n)."""
        ny, nx, n = self.values.shape
        return ny // self.repeats[0], nx // self.repeats[1], n

    def to_volume(self, window: Window = "hann", dispersion: tuple[float, float] | None = None) -> OctVolume:
        """Transform to a complex volume; where A-lines repeat, to their mean power, whose phases have drifted.

        Args:
            window: Apodisation of the spectrum where there is light: "hann", or "none", which keeps the reference's.
            dispersion: Second and third order of the phase [rad] at the ends of the spectrum, to be taken out; None
                takes the stated ones.

        Raises:
            MeasurementError: When the volume does not fit 2 GB: crop the spectra, or take fewer B-scans.
        """
        ny, nx, pixels = self.shape
        depths = pixels // 2
        repeated = self.repeats != (1, 1)
        size = ny * nx * depths * (4 if repeated else 8)
        if size > 2**31:
            raise MeasurementError(
                f"The volume of {ny} × {nx} spectra of {pixels} pixels takes {size / 2**30:.1f} GB, above 2 GB; take "
                "fewer B-scans at a time."
            )
        turn = np.asarray(self.dispersion if dispersion is None else dispersion, float)
        shape, factor = self._shaped(window, turn)
        # Phase of the central wavenumber: of one reflector it is the same in all samples that see it.
        centre = float(np.sum(shape * np.arange(pixels)) / shape.sum())
        phase = np.exp(2j * np.pi * np.arange(depths) * centre / pixels)
        values = np.empty((ny, nx, depths), np.float32 if repeated else np.complex64)
        scans, lines = self.repeats
        at_once = max(1, _ROWS // scans)
        for first in range(0, ny, at_once):
            field = self._transformed(slice(scans * first, scans * (first + at_once)), factor)[..., :depths]
            if repeated:
                power = (np.abs(field) ** 2).reshape(-1, scans, nx, lines, depths)
                values[first : first + at_once] = power.mean(axis=(1, 3))
            else:
                values[first : first + at_once] = field * phase
        return OctVolume(
            values,
            self.spacing,
            self.optical_spacing,
            "linear" if repeated else "complex",
            origin=self.origin,
            wavelength=self.wavelength,
            phase_sign=None if repeated else 1 if self.is_ascending else -1,
            steps=(*self.steps, Step("spectra", pixels=pixels, dispersion=turn, repeats=np.array(self.repeats))),
        )

    def _shaped(self, window: Window, dispersion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the window on a grid even in wavenumber, and what spectra there are multiplied with."""
        reference, places = np.asarray(self.reference), np.asarray(self.chirp)
        even = np.arange(places.size, dtype=float)
        lit = np.interp(even, places, (reference > _LEAST_REFERENCE * reference.max()).astype(float)) > 0.5
        shape = np.where(lit, np.interp(even, places, reference), 0.0)
        if window == "hann":
            # From the first pixel with light to the last: over dark ones it would end in the middle of its slope.
            ends = np.flatnonzero(lit)[[0, -1]]
            shape = np.zeros(places.size)
            shape[ends[0] : ends[1] + 1] = np.hanning(ends[1] - ends[0] + 1)
            shape = np.where(lit, shape, 0.0)
        span = np.linspace(-1.0, 1.0, places.size)
        return shape, shape / shape.sum() * np.exp(-1j * (dispersion[0] * span**2 + dispersion[1] * span**3))

    def _transformed(self, rows: slice, factor: np.ndarray) -> np.ndarray:
        """Transform B-scans: reference, resampling, window, Fourier transform."""
        reference, places = np.asarray(self.reference), np.asarray(self.chirp)
        bright = reference > _LEAST_REFERENCE * reference.max()
        counts = np.asarray(self.values[rows], float) - np.asarray(self.offset)
        fringes = np.where(bright, counts / np.where(bright, reference, 1.0) - 1.0, 0.0)
        # Cubic: linear interpolation loses half of the fringes near the end of the depth range.
        even = np.clip(np.arange(places.size, dtype=float), places[0], places[-1])
        resampled = make_interp_spline(places, fringes, k=3, axis=2)(even)
        return np.fft.fft(resampled * factor, axis=2)
