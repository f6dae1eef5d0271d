"""Maps of pressure in kPa, thickness in µm and contact status, oriented as MATLAB's imagesc shows them.

Edge of the chain: drawn from `to_xarray` and `ThicknessMap`. Row 0 of a map is at the top, so y grows
downwards and x to the right; x and y have the same scale. Without `ax` a picture is pyplot's, as in
pandas: notebooks show it by themselves, a script calls `matplotlib.pyplot.show()` or `ax.figure.savefig`.
"""

from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch

from ..measurement import ThicknessMap
from ..results import ExperimentSolution, Solution, TractionFit, to_xarray

_KPA = 1e3
_UM = 1e3
_MAP_SIZE = (5.6, 4.6)  # inches
_REPORT_SIZE = (10.4, 8.4)
_NO_DATA: dict[str, Any] = {"facecolor": "0.88", "edgecolor": "0.55", "hatch": "////"}
# Apart in hue for every kind of colour vision, and in lightness for a grey print.
STATUS_COLOURS = {"open": "#f0f0f0", "stick": "#0072b2", "slip": "#e69f00"}


def plot_pressure(
    data: Solution | ExperimentSolution | xr.Dataset,
    ax: Axes | None = None,
    *,
    window: bool = False,
    vmax: float | None = None,
    cmap: str = "viridis",
) -> Axes:
    """Draw the contact pressure [kPa] where it acts, on the current positions of the interface.

    Oriented as MATLAB's imagesc: row 0 at the top.

    Args:
        data: A solution, or its dataset.
        ax: Axes to draw on; None makes a figure.
        window: Draw the pressure at the window instead of at the sample; positions stay those of the interface.
        vmax: Pressure at the upper end of the colours [kPa]; None takes the largest.
        cmap: Name of the colour map; the default brightens with pressure and so reads in grey.

    Raises:
        ValueError: For a failed solution, which has no pressure.
    """
    dataset = _converged(data)
    ax = _axes(ax)
    x, y = dataset["x_current"].values, dataset["y_current"].values
    pressure = _KPA * dataset["window_pressure" if window else "pressure"].values
    vmin = min(0.0, float(pressure.min()))
    colours = ax.pcolormesh(x, y, pressure, shading="gouraud", cmap=cmap, vmin=vmin, vmax=vmax)
    extend = "max" if vmax is not None and pressure.max() > vmax else "neither"
    _colour_bar(ax, colours, "Contact pressure [kPa]", extend)
    _orient(ax, x, y)
    return ax


def plot_status(
    data: Solution | ExperimentSolution | xr.Dataset, ax: Axes | None = None, *, window: bool = False
) -> Axes:
    """Draw where the layer is open, sticks or slips, on the current positions of the interface.

    Oriented as MATLAB's imagesc: row 0 at the top. The key beside it names the states and their shares.

    Args:
        data: A solution, or its dataset.
        ax: Axes to draw on; None makes a figure.
        window: Draw the status at the window instead of at the sample; positions stay those of the interface.

    Raises:
        ValueError: For a failed solution, which has no status.
    """
    dataset = _converged(data)
    ax = _axes(ax)
    x, y = _corners(dataset["x_current"].values), _corners(dataset["y_current"].values)
    status = dataset["window_contact_status" if window else "contact_status"].values
    palette = ListedColormap(list(STATUS_COLOURS.values()))
    norm = BoundaryNorm([-0.5, 0.5, 1.5, 2.5], palette.N)
    colours = ax.pcolormesh(x, y, status, cmap=palette, norm=norm, shading="flat")
    bar = _colour_bar(ax, colours, "Contact status, share of nodes", "neither")
    shares = [f"{name}\n{np.mean(status == code):.0%}" for code, name in enumerate(STATUS_COLOURS)]
    bar.set_ticks([0, 1, 2], labels=shares)
    bar.ax.tick_params(length=0)
    _orient(ax, x, y)
    return ax


def plot_thickness(
    thickness: ThicknessMap, ax: Axes | None = None, *, label: str = "Thickness [µm]", cmap: str = "viridis"
) -> Axes:
    """Draw a thickness map [µm]; pixels without data are hatched grey, also where they hold a fill.

    Oriented as MATLAB's imagesc: row 0 at the top.

    Args:
        thickness: Map to draw.
        ax: Axes to draw on; None makes a figure.
        label: Label of the colour bar.
        cmap: Name of the colour map.
    """
    values = np.where(thickness.mask, np.nan, _UM * np.asarray(thickness.values))
    return draw_image(values, np.asarray(thickness.x), np.asarray(thickness.y), ax, label, cmap, None)


