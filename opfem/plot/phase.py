"""Axial displacement as pictures: the middle B-scan, and a profile along depth with its band.

Edge of the chain: drawn from a `DisplacementVolume`. Depth grows downwards; displacement is in nm.
"""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ..measurement.oct import DisplacementVolume
from .layout import shown_figure

_NM, _UM = 1e6, 1e3
_SIZE = (10.4, 4.4)  # inches
_BAND = 2.0  # standard deviations drawn


def plot_displacement(volume: DisplacementVolume, row: int | None = None, figure: Figure | None = None) -> np.ndarray:
    """Draw one B-scan of the displacement, and its middle A-line with a band of two standard deviations.

    Args:
        volume: What was measured.
        row: Of the B-scan; None takes the middle one.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The two axes.
    """
    figure = shown_figure(_SIZE) if figure is None else figure
    axes: Any = figure.subplots(1, 2, sharey=True)
    ny, nx, _ = volume.shape
    row = ny // 2 if row is None else row
    x, depth = np.asarray(volume.x), _UM * volume.depth
    shown = np.where(volume.mask[row], np.nan, _NM * volume.values[row])
    image = axes[0].imshow(shown.T, extent=(x[0], x[-1], depth[-1], depth[0]), aspect="auto", cmap="viridis")
    figure.colorbar(image, ax=axes[0], label="Axial displacement [nm]")
    axes[0].axvline(x[nx // 2], color="w", linewidth=0.8, path_effects=[withStroke(linewidth=2.0, foreground="black")])
    axes[0].set(xlabel="x [mm]", ylabel="Depth in the layer [µm]", title=f"y = {float(volume.y[row]):.2f} mm")
    line, std = shown[nx // 2], _BAND * _NM * volume.std[row, nx // 2]
    axes[1].fill_betweenx(depth, line - std, line + std, color="#e69f00", alpha=0.5, linewidth=0)
    axes[1].plot(line, depth, color="#0072b2", linewidth=0.9)
    axes[1].set(xlabel="Axial displacement [nm]", title=f"x = {x[nx // 2]:.2f} mm, band of two std")
    return axes


def draw_displacement(volume: DisplacementVolume) -> Figure:
    """Draw the picture that goes with a measurement's files, without any display."""
    figure = Figure(figsize=_SIZE, layout="compressed")
    plot_displacement(volume, figure=figure)
    return figure
