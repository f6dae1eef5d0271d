"""Each map of a result on its own axes, without key or title: what single pictures and pages of maps share.

Edge of the chain: drawn from the dataset of `to_xarray`, and from its maps on the pixels of the measured one.
"""

from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Circle

from ..measurement import ThicknessMap
from ..results import ExperimentSolution, Solution, TractionFit, on_pixels, to_xarray
from . import layout

_KPA, _UM, _PERCENT = 1e3, 1e3, 1e2
DIVERGING = "PuOr_r"
"""For differences: pale at zero, orange above, violet below; apart for every kind of colour vision."""
# Apart in hue for every kind of colour vision, and in lightness for a grey print.
STATUS_COLOURS = {"open": "#f0f0f0", "stick": "#0072b2", "slip": "#e69f00"}
_LEAST_RESIDUAL = 1e-3  # µm at the ends of the colours: below is round-off

Data = Solution | ExperimentSolution | TractionFit | xr.Dataset


class Drawn:
    """What is drawn: a result, and the measured map that it is compared with.

    Args:
        data: A solution or a fit, or its dataset.
        measured: The measured map; None takes the map that was pressed in.

    Raises:
        ValueError: For a failed solution, which has no fields.
    """

    def __init__(self, data: Data, measured: ThicknessMap | None = None):
        self.dataset = data if isinstance(data, xr.Dataset) else to_xarray(data)
        self.measured = measured
        if not np.isfinite(self.dataset["pressure"].values).all():
            status = self.dataset.attrs.get("status")
            raise ValueError(f"There is nothing to draw: the solve did not converge (status {status!r}).")

    @cached_property
    def pixels(self) -> xr.Dataset:
        """Its maps on the pixels of the measured one."""
        return on_pixels(self.dataset, self.measured)

    @property
    def x(self) -> Float[np.ndarray, "my mx"]:
        """Current x of interface nodes [mm]."""
        return self.dataset["x_current"].values

    @property
    def y(self) -> Float[np.ndarray, "my mx"]:
        """Current y of interface nodes [mm]."""
        return self.dataset["y_current"].values

    @cached_property
    def grid(self) -> tuple[Float[np.ndarray, " px"], Float[np.ndarray, " py"]]:
        """Positions of columns and rows of the measured map, or of the load's [mm]."""
        if self.measured is not None:
            return np.asarray(self.measured.x), np.asarray(self.measured.y)
        return self.dataset["x_image"].values, self.dataset["y_image"].values

    @property
    def missing(self) -> np.ndarray:
        """Pixels without data."""
        if self.measured is not None:
            return np.asarray(self.measured.mask)
        if "missing" in self.dataset:
            return self.dataset["missing"].values.astype(bool)
        x, y = self.grid
        return np.zeros((y.size, x.size), bool)

    @cached_property
    def limits(self) -> layout.Limits:
        """What holds the layer where it is now, and the map."""
        return layout.together(layout.limits_of(self.x, self.y), layout.pixel_limits(*self.grid))


def draw_pressure(drawn: Drawn, ax: Axes, window: bool = False, vmax: float | None = None, cmap: str = "viridis"):
    """Draw the contact pressure [kPa] where it acts."""
    pressure = _KPA * drawn.dataset["window_pressure" if window else "pressure"].values
    _shaded(drawn, ax, pressure, "Contact pressure [kPa]", cmap, (min(0.0, float(pressure.min())), vmax))
    hatched(drawn, ax, window)


def draw_uncertainty(drawn: Drawn, ax: Axes, vmax: float | None = None, cmap: str = "cividis"):
    """Draw the standard deviation of a fitted pressure [kPa] where it acts, with circles as wide as it resolves."""
    dataset = drawn.dataset
    _shaded(drawn, ax, _KPA * dataset["pressure_std"].values, "Std of pressure [kPa]", cmap, (0.0, vmax))
    hatched(drawn, ax)
    for centre, width in zip(dataset["resolution_points"].values, dataset["resolution_width"].values, strict=True):
        ax.add_patch(Circle(tuple(centre), 0.5 * width, fill=False, edgecolor="white", linewidth=0.8))


