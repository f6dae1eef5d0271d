"""Pages of maps: what a palpation, a fit or a virtual experiment rests on, with the numbers that judge it.

Edge of the chain. All maps of a page show the same part of the layer and are aligned.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..measurement import ThicknessMap
from ..results import TractionFit, residual_rms
from . import layout
from .drawing import (
    Data,
    Drawn,
    draw_compression,
    draw_pressure,
    draw_residual,
    draw_significance,
    draw_status,
    draw_thickness,
    draw_uncertainty,
)
from .maps import plot_pressure

_UM = 1e3
_MAPS = {"report.png": 6, "fit.png": 8}


def plot_report(data: Data, measured: ThicknessMap | None = None, figure: Figure | None = None) -> np.ndarray:
    """Draw what a palpation rests on: thickness, compression, pressure, residual, contact with sample and window.

    Args:
        data: A solution under `Imprint`, or its dataset.
        measured: Measured map; None takes the map that was pressed in.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The six axes.

    Raises:
        ValueError: For a failed solution, or where there is no map to compare with.
    """
    drawn = Drawn(data, measured)
    panels = {
        "Thickness pressed in" if measured is None else "Measured thickness": partial(draw_thickness, drawn),
        "Compression": partial(draw_compression, drawn),
        f"Pressure at the sample, {_force(drawn)}": partial(draw_pressure, drawn),
        f"Residual, {_UM * residual_rms(drawn.pixels):.2g} µm rms": partial(draw_residual, drawn),
        "Contact at the sample": partial(draw_status, drawn),
        "Contact at the window": partial(draw_status, drawn, window=True),
    }
    return layout.draw_page(panels, drawn.limits, figure)


def plot_fit(
    data: TractionFit | xr.Dataset, measured: ThicknessMap | None = None, figure: Figure | None = None
) -> np.ndarray:
    """Draw what a traction fit found: pressure, its uncertainty and resolution, what it misses, what was measured.

    Args:
        data: A traction fit of one map, or its dataset.
        measured: The measured map; None: the computed thickness is drawn in its place, and no residual.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The eight axes; seven without a measured map.

    Raises:
        ValueError: For a failed fit.
    """
    drawn = Drawn(data, measured)
    width = _UM * np.median(drawn.dataset["resolution_width"].values)
    chi2 = f"χ²/dof {float(drawn.dataset['reduced_chi2']):.2f}"
    panels = {
        "Computed thickness" if measured is None else "Measured thickness": partial(draw_thickness, drawn),
        "Compression": partial(draw_compression, drawn),
        f"Fitted pressure, {_force(drawn)}": partial(draw_pressure, drawn),
        f"Uncertainty; resolution {width:.0f} µm": partial(draw_uncertainty, drawn),
        "Pressure over its uncertainty": partial(draw_significance, drawn),
        "Contact at the sample": partial(draw_status, drawn),
        "Contact at the window": partial(draw_status, drawn, window=True),
    }
    if measured is not None:
        panels[f"Residual, {_UM * residual_rms(drawn.pixels):.2g} µm rms, {chi2}"] = partial(draw_residual, drawn)
    return layout.draw_page(panels, drawn.limits, figure)


def draw_pictures(data: xr.Dataset, measured: ThicknessMap) -> dict[str, Figure]:
    """Draw the pictures that go with a palpation's files, by file name, without any display.

    Args:
        data: Dataset of a solution under `Imprint`.
        measured: Measured map.
    """
    return _pictures("report.png", plot_report, data, measured)


def draw_fit(data: xr.Dataset, measured: ThicknessMap) -> dict[str, Figure]:
    """Draw the pictures that go with a fit's files, by file name, without any display.

    Args:
        data: Dataset of a fit.
        measured: The measured map.
    """
    return _pictures("fit.png", plot_fit, data, measured)


def _pictures(name: str, plot: Callable, data: xr.Dataset, measured: ThicknessMap) -> dict[str, Figure]:
    limits = Drawn(data, measured).limits
    pressure, report = layout.empty_page(1, limits), layout.empty_page(_MAPS[name], limits)
    plot_pressure(data, pressure.subplots(), measured=measured)
    plot(data, measured, report)
    return {"pressure.png": pressure, name: report}


def _force(drawn: Drawn) -> str:
    return f"{-drawn.dataset['force_sample'].values[2]:.3g} N"
