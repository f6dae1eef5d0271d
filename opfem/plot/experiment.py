"""Pictures of a virtual experiment: the deformed cross-section with its inclusions, and an estimate beside the truth.

Edge of the chain: drawn from `to_xarray` and `compare`. Sections have the window at the top, as a B-scan has.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ..measurement import ThicknessMap
from ..results import Comparison, ExperimentSolution, to_xarray
from . import layout
from .drawing import DIVERGING, Drawn, draw_compression, draw_pressure, draw_status, draw_thickness

_KPA = 1e3
_SECTION_WIDTH, _BESIDE, _ABOVE = 8.0, 1.6, 1.1  # inches; room beside and above the bodies for labels
_LABELS = {"stress_zz": "−σ_zz, compression [kPa]", "mises": "von Mises stress [kPa]"}
_LEAST_ERROR = 1e-6  # kPa at the ends of the colours: below is round-off
_SAME = 1e-6  # difference of shear moduli that is none, relative

Faces = Float[np.ndarray, "2 mz mx"]


def plot_section(
    data: ExperimentSolution | xr.Dataset,
    ax: Axes | None = None,
    *,
    y: float | None = None,
    colour: str = "stress_zz",
    vmax: float | None = None,
    cmap: str = "viridis",
) -> Axes:
    """Draw layer and sample where they have moved, cut along x, coloured by the stress in each element [kPa].

    White lines outline inclusions: where the sample's material changes from element to element. Black lines are
    window (top), interface and plate. Both bodies are cut through the elements nearest to y.

    Args:
        data: The solution of an experiment, or its dataset.
        ax: Axes to draw on; None makes a figure.
        y: Where to cut [mm]; None takes the middle.
        colour: "stress_zz" (−σ_zz) or "mises".
        vmax: Upper end of the colours [kPa]; None takes the 99.5th percentile.
        cmap: Name of the colour map; the default brightens with stress and so reads in grey.

    Raises:
        ValueError: For a failed solution, a palpation, an unknown colour, or a cut off the sample.
    """
    dataset = data if isinstance(data, xr.Dataset) else to_xarray(data)
    if "sample_displacement" not in dataset:
        raise ValueError("plot_section draws both bodies of an experiment; plot_layer shows the layer of a palpation.")
    if not np.isfinite(dataset["displacement"].values).all():
        raise ValueError(
            f"There is nothing to draw: the solve did not converge (status {dataset.attrs.get('status')!r})."
        )
    if colour not in _LABELS:
        raise ValueError(f"colour must be one of {tuple(_LABELS)}, got {colour!r}.")
    rows = dataset["y_sample"].values
    y = float(0.5 * (rows[0] + rows[-1])) if y is None else float(y)
    if not rows[0] <= y <= rows[-1]:
        raise ValueError(f"plot_section.y [mm] must lie between {rows[0]:g} and {rows[-1]:g}, got {y:g}.")
    layer, layer_stress = _cut(dataset, y, "", "y", "layer_element_stress", colour)
    sample, sample_stress = _cut(dataset, y, "sample_", "y_sample", "sample_element_stress", colour)
    both = np.concatenate([layer_stress.ravel(), sample_stress.ravel()])
    limits = (min(0.0, float(both.min())), float(np.percentile(both, 99.5)) if vmax is None else vmax)
    ax = layout.shown_figure(_section_size(dataset)).subplots() if ax is None else ax
    style: Any = {"cmap": cmap, "vmin": limits[0], "vmax": limits[1], "edgecolors": (0, 0, 0, 0.15), "linewidth": 0.2}
    for nodes, stress in ((layer, layer_stress), (sample, sample_stress)):
        colours = ax.pcolormesh(nodes[0], nodes[1], stress, shading="flat", **style)
    ax.add_collection(LineCollection(list(_outlines(dataset, y, sample)), colors="white", linewidths=1.4))
    ax.plot(*layer[:, -1], color="black", linewidth=1.0)
    plate = float(sample[1, -1].mean())
    for height in (0.0, plate):
        ax.axhline(height, color="black", linewidth=2.5)
    extend = "max" if both.max() > limits[1] else "neither"
    ax.figure.colorbar(colours, ax=ax, label=_LABELS[colour], extend=extend, fraction=0.04, pad=0.02)
    room = 0.05 * plate
    ax.set(
        xlabel="x [mm]", ylabel="z [mm]", ylim=(plate + room, -room), aspect="equal", title=f"Section at y = {y:.3g} mm"
    )
    return ax


def plot_comparison(comparison: Comparison, figure: Figure | None = None, *, vmax: float | None = None) -> np.ndarray:
    """Draw true pressure, estimated pressure and their difference [kPa].

    Oriented as MATLAB's imagesc: row 0 at the top. Places where one has no pressure are grey.

    Args:
        comparison: What `compare` returned.
        figure: Empty figure to draw on; None makes one.
        vmax: Pressure at the upper end of the colours [kPa]; None takes the largest true one.

    Returns:
        The three axes.
    """
    truth, estimate, error = (
        _KPA * part for part in (comparison.truth_pressure, comparison.estimate_pressure, comparison.error)
    )
    pressures = (0.0, float(np.nanmax(truth)) if vmax is None else vmax)

    def panel(values: np.ndarray, label: str, cmap: str, colours: tuple[float, float]) -> Callable[[Axes], Axes]:
        return lambda ax: layout.image(values, comparison.x, comparison.y, ax, label, cmap, colours)

    panels = {
        f"Truth, {comparison.truth.force:.3g} N": panel(truth, "Contact pressure [kPa]", "viridis", pressures),
        f"Estimate, {comparison.estimate.force:.3g} N": panel(estimate, "Contact pressure [kPa]", "viridis", pressures),
        f"Estimate − truth, {comparison.relative_error:.1%}": panel(
            error, "Difference [kPa]", DIVERGING, layout.even(error, _LEAST_ERROR)
        ),
    }
    return layout.draw_page(panels, layout.pixel_limits(comparison.x, comparison.y), figure)


def draw_simulation(data: xr.Dataset, measured: ThicknessMap, y: float | None = None) -> dict[str, Figure]:
    """Draw the pictures that go with a simulation's files, by file name, without any display.

    Args:
        data: Dataset of an experiment's solution.
        measured: The map as it would be measured.
        y: Where to cut [mm]; None takes the middle.
    """
    section = Figure(figsize=_section_size(data), layout="compressed")
    plot_section(data, section.subplots(), y=y)
    drawn = Drawn(data, measured)
    panels = {
        "Thickness as measured": partial(draw_thickness, drawn),
        "Compression": partial(draw_compression, drawn),
        f"True pressure, {-data['force_sample'].values[2]:.3g} N": partial(draw_pressure, drawn),
        "Contact of layer and sample": partial(draw_status, drawn),
        "Contact of layer and window": partial(draw_status, drawn, window=True),
    }
    report = layout.empty_page(len(panels), drawn.limits)
    layout.draw_page(panels, drawn.limits, report)
    return {"section.png": section, "report.png": report}


def _section_size(dataset: xr.Dataset) -> tuple[float, float]:
    """Find the size of a picture [inch] that both bodies fill."""
    height = float(dataset["sample_height"].values.max() / np.ptp(dataset["x_sample"].values))
    return _SECTION_WIDTH, height * (_SECTION_WIDTH - _BESIDE) + _ABOVE


def _cut(
    dataset: xr.Dataset, y: float, prefix: str, axis: str, stress: str, colour: str
) -> tuple[Faces, Float[np.ndarray, "nz nx"]]:
    """Cut a body through the elements nearest to y: current x and z of the nodes [mm], and their stress [kPa]."""
    displacement = dataset[f"{prefix}displacement"].transpose("component", ...).values
    height = dataset["sample_height"] if prefix else dataset["z"] * dataset["unloaded_thickness"]
    x = dataset["x_sample" if prefix else "x"].values
    z = height.transpose(..., axis, "x_sample" if prefix else "x").values
    current = np.stack([x + displacement[0], z + displacement[2]])
    j = _element(dataset[axis].values, y)
    # Along the middle of the elements.
    return 0.5 * (current[:, :, j] + current[:, :, j + 1]), _KPA * _scalar(dataset[stress].values[:, :, :, j], colour)


def _element(nodes: np.ndarray, y: float) -> int:
    return int(np.clip(np.searchsorted(nodes, y, side="right") - 1, 0, nodes.size - 2))


def _scalar(stress: Float[np.ndarray, "3 3 nz nx"], colour: str) -> Float[np.ndarray, "nz nx"]:
    if colour == "stress_zz":
        return -stress[2, 2]
    deviator = stress - np.eye(3)[:, :, None, None] * np.trace(stress) / 3.0
    return np.sqrt(1.5 * np.sum(deviator**2, axis=(0, 1)))


def _outlines(dataset: xr.Dataset, y: float, nodes: Faces) -> np.ndarray:
    """Collect the element edges (pairs of points [mm]) across which the sample's shear modulus changes."""
    shear = dataset["sample_shear_modulus"].values[:, _element(dataset["y_sample"].values, y)]
    points = np.moveaxis(nodes, 0, -1)
    across_z = np.argwhere(~np.isclose(shear[1:], shear[:-1], rtol=_SAME))
    across_x = np.argwhere(~np.isclose(shear[:, 1:], shear[:, :-1], rtol=_SAME))
    level = [(points[k + 1, i], points[k + 1, i + 1]) for k, i in across_z]
    upright = [(points[k, i + 1], points[k + 1, i + 1]) for k, i in across_x]
    return np.array([*level, *upright]).reshape(-1, 2, 2)