def draw_significance(drawn: Drawn, ax: Axes, cmap: str = "viridis"):
    """Draw a fitted pressure over its standard deviation [-]: where the map tells that there is any."""
    ratio = drawn.dataset["pressure"].values / drawn.dataset["pressure_std"].values
    _shaded(drawn, ax, ratio, "Pressure / std [-]", cmap, (min(0.0, float(ratio.min())), None))
    hatched(drawn, ax)


def draw_status(drawn: Drawn, ax: Axes, window: bool = False):
    """Draw where the layer is open, sticks or slips; its bar names the states and their current areas."""
    side = "window_" if window else ""
    status, area = (drawn.dataset[f"{side}{name}"].values for name in ("contact_status", "node_area"))
    palette = ListedColormap(list(STATUS_COLOURS.values()))
    norm = BoundaryNorm([-0.5, 0.5, 1.5, 2.5], palette.N)
    x, y = _corners(drawn.x), _corners(drawn.y)
    colours = ax.pcolormesh(x, y, status, cmap=palette, norm=norm, shading="flat", rasterized=True)
    bar = layout.colour_bar(ax, colours, "Contact status, area [mm²]", "neither")
    areas = [float(area[status == code].sum()) for code in range(len(STATUS_COLOURS))]
    bar.set_ticks([0, 1, 2], labels=[f"{name}\n{size:.3g}" for name, size in zip(STATUS_COLOURS, areas, strict=True)])
    bar.ax.tick_params(length=0)
    layout.orient(ax, layout.limits_of(drawn.x, drawn.y))
    hatched(drawn, ax, window)


def draw_thickness(drawn: Drawn, ax: Axes, cmap: str = "viridis"):
    """Draw the measured thickness [µm], or the computed one where none was measured."""
    name = "measured" if "measured" in drawn.pixels else "thickness"
    layout.image(_UM * drawn.pixels[name].values, *drawn.grid, ax, "Thickness [µm]", cmap)
    hatched(drawn, ax)


def draw_compression(drawn: Drawn, ax: Axes, vmax: float | None = None, cmap: str = "viridis"):
    """Draw the compression of the layer, 1 - L1/L0 [%]."""
    compression = _PERCENT * drawn.pixels["compression"].values
    colours = None if vmax is None else (min(0.0, float(np.nanmin(compression))), vmax)
    layout.image(compression, *drawn.grid, ax, "Compression [%]", cmap, colours)
    hatched(drawn, ax)


def draw_residual(drawn: Drawn, ax: Axes, cmap: str = DIVERGING):
    """Draw measured less computed thickness [µm]."""
    if "residual" not in drawn.pixels:
        raise ValueError("The load holds no thickness map to compare with; pass measured=.")
    residual = _UM * drawn.pixels["residual"].values
    colours = layout.even(residual, _LEAST_RESIDUAL)
    layout.image(residual, *drawn.grid, ax, "Measured − computed [µm]", cmap, colours)
    hatched(drawn, ax)


def hatched(drawn: Drawn, ax: Axes, window: bool = False):
    """Hatch what holds no data and what does not touch, and outline contact."""
    layout.hatch_missing(ax, drawn.missing, *drawn.grid)
    status = drawn.dataset["window_contact_status" if window else "contact_status"].values
    layout.hatch_open(ax, status != 0, drawn.x, drawn.y)


def _shaded(
    drawn: Drawn, ax: Axes, values: np.ndarray, label: str, cmap: str, colours: tuple[float, float | None]
) -> None:
    vmin, vmax = colours
    style: Any = {"cmap": cmap, "vmin": vmin, "vmax": vmax, "rasterized": True}
    mesh = ax.pcolormesh(drawn.x, drawn.y, values, shading="gouraud", **style)
    layout.colour_bar(ax, mesh, label, "max" if vmax is not None and values.max() > vmax else "neither")
    layout.orient(ax, layout.limits_of(drawn.x, drawn.y))


def _corners(nodes: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "my mx"]:
    """Locate the corners of the cells around nodes [mm]; the outermost lie on the layer's rim."""
    wide = np.pad(nodes, 1, mode="edge")
    return 0.25 * (wide[1:, 1:] + wide[1:, :-1] + wide[:-1, 1:] + wide[:-1, :-1])
