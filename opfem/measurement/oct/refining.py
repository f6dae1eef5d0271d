"""From a coarse surface to the interface: profiles flattened along it, averaged across, and fitted by edge models.

Second half of `find_interface`. Runs over blocks of B-scans, so that memory does not grow with the volume's depth or
its number of B-scans.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import gaussian_filter

from .edge import MODELS, EdgeFit, coupling_lag, fit_edges, looks_along_depth
from .lines import DepthLines
from .path import smooth_surface
from .system import OctSystem
from .volume import OctVolume, power

_HALF_WINDOW = 0.06  # mm above and below the edge that levels are fitted to
_REACH = 0.02  # mm around the coarse surface that the search for the edge covers
_TRUNCATE = 3.5  # standard deviations that the lateral average reaches
_SHADE = 0.1  # of the power of its region, which an A-line in a shadow has less of
_NEAREST, _REGION = 0.35, 8.0  # widths of the lateral average that an A-line's power and its region's are taken over
_SELECTION = 3.0  # widths of the lateral average that models are compared over
# Standard deviations [mm] of the edge about the surface that profiles are flattened along, for the start of a fit and
# the fit itself: about the coarse surface, and about one that is already fine. At 3 dB they keep the fit from bright
# specks 20 µm away; at 6 dB and above the data outweigh them.
_PRIORS = ((0.008, 0.006), (0.003, 0.004))
_PASSES = 3  # the surface to flatten along is the last one found
# Widths of the lateral average that this surface is smoothed by. Its noise adds to that of the fit: 47 % of variance at
# 1, 21 % at 1.5, 11 % at 2; its lack of detail shows at 2.
_SURFACE = 1.5
_SURFACE_NOISE = {1: 1.162, 2: 1.213}  # factor on the variance by the number of lateral axes: see `geometry_of`
NOISE_WIDTH = _SURFACE_NOISE[2] ** -0.5
"""Width of the noise's correlation over that of the lateral average: its power per area is the same."""


class Geometry(NamedTuple):
    """Lengths of a search in samples of its volume.

    Attributes:
        dz: Geometric distance between samples in depth [mm].
        axial: Standard deviation of the point spread function along depth [samples].
        lateral: The same across [mm].
        average: Standard deviation of the lateral average along y and x [samples].
        looks: Independent samples that an averaged one is worth, across.
        looks_per_sample: The same, times those that a sample along depth is worth.
    """

    dz: float
    axial: float
    lateral: float
    average: tuple[float, float]
    looks: float
    looks_per_sample: float


class Refined(NamedTuple):
    """Result of the fine stage, by pixel.

    Attributes:
        depth: Geometric depth from the volume's first sample [mm].
        std: Its standard deviation [mm].
        contrast: Power below over power above, or of a peak over its ground [dB].
        model: Index in `MODELS`.
        shaded: A-lines of too little power; they are ignored.
    """

    depth: Float[np.ndarray, "ny nx"]
    std: Float[np.ndarray, "ny nx"]
    contrast: Float[np.ndarray, "ny nx"]
    model: Int[np.ndarray, "ny nx"]
    shaded: Bool[np.ndarray, "ny nx"]


def geometry_of(volume: OctVolume, system: OctSystem, average: float) -> Geometry:
    """Measure a search in samples; `average` is the FWHM of the lateral average [mm].

    A surface that is smoothed by G_s, and moved by what an average by G of the profiles along it finds, keeps of white
    noise G / (1 - (1 - G) G_s): `_SURFACE_NOISE` is the integral of its square over that of G².
    """
    dz = float(volume.optical_spacing) / float(system.index)
    widths, looks = [], 1.0
    for spacing, count in zip(np.asarray(volume.spacing)[::-1], volume.shape[:2], strict=True):
        width = average / 2.3548 / spacing if count > 1 else 0.0
        widths.append(width)
        weight = _kernel(width)
        distance = np.subtract.outer(np.arange(weight.size), np.arange(weight.size)) * spacing
        correlation = np.exp(-2.0 * math.log(2.0) * (distance / float(system.lateral_fwhm)) ** 2)
        looks /= float(weight @ correlation @ weight)
    per_sample = dz / float(system.axial_fwhm) * math.sqrt(2.0 * math.log(2.0) / math.pi)
    return Geometry(
        dz, system.axial_std / dz, system.lateral_std, (widths[0], widths[1]), looks, looks * min(per_sample, 1.0)
    )


