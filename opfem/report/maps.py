"""The maps of a report: which there are for a result, their values in the units of the field, and what covers them.

Values are as computed or measured; where they are not data, or the layer touches nothing, a map says so itself.
"""

from typing import Literal, NamedTuple

import numpy as np
import xarray as xr

from ..measurement import ThicknessMap
from .places import Axis, Grid, Places, at_places, nearest

KPA = 1e3
UM = 1e3
STATUS = ("open", "sticks", "slips")
"""Words of the contact status 0, 1, 2."""
OPEN = 0
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
        values: In `unit`; NaN where there is nothing to draw.
        kind: Size from zero or from the least value, deviation about zero, or a status.
        limits: Ends of the colours; None takes those of the values.
        unmeasured: Where the map that was measured holds no data.
        clear: Where the layer does not touch the sample, so that the value says nothing of it.
    """

    key: str
    title: str
    unit: str
    words: str
    x: Axis
    y: Axis
    values: Grid
    kind: Literal["size", "thickness", "deviation", "uncertainty", "status"]
    limits: tuple[float, float] | None = None
    unmeasured: np.ndarray | None = None
    clear: np.ndarray | None = None


def report_maps(dataset: xr.Dataset, measured: ThicknessMap | None, places: Places) -> list[ReportMap]:
    """Collect the maps of a result, in the order in which they are read.

    Args:
        dataset: What `to_xarray` returned.
        measured: The measured map, where it is known.
        places: Pixels of the page.
    """
    x, y = places.x, places.y
    image = _pixels_of(dataset, measured, places.stride)
    unmeasured = None if image is None else _resampled(image.missing, (image.x, image.y), (x, y))
    clear = nearest(dataset["contact_status"].values, places.sample) == OPEN
    computed = UM * at_places(loaded_thickness(dataset), places.sample)
    pressure = KPA * at_places(dataset["pressure"].values, places.sample)
    return [
        _thickness(image, x, y, computed),
        ReportMap(
            "compression",
            "Compression of the layer",
            "%",
            "How much thinner the loaded layer is than the unloaded one, 1 − L1/L0, as computed.",
            x,
            y,
            100.0 * (1.0 - computed / (UM * _unloaded(dataset, places))),
            "thickness",
            unmeasured=unmeasured,
        ),
        ReportMap(
            "pressure",
            "Pressure on the sample",
            "kPa",
            "Force between layer and sample per area, at a right angle to the surface, where the surface now lies.",
            x,
            y,
            pressure,
            "size",
            unmeasured=unmeasured,
            clear=clear,
        ),
        *_uncertainty(dataset, places, unmeasured, clear),
        *_statuses(dataset, places),
        *_residual(dataset, image, places, clear),
    ]


def loaded_thickness(dataset: xr.Dataset) -> np.ndarray:
    """Compute how thick the loaded layer is over each node of the interface [mm], measured from the window's plane."""
    uz = dataset["displacement"].transpose("component", "z", "y", "x").values[2]
    return dataset["unloaded_thickness"].values + uz[-1]


class _Image(NamedTuple):
    """A map on pixels of its own."""

    x: Axis
    y: Axis
    values: Grid
    missing: np.ndarray
    computed: Grid | None
    words: str


def _pixels_of(dataset: xr.Dataset, measured: ThicknessMap | None, stride: int) -> _Image | None:
    """Find the map that was measured, or else pressed in; None where the result holds neither."""
    thin = (slice(None, None, stride),) * 2
    x, y = dataset["x_image"].values, dataset["y_image"].values
    if measured is not None:
        mx, my = np.asarray(measured.x), np.asarray(measured.y)
        same = mx.shape == x.shape and my.shape == y.shape and np.allclose(mx, x) and np.allclose(my, y)
        computed = dataset["thickness"].values[thin] if same else None
        missing = np.asarray(measured.mask)[thin]
        values = np.asarray(measured.values)[thin]
        return _Image(mx[::stride], my[::stride], values, missing, computed, "as measured")
    if "imposed_thickness" not in dataset:
        return None
    values, missing = (dataset[name].values[thin] for name in ("imposed_thickness", "missing"))
    computed = dataset["thickness"].values[thin]
    return _Image(x[::stride], y[::stride], values, missing.astype(bool), computed, "as it was pressed in")


