"""Artefact lines at constant depth: autocorrelation, outer faces of the window, a camera's fixed pattern.

First step of `find_interface`. Lines are what a grey opening removes of the median depth profiles of a map's tiles,
at one depth in all of them: an interface is rarely flat to a micrometre. The mean B-scan is
never subtracted: over a flat layer the interface itself is constant in depth, and would go with it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, grey_opening, label

_WIDTH = 4.0  # axial FWHM: what is narrower is a line; an edge is a step, which an opening keeps
_ABOVE = 1.3  # times the profile without lines: twice the scatter of a median over 100 A-lines
_TILES = 6  # along each side of a map
_SPREAD = 0.12  # axial FWHM: standard deviation from tile to tile above which a peak is no line but an interface
_FLOOR = 0.05  # of the profile without lines, which what is left of a line is kept above
_PROFILES = 20_000  # A-lines that the profile is the median of: its scatter is then 1 %


class DepthLines(NamedTuple):
    """Artefact lines of a volume, by samples in depth.

    Attributes:
        excess: Power that lines add.
        floor: Power that a sample keeps at least.
        is_line: Samples that hold no information on the interface.
    """

    excess: Float[np.ndarray, " nz"]
    floor: Float[np.ndarray, " nz"]
    is_line: Bool[np.ndarray, " nz"]


def profile_lattice(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Choose evenly spaced rows and columns of A-lines to take the depth profile from."""
    ny, nx = shape[:2]
    # Whole rows are read from a file, so few rows and many columns.
    rows = slice(None, None, max(1, ny // 40))
    columns = slice(None, None, max(1, nx * min(ny, 40) // _PROFILES))
    return rows, columns


def find_lines(power: Float[np.ndarray, "rows columns nz"], fwhm: float) -> DepthLines | None:
    """Find artefact lines in the median depth profiles of the tiles of a map.

    Args:
        power: Linear power of A-lines from all over the volume.
        fwhm: Axial FWHM [samples].

    Returns:
        The lines; None where there are none.
    """
    tiles = [
        tile
        for rows in np.array_split(power, min(_TILES, power.shape[0]), axis=0)
        for tile in np.array_split(rows, min(_TILES, rows.shape[1]), axis=1)
    ]
    profiles = np.stack([np.median(tile, axis=(0, 1)) for tile in tiles])
    bases = grey_opening(profiles, size=(1, max(3, round(_WIDTH * fwhm))), mode="nearest")
    excess = np.median(profiles - _ABOVE * bases, axis=0)
    runs = np.asarray(label(excess > 0)[0])  # pyright: ignore[reportIndexIssue]
    for run in range(1, runs.max() + 1):
        near = binary_dilation(runs == run, iterations=max(1, round(fwhm)))
        if _scatter(np.where(near, np.maximum(profiles - bases, 0.0), 0.0)) > _SPREAD * fwhm:
            excess[runs == run] = 0.0
    profile, base = np.median(profiles, axis=0), np.median(bases, axis=0)
    if not (excess > 0).any():
        return None
    is_line = binary_dilation(excess > 0, iterations=max(1, round(fwhm)))
    # The median of a line is its power, that of speckle ln 2 of it.
    return DepthLines(
        np.where(is_line, np.maximum(profile - base, 0.0), 0.0).astype(np.float32),
        (_FLOOR * base).astype(np.float32),
        is_line,
    )


def _scatter(heights: Float[np.ndarray, "tiles nz"]) -> float:
    """Robust standard deviation of the centroids of a peak in several profiles [samples]."""
    weight = heights.sum(axis=1)
    centroids = (heights @ np.arange(heights.shape[1]))[weight > 0] / weight[weight > 0]
    return 1.4826 * float(np.median(np.abs(centroids - np.median(centroids)))) if centroids.size else 0.0


def without_lines(power: Float[np.ndarray, "*shape nz"], lines: DepthLines | None) -> Float[np.ndarray, "*shape nz"]:
    """Take the power of lines from A-lines."""
    return power if lines is None else np.maximum(power - lines.excess, lines.floor)