def refine(
    volume: OctVolume,
    geometry: Geometry,
    surface: Float[np.ndarray, "ny nx"],
    sign: Float[np.ndarray, "ny nx"],
    ignored: Bool[np.ndarray, "ny nx"],
    models: tuple[str, ...],
    lines: DepthLines | None,
    block_rows: int,
) -> Refined:
    """Find the edge near a surface.

    Args:
        volume: The volume.
        geometry: Its lengths.
        surface: Coarse depth [samples].
        sign: 1 where power rises at the edge, -1 where it falls.
        ignored: A-lines that hold no data.
        models: Of `MODELS`, those to choose from.
        lines: Artefact lines.
        block_rows: B-scans that are worked on at once.
    """
    widths = (_SURFACE * geometry.average[0], _SURFACE * geometry.average[1])
    found = Refined(surface, surface, surface, np.zeros(surface.shape, int), ignored)
    # Blocks of one size, nearly: the last must not be a few rows, whose mean profile is mostly speckle.
    ny = surface.shape[0]
    block_rows = math.ceil(ny / math.ceil(ny / block_rows))
    decay: Array | None = None
    for number in range(_PASSES):
        prior = jnp.asarray((geometry.dz / np.array(_PRIORS[min(number, 1)])) ** 2 / geometry.looks, jnp.float32)
        flat = smooth_surface(found.depth, widths, ignored)
        fits, own, decay = _fit_blocks(volume, geometry, flat, sign, ignored, models, lines, block_rows, prior, decay)
        if number == 0:
            shaded = _shaded(own, ignored, geometry)
            ignored = ignored | shaded
        found = _chosen(fits, models, geometry, flat, shaded)
        # Further passes fit what was chosen somewhere.
        models = tuple(name for index, name in enumerate(models) if np.any(found.model == MODELS.index(name)))
    return found._replace(depth=found.depth * geometry.dz, std=found.std * geometry.dz)


def _fit_blocks(volume, geometry, flat, sign, ignored, models, lines, block_rows, prior, known_decay):
    """Fit each model to all A-lines, block by block; maps of each number, and of the power of each A-line.

    Rates of decay are those of the pass before, the mean of all blocks, so that no step runs where two blocks meet; in
    the first pass those of the block itself.
    """
    ny, nx = flat.shape
    spacing = np.asarray(volume.spacing)
    slope = (
        np.hypot(
            *(
                np.gradient(flat, s, axis=a) if flat.shape[a] > 1 else np.zeros_like(flat)
                for a, s in ((0, spacing[1]), (1, spacing[0]))
            )
        )
        * geometry.dz
    )
    width = np.sqrt(geometry.axial**2 + (slope * geometry.lateral / geometry.dz) ** 2)
    half, reach = (round(length / geometry.dz) for length in (_HALF_WINDOW, _REACH))
    kernels = tuple(tuple(_kernel(w).astype(np.float32).tolist()) for w in geometry.average)
    halo, lag = len(kernels[0]) // 2, coupling_lag(geometry.axial)
    own, decays = np.empty((ny, nx)), []
    maps = [[np.empty((ny, nx), np.float32) for _ in EdgeFit._fields] for _ in models]
    for first in range(0, ny, block_rows):
        wanted = np.arange(first, min(first + block_rows, ny))
        around = np.arange(first - halo, first + block_rows + halo)
        rows = np.clip(around, 0, ny - 1)
        counts = np.where((around == rows)[:, None] & ~ignored[rows], 1.0, 0.0).astype(np.float32)
        band, valid = _band(volume, rows, flat[rows], half, lines)
        own[wanted] = band[halo : halo + wanted.size].mean(axis=2)
        profile, weight = _averaged(band, valid, (flat[rows] % 1.0).astype(np.float32), counts, kernels)
        inner = np.clip(np.arange(first, first + block_rows), 0, ny - 1)
        decays.append(_decays(profile, weight, half, geometry.axial))
        decay = decays[-1] if known_decay is None else known_decay
        per_line = [jnp.asarray(field[inner].ravel(), jnp.float32) for field in (width, sign)]
        for fields, model in zip(maps, models, strict=True):
            fit = fit_edges(profile, weight, per_line[0], decay, per_line[1], prior, model, reach, lag)
            for field, value in zip(fields, fit, strict=True):
                field[wanted] = np.asarray(value).reshape(block_rows, nx)[: wanted.size]
        volume.release()
    return [EdgeFit(*fields) for fields in maps], own, jnp.mean(jnp.stack(decays), axis=0)


def _shaded(own, ignored, geometry: Geometry) -> Bool[np.ndarray, "ny nx"]:
    """Find the A-lines in a shadow, whose lateral average would show their neighbours' edge."""
    near, region = (
        gaussian_filter(np.where(ignored, 0.0, own), tuple(scale * width for width in geometry.average), mode="nearest")
        for scale in (_NEAREST, _REGION)
    )
    return near < _SHADE * region


def _band(volume, rows, flat, half, lines):
    """Linear power from one sample more than `half` above the surface to two more below, and where it counts."""
    block = volume.values[rows[0] : rows[-1] + 1]
    start = np.floor(flat).astype(np.int64) - half - 1
    index = start[..., None] + np.arange(2 * half + 4)
    inside = np.clip(index, 0, volume.shape[2] - 1)
    band = power(np.take_along_axis(np.asarray(block)[rows - rows[0]], inside, axis=2), volume.scale)
    valid = (inside == index).astype(np.float32)
    if lines is not None:
        band = np.maximum(band - lines.excess[inside], lines.floor[inside])
        valid *= ~lines.is_line[inside]
    return band, valid


