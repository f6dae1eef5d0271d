"""How a solve went, in words: whether forces balance, what it took, where the energy went; of a fit, how it ended.

Explicit dynamics records its energies over time, which become a figure.
"""

import math

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from .figures import AXIS, FONT
from .numbers import Row

_UJ = 1e3  # µJ of a N mm
_ENERGIES = {
    "strain": "stored in the layer",
    "kinetic": "kinetic",
    "contact": "contact",
    "friction": "lost to friction",
    "viscous": "lost to bulk viscosity",
    "damping": "lost to damping",
    "external": "work of the load",
}
# Of the Okabe–Ito palette, with a dash each: distinct without colour, too.
_LINES = ("#0072b2", "#d55e00", "#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#000000")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "solid")


def imbalance(dataset: xr.Dataset) -> float:
    """Compute what is left of the outer forces, over the force on the sample [-]; NaN where nothing presses."""
    names = ["force_window", "force_hold", "force_plate" if "force_plate" in dataset else "force_sample"]
    left = np.linalg.norm(np.sum([dataset[name].values for name in names], axis=0))
    pressing = np.linalg.norm(dataset["force_sample"].values)
    return float(left / pressing) if pressing else math.nan


def small_percent(part: float) -> str:
    """Write a part of the whole in per cent, those too small to matter as less than a hundredth."""
    return "nothing to balance" if math.isnan(part) else "< 0.01" if part < 1e-4 else f"{100.0 * part:.2g}"


def convergence_rows(dataset: xr.Dataset) -> list[Row]:
    """Lay out how the solve went, and what the energy says of it.

    Args:
        dataset: What `to_xarray` returned.
    """
    attrs = dataset.attrs
    rows = [
        Row("Ended", str(attrs["status"]).replace("_", " "), "", attrs.get("status_message") or "without remarks"),
        Row("Load reached", f"{100 * float(dataset['load_fraction']):.0f}", "%", "of the load that was asked for"),
        Row("Forces out of balance", small_percent(imbalance(dataset)), "%", "of the force of the sample"),
        _increments(dataset),
        Row("Smallest volume ratio", f"{float(dataset['min_volume_ratio']):.3f}", "", "1 keeps its volume"),
        Row("Largest penetration", f"{1e3 * float(dataset['max_penetration']):.2g}", "µm", "of the faces in contact"),
        *_energy(dataset),
    ]
    if "fit_status" in attrs:
        rows += [
            Row("Fit ended", attrs["fit_status"], "", attrs.get("fit_message") or "without remarks"),
            Row(
                "Solves, products with the derivative",
                f"{int(dataset['forward_solves'])}, {int(dataset['inner_iterations'])}",
                "",
                "of the layer under a trial pressure",
            ),
            Row(
                "Error of the standard deviations",
                f"{100 * float(dataset['std_error']):.0f}",
                "%",
                f"as they come from {int(dataset['draws'])} draws",
            ),
        ]
    return rows


def _increments(dataset: xr.Dataset) -> Row:
    count = int(dataset["increments"])
    if "kinetic_ratio" in dataset:
        return Row("Time increments", f"{count}", "", "of explicit dynamics, each no longer than is stable")
    words = "friction depends on the path, so the load is applied in increments"
    return Row("Increments, Newton steps", f"{count}, {int(dataset['newton_steps'])}", "", words)


def _energy(dataset: xr.Dataset) -> list[Row]:
    presser = "plate" if "work_plate" in dataset else "sample"
    work = float(dataset[f"work_{presser}"]) + float(dataset["work_window"])
    rows = [
        Row("Work done on the bodies", f"{_UJ * work:.4g}", "µJ", f"by {presser} and window"),
        Row("Stored as strain energy", f"{_UJ * float(dataset['strain_energy']):.4g}", "µJ", "given back on unloading"),
        Row("Lost to friction", f"{_UJ * float(dataset['friction_dissipation']):.4g}", "µJ", "on all faces"),
    ]
    if "kinetic_ratio" in dataset:
        kinetic, drift = (100 * float(dataset[name]) for name in ("kinetic_ratio", "energy_drift"))
        rows += [
            Row("Kinetic energy", f"{kinetic:.2g}", "%", "of all energy; below 1 % the load is slow enough"),
            Row("Energy missing from the balance", f"{drift:.2g}", "%", "of all energy"),
        ]
    return rows


def energy_figure(dataset: xr.Dataset) -> go.Figure | None:
    """Draw the energies over time; None where the solver records none.

    Args:
        dataset: What `to_xarray` returned.
    """
    if "output_time" not in dataset:
        return None
    figure = go.Figure()
    for (name, words), colour, dash in zip(_ENERGIES.items(), _LINES, _DASHES, strict=True):
        figure.add_trace(
            go.Scatter(
                x=dataset["output_time"].values,
                y=_UJ * dataset[f"energy_{name}"].values,
                name=words,
                line={"color": colour, "dash": dash},
                hovertemplate="%{y:.3g} µJ",
            )
        )
    figure.update_xaxes(title="time [s]", **AXIS)
    figure.update_yaxes(title="energy [µJ]", **AXIS)
    legend = {"orientation": "h", "y": -0.25}
    return figure.update_layout(
        margin={"l": 60, "r": 12, "t": 8, "b": 40},
        font=FONT,
        hovermode="x unified",
        legend=legend,
        plot_bgcolor="white",
    )
