"""Axial displacement from the phase of two complex volumes, to nanometres.

Products of the two volumes are averaged laterally, as complex numbers, before anything else: the phase is then
unwrapped from the window, where nothing moves, and the second volume shifted back by the result, so that neither
decorrelation nor the midpoint of the motion leaves an error.
"""

import math
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter

from ..errors import MeasurementError
from ..filtering import FWHM_PER_STD
from ..thickness import Step
from .displacement import DisplacementVolume
from .interface import Interface
from .system import OctSystem
from .volume import OctVolume

_AXIAL = 1.25  # samples: standard deviation of the average along depth, after the lateral one
_FIRST = 0.02  # mm below the window where the residue of the source's autocorrelation ends
_PASSES = 3  # of motion compensation: strain 1e-2 then leaves 4 nm
_SURPLUS = 2.0  # times the detector's variance beyond which a loss of coherence is more than its own estimate's scatter
_NARROWEST = 0.1  # samples: a narrower Gaussian averages nothing
_TRUNCATE = 3.0  # standard deviations of the lateral Gaussian that are summed
_SMOOTH = 6.0  # samples: standard deviation along depth of what is taken out, so that it adds no noise
_KEPT = 0.5  # coherence above which a pass takes the displacement itself, not the line
_LOST = 0.3  # median coherence below which two volumes have nothing in common
_REGISTERED = 0.05  # samples of lateral shift that are left alone
_NOISE_BAND = 0.4  # cycles a sample; a point of 3 samples' FWHM has less than 1e-6 of its power beyond
_TAPS = 8  # of the windowed sinc that shifts the second volume back
_KAISER = 6.0  # of its window: 3e-4 of a field whose point spread function is 3 samples wide
_NEIGHBOURS = 5  # A-lines along each side whose median a line is compared with
_SLAB = 30_000_000  # samples of a slab of rows at once, at about ten complex64 arrays: 2.4 GB
_BULK = 0.1  # mm below the window that determine the common phase of a B-scan


class _Plan(NamedTuple):
    """How a slab is processed."""

    radians: float  # of phase per sample of displacement
    stds: tuple[float, float]  # of the lateral Gaussian along y and x [samples]
    first: int
    passes: int
    bulk: bool


