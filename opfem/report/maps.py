"""The maps of a report: which there are for a result, their values in the units of the field, and what covers them.

Values are as computed or measured; where they are not data, or the layer touches nothing, a map says so itself.
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

KPA = 1e3
UM = 1e3
STATUS = ("open", "sticks", "slips")
"""Words of the contact status 0, 1, 2."""
OPEN = 0
MOST_PIXELS = 256
"""Pixels of a map along one axis: eight maps of that many take 2.5 MB of the page."""
_HOW = {
    "measured": "as measured",
    "pressed in": "as the computation took it",
    "as it would be measured": "with the noise of a microscope",
}
# Percentile of the size at the ends of the residual's colours, so that a few pixels do not set them.
_OFF = 99.5


class ReportMap(NamedTuple):
    """One map.

    Attributes:
        key: Name in the page.
        title: What it shows.
        unit: Of the values; empty for a status.
        words: What that means, for a reader who has not met it.
        x: Of columns [mm].
        y: Of rows [mm].
        values: In `unit`; NaN, of a status -1, where there is nothing to draw.
        kind: Size from zero, thickness from the least value, deviation about zero, uncertainty, or a status.
        limits: Ends of the colours; None takes those of the values.
        unmeasured: Where the map that was measured holds no data.
        clear: Where the layer does not touch the sample, so that the value says nothing of it.
    """

    key: str
    title: str
    unit: str
    words: str
    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    kind: Literal["size", "thickness", "deviation", "uncertainty", "status"]
    limits: tuple[float, float] | None = None
    unmeasured: np.ndarray | None = None
    clear: np.ndarray | None = None


def stride_of(pixels: xr.Dataset) -> int:
    """Say every how many pixels a report draws.

    Args:
        pixels: What `on_pixels` returned.
    """
    return math.ceil(max(pixels.sizes.values()) / MOST_PIXELS)


def report_maps(dataset: xr.Dataset, pixels: xr.Dataset, was_measured: bool) -> list[ReportMap]:
    """Collect the maps of a result, in the order in which they are read.

    Args:
        dataset: What `to_xarray` returned.
        pixels: What `on_pixels` returned for it.
        was_measured: Whether the thickness is that of a measured map, and not the one that was pressed in.
    """
    every = slice(None, None, stride_of(pixels))
    pixels = pixels.isel(x_image=every, y_image=every)
    compression = 100.0 * pixels["compression"].values
    clear = pixels["contact_status"].values == OPEN
    return [
        _thickness(pixels, was_measured, "sample_displacement" in dataset),
        _map(
            pixels,
            "compression",
            "Compression of the layer",
            "%",
            "How much thinner the loaded layer is than the unloaded one, 1 − L1/L0, as computed.",
            compression,
            "thickness",
        ),
        _map(
            pixels,
            "pressure",
            "Pressure on the sample",
            "kPa",
            "Force between layer and sample per area, at a right angle to the surface, where the surface now lies.",
            KPA * pixels["pressure"].values,
            "size",
            clear=clear,
        ),
        *_uncertainty(pixels, clear),
        *_statuses(pixels),
        *_residual(dataset, pixels, clear),
    ]


def _map(
    pixels: xr.Dataset, key: str, title: str, unit: str, words: str, values: np.ndarray, kind: Any, **more: Any
) -> ReportMap:
    """Make a map on the pixels of the measured one."""
    missing = pixels["missing"].values if "missing" in pixels else None
    axes = pixels["x_image"].values, pixels["y_image"].values
    return ReportMap(key, title, unit, words, *axes, values, kind, unmeasured=missing, **more)


def _thickness(pixels: xr.Dataset, was_measured: bool, simulated: bool) -> ReportMap:
    if "measured" not in pixels:
        words = "From the window to the sample, as computed; this result does not hold the measured map."
        return _map(
            pixels, "thickness", "Thickness, computed", "µm", words, UM * pixels["thickness"].values, "thickness"
        )
    done = "pressed in" if not was_measured else "as it would be measured" if simulated else "measured"
    words = f"From the window to the sample under load, {_HOW[done]}."
    return _map(pixels, "thickness", f"Thickness, {done}", "µm", words, UM * pixels["measured"].values, "thickness")


def _uncertainty(pixels: xr.Dataset, clear: np.ndarray) -> list[ReportMap]:
    if "pressure_std" not in pixels:
        return []
    words = (
        "Standard deviation that noise and missing pixels leave, if material and friction are as stated. Detail finer "
        "than the resolution, among the numbers below, is not in it."
    )
    std = KPA * pixels["pressure_std"].values
    limits = (0.0, float(np.nanmax(std)))
    title = "Uncertainty of the pressure"
    return [_map(pixels, "uncertainty", title, "kPa", words, std, "uncertainty", limits=limits, clear=clear)]


def _statuses(pixels: xr.Dataset) -> list[ReportMap]:
    axes = pixels["x_image"].values, pixels["y_image"].values
    return [
        ReportMap(
            f"{prefix}status",
            f"Contact with the {other}",
            "",
            f"Open: the layer is clear of the {other}. Sticks: friction keeps it in place. Slips: it slides.",
            *axes,
            pixels[f"{prefix}contact_status"].values,
            "status",
        )
        for prefix, other in (("", "sample"), ("window_", "window"))
    ]


def _residual(dataset: xr.Dataset, pixels: xr.Dataset, clear: np.ndarray) -> list[ReportMap]:
    """Take what the computed thickness misses: of the map, or of a fit where the result does not hold the map."""
    title = "What the computation misses"
    words = (
        "Measured less computed thickness. Structure here that is no noise is what the computation does not explain."
    )
    if "residual" in pixels and "sample_displacement" not in dataset:
        values = UM * pixels["residual"].values
        limits = _around_zero(values)
        return [_map(pixels, "residual", title, "µm", words, values, "deviation", limits=limits, clear=clear)]
    if "pressure_std" in dataset:
        x, y, values = dataset["x"].values, dataset["y"].values, -UM * dataset["residual"].values
        return [ReportMap("residual", title, "µm", words, x, y, values, "deviation", _around_zero(values))]
    return []


def _around_zero(values: np.ndarray) -> tuple[float, float]:
    known = np.abs(values[np.isfinite(values)])
    limit = max(float(np.percentile(known, _OFF)), 1e-3) if known.size else 1.0
    return -limit, limit
