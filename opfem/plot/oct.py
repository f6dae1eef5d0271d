"""What a user checks first: B-scans with the interface that was found drawn on them, its confidence, the thickness map.

Edge of the chain: drawn from an `OctVolume` and its `Interface`. Depth is geometric and grows downwards.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ..measurement import ThicknessMap
from ..measurement.oct import Interface, OctVolume
from ..measurement.oct.volume import power
from . import layout

_UM = 1e3
_SCANS = 3  # along both sides of the picture
_SIZE = (12.0, 9.0)  # inches
_BAND = 2.0  # standard deviations drawn
_RANGE = (0.02, 0.995)  # quantiles of a B-scan that its greys span
_MARGIN = 0.15  # mm drawn below the deepest interface
_MOST_COLUMNS = 800


def plot_interface(volume: OctVolume, interface: Interface, figure: Figure | None = None) -> np.ndarray:
    """Draw nine B-scans with the interface (orange, and a band of two standard deviations; blue dots: masked).

    Args:
        volume: The volume.
        interface: What was found in it.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The nine axes, 3 × 3.
    """
    figure = layout.shown_figure(_SIZE) if figure is None else figure
    ny = volume.shape[0]
    axes = figure.subplots(_SCANS, _SCANS, sharex=True, sharey=True)
    rows = np.unique(np.linspace(0, ny - 1, _SCANS**2 + 2).round().astype(int)[1:-1]) if ny > 2 else np.arange(ny)
    for ax in axes.ravel()[rows.size :]:
        ax.set_visible(False)
    depths = _UM * np.asarray(volume.depth(interface.index))
    kept = ~np.asarray(interface.mask)
    lowest = _UM * (float(np.max(np.asarray(interface.depth)[kept], initial=0.0)) + _MARGIN)
    levels = slice(0, max(8, int(np.searchsorted(depths, lowest))))
    x, y = np.asarray(interface.x), np.asarray(interface.y)
    every = max(1, volume.shape[1] // _MOST_COLUMNS)
    for ax, row in zip(axes.ravel(), rows, strict=False):
        scan = 10.0 * np.log10(np.maximum(power(volume.values[row, ::every, levels], volume.scale), 1e-30))
        low, high = np.quantile(scan, _RANGE)
        extent = (x[0], x[-1], depths[levels][-1], depths[0])
        ax.imshow(scan.T, extent=extent, aspect="auto", cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        depth, std = _UM * np.asarray(interface.depth)[row], _UM * np.asarray(interface.std)[row]
        known = np.where(kept[row], depth, np.nan)
        ax.fill_between(x, known - _BAND * std, known + _BAND * std, color="#e69f00", alpha=0.35, linewidth=0)
        # Its dark rim keeps the line apart from the sample in a grey print.
        ax.plot(x, known, color="#e69f00", linewidth=0.8, path_effects=[withStroke(linewidth=2.0, foreground="black")])
        ax.plot(x[~kept[row]], depth[~kept[row]], ".", color="#56b4e9", markersize=2.5)
        ax.set(title=f"y = {y[row]:.2f} mm", xlim=(x[0], x[-1]), ylim=(depths[levels][-1], depths[0]))
    for ax in axes[-1]:
        ax.set_xlabel("x [mm]")
    for ax in axes[:, 0]:
        ax.set_ylabel("Depth in the layer [µm]")
    return axes


def draw_interface(volume: OctVolume, interface: Interface, thickness: ThicknessMap) -> dict[str, Figure]:
    """Draw the pictures that go with a measurement's files, by file name, without any display.

    Args:
        volume: The loaded volume.
        interface: The interface found in it.
        thickness: The map made of it.
    """
    x, y, missing = np.asarray(interface.x), np.asarray(interface.y), np.asarray(interface.mask)

    def panel(values: np.ndarray, label: str, cmap: str, colours: tuple[float, float] | None = None) -> Any:
        def draw(ax: Axes) -> None:
            layout.image(values, x, y, ax, label, cmap, colours)
            layout.hatch_missing(ax, missing, x, y)

        return draw

    std, found = (np.where(missing, np.nan, _UM * np.asarray(v)) for v in (interface.std, thickness.values))
    panels = {
        "Confidence": panel(np.asarray(interface.confidence), "Confidence", "cividis", (0.0, 1.0)),
        "Standard deviation of depth": panel(std, "Std of depth [µm]", "cividis"),
        "Thickness": panel(found, "Thickness [µm]", "viridis"),
    }
    limits = layout.pixel_limits(x, y)
    scans, maps = Figure(figsize=_SIZE, layout="compressed"), layout.empty_page(len(panels), limits)
    plot_interface(volume, interface, scans)
    layout.draw_page(panels, limits, maps)
    return {"bscans.png": scans, "maps.png": maps}
