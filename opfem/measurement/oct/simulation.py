"""OCT volumes with known truth: scatterers under a surface, seen through a Gaussian point spread function with noise.

Speckle is fully developed by construction: a lattice of scatterers with complex Gaussian strengths, displaced at random
within its cells. The same key gives the same bits, however the volume is divided into slabs.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from ..._checks import check_positive
from ..._types import ScalarLike
from ..grid import bilinear
from ..thickness import Step, ThicknessMap
from .interferogram import interferograms
from .spectra import Spectra
from .system import OctSystem
from .volume import OctVolume, Scale, power

Surface = Callable[[Any, Any], Any] | np.ndarray | Array | ThicknessMap
Increment = Callable[[Any, Any, Any], Any]

_REACH = 4.0  # standard deviations of the field's Gaussian that its kernel covers: 3e-4 of its height is cut off
_SUBVOXELS = 24_000_000  # in a slab, at eight float32 arrays of this size: 0.8 GB
_MOST_MOVED = 3.0  # pixels: beyond, speckle is another one and phase means nothing


class Medium(eqx.Module):
    """How much a medium scatters back, and how fast light fades in it.

    Attributes:
        backscatter: Mean power that comes back, over that of the reference sample [dB].
        attenuation: Attenuation µ of the field's round trip [1/mm]: power falls as exp(-2 µ z).
    """

    backscatter: float = eqx.field(converter=float)
    attenuation: float = eqx.field(converter=float)


LAYER = Medium(-25.0, 0.5)
"""A clear silicone layer."""

SCATTERING_LAYER = Medium(0.0, 2.0)
"""A silicone layer with titanium dioxide."""

SAMPLE = Medium(0.0, 3.0)
"""A scattering sample; tissue has an attenuation of 5 to 10 /mm."""

_ROLL_OFF = (6.0, 1.5)  # dB of power lost at this optical depth [mm]; Gaussian


def simulate_oct(
    system: OctSystem,
    surface: Surface,
    *,
    key: PRNGKeyArray,
    spacing: tuple[float, float],
    shape: tuple[int, int] | None = None,
    depth_spacing: float | int = 2.5e-3,
    depth: float | int = 0.75,
    increment: Increment | None = None,
    media: tuple[Medium, Medium] = (LAYER, SAMPLE),
    snr: float | int = 25.0,
    specular: float | int | None = None,
    lines: Sequence[tuple[float, float]] = (),
    scale: Scale = "db",
    spectra: bool = False,
    dispersion: tuple[float, float] = (0.0, 0.0),
) -> OctVolume | Spectra | tuple[OctVolume, OctVolume] | tuple[Spectra, Spectra]:
    """Simulate the volume that a microscope would measure, or two volumes before and after a small increment.

    Args:
        system: The microscope.
        surface: Depth of the sample's surface [mm]: a function of x and y [mm], a map, or an array (ny, nx).
        key: Source of randomness.
        spacing: (dx, dy) between A-lines [mm].
        shape: Number of A-lines (ny, nx); None takes that of `surface`.
        depth_spacing: Geometric distance between samples in depth [mm].
        depth: Geometric depth that is imaged [mm].
        increment: Displacement of scatterers (u_x, u_y, u_z) [mm] between two states, a function of x, y, z [mm] of the
            first; then both volumes are complex.
        media: Layer and sample.
        snr: Power of the sample at its surface (mean depth) over the noise [dB].
        specular: Power of the surface's own reflection over the sample's, where it is level [dB]; None has none.
        lines: (depth [mm], power over the sample's [dB]) of artefact lines at constant depth.
        scale: Scale of the samples of a single volume.
        spectra: Return the counts of the spectrometer's camera, with shot noise, in place of the volume. Shaped by
            a Hann window, volumes of such spectra have 2 dB more noise than given.
        dispersion: Second and third order of the phase [rad] of spectra at their ends.

    Returns:
        The volume or spectra; with `increment`, those before and after.

    Raises:
        ValueError: For spacings beyond half the resolution in depth, and an increment of more than 3 pixels.
    """
    check_positive("simulate_oct.spacing (dx, dy)", "mm", spacing)
    check_positive("simulate_oct.depth_spacing", "mm", depth_spacing)
    if not spectra and any(dispersion):
        raise ValueError("simulate_oct.dispersion [rad] is that of spectra; pass spectra=True as well.")
    if shape is None:
        if callable(surface) and not isinstance(surface, ThicknessMap):
            raise ValueError("simulate_oct.shape (ny, nx) is needed for a surface that is a function.")
        ny, nx = np.shape(surface.values if isinstance(surface, ThicknessMap) else surface)
        shape = (ny, nx)
    if depth_spacing > 0.5 * float(system.axial_fwhm):
        raise ValueError(
            f"simulate_oct.depth_spacing [mm] must be at most half of axial_fwhm, {0.5 * float(system.axial_fwhm):g}, "
            f"got {depth_spacing:g}."
        )
    scene = _Scene(system, surface, shape, spacing, depth_spacing, round(depth / depth_spacing), media, increment)
    fields = [np.empty((*shape, scene.levels), np.complex64) for _ in range(1 if increment is None else 2)]
    for rows in scene.slabs():
        for field, slab in zip(fields, scene.speckle(key, rows), strict=True):
            field[rows] = slab
    noise = scene.reflected(fields, specular, lines) * 10.0 ** (-snr / 20.0)
    noise_key, step = jax.random.fold_in(key, 2**31 - 1), Step("simulated", snr=snr)
    if spectra:
        keys = [jax.random.fold_in(noise_key, state) for state in range(len(fields))]
        states: Any = interferograms(fields, system, spacing, depth_spacing, noise, dispersion, keys, step)
    else:
        _add_noise(fields, noise, noise_key)
        states = [scene.volume(field, scale if increment is None else "complex", step) for field in fields]
    return states[0] if increment is None else tuple(states)


class _Scene:
    """One simulation: its grid, its scatterers' lattice and its media."""

    def __init__(self, system, surface, shape, spacing, depth_spacing, levels, media, increment):
        self.system, self.shape, self.spacing, self.dz = system, shape, spacing, depth_spacing
        self.levels, self.media, self.increment = levels, media, increment
        # Sub-columns at most half the beam apart: a surface's slope within the beam is kept.
        self.columns = tuple(math.ceil(step / (0.5 * float(system.lateral_fwhm))) for step in spacing)
        field_std = 0.5 / math.sqrt(math.log(2.0))  # of a field whose intensity has FWHM 1
        across = [
            _gaussian(field_std * float(system.lateral_fwhm) / (step / columns))
            for step, columns in zip(spacing, self.columns, strict=True)
        ]
        # The linear split between two samples widens a point by dz²/6 in the mean.
        axial = _gaussian(math.sqrt((field_std * float(system.axial_fwhm) / depth_spacing) ** 2 - 1.0 / 6.0))
        neighbour = float(np.sum(axial[1:] * axial[:-1]))
        mean_power = (2.0 * np.sum(axial**2) + neighbour) / 3.0 * np.prod([np.sum(k**2) for k in across])
        self.axial, (self.across_x, self.across_y) = axial / math.sqrt(mean_power), across
        self.surface = self._depth_function(surface)

    def _depth_function(self, surface: Surface) -> Callable[[Any, Any], Any]:
        if isinstance(surface, ThicknessMap):
            return surface.sample
        if callable(surface):
            return surface
        heights = jnp.asarray(surface, float)
        if heights.shape != tuple(self.shape):
            raise ValueError(f"simulate_oct.surface must have shape (ny, nx) = {self.shape}, got {heights.shape}.")
        return lambda x, y: bilinear(heights, jnp.zeros(2), self.spacing, x, y)

    def slabs(self) -> list[slice]:
        """Divide the rows so that a slab's scatterers fit the memory set aside for them."""
        ny, nx = self.shape
        row = nx * self.columns[0] * self.columns[1] * self.levels
        count = max(1, min(ny, _SUBVOXELS // row))
        return [slice(first, min(first + count, ny)) for first in range(0, ny, count)]

    def positions(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Positions x and y [mm] of the scatterers' columns that a slab of A-lines sees."""
        (kx, ky), (dx, dy) = self.columns, self.spacing
        reach_x, reach_y = len(self.across_x) // 2, len(self.across_y) // 2
        x = (np.arange(-reach_x, (self.shape[1] - 1) * kx + reach_x + 1)) * (dx / kx)
        y = (np.arange(rows.start * ky - reach_y, (rows.stop - 1) * ky + reach_y + 1)) * (dy / ky)
        return x, y

    def speckle(self, key: PRNGKeyArray, rows: slice) -> list[np.ndarray]:
        """Fields of a slab of rows without noise, before and, if there is an increment, after."""
        x, y = self.positions(rows)
        xs, ys = np.meshgrid(x, y)
        depth = jnp.asarray(self.surface(xs, ys), jnp.float32)
        first = rows.start * self.columns[1]
        keys = jax.vmap(partial(jax.random.fold_in, key))(first + jnp.arange(y.size))
        levels = self.levels + len(self.axial) // 2
        strength, place = _scatterers(keys, depth, levels, self.dz, self._numbers())
        fields = [self._seen(_split(strength, place))]
        if self.increment is not None:
            fields.append(self._seen(self._moved(strength, place, xs, ys)))
        return fields

    def _numbers(self) -> tuple[float, ...]:
        layer, sample = self.media
        # exp(-c z²) of the field loses the stated power at the stated depth.
        decibels, optical = _ROLL_OFF
        roll_off = decibels * math.log(10.0) / 20.0 / (optical / float(self.system.index)) ** 2
        amplitudes = (10.0 ** (medium.backscatter / 20.0) for medium in self.media)
        return (*amplitudes, layer.attenuation, sample.attenuation, roll_off)

    def _seen(self, field: Array) -> np.ndarray:
        """Blur a lattice's field by the point spread function, onto the A-lines."""
        pad = len(self.axial) // 2
        kx, ky = self.columns
        seen = _blurred(jnp.pad(field, ((0, 0), (0, 0), (0, 0), (pad, pad))), tuple(self.axial), 3, 1)
        seen = _blurred(seen, tuple(self.across_x), 2, kx)
        real, imaginary = np.asarray(_blurred(seen, tuple(self.across_y), 1, ky))[..., : self.levels]
        return real + 1j * imaginary

    def _moved(self, strength: Array, place: Array, xs: np.ndarray, ys: np.ndarray) -> Array:
        """Field of the lattice after the increment: phase exact, envelope split between samples."""
        z = (jnp.arange(strength.shape[3]) + place) * self.dz
        assert self.increment is not None
        moves = [
            jnp.broadcast_to(jnp.asarray(u, jnp.float32), place.shape)
            for u in self.increment(xs[:, :, None], ys[:, :, None], z)
        ]
        sub = (self.spacing[0] / self.columns[0], self.spacing[1] / self.columns[1])
        _refuse_far(moves, (*self.spacing, self.dz))
        wavenumber = 4.0 * math.pi * float(self.system.phase_index) / float(self.system.wavelength)
        turned = _turned(strength, wavenumber * moves[2])
        moved = _spread(turned, place + moves[2] / self.dz, 3)
        for axis, (move, step) in zip((2, 1), zip(moves[:2], sub, strict=True), strict=True):
            if float(jnp.abs(move).max()) > 0.0:
                moved = _spread(moved, move / step, axis)
        return moved

    def reflected(
        self, fields: list[np.ndarray], specular: float | None, lines: Sequence[tuple[float, float]]
    ) -> float:
        """Add the surface's reflection and lines; return the mean amplitude of the sample at its surface."""
        ny, nx = self.shape
        x, y = np.arange(nx) * self.spacing[0], np.arange(ny) * self.spacing[1]
        depth = np.asarray(self.surface(*np.meshgrid(x, y)), float)
        levels = np.arange(self.levels) * self.dz
        _, amplitude, fade, _, roll_off = self._numbers()
        level = amplitude * np.exp(-fade * depth - roll_off * depth**2)
        extra = np.zeros(self.levels, np.complex64)
        for place, decibels in lines:
            extra += np.float32(level.mean() * 10.0 ** (decibels / 20.0)) * self._point(levels - place)
        for state, field in enumerate(fields):
            moved = depth if state == 0 else depth + np.asarray(self._axial(x, y, depth))
            for j in range(ny):
                field[j] += extra
                if specular is not None:
                    field[j] += self._reflection(moved, level, levels, j, specular)
        return float(level.mean())

    def _axial(self, x, y, depth):
        assert self.increment is not None
        xs, ys = np.meshgrid(x, y)
        return np.broadcast_to(self.increment(xs, ys, depth)[2], depth.shape)

    def _point(self, distance: np.ndarray) -> np.ndarray:
        """Field of a reflector along depth, `distance` [mm] from it."""
        return np.exp(-2.0 * math.log(2.0) * (distance / float(self.system.axial_fwhm)) ** 2).astype(np.complex64)

    def _reflection(self, depth, level, levels, j, specular):
        slope_y, slope_x = (
            np.gradient(depth, step, axis=axis) if depth.shape[axis] > 1 else np.zeros_like(depth)
            for axis, step in ((0, self.spacing[1]), (1, self.spacing[0]))
        )
        seen = np.exp(-(slope_x[j] ** 2 + slope_y[j] ** 2) / self.system.half_angle**2)
        wavenumber = 4.0 * math.pi * float(self.system.phase_index) / float(self.system.wavelength)
        height = level[j] * 10.0 ** (specular / 20.0) * seen * np.exp(1j * wavenumber * depth[j])
        return (height[:, None] * self._point(levels - depth[j][:, None])).astype(np.complex64)

    def volume(self, field: np.ndarray, scale: Scale, step: Step) -> OctVolume:
        """Make a volume of a finished field."""
        values: Any = field
        if scale != "complex":
            values = power(field, "complex")
            if scale == "db":
                values = 10.0 * np.log10(np.maximum(values, np.float32(1e-30)))
        return OctVolume(
            values,
            self.spacing,
            self.dz * float(self.system.index),
            scale,
            wavelength=self.system.wavelength,
            phase_sign=1 if scale == "complex" else None,
            steps=(step,),
        )


def _add_noise(fields: list[np.ndarray], noise: float, key: PRNGKeyArray) -> None:
    ny, nx, levels = fields[0].shape
    for state, field in enumerate(fields):
        for j in range(ny):
            draw = jax.random.normal(jax.random.fold_in(key, state * ny + j), (2, nx, levels), jnp.float32)
            real, imaginary = np.asarray(draw) * np.float32(noise / math.sqrt(2.0))
            field[j] += real + 1j * imaginary


def _gaussian(std: float) -> np.ndarray:
    reach = math.ceil(_REACH * std)
    return np.exp(-0.5 * (np.arange(-reach, reach + 1) / std) ** 2)


@partial(jax.jit, static_argnames=("levels",))
def _scatterers(keys, depth: Array, levels: int, dz: ScalarLike, numbers) -> tuple[Array, Array]:
    """Draw strength (real, imaginary) and place within its voxel of each scatterer of a slab."""
    columns = depth.shape[1]

    def row(key):
        draw, within = jax.random.split(key)
        return (
            jax.random.normal(draw, (2, columns, levels), jnp.float32),
            jax.random.uniform(within, (columns, levels), jnp.float32),
        )

    strength, place = jax.vmap(row, out_axes=(1, 0))(keys)
    above, below, fade_above, fade_below, roll_off = (jnp.float32(number) for number in numbers)
    z = (jnp.arange(levels, dtype=jnp.float32) + place) * jnp.float32(dz)
    surface = depth[:, :, None]
    inside = z >= surface
    faded = fade_above * jnp.minimum(z, surface) + fade_below * jnp.maximum(z - surface, 0.0) + roll_off * z**2
    return strength * (jnp.where(inside, below, above) * jnp.exp(-faded) * math.sqrt(0.5)), place


@jax.jit
def _split(strength: Array, place: Array) -> Array:
    """Share each scatterer between the sample before and the one after."""
    after = strength * place
    return strength - after + jnp.pad(after, ((0, 0), (0, 0), (0, 0), (1, 0)))[..., :-1]


@jax.jit
def _turned(strength: Array, phase: Array) -> Array:
    cosine, sine = jnp.cos(phase), jnp.sin(phase)
    return jnp.stack([strength[0] * cosine - strength[1] * sine, strength[0] * sine + strength[1] * cosine])


def _spread(strength: Array, place: Array, axis: int) -> Array:
    """Share each scatterer between the two samples about its place [samples from its own], along one axis."""
    lowest, highest = int(jnp.floor(place.min())), int(jnp.floor(place.max()))
    return _spread_within(strength, place, axis, lowest, highest)


@partial(jax.jit, static_argnames=("axis", "lowest", "highest"))
def _spread_within(strength: Array, place: Array, axis: int, lowest: int, highest: int) -> Array:
    whole = jnp.floor(place)
    part = place - whole
    total = jnp.zeros_like(strength)
    for shift in range(lowest, highest + 2):
        share = jnp.where(whole == shift, 1.0 - part, 0.0) + jnp.where(whole == shift - 1, part, 0.0)
        total = total + _shifted(strength * share, shift, axis)
    return total


def _shifted(values: Array, shift: int, axis: int) -> Array:
    """Move values by whole samples; what leaves is lost, zeros come in."""
    count = values.shape[axis]
    pads = [(0, 0)] * values.ndim
    pads[axis] = (max(shift, 0), max(-shift, 0))
    first = max(-shift, 0)
    return jax.lax.slice_in_dim(jnp.pad(values, pads), first, first + count, axis=axis)


@partial(jax.jit, static_argnames=("kernel", "axis", "stride"))
def _blurred(values: Array, kernel: tuple[float, ...], axis: int, stride: int) -> Array:
    """Correlate with a kernel along one axis, keeping every `stride`-th sample of those it covers whole."""
    count = (values.shape[axis] - len(kernel)) // stride + 1
    taps = [
        jnp.float32(weight) * jax.lax.slice_in_dim(values, tap, tap + (count - 1) * stride + 1, stride, axis)
        for tap, weight in enumerate(kernel)
    ]
    return jnp.asarray(sum(taps))


def _refuse_far(moves: list[Array], steps: tuple[float, ...]) -> None:
    far = max(float(jnp.abs(move).max()) / step for move, step in zip(moves, steps, strict=True))
    if far > _MOST_MOVED:
        raise ValueError(
            f"simulate_oct.increment must move scatterers by at most {_MOST_MOVED:g} pixels, got {far:.3g}; "
            "speckle beyond is another one: chain smaller increments, or simulate each state by itself."
        )