@partial(jax.jit, static_argnames=("kernels",))
def _averaged(band, valid, fraction, counts, kernels):
    """Interpolate profiles so that the surface is in their middle, and average them across; depth comes first.

    Cubic: linear interpolation lifts the flanks of a bright peak, and with a sample on one side moves it by 0.2 µm.
    """
    band, valid = (jnp.moveaxis(field, 2, 0) for field in (band, valid))
    f = fraction
    taps = (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )
    count = band.shape[0] - 3
    profile = taps[0] * band[:count]
    for place, tap in enumerate(taps[1:], start=1):
        profile = profile + tap * band[place : place + count]
    weight = jnp.minimum(valid[1:-2], valid[2:-1]) * counts
    reach = len(kernels[1]) // 2
    total, share = profile * weight, weight
    fields = []
    for field in (total, share):
        across = jnp.pad(field, ((0, 0), (0, 0), (reach, reach)))
        nx = field.shape[2]
        across = _weighted(across, kernels[1], 2, nx)
        rows = field.shape[1] - len(kernels[0]) + 1
        fields.append(_weighted(across, kernels[0], 1, rows))
    total, share = (field.reshape(field.shape[0], -1) for field in fields)
    return jnp.maximum(total / jnp.maximum(share, 1e-6), 0.0), (share > 0.25 * share.max()).astype(jnp.float32)


def _weighted(field: Array, kernel: tuple[float, ...], axis: int, count: int) -> Array:
    total = jnp.float32(kernel[0]) * jax.lax.slice_in_dim(field, 0, count, axis=axis)
    for place, weight in enumerate(kernel[1:], start=1):
        total = total + jnp.float32(weight) * jax.lax.slice_in_dim(field, place, place + count, axis=axis)
    return total


@partial(jax.jit, static_argnames=("half", "axial"))
def _decays(profile: Array, weight: Array, half: int, axial: float) -> Array:
    """Rates that the mean profile of a block grows by above and below the edge [1/sample]; below at most 0."""
    relative = (profile / jnp.maximum(profile.mean(axis=0), 1e-30) * weight).sum(axis=1) / jnp.maximum(
        weight.sum(axis=1), 1e-6
    )
    place = (jnp.arange(profile.shape[0]) - half).astype(jnp.float32)
    known = weight.mean(axis=1) > 0.5
    far = jnp.float32(5.0 * axial)  # the coarse surface may be off by two

    def rate(inside):
        w = jnp.where(inside & known, 1.0, 0.0)
        x = place - (w * place).sum() / jnp.maximum(w.sum(), 1.0)
        return (w * x * jnp.log(jnp.maximum(relative, 1e-12))).sum() / jnp.maximum((w * x**2).sum(), 1.0)

    return jnp.stack([rate(place < -far), jnp.minimum(rate(place > far), 0.0)]).astype(jnp.float32)


def _chosen(fits: list[EdgeFit], models: tuple[str, ...], geometry: Geometry, flat, shaded) -> Refined:
    """Take the likeliest model (Bayesian information criterion over a neighbourhood) at each pixel."""
    unknowns = {"step": 3, "peak": 3, "step and peak": 4}
    neighbourhood = tuple(_SELECTION * width for width in geometry.average)
    samples = 2.0 * _HALF_WINDOW / geometry.dz
    costs = [
        gaussian_filter(geometry.looks_per_sample * fit.loss, neighbourhood, mode="nearest")
        + 0.5 * unknowns[model] * math.log(geometry.looks_per_sample * samples)
        for fit, model in zip(fits, models, strict=True)
    ]
    choice = np.argmin(costs, axis=0)
    fit = EdgeFit(*(np.choose(choice, fields) for fields in zip(*fits, strict=True)))
    # A fit takes as many of the looks of a profile as four numbers: the residual of pure speckle says so.
    free = max(1.0 - 4.0 / (geometry.looks_per_sample / geometry.looks * samples), 0.1)
    texture = gaussian_filter(fit.texture, neighbourhood, mode="nearest") * geometry.looks / free
    noisy = _SURFACE_NOISE[sum(width > 0 for width in geometry.average)]
    correlated = looks_along_depth(geometry.axial, round(_HALF_WINDOW / geometry.dz))
    variance = fit.dispersion * np.clip(texture, 0.6, 4.0) * correlated * noisy
    variance = variance / (geometry.looks * np.maximum(fit.information, 1e-12))
    model = np.array([MODELS.index(name) for name in models])[choice]
    with np.errstate(divide="ignore"):
        contrast = 10.0 * np.log10((fit.below + np.where(model == 1, fit.peak, 0.0)) / fit.above)
    return Refined(flat + fit.shift, np.sqrt(variance), contrast, model, shaded)


def _kernel(width: float) -> np.ndarray:
    reach = math.ceil(_TRUNCATE * width)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(width, 1e-6)) ** 2)
    return weight / weight.sum()
