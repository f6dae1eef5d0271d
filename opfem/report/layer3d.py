"""The deformed layer of a report in three dimensions, seen through the window as the microscope sees it.

Lit and turned by plotly in the reader's browser; the geometry is that of result.vtu.
"""

from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr
from jaxtyping import Float
from plotly.colors import get_colorscale

from .figures import FONT
from .maps import KPA

_THICK = 0.3  # thickness in the picture, over the longer side, that a thinner layer is stretched to
_SIDE = "#9fb6c4"
_BAR: dict[str, Any] = {
    "title": {"text": "pressure on the sample [kPa]", "side": "top"}, "orientation": "h", "thickness": 12, "len": 0.7,
    "outlinewidth": 0, "y": 0.0, "yanchor": "top",
}  # fmt: skip
_MOST_NODES = 200  # along one axis; more are thinned out


def stretch(dataset: xr.Dataset) -> float:
    """Say how much the picture is stretched along the thickness: a layer is some ten times as wide as it is thick.

    Args:
        dataset: What `to_xarray` returned.
    """
    longest = float(max(np.ptp(dataset["x"].values), np.ptp(dataset["y"].values)))
    return max(1.0, round(_THICK * longest / float(dataset["unloaded_thickness"].max()), 1))


def layer_figure(dataset: xr.Dataset) -> go.Figure:
    """Draw the surface of the deformed layer, the face at the sample coloured by its pressure [kPa].

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
    """
    points = _deformed(dataset)
    thin = slice(None, None, int(np.ceil(max(points.shape[2:]) / _MOST_NODES)))
    points = points[:, :, thin, thin]
    pressure = KPA * dataset["pressure"].values[thin, thin]
    figure = go.Figure(_face(points[:, -1], pressure))
    for sheet in (points[:, :, 0], points[:, :, -1], points[:, :, :, 0], points[:, :, :, -1]):
        figure.add_trace(_side(sheet))
    figure.add_trace(_rim(points[:, 0]))
    spans = [float(np.ptp(axis)) for axis in points]
    ratio = dict(zip("xyz", (spans[0], spans[1], stretch(dataset) * spans[2]), strict=True))
    longest = max(ratio.values())
    axis: dict[str, Any] = {"backgroundcolor": "white", "gridcolor": "#ddd", "nticks": 6, "showspikes": False}
    # Both y and z run against the scene's own axes, which turns it and mirrors nothing.
    figure.update_layout(
        scene={
            "xaxis": {**axis, "title": {"text": "x [mm]"}},
            "yaxis": {**axis, "title": {"text": "y [mm]"}, "autorange": "reversed"},
            "zaxis": {**axis, "title": {"text": "z [mm]"}, "autorange": "reversed", "nticks": 3},
            "aspectmode": "manual",
            "aspectratio": {name: 1.5 * value / longest for name, value in ratio.items()},
            "camera": {"eye": {"x": 0.3, "y": -1.7, "z": 1.45}, "center": {"x": 0.0, "y": 0.0, "z": -0.22}},
        },
        margin={"l": 0, "r": 0, "t": 0, "b": 60},
        font=FONT,
    )
    return figure


def _deformed(dataset: xr.Dataset) -> Float[np.ndarray, "3 mz my mx"]:
    x, y, z = xr.broadcast(dataset["x"], dataset["y"], dataset["z"] * dataset["unloaded_thickness"])
    reference = np.stack([axis.transpose("z", "y", "x").values for axis in (x, y, z)])
    return reference + dataset["displacement"].transpose("component", "z", "y", "x").values


def _face(points: np.ndarray, pressure: np.ndarray) -> go.Surface:
    x, y, z = points.astype(np.float32)
    return go.Surface(
        x=x,
        y=y,
        z=z,
        surfacecolor=pressure.astype(np.float32),
        cmin=min(0.0, float(pressure.min())),
        cmax=max(float(pressure.max()), 1e-9),
        colorscale=get_colorscale("viridis"),
        colorbar=_BAR,
        lighting={"ambient": 0.8, "diffuse": 0.5, "specular": 0.05},
        name="face at the sample",
        hovertemplate="x %{x:.2f}, y %{y:.2f}, z %{z:.3f} mm<br><b>%{surfacecolor:.2f} kPa</b><extra></extra>",
    )


def _side(points: np.ndarray) -> go.Surface:
    x, y, z = points.astype(np.float32)
    plain = [[0.0, _SIDE], [1.0, _SIDE]]
    return go.Surface(
        x=x, y=y, z=z, surfacecolor=np.zeros(x.shape, np.int8), colorscale=plain, showscale=False, opacity=0.35,
        hoverinfo="skip",
    )  # fmt: skip


def _rim(points: np.ndarray) -> go.Scatter3d:
    """Outline the face at the window, which is drawn as clear as it is."""
    rim = np.concatenate([points[:, 0], points[:, 1:, -1], points[:, -1, -2::-1], points[:, -2::-1, 0]], axis=1)
    x, y, z = rim.astype(np.float32)
    line = {"color": "#333", "width": 3}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, hoverinfo="skip", showlegend=False)
