"""Counts of a spectrometer's camera for a simulated field: interferograms on pixels even in wavelength.

Last step of `simulate_oct(spectra=True)`; `Spectra.to_volume` is the inverse.
"""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Complex, Float, PRNGKeyArray

from ..thickness import Step
from .spectra import Spectra
from .system import OctSystem

_BRIGHTEST, _DARK = 3e4, 200.0  # counts of the reference at its brightest, and without light
_MOST_COUNTS = 65535  # of a camera of 16 bits
_FRINGES = 0.1  # root mean square of the fringes over the reference: bright A-lines do not saturate the camera


class Spectrometer(NamedTuple):
    """A spectrometer whose volumes have the samples of a simulated field.

    Attributes:
        chirp: Place of each pixel on a grid even in wavenumber, from short to long wavelength.
        reference: Counts without sample [pixel].
        centre: Place of the central wavenumber.
    """

    chirp: Float[np.ndarray, " n"]
    reference: Float[np.ndarray, " n"]
    centre: float


def spectrometer_of(system: OctSystem, dz: float, levels: int) -> Spectrometer:
    """Make the spectrometer that sees depth in steps of `dz` [mm, geometric] with the system's resolution."""
    pixels = 2 * levels
    centre = 0.5 * (pixels - 1)
    step = math.pi / (pixels * dz * float(system.index))  # of wavenumber [rad/mm]
    middle = 2.0 * math.pi / float(system.wavelength)
    if step * centre > 0.9 * middle:
        raise ValueError(
            f"simulate_oct.depth_spacing [mm] of {dz:g} needs wavelengths of more than one octave; take a larger one."
        )
    shortest, longest = (2.0 * math.pi / (middle + way * step * centre) for way in (1.0, -1.0))
    k = 2.0 * math.pi / np.linspace(shortest, longest, pixels)
    chirp = (k[0] - k) / (k[0] - k[-1]) * (pixels - 1)
    # The spectrum of light is the Fourier transform of the axial point spread function.
    field_std = 0.5 / math.sqrt(math.log(2.0)) * float(system.axial_fwhm) / dz
    width = pixels / (2.0 * math.pi * field_std)
    return Spectrometer(chirp, _BRIGHTEST * np.exp(-0.5 * ((chirp - centre) / width) ** 2), centre)


def interferograms(
    fields: list[Complex[np.ndarray, "ny nx levels"]],
    system: OctSystem,
    spacing: tuple[float, float],
    dz: float,
    noise: float,
    dispersion: tuple[float, float],
    keys: list[Array],
    step: Step,
) -> list[Spectra]:
    """Record fields of one scene.

    Args:
        fields: Simulated fields without noise, blurred by the system's point spread function; of all states.
        system: The microscope.
        spacing: (dx, dy) between A-lines [mm].
        dz: Geometric distance between samples in depth [mm].
        noise: Amplitude of the noise of a volume of these spectra, shaped as the reference is; in units of the fields.
        dispersion: Second and third order of the phase [rad] at the ends of the spectrum.
        keys: Source of each state's noise.
        step: What was done to make the fields.
    """
    levels = fields[0].shape[2]
    light = spectrometer_of(system, dz, levels)
    pixels = light.chirp.size
    # Depth grows with the phase along a falling wavenumber: the field appears conjugate.
    turn = 2j * math.pi / pixels * np.outer(np.arange(levels), light.chirp - light.centre)
    span = 2.0 * light.chirp / (pixels - 1) - 1.0
    waves = np.exp(turn + 1j * (dispersion[0] * span**2 + dispersion[1] * span**3)).astype(np.complex64)
    energy = float(np.mean(np.sum(np.abs(fields[0]) ** 2, axis=2, dtype=float)))
    amplitude = _FRINGES * math.sqrt(float(np.sum(light.reference**2)) / (2.0 * pixels * energy))
    # Shot noise: the variance of counts is their mean over the electrons of a count. Over the square of the number of
    # counts it is that of a volume's sample, in which a field of 1 is `amplitude * pixels` over this number.
    electrons = float(light.reference.sum()) / (amplitude * pixels * noise) ** 2
    return [
        Spectra(
            _counts(field, waves, light.reference, amplitude, electrons, key),
            spacing,
            dz * float(system.index),
            reference=light.reference,
            offset=_DARK,
            chirp=light.chirp,
            wavelength=system.wavelength,
            dispersion=dispersion,
            steps=(step,),
        )
        for field, key in zip(fields, keys, strict=True)
    ]


def _counts(field, waves, reference, amplitude: float, electrons: float, key: PRNGKeyArray) -> np.ndarray:
    ny, nx, _ = field.shape
    counts = np.empty((ny, nx, reference.size), np.uint16)
    for row in range(ny):
        light = reference + 2.0 * amplitude * (field[row].conj() @ waves).real
        draw = np.asarray(jax.random.normal(jax.random.fold_in(key, row), light.shape))
        light += draw * np.sqrt(np.maximum(light, 0.0) / electrons)
        counts[row] = np.clip(np.rint(light + _DARK), 0, _MOST_COUNTS)
    return counts
