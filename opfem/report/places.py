"""Where the pixels of a report lie on the layer, so that what is known at nodes can be drawn beside what was measured.

A point of the layer moves sideways; a map shows it where it has moved to, as the microscope sees it.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from ..measurement import ThicknessMap
from ..results.fields import under_pixels

MOST_PIXELS = 256
"""Pixels of a map along one axis: eight maps of that many take 2.5 MB of the page."""
# Of a computed field, which is smooth between nodes: a coarser grid would look like the mesh.
_FEWEST_PIXELS = 101

Axis = Float[np.ndarray, "_"]
Grid = Float[np.ndarray, "_ _"]
At = Float[np.ndarray, "2 _ _"]


class Places(NamedTuple):
    """The pixels that computed fields are drawn on.

    Attributes:
        x: Of image columns [mm].
        y: Of image rows [mm].
        limits: Ends of x and of y [mm], of the whole map.
        stride: Every how many pixels of the map are drawn.
        sample: Row and column, in nodes, of the point of the interface under each pixel; NaN off the layer.
        window: The same of the face at the window.
    """

    x: Axis
    y: Axis
    limits: tuple[tuple[float, float], tuple[float, float]]
    stride: int
    sample: At
    window: At


def find_places(dataset: xr.Dataset, measured: ThicknessMap | None) -> Places:
    """Choose the pixels, those of the map where they are neither too many nor too few, and find the layer under them.

    Args:
        dataset: What `to_xarray` returned.
        measured: The measured map; None takes the grid of the solution's load.
    """
    axes = (dataset["x_image"], dataset["y_image"]) if measured is None else (measured.x, measured.y)
    stride = max(1, int(np.ceil(max(len(axis) for axis in axes) / MOST_PIXELS)))
    x, y = (_axis(np.asarray(axis), stride) for axis in axes)
    u = dataset["displacement"].transpose("component", "z", "y", "x").values
    limits = ((float(axes[0][0]), float(axes[0][-1])), (float(axes[1][0]), float(axes[1][-1])))
    return Places(x, y, limits, stride, _under(dataset, u[:2, -1], x, y), _under(dataset, u[:2, 0], x, y))


def at_places(nodal: np.ndarray, at: At) -> Grid:
    """Read a field between nodes, bilinearly; NaN off the layer.

    Args:
        nodal: Values at the nodes (my, mx).
        at: `Places.sample` or `Places.window`.
    """
    return _read(nodal, at, 1)


def nearest(nodal: np.ndarray, at: At) -> Grid:
    """Read a field of whole numbers at the nearest node; NaN off the layer.

    Args:
        nodal: Values at the nodes (my, mx).
        at: `Places.sample` or `Places.window`.
    """
    return _read(nodal, at, 0)


def _read(nodal: np.ndarray, at: At, order: int) -> Grid:
    values = map_coordinates(np.asarray(nodal, float), np.nan_to_num(at), order=order, mode="nearest")
    return np.where(np.isfinite(at[0]), values, np.nan)


def _axis(axis: np.ndarray, stride: int) -> Axis:
    if stride > 1 or axis.size >= _FEWEST_PIXELS:
        return axis[::stride]
    finer = int(np.ceil((_FEWEST_PIXELS - 1) / (axis.size - 1)))
    return np.linspace(axis[0], axis[-1], finer * (axis.size - 1) + 1)


def _under(dataset: xr.Dataset, lateral: np.ndarray, x: Axis, y: Axis) -> At:
    reference = np.stack(np.meshgrid(dataset["x"].values, dataset["y"].values))
    numbers = np.indices(reference.shape[1:]).astype(float)
    xs, ys = np.meshgrid(x, y)
    return np.stack([under_pixels(number, reference, lateral, xs, ys) for number in numbers])
