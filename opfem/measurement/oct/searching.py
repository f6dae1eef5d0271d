"""The search for an interface, from the volume's samples to maps: lines, coarse surface, fine fit, confidence.

`find_interface` checks what it is given, runs this, and decides which pixels to believe.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter

from ..filtering import FWHM_PER_STD
from ..thickness import Step
from .edge import MODELS
from .lines import DepthLines, find_lines, profile_lattice, without_lines
from .path import Cells, CoarsePath, Filter, cell_means, coarse_path, surface_confidence, to_pixels
from .refining import NOISE_WIDTH, Geometry, geometry_of, refine
from .system import OctSystem
from .volume import OctVolume, power

EDGES = ("brighter", "darker", "peak", "brighter and peak", "darker and peak")
"""What `Interface.edge` counts: how the sample's side differs from the layer's, and whether it reflects."""

CONTRAST = 1.5
"""Contrast [dB] that an edge has at least; an average of 30 A-lines and 5 resolutions of speckle scatters by 0.5 dB."""

_FILTER = 1.25  # axial FWHM: standard deviation of the coarse filter along depth; 1 and 1.5 lose more edges of 3 dB
_PEAK_FILTER = 0.6
_REACH = 0.06  # mm that the coarse surface is looked for away from the first one
_MOST_MOVED = 0.02  # mm that the fine stage may move the coarse surface by
_MOST_CELLS = 150_000_000  # cells of the coarse stage: three float32 arrays of this size are 1.8 GB
_BLOCK = 6  # cells: side of the blocks that confidence is computed for, some 0.15 mm
_PREFERENCE = 1.5  # ratio of squared strengths from which a neighbourhood has the other polarity than the whole
_NEIGHBOURHOOD = 4.0  # cells: standard deviation of that neighbourhood
_CLIPPED = 0.01  # share of samples at the lowest value from which a volume in dB counts as clipped


class Search(NamedTuple):
    """Settings of the search; see `find_interface`."""

    edge: str
    search: tuple[Any, float | None]
    max_slope: float
    average: float
    background: OctVolume | None
    ignored: Bool[np.ndarray, "ny nx"]
    block_rows: int


class Found(NamedTuple):
    """Result at every pixel; lengths in mm."""

    depth: Float[np.ndarray, "ny nx"]
    std: Float[np.ndarray, "ny nx"]
    confidence: Float[np.ndarray, "ny nx"]
    contrast: Float[np.ndarray, "ny nx"]
    edge: Int[np.ndarray, "ny nx"]
    moved: Bool[np.ndarray, "ny nx"]
    at_bound: Bool[np.ndarray, "ny nx"]
    shaded: Bool[np.ndarray, "ny nx"]
    bounds: tuple[float, float]
    noise_db: float
    noise_length: float


def search_volume(volume: OctVolume, system: OctSystem, options: Search) -> tuple[Found, tuple[Step, ...]]:
    """Find the interface at every pixel."""
    geometry = geometry_of(volume, system, options.average)
    lowest, levels = _depths(volume, geometry, options.search)
    rows, columns = profile_lattice(volume.shape)
    some = power(volume.values[rows, columns], volume.scale)
    lines, clipped = _lines(some, system, geometry, options), _clipped_share(some, volume.scale)
    cells = _cells(volume.shape, geometry, levels)
    decibels = _cell_decibels(volume, cells, levels, lines, options.block_rows)
    outside = _outside(decibels.shape, cells, levels, lowest, options.ignored)
    path, sign, confidence = _coarse(decibels, geometry, cells, options, volume, outside)
    del decibels, outside
    shape = volume.shape[:2]
    coarse = levels.start + to_pixels((path.depth + 0.5) * cells.levels - 0.5, cells, shape)
    signs = np.where(to_pixels(sign.astype(float), cells, shape) > 0, 1.0, -1.0)
    models = {"auto": MODELS, "peak": MODELS[1:]}.get(options.edge, MODELS[:1])
    fine = refine(volume, geometry, coarse, signs, options.ignored, models, lines, options.block_rows)
    origin = float(volume.depth_origin) / float(system.index)
    deep = fine.depth / geometry.dz
    margin = 2.0 * geometry.axial
    first = levels.start if lowest is None else lowest
    # The dark level of a clipped volume is not its own.
    std = fine.std * (2.0 if clipped > _CLIPPED else 1.0)
    found = Found(
        depth=origin + fine.depth,
        std=std,
        confidence=np.clip(to_pixels(confidence, Cells(cells.rows * _BLOCK, cells.columns * _BLOCK, 1), shape), 0, 1),
        contrast=fine.contrast,
        edge=np.where(fine.model == 1, 2, np.where(fine.contrast > 0, 0, 1) + np.where(fine.model == 2, 3, 0)),
        moved=np.abs(deep - coarse) * geometry.dz > _MOST_MOVED,
        at_bound=(deep < first + margin) | (deep > levels.stop - 1 - margin),
        shaded=fine.shaded,
        bounds=(origin + levels.start * geometry.dz, origin + (levels.stop - 1) * geometry.dz),
        noise_db=10.0 * math.log10(max(float(np.quantile(some, 0.05)) / 0.05, 1e-30)),
        noise_length=math.hypot(NOISE_WIDTH * options.average, float(system.lateral_fwhm)),
    )
    steps = [Step("find_interface", index=float(system.index), average=options.average, max_slope=options.max_slope)]
    if lines is not None:
        steps.append(Step("lines", depth=origin + geometry.dz * np.flatnonzero(lines.is_line)))
    if clipped > _CLIPPED:
        steps.append(Step("clipped", share=clipped))
    return found, tuple(steps)


def _depths(volume: OctVolume, geometry: Geometry, search) -> tuple[np.ndarray | None, slice]:
    """Find the first sample to search of each A-line, where they differ, and those of the whole volume."""
    low, high = search
    nz = volume.shape[2]
    origin = float(volume.depth_origin) * geometry.dz / float(volume.optical_spacing)
    first = (np.asarray(low, float) - origin) / geometry.dz
    last = nz if high is None else (high - origin) / geometry.dz
    levels = slice(int(np.clip(np.ceil(first.min()), 0, nz)), int(np.clip(math.floor(last) + 1, 0, nz)))
    if levels.stop - levels.start < 8:
        end = origin + nz * geometry.dz
        raise ValueError(
            f"find_interface.search [mm] must keep at least 8 samples of {origin:.3g} to {end:.3g} mm (geometric), "
            f"got ({float(np.min(low)):g}, {high})."
        )
    return (None if first.ndim == 0 else first), levels


def _lines(some, system: OctSystem, geometry: Geometry, options: Search) -> DepthLines | None:
    if options.background is not None:
        profile = power(options.background.values, options.background.scale).mean(axis=(0, 1))
        if profile.size != some.shape[2]:
            raise ValueError(
                f"find_interface.background has {profile.size} samples in depth, the volume {some.shape[2]}."
            )
        floor = (0.05 * np.median(some, axis=(0, 1))).astype(np.float32)
        return DepthLines(profile.astype(np.float32), floor, np.zeros(profile.size, bool))
    # A level reflecting interface is itself a line.
    return None if options.edge == "peak" else find_lines(some, FWHM_PER_STD * geometry.axial)


def _clipped_share(some, scale: str) -> float:
    return float(np.mean(some == some.min())) if scale == "db" else 0.0


def _cells(shape, geometry: Geometry, levels: slice) -> Cells:
    """Cells some widths of the lateral average wide, larger where memory is short."""
    rows, columns = (max(1, int(width)) for width in geometry.average)
    depth = max(1, int(0.5 * FWHM_PER_STD * geometry.axial))
    while (shape[0] / rows) * (shape[1] / columns) * (levels.stop - levels.start) / depth > _MOST_CELLS:
        rows, columns = rows + (shape[0] > 1), columns + 1
    return Cells(rows, columns, depth)


def _cell_decibels(volume: OctVolume, cells: Cells, levels: slice, lines, block_rows: int):
    """Average the power of cells, in dB, block by block."""
    cut = None if lines is None else DepthLines(*(field[levels] for field in lines))
    step = max(1, block_rows // cells.rows) * cells.rows
    parts = []
    for first in range(0, volume.shape[0], step):
        block = power(volume.values[first : first + step, :, levels], volume.scale)
        means = cell_means(without_lines(block, cut), cells)
        parts.append(np.log10(np.maximum(means, np.float32(1e-30))) * np.float32(10.0))
        volume.release()
    return np.concatenate(parts)


def _outside(shape, cells: Cells, levels: slice, lowest, ignored):
    """Cells that are masked, or above the first depth of their A-lines; None where there are none."""
    if lowest is None and not ignored.any():
        return None
    outside = cell_means(ignored[..., None].astype(np.float32), cells._replace(levels=1)) > 0.5
    outside = np.broadcast_to(outside, shape).copy()
    if lowest is not None:
        first = cell_means(lowest[..., None], cells._replace(levels=1))
        outside |= levels.start + (np.arange(shape[2]) + 0.5) * cells.levels < first
    return outside


def _coarse(decibels, geometry: Geometry, cells: Cells, options: Search, volume: OctVolume, outside):
    """Find the coarse surface, the sign of its edge, and how sure it is; of two signs the stronger in each place."""
    across = tuple(
        math.sqrt(max(width**2 - (size**2 - 1) / 12.0, 0.0)) / size
        for width, size in zip(geometry.average, cells, strict=False)
    )
    is_peak = options.edge == "peak"
    fwhm = FWHM_PER_STD * geometry.axial / cells.levels
    edge = Filter((across[0], across[1]), (_PEAK_FILTER if is_peak else _FILTER) * fwhm, 2 if is_peak else 1)
    dx, dy = np.asarray(volume.spacing)
    steepest = options.max_slope / (geometry.dz * cells.levels)
    slopes = (float(steepest * dy * cells.rows), float(steepest * dx * cells.columns))
    reach = math.ceil(_REACH / (geometry.dz * cells.levels))
    signs = {"darker": (-1,), "auto": (1, -1)}.get(options.edge, (1,))
    paths = [coarse_path(decibels, edge, sign, slopes, reach, outside) for sign in signs]
    sure = [
        surface_confidence(decibels, path.depth, edge, sign, _BLOCK, outside)
        for path, sign in zip(paths, signs, strict=True)
    ]
    if len(paths) == 1:
        return paths[0], np.full(paths[0].depth.shape, signs[0]), sure[0]
    strength = [gaussian_filter(np.maximum(path.strength, 0.0) ** 2, _NEIGHBOURHOOD) for path in paths]
    main = 0 if strength[0].mean() >= strength[1].mean() else 1
    other = strength[1 - main] > _PREFERENCE * strength[main]
    path = CoarsePath(*(np.where(other, b, a) for a, b in zip(paths[main], paths[1 - main], strict=True)))
    by_block = cell_means(other[..., None].astype(np.float32), Cells(_BLOCK, _BLOCK, 1))[..., 0] > 0.5
    return path, np.where(other, -signs[main], signs[main]), np.where(by_block, sure[1 - main], sure[main])