def plot_residual(
    data: Solution | ExperimentSolution | xr.Dataset,
    measured: ThicknessMap | None = None,
    ax: Axes | None = None,
    *,
    cmap: str = "cividis",
) -> Axes:
    """Draw measured less computed thickness [µm]; pixels without data or interface are hatched grey.

    Oriented as MATLAB's imagesc: row 0 at the top. Colours span the 99.5th percentile of the size, both ways.

    Args:
        data: A solution, or its dataset.
        measured: Measured map on the grid of the solution's load; None takes the map that was pressed in.
        ax: Axes to draw on; None makes a figure.
        cmap: Name of the colour map.

    Raises:
        ValueError: For a failed solution, or a map on another grid.
    """
    dataset = _converged(data)
    computed = dataset["thickness"].values
    residual = _UM * (_measured_values(dataset, measured) - computed)
    known = np.abs(residual[np.isfinite(residual)])
    limit = max(float(np.percentile(known, 99.5)), 1e-3) if known.size else 1.0
    x, y = dataset["x_image"].values, dataset["y_image"].values
    label = "Measured − computed thickness [µm]"
    return draw_image(residual, x, y, ax, label, cmap, (-limit, limit))


def plot_report(
    data: Solution | ExperimentSolution | xr.Dataset, measured: ThicknessMap | None = None, figure: Figure | None = None
) -> np.ndarray:
    """Draw what a palpation rests on: measured thickness, pressure, contact status, residual of thickness.

    Args:
        data: A solution under `Imprint`, or its dataset.
        measured: Measured map on the grid of the solution's load; None takes the map that was pressed in.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The four axes, 2 × 2.

    Raises:
        ValueError: For a failed solution, or a map on another grid.
    """
    dataset = _converged(data)
    axes = (shown_figure(_REPORT_SIZE) if figure is None else figure).subplots(2, 2)
    x, y = dataset["x_image"].values, dataset["y_image"].values
    measured_um = _UM * _measured_values(dataset, measured)
    draw_image(measured_um, x, y, axes[0, 0], "Thickness [µm]", "viridis", None)
    plot_pressure(dataset, axes[0, 1])
    plot_status(dataset, axes[1, 0])
    plot_residual(dataset, measured, axes[1, 1])
    residual = measured_um - _UM * dataset["thickness"].values
    rms = np.sqrt(np.nanmean(residual**2))
    force = -dataset["force_sample"].values[2]
    axes[0, 0].set_title("Measured thickness" if measured is not None else "Thickness pressed in")
    axes[0, 1].set_title(f"Pressure at the sample, {force:.3g} N")
    axes[1, 0].set_title("Contact at the sample")
    axes[1, 1].set_title(f"Residual, {rms:.2g} µm rms")
    return axes


def plot_uncertainty(
    data: TractionFit | xr.Dataset, ax: Axes | None = None, *, vmax: float | None = None, cmap: str = "cividis"
) -> Axes:
    """Draw the posterior standard deviation of the pressure [kPa] where it acts.

    Oriented as MATLAB's imagesc: row 0 at the top. Circles are as wide as the fit resolves there.

    Args:
        data: A traction fit, or its dataset.
        ax: Axes to draw on; None makes a figure.
        vmax: Standard deviation at the upper end of the colours [kPa]; None takes the largest.
        cmap: Name of the colour map.

    Raises:
        ValueError: For a failed fit.
    """
    dataset = _converged(data)
    ax = _axes(ax)
    x, y, std = (dataset[name].values for name in ("x_current", "y_current", "pressure_std"))
    colours = ax.pcolormesh(x, y, _KPA * std, shading="gouraud", cmap=cmap, vmin=0.0, vmax=vmax)
    extend = "max" if vmax is not None and _KPA * std.max() > vmax else "neither"
    _colour_bar(ax, colours, "Standard deviation of pressure [kPa]", extend)
    for centre, width in zip(dataset["resolution_points"].values, dataset["resolution_width"].values, strict=True):
        ax.add_patch(Circle(tuple(centre), 0.5 * width, fill=False, edgecolor="white", linewidth=0.8))
    _orient(ax, x, y)
    return ax


def plot_fit(
    data: TractionFit | xr.Dataset, measured: ThicknessMap | None = None, figure: Figure | None = None
) -> np.ndarray:
    """Draw what a traction fit found: pressure, its uncertainty and resolution, what it misses, what was measured.

    Args:
        data: A traction fit of one map, or its dataset.
        measured: The measured map; None: the computed thickness is drawn in its place.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The four axes, 2 × 2.

    Raises:
        ValueError: For a failed fit.
    """
    dataset = _converged(data)
    axes = (shown_figure(_REPORT_SIZE) if figure is None else figure).subplots(2, 2)
    plot_pressure(dataset, axes[0, 0])
    plot_uncertainty(dataset, axes[0, 1])
    x, y, residual = dataset["x"].values, dataset["y"].values, _UM * dataset["residual"].values
    limit = max(float(np.percentile(np.abs(residual), 99.5)), 1e-3)
    draw_image(residual, x, y, axes[1, 0], "Interface − measured surface [µm]", "cividis", (-limit, limit))
    if measured is None:
        computed = _UM * dataset["thickness"].values
        x, y = dataset["x_image"].values, dataset["y_image"].values
        draw_image(computed, x, y, axes[1, 1], "Thickness [µm]", "viridis", None)
    else:
        plot_thickness(measured, axes[1, 1])
    width = _UM * np.median(dataset["resolution_width"].values)
    axes[0, 0].set_title(f"Fitted pressure, {-dataset['force_sample'].values[2]:.3g} N")
    axes[0, 1].set_title(f"Uncertainty; resolution {width:.0f} µm (circles)")
    axes[1, 0].set_title(f"Residual, χ² per degree of freedom {float(dataset['reduced_chi2']):.2f}")
    axes[1, 1].set_title("Computed thickness" if measured is None else "Measured thickness")
    return axes


