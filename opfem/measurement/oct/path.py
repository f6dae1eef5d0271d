"""Coarse stage of `find_interface`: the smooth surface along which a volume's depth gradient is largest.

The cost of a depth is the Gaussian derivative of the power in dB; semi-global matching (dynamic programming along four
directions, summed) finds a surface of bounded slope on a grid of cells that are as wide as the later average.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates, median_filter

_STRONGEST = 6.0  # standard deviations of the gradient: a bright speck counts no more than a clear edge
# Per cell of depth that neighbours differ by: of a surface itself, and of its residual along a first surface. Steep
# surfaces of 3 dB are lost at 0.3 (standard deviation of the error 6.0 µm, 4.6 at 0.1), noise is followed below.
_PENALTIES = (0.1, 0.3)
_ROUNDS = 2  # of averaging along the surface found before: a third changes nothing at 3 dB
_TRUNCATE = 3.0  # standard deviations that a smoothing kernel reaches


class Cells(NamedTuple):
    """Grid of the coarse stage: how many samples of the volume a cell averages.

    Attributes:
        rows: Along y.
        columns: Along x.
        levels: Along depth.
    """

    rows: int
    columns: int
    levels: int


class Filter(NamedTuple):
    """The Gaussian whose derivative along depth finds an edge.

    Attributes:
        across: Standard deviations along y and x [cells].
        depth: Standard deviation along depth [cells].
        order: 1 for steps; 2 for peaks, which minus the second derivative finds.
    """

    across: tuple[float, float]
    depth: float
    order: int


class CoarsePath(NamedTuple):
    """A surface through the cells.

    Attributes:
        depth: Index of its cell in depth, with a fraction.
        strength: Gradient on it over the gradient's noise.
    """

    depth: Float[np.ndarray, "cy cx"]
    strength: Float[np.ndarray, "cy cx"]


def cell_means(power: Float[np.ndarray, "ny nx nz"], cells: Cells) -> Float[np.ndarray, "cy cx cz"]:
    """Average power over cells; the last cell of an axis averages what is left for it."""
    for axis, size in enumerate(cells):
        if size == 1:
            continue
        starts = np.arange(0, power.shape[axis], size)
        counts = np.diff(np.append(starts, power.shape[axis])).astype(np.float32)
        shape = [1, 1, 1]
        shape[axis] = -1
        power = np.add.reduceat(power, starts, axis=axis) / counts.reshape(shape)
    return power


def coarse_path(
    decibels: Float[np.ndarray, "cy cx cz"],
    edge: Filter,
    sign: int,
    slopes: tuple[float, float],
    reach: int,
    outside: Bool[np.ndarray, "cy cx cz"] | None = None,
) -> CoarsePath:
    """Find the smooth surface along which `sign` times the depth gradient is largest.

    The lateral average smears a steep edge, so that a second and third search average along the surface that the one
    before has found.

    Args:
        decibels: Power of cells [dB].
        edge: What to filter by.
        sign: 1 where power rises with depth, or at a peak; -1 where it falls.
        slopes: Largest difference between neighbouring cells along y and x [cells].
        reach: Largest distance of the other surfaces from the first [cells].
        outside: Cells that are not searched.
    """
    gradient = _gradient(decibels.copy(), edge)
    if outside is not None:
        gradient[outside] = 0.0
    path = _smoothest(gradient, sign, slopes, _PENALTIES[0])
    del gradient
    for _ in range(_ROUNDS):
        base = np.rint(smooth_surface(median_filter(path.depth, 5), (2.0, 2.0))).astype(np.int64) - reach
        index = np.clip(base[..., None] + np.arange(2 * reach + 1), 0, decibels.shape[2] - 1)
        gradient = _gradient(np.take_along_axis(decibels, index, axis=2), edge)
        if outside is not None:
            gradient[np.take_along_axis(outside, index, axis=2)] = 0.0
        path = _smoothest(gradient, sign, (0.5 * slopes[0], 0.5 * slopes[1]), _PENALTIES[1])
        path = path._replace(depth=np.clip(base + path.depth, 0, decibels.shape[2] - 1))
    return path


def surface_confidence(
    decibels: Float[np.ndarray, "cy cx cz"],
    depth: Float[np.ndarray, "cy cx"],
    edge: Filter,
    sign: int,
    block: int,
    outside: Bool[np.ndarray, "cy cx cz"] | None = None,
) -> Float[np.ndarray, "by bx"]:
    """Compute the posterior probability of a surface against the best parallel one, in square blocks of cells.

    Blocks are averaged along the surface. A gradient t times its noise is exp(t²/2) times as likely to be an edge.

    Args:
        decibels: Power of cells [dB].
        depth: The surface [cells].
        edge: What to filter by.
        sign: 1 where power rises at the surface, -1 where it falls.
        block: Cells along the side of a block.
        outside: Cells that are not searched.
    """
    cy, cx, cz = decibels.shape
    columns = np.arange(0, cx, block)
    counts = np.diff(np.append(columns, cx))[:, None]
    offsets = np.arange(2 * cz - 1) - (cz - 1)
    profiles, known = [], []
    for first in range(0, cy, block):
        rows = slice(first, min(first + block, cy))
        index = np.rint(depth[rows]).astype(np.int64)[..., None] + offsets
        inside = (index >= 0) & (index < cz)
        index = np.clip(index, 0, cz - 1)
        if outside is not None:
            inside &= ~np.take_along_axis(outside[rows], index, axis=2)
        values = np.take_along_axis(decibels[rows], index, axis=2).mean(axis=0)
        profiles.append(np.add.reduceat(values, columns, axis=0) / counts)
        known.append(np.add.reduceat(inside.mean(axis=0), columns, axis=0) / counts > 0.5)
    # Beyond 3 standard deviations of the filter the surface's own gradient is over.
    apart = np.abs(offsets) > 3.0 * edge.depth
    gradient = sign * _gradient(np.stack(profiles), edge._replace(across=(0.0, 0.0)), np.stack(known))
    chosen = np.maximum(gradient[..., np.abs(offsets) <= edge.depth].max(axis=2), 0.0)
    rival = np.maximum(np.where(apart & np.stack(known), gradient, 0.0).max(axis=2), 0.0)
    return 1.0 / (1.0 + np.exp(np.clip(0.5 * (rival**2 - chosen**2), -50.0, 50.0)))


def _gradient(
    decibels: Float[np.ndarray, "cy cx cz"], edge: Filter, known: Bool[np.ndarray, "cy cx cz"] | None = None
) -> Float[np.ndarray, "cy cx cz"]:
    """Filter along depth, in units of the noise; the input is overwritten."""
    for axis, width in enumerate(edge.across):
        if width > 0 and decibels.shape[axis] > 1:
            gaussian_filter1d(decibels, width, axis=axis, output=decibels, mode="mirror", truncate=_TRUNCATE)
    gaussian_filter1d(
        decibels, edge.depth, axis=2, order=edge.order, output=decibels, mode="nearest", truncate=_TRUNCATE
    )
    # Most of a volume is far from the interface, so that its median size is that of noise.
    sample = np.abs(decibels if known is None else decibels[known])
    noise = max(float(np.median(sample[:: max(1, sample.shape[0] // 64)])) / 0.6745, 1e-6)
    decibels /= np.float32(noise if edge.order == 1 else -noise)
    return decibels


def _smoothest(
    gradient: Float[np.ndarray, "cy cx cz"], sign: int, slopes: tuple[float, float], penalty: float
) -> CoarsePath:
    """Find the surface by semi-global matching."""
    scale = float(gradient[:: max(1, gradient.shape[0] // 64)].std()) + 1e-12
    cost = np.clip(gradient * np.float32(-sign / scale), -_STRONGEST, 0.0)
    total = _aggregated(cost, slopes, penalty)
    index = np.argmin(total, axis=2)
    return CoarsePath(index + _vertex(total, index), sign * _at(gradient, index))


def smooth_surface(
    surface: Float[np.ndarray, "ny nx"],
    widths: tuple[float, float],
    ignored: Bool[np.ndarray, "ny nx"] | None = None,
) -> Float[np.ndarray, "ny nx"]:
    """Smooth a surface by lines fitted with Gaussian weights, along y and x: a Gaussian that keeps slopes at the edges.

    Args:
        surface: Depths.
        widths: Standard deviations along y and x [samples].
        ignored: Samples that count for nothing.
    """
    if ignored is not None and ignored.any():
        weight = np.where(ignored, 1e-6, 1.0)
        filled = gaussian_filter(surface * weight, widths) / gaussian_filter(weight, widths)
        surface = np.where(ignored, filled, surface)
    along_y, along_x = (_local_lines(count, width) for count, width in zip(surface.shape, widths, strict=True))
    return along_y @ surface @ along_x.T


def _local_lines(count: int, width: float) -> Float[np.ndarray, "count count"]:
    """Matrix that takes samples to the values of the lines fitted about each of them."""
    if width <= 0 or count < 3:
        return np.eye(count)
    distance = np.subtract.outer(np.arange(count), np.arange(count)).astype(float)
    weight = np.exp(-0.5 * (distance / width) ** 2)
    zeroth, first, second = (np.sum(weight * distance**power, axis=1, keepdims=True) for power in range(3))
    return weight * (second - first * distance) / (zeroth * second - first**2)


def _aggregated(cost: Float[np.ndarray, "cy cx cz"], slopes: tuple[float, float], penalty: float) -> np.ndarray:
    """Sum of the costs of the best paths that come to each cell from four sides."""
    along_x, along_y = cost.swapaxes(0, 1), cost

    def both_ways(lines: np.ndarray, reach: float) -> np.ndarray:
        # The cell's own cost is in every path: counted once in the sum of four.
        total = -1.5 * lines
        for backward in (False, True):
            _add_paths(lines, int(np.ceil(reach)), np.float32(penalty), backward, total)
        return total

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(both_ways, along_x, slopes[1])
        second = pool.submit(both_ways, along_y, slopes[0])
        total = second.result()
        total += first.result().swapaxes(0, 1)
    return total


def _add_paths(cost: np.ndarray, reach: int, penalty: np.float32, backward: bool, total: np.ndarray) -> None:
    """Add D_i(k) = c_i(k) + min over |o| <= reach of [D_{i-1}(k+o) + P|o|] - min D_{i-1} of one direction."""
    order = range(cost.shape[0])[::-1] if backward else range(cost.shape[0])
    best = np.zeros(cost.shape[1:], np.float32)
    raised = np.empty_like(best)
    for index in order:
        best -= best.min(axis=1, keepdims=True)
        for _ in range(reach):
            np.add(best, penalty, out=raised)
            stepped = best.copy()
            np.minimum(stepped[:, 1:], raised[:, :-1], out=stepped[:, 1:])
            np.minimum(stepped[:, :-1], raised[:, 1:], out=stepped[:, :-1])
            best = stepped
        best += cost[index]
        total[index] += best


def _at(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    return np.take_along_axis(values, index[..., None], axis=2)[..., 0]


def _vertex(total: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Offset of the minimum of the parabola through a cell and its neighbours in depth, at most half a cell."""
    inner = np.clip(index, 1, total.shape[2] - 2)
    low, mid, high = (_at(total, inner + step) for step in (-1, 0, 1))
    bend = low - 2.0 * mid + high
    offset = np.where(bend > 0, 0.5 * (low - high) / np.where(bend > 0, bend, 1.0), 0.0)
    return np.where(inner == index, np.clip(offset, -0.5, 0.5), 0.0)


def to_pixels(
    cell_values: Float[np.ndarray, "cy cx"], cells: Cells, shape: tuple[int, int]
) -> Float[np.ndarray, "ny nx"]:
    """Interpolate values at cells' centres bilinearly at the volume's A-lines; beyond the edge cells they continue."""
    places = [
        np.clip((np.arange(count) - 0.5 * (size - 1)) / size, 0, number - 1)
        for count, size, number in zip(shape, cells[:2], cell_values.shape, strict=True)
    ]
    grid = np.meshgrid(*places, indexing="ij")
    return map_coordinates(cell_values.astype(np.float64), grid, order=1, mode="nearest")
