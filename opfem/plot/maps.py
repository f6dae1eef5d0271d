"""Maps of pressure in kPa, thickness in µm, compression in % and contact status, as MATLAB's imagesc shows them.

Edge of the chain. Row 0 of a map is at the top, so y grows downwards and x to the right; x and y have the same scale.
On every map pixels without data and places where nothing touches are hatched, and contact is outlined. Without `ax` a
picture is pyplot's, as in pandas: notebooks show it by themselves, a script calls `matplotlib.pyplot.show()` or
`ax.figure.savefig`.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from ..measurement import ThicknessMap
from ..results import TractionFit
from . import layout
from .drawing import (
    DIVERGING,
    Data,
    Drawn,
    draw_compression,
    draw_pressure,
    draw_residual,
    draw_status,
    draw_uncertainty,
)

_UM = 1e3


def plot_pressure(
    data: Data,
    ax: Axes | None = None,
    *,
    window: bool = False,
    vmax: float | None = None,
    cmap: str = "viridis",
    measured: ThicknessMap | None = None,
) -> Axes:
    """Draw the contact pressure [kPa] where it acts, on the current positions of the interface.

    Args:
        data: A solution or a fit, or its dataset.
        ax: Axes to draw on; None makes a figure.
        window: Draw the pressure at the window instead of at the sample; positions stay those of the interface.
        vmax: Pressure at the upper end of the colours [kPa]; None takes the largest.
        cmap: Name of the colour map; the default brightens with pressure and so reads in grey.
        measured: Map whose missing pixels are hatched; None takes the map that was pressed in.

    Raises:
        ValueError: For a failed solution, which has no pressure.
    """
    drawn = Drawn(data, measured)
    ax = layout.single(ax, drawn.limits)
    draw_pressure(drawn, ax, window, vmax, cmap)
    return layout.key(ax)


def plot_compression(
    data: Data,
    ax: Axes | None = None,
    *,
    vmax: float | None = None,
    cmap: str = "viridis",
    measured: ThicknessMap | None = None,
) -> Axes:
    """Draw the compression of the layer, 1 - L1/L0 [%], on the pixels of the map; negative where it bulges.

    Args:
        data: A solution or a fit, or its dataset.
        ax: Axes to draw on; None makes a figure.
        vmax: Compression at the upper end of the colours [%]; None takes the largest.
        cmap: Name of the colour map; the default brightens with compression and so reads in grey.
        measured: Map whose pixels are taken; None takes those of the load.

    Raises:
        ValueError: For a failed solution.
    """
    drawn = Drawn(data, measured)
    ax = layout.single(ax, drawn.limits)
    draw_compression(drawn, ax, vmax, cmap)
    return layout.key(ax)


def plot_status(data: Data, ax: Axes | None = None, *, window: bool = False) -> Axes:
    """Draw where the layer is open, sticks or slips, on the current positions of the interface.

    The key beside it names the states and their current areas.

    Args:
        data: A solution or a fit, or its dataset.
        ax: Axes to draw on; None makes a figure.
        window: Draw the status at the window instead of at the sample; positions stay those of the interface.

    Raises:
        ValueError: For a failed solution, which has no status.
    """
    drawn = Drawn(data)
    ax = layout.single(ax, drawn.limits)
    draw_status(drawn, ax, window)
    return layout.key(ax)


def plot_thickness(
    thickness: ThicknessMap, ax: Axes | None = None, *, label: str = "Thickness [µm]", cmap: str = "viridis"
) -> Axes:
    """Draw a thickness map [µm]; pixels without data are hatched grey, also where they hold a fill.

    Args:
        thickness: Map to draw.
        ax: Axes to draw on; None makes a figure.
        label: Label of the colour bar.
        cmap: Name of the colour map.
    """
    x, y, missing = np.asarray(thickness.x), np.asarray(thickness.y), np.asarray(thickness.mask)
    ax = layout.single(ax, layout.pixel_limits(x, y))
    layout.image(np.where(missing, np.nan, _UM * np.asarray(thickness.values)), x, y, ax, label, cmap)
    layout.hatch_missing(ax, missing, x, y)
    return layout.key(ax)


def plot_residual(
    data: Data, measured: ThicknessMap | None = None, ax: Axes | None = None, *, cmap: str = DIVERGING
) -> Axes:
    """Draw measured less computed thickness [µm]; what is open is left out, since an air gap is no misfit.

    Colours are even about zero and span the 99.5th percentile of the size.

    Args:
        data: A solution or a fit, or its dataset.
        measured: Measured map; None takes the map that was pressed in.
        ax: Axes to draw on; None makes a figure.
        cmap: Name of the colour map.

    Raises:
        ValueError: For a failed solution, or where there is no map to compare with.
    """
    drawn = Drawn(data, measured)
    ax = layout.single(ax, drawn.limits)
    draw_residual(drawn, ax, cmap)
    return layout.key(ax)


def plot_uncertainty(
    data: TractionFit | xr.Dataset,
    ax: Axes | None = None,
    *,
    vmax: float | None = None,
    cmap: str = "cividis",
    measured: ThicknessMap | None = None,
) -> Axes:
    """Draw the posterior standard deviation of the pressure [kPa] where it acts.

    Circles are as wide as the fit resolves there.

    Args:
        data: A traction fit, or its dataset.
        ax: Axes to draw on; None makes a figure.
        vmax: Standard deviation at the upper end of the colours [kPa]; None takes the largest.
        cmap: Name of the colour map.
        measured: Map whose missing pixels are hatched; None hatches none.

    Raises:
        ValueError: For a failed fit.
    """
    drawn = Drawn(data, measured)
    ax = layout.single(ax, drawn.limits)
    draw_uncertainty(drawn, ax, vmax, cmap)
    return layout.key(ax)
