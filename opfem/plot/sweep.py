"""A sweep as a picture: each output against each axis, with the lowest, the highest and the failed points marked.

Edge of the chain: drawn from columns of numbers, one entry a point.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .calibration import COLOURS

_PANEL, _AROUND = (3.6, 2.4), 0.7  # inches
_MOST_OUTPUTS = 6
_LOGARITHMIC = 20.0  # largest over smallest value of an axis that is drawn by its logarithm
_MARKERS = "os^Dvp"


def draw_sweep(
    axes: Mapping[str, np.ndarray], outputs: Mapping[str, np.ndarray], good: np.ndarray, shape: tuple[int, ...] | None
) -> Figure:
    """Draw outputs against axes, without any display.

    Points of a grid are joined along the axis that is drawn; the key names the values of another.

    Args:
        axes: Values of each axis, by name and unit, one entry a point.
        outputs: Values of each output, by name and unit; the first few are drawn.
        good: Which points have a result.
        shape: Of the grid, the last axis running fastest; None where points form none.
    """
    shown = dict(list(outputs.items())[:_MOST_OUTPUTS])
    size = (_PANEL[0] * len(axes) + _AROUND, _PANEL[1] * len(shown) + _AROUND)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(shown), len(axes), sharex="col", sharey="row", squeeze=False)
    for column, (axis, at) in zip(panels.T, axes.items(), strict=True):
        lines = _lines(axes, axis, shape)
        for ax, (output, values) in zip(column, shown.items(), strict=True):
            _draw_panel(ax, at, values, good, lines)
            ax.set(xlabel=axis, ylabel=output)
            ax.label_outer()
            ax.grid(alpha=0.3)
        if column[0].get_legend_handles_labels()[1]:
            column[0].legend(fontsize="small")
    figure.align_ylabels()
    return figure


def _lines(axes: Mapping[str, np.ndarray], axis: str, shape: tuple[int, ...] | None) -> dict[str, np.ndarray]:
    """Collect the points of each line by its name: those that differ in one axis only, or where no grid is, all."""
    points = np.arange(axes[axis].size)
    if shape is None:
        return {"": points}
    along = list(axes).index(axis)
    lines = np.moveaxis(points.reshape(shape), along, -1).reshape(-1, shape[along])
    others = {name: values for name, values in axes.items() if name != axis}
    return {", ".join(f"{name} {_shown(at[line[0]])}" for name, at in others.items()): line for line in lines}


def _draw_panel(
    ax: Axes, at: np.ndarray, values: np.ndarray, good: np.ndarray, lines: Mapping[str, np.ndarray]
) -> None:
    for number, (name, points) in enumerate(lines.items()):
        known = points[good[points]]
        known = known[np.argsort(at[known])]
        ax.plot(
            at[known],
            values[known],
            color=COLOURS[number % len(COLOURS)],
            marker=_MARKERS[number % len(_MARKERS)],
            markersize=4,
            linestyle="-" if np.unique(at).size == points.size else "none",
            label=name if name and len(lines) <= len(COLOURS) else "_",
        )
    if good.any():
        known = np.flatnonzero(good)
        for point in (known[np.argmin(values[known])], known[np.argmax(values[known])]):
            ax.plot(at[point], values[point], "o", markersize=12, fillstyle="none", color="0.2", label="_")
    if not good.all():
        failed: Any = {"marker": "x", "linestyle": "none", "color": "#d62728", "label": "failed"}
        ax.plot(at[~good], np.full(np.sum(~good), 0.03), transform=ax.get_xaxis_transform(), **failed)
    if at.dtype.kind in "fi" and at.min() > 0.0 and at.max() > _LOGARITHMIC * at.min():
        ax.set_xscale("log")


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float | int | np.number) else str(value)
