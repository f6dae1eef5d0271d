"""The section of a report: profiles of thickness, compression and pressure along a line that the reader drags.

Here are the axes and the curves, each named after its map; page.js reads the maps under the line.
"""

from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from .figures import AXIS, FONT, MARGINS
from .maps import ReportMap

BAND = 2.0
"""Standard deviations around a fitted pressure."""
_SHOWN = ("thickness", "compression", "pressure")
_LINE, _SHADE = "#0072b2", "rgba(0, 114, 178, 0.22)"


def section_figure(maps: list[ReportMap]) -> go.Figure:
    """Prepare the profiles; `meta` of a curve says which map it is of, and how many standard deviations are added.

    Args:
        maps: Of the report.
    """
    rows = [drawn for drawn in maps if drawn.key in _SHOWN]
    uncertain = any(drawn.key == "uncertainty" for drawn in maps)
    figure = make_subplots(rows=len(rows), cols=1, shared_xaxes=True, vertical_spacing=0.04)
    for row, drawn in enumerate(rows, start=1):
        for stds in (-BAND, BAND) if uncertain and drawn.key == "pressure" else ():
            band: dict[str, Any] = {"mode": "lines", "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False}
            fill: dict[str, Any] = {"fill": "tonexty", "fillcolor": _SHADE} if stds > 0 else {}
            figure.add_trace(go.Scatter(meta={"map": drawn.key, "stds": stds}, **band, **fill), row, 1)
        curve = go.Scatter(
            mode="lines",
            line={"color": _LINE, "width": 2},
            name=drawn.title,
            meta={"map": drawn.key, "stds": 0},
            hovertemplate=f"%{{y:.4g}} {drawn.unit}<extra></extra>",
            showlegend=False,
        )
        figure.add_trace(curve, row, 1)
        upward = {"autorange": "reversed"} if drawn.key == "thickness" else {"rangemode": "tozero"}
        title = {"text": f"{drawn.key.capitalize()}<br>[{drawn.unit}]", "standoff": 4}
        figure.update_yaxes({"title": title, **AXIS, **upward}, row=row, col=1)
    figure.update_xaxes(**AXIS)
    figure.update_xaxes(title="from A to B along the line [mm]", row=len(rows), col=1)
    return figure.update_layout(
        margin={**MARGINS, "l": 70, "r": 12}, font=FONT, hovermode="x unified", plot_bgcolor="white"
    )
