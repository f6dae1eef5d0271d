"""The numbers of a report in words, with their units: what the sample felt, and how sure that is.

Read from a dataset, so that a result on disk says the same as one that was just solved. Means are over area.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from ..results.fields import node_areas
from .maps import KPA, OPEN, STATUS, UM, ReportMap, loaded_thickness

_SMALLEST = 1e-3  # mN: smaller lateral forces are round-off


class Row(NamedTuple):
    """One number.

    Attributes:
        name: What it is.
        value: As text.
        unit: Of the value, or empty.
        words: What it means.
    """

    name: str
    value: str
    unit: str
    words: str


def number_rows(dataset: xr.Dataset, maps: list[ReportMap]) -> list[Row]:
    """Lay out the results for reading.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
        maps: Of the report.
    """
    force = dataset["force_sample"].values
    return [
        Row("Force on the layer", f"{1e3 * -force[2]:.4g}", "mN", "of the sample, at a right angle to the window"),
        Row("Force along the layer", _small(1e3 * math.hypot(*force[:2])), "mN", "of the sample, by friction"),
        *_pressures(dataset),
        *_compression(dataset),
        *_touching(dataset),
        *_misfit(maps),
        *_fit(dataset),
    ]


def _small(value: float) -> str:
    """Write a size that may be round-off."""
    return f"{value:.2g}" if value >= _SMALLEST else f"< {_SMALLEST:g}"


def touching_share(dataset: xr.Dataset) -> float:
    """Compute the part of the layer's unloaded area that touches the sample [-]."""
    return float(np.sum(_unloaded_areas(dataset)[_touches(dataset)]) / np.sum(_unloaded_areas(dataset)))


def mean_pressure(dataset: xr.Dataset) -> float:
    """Compute the mean pressure over the area that touches the sample [kPa]; zero where nothing touches."""
    area = _loaded_areas(dataset) * _touches(dataset)
    total = float(np.sum(area))
    return KPA * float(np.sum(dataset["pressure"].values * area)) / total if total else 0.0


def residual_rms(maps: list[ReportMap]) -> float | None:
    """Compute the root mean square of the residual [µm] where the layer touches; None where there is no such map."""
    for drawn in maps:
        if drawn.key == "residual":
            known = np.isfinite(drawn.values) if drawn.clear is None else np.isfinite(drawn.values) & ~drawn.clear
            return float(np.sqrt(np.mean(drawn.values[known] ** 2))) if known.any() else None
    return None


def _touches(dataset: xr.Dataset) -> np.ndarray:
    return dataset["contact_status"].values != OPEN


def _unloaded_areas(dataset: xr.Dataset) -> np.ndarray:
    x, y = np.meshgrid(dataset["x"].values, dataset["y"].values)
    return node_areas(x, y, dataset["unloaded_thickness"].values)


def _loaded_areas(dataset: xr.Dataset) -> np.ndarray:
    return node_areas(dataset["x_current"].values, dataset["y_current"].values, loaded_thickness(dataset))


def _pressures(dataset: xr.Dataset) -> list[Row]:
    pressure = KPA * dataset["pressure"].values
    at = np.unravel_index(np.argmax(pressure), pressure.shape)
    x, y = (float(dataset[f"{axis}_current"].values[at]) for axis in "xy")
    return [
        Row("Mean pressure", f"{mean_pressure(dataset):.3g}", "kPa", "over the area that touches the sample"),
        Row("High pressure", f"{np.percentile(pressure, 99):.3g}", "kPa", "99 of 100 places of the layer feel less"),
        Row("Largest pressure", f"{pressure.max():.3g}", "kPa", f"at x {x:.2f}, y {y:.2f} mm"),
    ]


def _compression(dataset: xr.Dataset) -> list[Row]:
    compression = 100.0 * (1.0 - loaded_thickness(dataset) / dataset["unloaded_thickness"].values)
    area = _unloaded_areas(dataset)
    mean = float(np.sum(compression * area) / np.sum(area))
    words = "of the unloaded thickness, over the whole layer; negative where it is thicker than unloaded"
    return [
        Row("Compression, mean", f"{mean:.3g}", "%", words),
        Row("Compression, largest", f"{compression.max():.3g}", "%", "where the layer is thinnest"),
    ]


def _touching(dataset: xr.Dataset) -> list[Row]:
    area = _unloaded_areas(dataset)
    rows = []
    for prefix, other in (("", "sample"), ("window_", "window")):
        status = dataset[f"{prefix}contact_status"].values
        shares = [f"{100.0 * np.sum(area[status == code]) / np.sum(area):.0f}" for code in range(len(STATUS))]
        rows.append(Row(f"Contact with the {other}", " / ".join(shares), "% of area", " / ".join(STATUS)))
    return rows


def _misfit(maps: list[ReportMap]) -> list[Row]:
    rms = residual_rms(maps)
    words = "root mean square of measured less computed thickness, where the layer touches"
    return [] if rms is None else [Row("What the computation misses", f"{rms:.2g}", "µm", words)]


def _fit(dataset: xr.Dataset) -> list[Row]:
    if "pressure_std" not in dataset:
        return []
    std = KPA * float(np.sum(dataset["pressure_std"].values * (area := _loaded_areas(dataset))) / np.sum(area))
    width = UM * float(np.median(dataset["resolution_width"].values))
    rows = [
        Row("Uncertainty of the pressure", f"{std:.2g}", "kPa", "one standard deviation, mean over the layer"),
        Row("Resolution", f"{width:.0f}", "µm", "width over which the fit blurs a point"),
        Row(
            "χ² per degree of freedom",
            f"{float(dataset['reduced_chi2']):.2f}",
            "",
            "near 1 where noise, material and friction are as stated; above 2 the map holds what they do not explain",
        ),
    ]
    if "fitted_number" in dataset:
        for name, value, (low, high) in zip(
            dataset["fitted_number"].values,
            dataset["fitted_value"].values,
            dataset["fitted_interval"].values,
            strict=True,
        ):
            rows.append(Row(f"Fitted {name}", f"{value:.4g}", "", f"{low:.4g} to {high:.4g} with 95 % probability"))
    return rows