def draw_pictures(data: xr.Dataset, measured: ThicknessMap) -> dict[str, Figure]:
    """Draw the pictures that go with a palpation's files, by file name, without any display.

    Args:
        data: Dataset of a solution under `Imprint`.
        measured: Measured map on the grid of the solution's load.
    """
    pressure, report = (Figure(figsize=size, layout="compressed") for size in (_MAP_SIZE, _REPORT_SIZE))
    plot_pressure(data, pressure.subplots())
    plot_report(data, measured, report)
    return {"pressure.png": pressure, "report.png": report}


def draw_fit(data: xr.Dataset, measured: ThicknessMap) -> dict[str, Figure]:
    """Draw the pictures that go with a fit's files, by file name, without any display.

    Args:
        data: Dataset of a fit.
        measured: The measured map.
    """
    pressure, report = (Figure(figsize=size, layout="compressed") for size in (_MAP_SIZE, _REPORT_SIZE))
    plot_pressure(data, pressure.subplots())
    plot_fit(data, measured, report)
    return {"pressure.png": pressure, "fit.png": report}


def _converged(data: Solution | ExperimentSolution | TractionFit | xr.Dataset) -> xr.Dataset:
    dataset = data if isinstance(data, xr.Dataset) else to_xarray(data)
    if not np.isfinite(dataset["pressure"].values).all():
        status = dataset.attrs.get("status")
        raise ValueError(f"There is nothing to draw: the solve did not converge (status {status!r}).")
    return dataset


def _measured_values(dataset: xr.Dataset, measured: ThicknessMap | None) -> Float[np.ndarray, "my mx"]:
    """Thickness [mm] on the image's pixels, NaN where it is not data."""
    if measured is None:
        if "imposed_thickness" not in dataset:
            raise ValueError("The load holds no thickness map to compare with; pass measured=.")
        return np.where(dataset["missing"].values, np.nan, dataset["imposed_thickness"].values)
    x, y = dataset["x_image"].values, dataset["y_image"].values
    if measured.shape != (y.size, x.size) or not (np.allclose(measured.x, x) and np.allclose(measured.y, y)):
        raise ValueError(
            f"The measured map must lie on the grid of the solution's load, (ny, nx) = {(y.size, x.size)}, "
            f"got {measured.shape} or other positions."
        )
    return np.where(measured.mask, np.nan, measured.values)


def draw_image(
    values: Float[np.ndarray, "my mx"],
    x: Float[np.ndarray, " mx"],
    y: Float[np.ndarray, " my"],
    ax: Axes | None,
    label: str,
    cmap: str,
    limits: tuple[float, float] | None,
) -> Axes:
    """Draw an image with samples at x and y [mm]; NaN shows the hatched ground."""
    ax = _axes(ax)
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    extent = (x[0] - half_x, x[-1] + half_x, y[-1] + half_y, y[0] - half_y)
    vmin, vmax = limits or (None, None)
    colours = ax.imshow(values, extent=extent, cmap=cmap, vmin=vmin, vmax=vmax, interpolation="nearest")
    ax.patch.set(**_NO_DATA)
    known = values[np.isfinite(values)]
    beyond = limits is not None and known.size and np.abs(known).max() > limits[1]
    _colour_bar(ax, colours, label, "both" if beyond else "neither")
    _orient(ax, np.array(extent[:2]), np.array(extent[2:]))
    if not np.isfinite(values).all():
        ax.legend(handles=[Patch(label="no data", **_NO_DATA)], loc="upper right", fontsize="small", framealpha=0.9)
    return ax


def shown_figure(size: tuple[float, float]) -> Figure:
    """Make a figure that notebooks show by themselves."""
    # Loaded here, so that writing a file never starts a display.
    import matplotlib.pyplot as plt

    return plt.figure(figsize=size, layout="compressed")


def _axes(ax: Axes | None) -> Axes:
    return shown_figure(_MAP_SIZE).subplots() if ax is None else ax


def _colour_bar(ax: Axes, colours: ScalarMappable, label: str, extend: str) -> Colorbar:
    return ax.figure.colorbar(colours, ax=ax, label=label, extend=extend)


def _orient(ax: Axes, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> None:
    """Give both axes the same scale, row 0 at the top, as imagesc shows a matrix."""
    ax.set(xlabel="x [mm]", ylabel="y [mm]", xlim=(x.min(), x.max()), ylim=(y.max(), y.min()), aspect="equal")


def _corners(nodes: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "my mx"]:
    """Locate the corners of the cells around nodes [mm]; the outermost lie on the layer's rim."""
    wide = np.pad(nodes, 1, mode="edge")
    return 0.25 * (wide[1:, 1:] + wide[1:, :-1] + wide[:-1, 1:] + wide[:-1, :-1])
