"""A map of a report as a plotly figure: its colours, what covers it, and what is said where the reader points.

Oriented as MATLAB's imagesc: row 0 at the top. All figures of a report have the same margins, so that maps align.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.colors import get_colorscale

from .maps import STATUS, ReportMap

MARGINS = {"l": 46, "r": 74, "t": 8, "b": 40}
"""Around the axes of every map [pixels of the screen]; page.css counts with the same."""
# All of equal steps to the eye, also for colour-blind readers; a size reads in grey, too.
_SCALES = {"size": "viridis", "thickness": "viridis", "uncertainty": "cividis", "deviation": "balance"}
# Apart in hue for every kind of colour vision, and in lightness for a grey print.
STATUS_COLOURS = ("#e4e4e4", "#0072b2", "#e69f00")
# Nothing, no contact, the two shades of the hatching, seen on every colour, and no layer.
_COVERS = ("rgba(0, 0, 0, 0)", "#d4d4d4", "#3a3a3a", "#f6f6f6", "#ffffff")
_SMOOTHED = 100  # pixels along x: what has fewer is drawn smoothly between them
_HATCHING_WIDTH = 0.012  # of a line, over the longer side of the map
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": "#1b1b1b"}
AXIS: dict[str, Any] = {
    "ticks": "outside", "showline": True, "mirror": True, "linecolor": "#666", "gridcolor": "#e4e4e4", "zeroline": False
}  # fmt: skip


def map_figure(drawn: ReportMap, limits: tuple[tuple[float, float], tuple[float, float]]) -> go.Figure:
    """Draw a map.

    Args:
        drawn: The map.
        limits: Ends of x and of y [mm], the same for all maps of a report.
    """
    covered = _covered(drawn)
    figure = go.Figure([_image(drawn), *([_cover(drawn, covered)] if covered.any() else [])])
    (x0, x1), (y0, y1) = limits
    spikes = {"showspikes": True, "spikemode": "across", "spikesnap": "hovered data", "spikethickness": 1}
    figure.update_layout(
        margin=MARGINS,
        font=FONT,
        hovermode="closest",
        plot_bgcolor="white",
        dragmode="zoom",
        xaxis={**AXIS, **spikes, "range": [x0, x1], "constrain": "domain", "title": _title("x [mm]")},
        yaxis={**AXIS, **spikes, "range": [y1, y0], "constrain": "domain", "title": _title("y [mm]")},
        hoverlabel={"bgcolor": "white", "font": FONT},
    )
    return figure.update_yaxes(scaleanchor="x", scaleratio=1)


def _title(text: str) -> dict[str, Any]:
    return {"text": text, "standoff": 4}


def _image(drawn: ReportMap) -> go.Heatmap:
    where = "x %{x:.2f}, y %{y:.2f} mm<br>"
    common: dict[str, Any] = {"x": drawn.x, "y": drawn.y, "name": drawn.title, "hoverongaps": False}
    if drawn.kind == "status":
        return go.Heatmap(
            z=drawn.values.astype(np.int8),
            zmin=-0.5,
            zmax=len(STATUS) - 0.5,
            colorscale=_steps(STATUS_COLOURS),
            colorbar={**_bar(), "tickvals": list(range(len(STATUS))), "ticktext": list(STATUS)},
            meta=list(STATUS),
            hovertemplate=where + "<b>%{text}</b><extra></extra>",
            **common,
        )
    low, high = _limits(drawn)
    return go.Heatmap(
        z=drawn.values.astype(np.float32),
        zmin=low,
        zmax=high,
        colorscale=get_colorscale(_SCALES[drawn.kind]),
        colorbar=_bar(),
        zsmooth="best" if drawn.x.size < _SMOOTHED else False,
        hovertemplate=f"{where}<b>%{{z:.{_digits(high - low)}f}} {drawn.unit}</b><extra></extra>",
        **common,
    )


def _limits(drawn: ReportMap) -> tuple[float, float]:
    if drawn.limits is not None:
        return drawn.limits
    known = drawn.values[np.isfinite(drawn.values)]
    low = 0.0 if drawn.kind == "size" else float(known.min())
    return min(low, float(known.min())), max(float(known.max()), low + 1e-9)


def _digits(span: float) -> int:
    """Count the decimals that tell a hundredth of a range, which is positive."""
    return max(0, 2 - math.floor(math.log10(span)))


def _bar() -> dict[str, Any]:
    """Place the bar of colours; the unit stands in the heading of the map."""
    return {"thickness": 12, "len": 1.0, "outlinewidth": 0, "x": 1.02, "xpad": 0, "ypad": 0, "nticks": 6}


def _covered(drawn: ReportMap) -> np.ndarray:
    """Say what covers each pixel, by its place in `_COVERS`."""
    code = np.zeros(drawn.values.shape, np.int8)
    if drawn.clear is not None:
        code[drawn.clear] = 1
    if drawn.unmeasured is not None:
        code = np.where(drawn.unmeasured, _hatching(drawn), code)
    if drawn.kind == "status":
        code[drawn.values < 0] = 4
    return code.astype(np.int8)


def _cover(drawn: ReportMap, code: np.ndarray) -> go.Heatmap:
    """Cover part of a map; what lies under it still answers where the reader points."""
    return go.Heatmap(
        x=drawn.x,
        y=drawn.y,
        z=code,
        zmin=-0.5,
        zmax=len(_COVERS) - 0.5,
        colorscale=_steps(_COVERS),
        showscale=False,
        hoverinfo="skip",
    )


def _steps(colours: Sequence[str]) -> list[list[Any]]:
    """Make a scale of plain colours, one for each whole number from 0."""
    return [[edge / len(colours), colour] for place, colour in enumerate(colours) for edge in (place, place + 1)]


def _hatching(drawn: ReportMap) -> np.ndarray:
    """Lay oblique lines over a map, a dark and a light one side by side, with as much of the map between two pairs."""
    xs, ys = np.meshgrid(drawn.x - drawn.x[0], drawn.y - drawn.y[0])
    width = max(_HATCHING_WIDTH * max(np.ptp(drawn.x), np.ptp(drawn.y)), float(drawn.x[1] - drawn.x[0]))
    return np.array([2, 3, 0, 0])[np.floor((xs + ys) / width).astype(int) % 4]