def _thickness(image: _Image | None, x: Axis, y: Axis, computed: Grid) -> ReportMap:
    if image is None:
        words = "From the window to the sample, as computed; this result does not hold the measured map."
        return ReportMap("thickness", "Thickness, computed", "µm", words, x, y, computed, "thickness")
    words = f"From the window to the sample under load, {image.words}."
    values = np.where(image.missing, np.nan, UM * image.values)
    title = "Thickness, measured" if image.words == "as measured" else "Thickness, pressed in"
    return ReportMap("thickness", title, "µm", words, image.x, image.y, values, "thickness", unmeasured=image.missing)


def _unloaded(dataset: xr.Dataset, places: Places) -> Grid:
    """Read the unloaded thickness [mm] at the pixels themselves, where the microscope saw it before loading."""
    rows, columns = (
        np.interp(positions, dataset[axis].values, np.arange(dataset[axis].size))
        for axis, positions in (("y", places.y), ("x", places.x))
    )
    return at_places(dataset["unloaded_thickness"].values, np.stack(np.meshgrid(rows, columns, indexing="ij")))


def _uncertainty(
    dataset: xr.Dataset, places: Places, unmeasured: np.ndarray | None, clear: np.ndarray
) -> list[ReportMap]:
    if "pressure_std" not in dataset:
        return []
    words = (
        "Standard deviation that noise and missing pixels leave, if material and friction are as stated. Detail finer "
        "than the resolution, among the numbers below, is not in it."
    )
    std = KPA * at_places(dataset["pressure_std"].values, places.sample)
    title = "Uncertainty of the pressure"
    top = float(np.nanmax(std))
    return [
        ReportMap(
            "uncertainty", title, "kPa", words, places.x, places.y, std, "uncertainty", (0.0, top), unmeasured, clear
        )
    ]


def _statuses(dataset: xr.Dataset, places: Places) -> list[ReportMap]:
    words = "Where the layer {0}: open is clear of it, sticks holds by friction, slips slides along it."
    return [
        ReportMap(
            f"{prefix}status",
            f"Contact with the {other}",
            "",
            words.format(f"touches the {other}"),
            places.x,
            places.y,
            nearest(dataset[f"{prefix}contact_status"].values, at),
            "status",
        )
        for prefix, other, at in (("", "sample", places.sample), ("window_", "window", places.window))
    ]


def _residual(dataset: xr.Dataset, image: _Image | None, places: Places, clear: np.ndarray) -> list[ReportMap]:
    """Take what the computed thickness misses: of the map, or of a fit where the result does not hold the map."""
    words = (
        "Measured less computed thickness. Structure here that is no noise is what the computation does not explain."
    )
    unmeasured, is_fit = None, "pressure_std" in dataset
    computed = None if image is None else image.computed
    if image is not None and computed is None and is_fit and image.x.size == places.x.size:
        computed = at_places(loaded_thickness(dataset), places.sample)
    if image is not None and computed is not None:
        x, y, unmeasured = image.x, image.y, image.missing
        values = UM * np.where(image.missing, np.nan, image.values - computed)
    elif is_fit:
        x, y, values = dataset["x"].values, dataset["y"].values, -UM * dataset["residual"].values
    else:
        return []
    clear = _resampled(clear, (places.x, places.y), (x, y))
    known = np.abs(values[np.isfinite(values) & ~clear])
    limit = max(float(np.percentile(known, _OFF)), 1e-3) if known.size else 1.0
    title = "What the computation misses"
    return [ReportMap("residual", title, "µm", words, x, y, values, "deviation", (-limit, limit), unmeasured, clear)]


def _resampled(mask: np.ndarray, axes: tuple[Axis, Axis], onto: tuple[Axis, Axis]) -> np.ndarray:
    """Read a mask on x and y at the pixels nearest to those of other axes."""
    columns, rows = (
        np.rint(np.interp(to, axis, np.arange(axis.size))).astype(int) for axis, to in zip(axes, onto, strict=True)
    )
    return mask[np.ix_(rows, columns)]