def axial_displacement(
    before: OctVolume,
    after: OctVolume,
    system: OctSystem,
    *,
    reference: Literal["first_pixel", "bulk"] | Interface = "first_pixel",
    average: tuple[float, float] = (0.05, 0.05),
    interface: Any = None,
    motion_compensation: bool = True,
    register: bool = True,
    phase_sign: int | None = None,
    min_coherence: float = 0.4,
    scale_std: float = 0.01,
) -> DisplacementVolume:
    """Measure the axial displacement between two complex volumes.

    Phase changes by 4π n u/λ: 48 nm per radian at 845 nm and n = 1.4. Strains up to 1e-2, or 5 µm, are followed.

    Args:
        before: The first volume; displacements are given at its positions.
        after: The second volume, on the same grid.
        system: The microscope; its `wavelength` and `phase_index` set the scale.
        reference: What does not move: the "first_pixel", in a common-path microscope; "bulk": the same, after removing
            a phase common to each B-scan; or the `Interface` of the window, whose phase is removed in each A-line.
        average: FWHM of the lateral average along x and y [mm].
        interface: Depth of the sample's surface, an `Interface` or a map [mm]: below, nothing is given.
        motion_compensation: Whether to shift the second volume back by the result, and repeat.
        register: Whether to remove a lateral shift of each B-scan.
        phase_sign: +1 where the phase grows as a scatterer moves away from the window, -1 where it falls; None takes
            that of the volumes.
        min_coherence: Coherence below which nothing is given [-].
        scale_std: Relative standard deviation of wavelength over index [-], common to all values.

    Raises:
        MeasurementError: For volumes without phase, of different grids, or that have nothing in common.
    """
    sign = _checked(before, after, phase_sign)
    dz = float(before.optical_spacing / system.index)
    depth = np.asarray(before.depth(system.index))
    across = [width / FWHM_PER_STD / float(step) for width, step in zip(average, before.spacing, strict=True)]
    plan = _Plan(
        sign * 4.0 * math.pi * float(system.phase_index) / float(system.wavelength) * dz,
        (across[1], across[0]),
        max(int(np.searchsorted(depth, _FIRST)), 1),
        _PASSES if motion_compensation else 0,
        isinstance(reference, str) and reference == "bulk",
    )
    ny, nx, nz = before.shape
    shifts = _shifts(before, after) if register else np.zeros(ny)
    if isinstance(reference, Interface):
        shifts = np.round(shifts)  # lines of unknown phase cannot be interpolated between
    halo = math.ceil(_TRUNCATE * plan.stds[0]) + 1
    count = max(1, min(ny, _SLAB // (nx * nz) - 2 * halo))
    u, coherence, noise = (np.zeros((ny, nx, nz), np.float32) for _ in range(3))
    for first in range(0, ny, count):
        top, bottom = max(first - halo, 0), min(first + count + halo, ny)
        a, b = (np.asarray(volume.values[top:bottom]).astype(np.complex64) for volume in (before, after))
        b = _shifted(b, shifts[top:bottom])
        if isinstance(reference, Interface):
            b = b * np.exp(-1j * _window_phase(a, b, reference, top, system, depth))[..., None].astype(np.complex64)
        part = _followed(a, b, plan)
        inner = slice(first - top, min(first + count, ny) - top)
        u[first : first + count], coherence[first : first + count] = (field[inner] for field in part[:2])
        noise[first : first + count] = part[2][inner]
    u, consistent = _consistent(u, abs(2.0 * math.pi / plan.radians))
    mask = (coherence < min_coherence) | ~consistent
    above = np.broadcast_to(np.arange(nz) >= plan.first, mask.shape)
    if interface is not None:
        surface = np.asarray(interface.depth if isinstance(interface, Interface) else interface, float)
        above = above & (depth < surface[..., None])
    mask |= ~above
    _check_coherence(float(np.median(coherence[above])), a, b, dz)
    std, shared = _std(u, coherence, noise, plan, before.spacing, system, dz)
    return DisplacementVolume(
        values=np.where(mask, np.float32(0), np.float32(dz) * u),
        std=std.astype(np.float32),
        coherence=coherence,
        mask=mask,
        depth=depth,
        spacing=before.spacing,
        origin=before.origin,
        scale_std=jnp.asarray(scale_std, float),
        noise_length=jnp.asarray(average, float),
        axial_noise=jnp.asarray(shared, float),
        steps=(
            *before.steps,
            Step("axial_displacement", average=average, passes=plan.passes, shift=np.abs(shifts).max()),
        ),
    )


def _checked(before: OctVolume, after: OctVolume, phase_sign: int | None) -> int:
    for name, volume in (("before", before), ("after", after)):
        if volume.scale != "complex":
            raise MeasurementError(
                f"axial_displacement: phase needs complex data, {name} is {volume.scale!r}; export complex or raw "
                "spectra."
            )
    if before.shape != after.shape:
        raise MeasurementError(
            f"axial_displacement: before has shape {before.shape}, after {after.shape}; crop to one grid."
        )
    for name, one, two in (
        ("spacing", before.spacing, after.spacing),
        ("optical_spacing", before.optical_spacing, after.optical_spacing),
    ):
        if not np.allclose(one, two, rtol=1e-3):
            raise MeasurementError(f"axial_displacement: {name} [mm] of before and after differ: {one} and {two}.")
    signs = {phase_sign} if phase_sign is not None else {before.phase_sign, after.phase_sign}
    if signs not in ({1}, {-1}):
        raise MeasurementError(
            "axial_displacement: phase_sign must be 1 or -1, and one for both volumes, got "
            f"{sorted(map(str, signs))}; press on the window: for a receding sample the phase grows (1) or falls (-1)."
        )
    return int(next(iter(signs)) or 1)


def _followed(a: np.ndarray, b: np.ndarray, plan: _Plan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find displacement [samples], coherence, and the coherence that detector noise alone leaves, of a slab."""
    power_a = _averaged(np.abs(a) ** 2, plan)
    product = _averaged(b * a.conj(), plan)
    if plan.bulk:
        phase = _bulk_phase(product, plan)
        turn = np.exp(-1j * phase)[:, None, None].astype(np.complex64)
        b, product = b * turn, product * turn
    power_b = _averaged(np.abs(b) ** 2, plan)
    coherence = np.abs(product) / np.sqrt(np.maximum(power_a * power_b, 1e-30))
    u = _unwrapped(product, plan.first) / np.float32(plan.radians)
    wrap = abs(2.0 * math.pi / plan.radians)
    for number in range(plan.passes):
        if number == 0:
            guess = _mean_strain(product) / np.float32(plan.radians)
        else:
            u = _consistent(u, wrap)[0]
            line = _line(u, coherence)
            off = np.where(coherence > _KEPT, u - line, 0.0)
            guess = line + gaussian_filter1d(off, _SMOOTH, axis=2, mode="nearest")
        for axis in (0, 1):
            if plan.stds[axis] >= _NARROWEST:
                guess = gaussian_filter1d(guess, plan.stds[axis], axis=axis, mode="nearest")
        moved = _shifted_back(b, guess)
        back = moved * a.conj() * np.exp(np.complex64(-1j * plan.radians) * guess)
        product = _averaged(back, plan)
        coherence = np.abs(product) / np.sqrt(np.maximum(power_a * _averaged(np.abs(moved) ** 2, plan), 1e-30))
        # The guess is as smooth as the average; with the product's weights it would belong to their centre.
        u = guess + _unwrapped(product, plan.first) / np.float32(plan.radians)
    shares = [np.clip(_noise_power(x) / np.maximum(p, 1e-30), 0.0, 0.99) for x, p in ((a, power_a), (b, power_b))]
    return u, coherence, np.sqrt((1.0 - shares[0]) * (1.0 - shares[1]))


def _noise_power(field: np.ndarray) -> float:
    """Mean power of white noise: that of the highest frequencies along depth, where no scatterer has any."""
    window = np.hanning(field.shape[2]).astype(np.float32)  # what leaks from the ends would count as noise
    spectrum = np.fft.fft(field * window, axis=2)
    top = np.abs(np.fft.fftfreq(field.shape[2])) > _NOISE_BAND
    return float(np.mean(np.abs(spectrum[..., top]) ** 2) / np.sum(window**2))


def _averaged(values: np.ndarray, plan: _Plan) -> np.ndarray:
    """Average laterally, then a little along depth; smaller sums at the edges leave phases and ratios as they are."""
    stds = (*plan.stds, _AXIAL)
    for axis in (0, 1, 2):
        if stds[axis] < _NARROWEST:
            continue
        values = gaussian_filter1d(values, stds[axis], axis=axis, mode="constant", truncate=_TRUNCATE)
    return values


def _unwrapped(product: np.ndarray, first: int) -> np.ndarray:
    """Unwrap the phase along depth from the first usable sample, whose own is within half a turn of zero."""
    phase = np.angle(product).astype(np.float32)
    phase[..., first:] = np.unwrap(phase[..., first:], axis=2)
    return phase


def _mean_strain(product: np.ndarray) -> np.ndarray:
    """Phase [rad] of a line of each A-line's mean strain, by products of neighbours: a little low, but no wrap."""
    slope = np.angle((product[..., 1:] * product[..., :-1].conj()).sum(axis=2))
    return _smooth_line(slope, product.shape[2])


def _line(u: np.ndarray, coherence: np.ndarray) -> np.ndarray:
    """Fit u = slope · depth where the volumes are coherent."""
    weight = np.where(coherence > _KEPT, coherence**2 / (1.0 - np.minimum(coherence, 0.999) ** 2), 0.0)
    z = np.arange(u.shape[2], dtype=np.float32)
    slope = (weight * z * u).sum(axis=2) / np.maximum((weight * z**2).sum(axis=2), 1e-12)
    return _smooth_line(slope, z.size)


def _smooth_line(slope: np.ndarray, count: int) -> np.ndarray:
    z = np.arange(count, dtype=np.float32)
    slope = median_filter(slope, size=[min(_NEIGHBOURS, n) for n in slope.shape], mode="nearest")
    return (slope[..., None] * z).astype(np.float32)


def _shifted_back(b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Interpolate b at z + u [samples] by a windowed sinc."""
    nz = b.shape[2]
    place = np.arange(nz, dtype=np.float32) + u
    before = np.floor(place).astype(np.int32)
    share = place - before
    total = np.zeros_like(b)
    for tap in range(1 - _TAPS // 2, _TAPS // 2 + 1):
        x = share - np.float32(tap)
        inside = np.maximum(1.0 - (2.0 * x / _TAPS) ** 2, 0.0)
        weight = np.sinc(x) * np.i0(_KAISER * np.sqrt(inside)) / np.i0(_KAISER)
        total += weight.astype(np.float32) * np.take_along_axis(b, np.clip(before + tap, 0, nz - 1), axis=2)
    return total


def _window_phase(a, b, reference: Interface, top: int, system: OctSystem, levels: np.ndarray) -> np.ndarray:
    """Phase [rad] of each A-line's product over one axial FWHM to both sides of the window."""
    depth = np.asarray(reference.depth)[top : top + a.shape[0]]
    dz = levels[1] - levels[0]
    place = np.clip(np.round((depth - levels[0]) / dz).astype(int), 0, a.shape[2] - 1)
    half = max(1, round(float(system.axial_fwhm) / dz))
    index = np.clip(place[..., None] + np.arange(-half, half + 1), 0, a.shape[2] - 1)
    return np.angle((np.take_along_axis(b, index, 2) * np.take_along_axis(a, index, 2).conj()).sum(axis=2))


def _bulk_phase(product: np.ndarray, plan: _Plan) -> np.ndarray:
    """Extrapolate the phase of each B-scan to the window [rad]: a parabola over the first depths."""
    last = max(plan.first + 8, round(_BULK / _FIRST * plan.first))
    phase = np.unwrap(np.angle(product.sum(axis=1)[:, plan.first : last]), axis=1)
    z = np.arange(plan.first, plan.first + phase.shape[1])
    return np.polynomial.polynomial.polyfit(z, phase.T, 2)[0]


def _shifts(before: OctVolume, after: OctVolume) -> np.ndarray:
    """Lateral shift of each B-scan [samples], by the peak of the intensities' cross-correlation along x."""
    shifts = np.zeros(before.shape[0])
    for row in range(shifts.size):
        one, two = (np.abs(np.asarray(volume.values[row])) for volume in (before, after))
        one, two = (np.fft.rfft(field - field.mean(axis=0), n=2 * field.shape[0], axis=0) for field in (one, two))
        correlation = np.fft.irfft((one.conj() * two).sum(axis=1))
        peak = int(np.argmax(correlation))
        left, middle, right = (correlation[(peak + k) % correlation.size] for k in (-1, 0, 1))
        curvature = left - 2.0 * middle + right
        shift = peak + (0.5 * (left - right) / curvature if curvature < 0 else 0.0)
        shifts[row] = shift - correlation.size if shift > 0.5 * correlation.size else shift
    common = median_filter(shifts, size=min(9, shifts.size), mode="nearest")
    return np.where(np.abs(common) < _REGISTERED, 0.0, common)


def _shifted(b: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Shift B-scans back along x, in Fourier space where the shift is no whole number."""
    if not np.any(shifts):
        return b
    n = b.shape[1]
    whole = np.round(shifts).astype(int)
    columns = np.clip(np.arange(n) + whole[:, None], 0, n - 1)
    b = np.take_along_axis(b, columns[..., None], axis=1)
    rest = shifts - whole
    if np.any(rest):
        padded = np.concatenate([b[:, 8:0:-1], b, b[:, -2:-10:-1]], axis=1)
        ramp = np.exp(2j * np.pi * np.fft.fftfreq(padded.shape[1])[None, :, None] * rest[:, None, None])
        b = np.fft.ifft(np.fft.fft(padded, axis=1) * ramp, axis=1)[:, 8:-8].astype(np.complex64)
    return b


def _consistent(u: np.ndarray, wrap: float) -> tuple[np.ndarray, np.ndarray]:
    """Remove whole turns by which a line differs from its neighbours; return where it still differs."""
    size = (min(_NEIGHBOURS, u.shape[0]), min(_NEIGHBOURS, u.shape[1]), 1)
    if size[0] * size[1] == 1:
        return u, np.ones(u.shape, bool)
    for _ in range(2):
        u = u - np.float32(wrap) * np.round((u - median_filter(u, size=size, mode="nearest")) / wrap).astype(np.float32)
    return u, np.abs(u - median_filter(u, size=size, mode="nearest")) < 0.5 * wrap


def _std(
    u: np.ndarray, coherence: np.ndarray, noise: np.ndarray, plan: _Plan, spacing: Any, system: OctSystem, dz: float
) -> tuple[np.ndarray, float]:
    """Compute the standard deviation [mm], and how many samples along depth share it.

    Detector noise differs from sample to sample, what decorrelation adds from speckle to speckle: each is averaged over
    its own number of looks. Strain within the point spread function decorrelates by at least exp(-(κ ε σ)²/2).
    """
    detector = _phase_variance(noise)
    strain = np.gradient(gaussian_filter1d(u, _SMOOTH, axis=2, mode="nearest"), axis=2)
    within = np.expm1(np.minimum((plan.radians * strain * system.axial_std / dz) ** 2, 50.0)) / 2.0
    speckle = np.maximum(within, _phase_variance(coherence) - _SURPLUS * detector)
    white_looks, shared = _looks(coherence.shape[:2], plan.stds, spacing, None, dz)
    looks, _ = _looks(coherence.shape[:2], plan.stds, spacing, system, dz)
    variance = detector / white_looks[..., None] + speckle / looks[..., None]
    return (dz / abs(plan.radians) * np.sqrt(variance)).astype(np.float32), shared


def _phase_variance(coherence: np.ndarray) -> np.ndarray:
    """Variance of the phase of one look [rad²]."""
    g = np.clip(coherence, 1e-3, 1.0 - 1e-7)
    return (1.0 - g**2) / (2.0 * g**2)


def _looks(shape, stds, spacing, system: OctSystem | None, dz: float) -> tuple[np.ndarray, float]:
    """Independent looks of each A-line's average, and samples along depth that share noise; white without a system."""
    along = []
    for n, std, step in zip(shape, stds, np.asarray(spacing)[::-1], strict=True):
        kernel = gaussian_filter1d(np.eye(n), max(std, _NARROWEST), axis=0, mode="constant", truncate=_TRUNCATE)
        kernel = kernel / kernel.sum(axis=1, keepdims=True)
        correlated = np.eye(n)
        if system is not None:
            distance = step * (np.arange(n)[:, None] - np.arange(n))
            correlated = np.exp(-2.0 * math.log(2.0) * (distance / float(system.lateral_fwhm)) ** 2)
        along.append(1.0 / np.einsum("ij,jk,ik->i", kernel, correlated, kernel))
    lag = np.arange(-60, 61)
    speckle = np.where(lag == 0, 1.0, 0.0)
    if system is not None:
        # Of what strain within the point spread function turns: ρ²(l) (1 - l²/2σ²), whose sum is zero.
        l2 = (lag * dz / system.axial_std) ** 2
        speckle = np.exp(-2.0 * math.log(2.0) / FWHM_PER_STD**2 * l2) * (1.0 - 0.5 * l2)
    smoothing = np.exp(-0.25 * (lag / _AXIAL) ** 2)
    smoothing = smoothing / smoothing.sum()
    correlation = np.convolve(speckle, smoothing, mode="same")
    return np.outer(*along) / correlation[60], float(correlation.sum() / correlation[60])


def _check_coherence(median: float, a: np.ndarray, b: np.ndarray, dz: float) -> None:
    if median >= _LOST:
        return
    one, two = (np.fft.rfft((np.abs(x) ** 2).mean(axis=(0, 1)) - (np.abs(x) ** 2).mean()) for x in (a, b))
    lags = np.fft.fftshift(np.fft.irfft(one.conj() * two))
    shift = (int(np.argmax(lags)) - lags.size // 2) * dz
    raise MeasurementError(
        f"axial_displacement: the volumes have nothing in common (median coherence {median:.2f}; their envelopes are "
        f"{1e3 * shift:+.0f} µm apart in depth). The layer moved by more than 5 µm, the position is another one, or "
        "the phase is not stable: take smaller increments, and chain them by cumulative()."
    )
