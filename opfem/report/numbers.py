"""The numbers of a report in words, with their units: what the sample felt, and how sure that is.

Read from a dataset, so that a result on disk says the same as one that was just solved. Means are over area.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from ..results import residual_rms, touching_compression
from .maps import KPA, OPEN, STATUS, UM

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


def number_rows(dataset: xr.Dataset, pixels: xr.Dataset) -> list[Row]:
    """Lay out the results for reading.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
        pixels: What `on_pixels` returned for it.
    """
    force = dataset["force_sample"].values
    return [
        Row("Force on the layer", f"{1e3 * -force[2]:.4g}", "mN", "of the sample, at a right angle to the window"),
        Row("Force along the layer", _small(1e3 * math.hypot(*force[:2])), "mN", "of the sample, by friction"),
        *_pressures(dataset),
        *_compression(pixels),
        *_touching(dataset),
        *_misfit(dataset, pixels),
        *_fit(dataset),
    ]


def _small(value: float) -> str:
    """Write a size that may be round-off."""
    return f"{value:.2g}" if value >= _SMALLEST else f"< {_SMALLEST:g}"


def touching_share(dataset: xr.Dataset) -> float:
    """Compute the part of the loaded layer's area that touches the sample [-]."""
    return float(dataset["node_area"].values[_touches(dataset)].sum() / dataset["node_area"].values.sum())


def mean_pressure(dataset: xr.Dataset) -> float:
    """Compute the mean pressure over the area that touches the sample [kPa]; zero where nothing touches."""
    area = dataset["node_area"].values * _touches(dataset)
    return KPA * float(np.sum(dataset["pressure"].values * area)) / max(float(np.sum(area)), np.finfo(float).tiny)


def _touches(dataset: xr.Dataset) -> np.ndarray:
    return dataset["contact_status"].values != OPEN


def _pressures(dataset: xr.Dataset) -> list[Row]:
    pressure = KPA * dataset["pressure"].values
    at = np.unravel_index(np.argmax(pressure), pressure.shape)
    x, y = (float(dataset[f"{axis}_current"].values[at]) for axis in "xy")
    return [
        Row("Mean pressure", f"{mean_pressure(dataset):.3g}", "kPa", "over the area that touches the sample"),
        Row("High pressure", f"{np.percentile(pressure, 99):.3g}", "kPa", "99 of 100 places of the layer feel less"),
        Row("Largest pressure", f"{pressure.max():.3g}", "kPa", f"at x {x:.2f}, y {y:.2f} mm"),
    ]


def _compression(pixels: xr.Dataset) -> list[Row]:
    mean, largest = touching_compression(pixels)
    return [
        Row("Compression, mean", f"{mean:.3g}", "%", "of the unloaded thickness, where the sample touches"),
        Row("Compression, largest", f"{largest:.3g}", "%", "where the layer is thinnest"),
    ]


def _touching(dataset: xr.Dataset) -> list[Row]:
    rows = []
    for prefix, other in (("", "sample"), ("window_", "window")):
        status, area = (dataset[f"{prefix}{name}"].values for name in ("contact_status", "node_area"))
        areas = " / ".join(f"{area[status == code].sum():.3g}" for code in range(len(STATUS)))
        rows.append(Row(f"Contact with the {other}", areas, "mm²", f"{' / '.join(STATUS)}, of {area.sum():.3g} mm²"))
    return rows


def _misfit(dataset: xr.Dataset, pixels: xr.Dataset) -> list[Row]:
    """Say what the computed thickness misses, where something was measured."""
    if "sample_displacement" in dataset:
        return []
    words = "root mean square of measured less computed thickness, where the layer touches"
    rms = UM * residual_rms(pixels)
    if math.isnan(rms) and "misfit_rms" in dataset:
        rms, words = UM * float(dataset["misfit_rms"]), "root mean square, as the fit counts it"
    return [] if math.isnan(rms) else [Row("What the computation misses", f"{rms:.2g}", "µm", words)]


def _fit(dataset: xr.Dataset) -> list[Row]:
    if "pressure_std" not in dataset:
        return []
    area = dataset["node_area"].values
    std = KPA * float(np.sum(dataset["pressure_std"].values * area) / np.sum(area))
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
