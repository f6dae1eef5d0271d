"""Maps of a solution or a fit on the pixels of a measured map, in space: what is compared, drawn and exported.

Last stage of the chain; made from the dataset of `to_xarray`, or from one that was read back.
"""

import math

import numpy as np
import xarray as xr

from ..measurement import ThicknessMap
from ..solvers.solution import OPEN, SLIP, STICK
from .dataset import IMAGE
from .fields import under_pixels
from .labels import NODES, Variable, variable

_STATUS = ("contact_status", "window_contact_status")
_STATES = (OPEN, STICK, SLIP)


def on_pixels(dataset: xr.Dataset, measured: ThicknessMap | None = None) -> xr.Dataset:
    """Read every map of the layer at the pixels of the measured map; NaN (status: -1) where no interface lies.

    Adds what the measurement makes of them: `measured`, `missing` (no data, filled or not) and `residual`, measured
    less computed thickness. It is NaN where there is no data and, of an imprint, where the sample does not touch:
    an air gap is no misfit.

    Args:
        dataset: What `to_xarray` returned for a solve or a fit that converged.
        measured: Measured map; None takes the map that was pressed in, or of other loads none.

    Returns:
        Maps in mm and MPa on `y_image`, `x_image`.
    """
    imprint = "imposed_thickness" in dataset
    x = dataset["x_image"].values if measured is None else np.asarray(measured.x)
    y = dataset["y_image"].values if measured is None else np.asarray(measured.y)
    maps = _maps(dataset, *np.meshgrid(x, y))
    values, missing = _measured(dataset, measured)
    if values is not None:
        residual = values - maps["thickness"][1]
        left_out = missing | (imprint & (maps["contact_status"][1] == OPEN))
        maps["measured"] = variable(IMAGE, values, "mm", "measured thickness of the loaded layer")
        maps["missing"] = variable(IMAGE, missing, "1", "pixels that hold no measured data")
        maps["residual"] = variable(
            IMAGE, np.where(left_out, np.nan, residual), "mm", "measured minus computed thickness"
        )
    coordinates = {
        "x_image": variable(("x_image",), x, "mm", "position of image columns"),
        "y_image": variable(("y_image",), y, "mm", "position of image rows"),
    }
    return xr.Dataset(maps, coords=coordinates, attrs=dataset.attrs)


def touching_compression(pixels: xr.Dataset) -> tuple[float, float]:
    """Compute the mean and the largest compression where the sample touches [%]; NaN where it does not.

    Pixels beyond the unloaded layer, which bulges, are left out.

    Args:
        pixels: What `on_pixels` returned.
    """
    values = 100.0 * pixels["compression"].values[pixels["contact_status"].values > OPEN]
    values = values[np.isfinite(values)]
    return (float(values.mean()), float(values.max())) if values.size else (math.nan, math.nan)


def _maps(dataset: xr.Dataset, x: np.ndarray, y: np.ndarray) -> dict[str, Variable]:
    X = np.stack(np.meshgrid(dataset["x"].values, dataset["y"].values))
    u = dataset["displacement"].transpose("component", "z", *NODES).values
    L0 = dataset["unloaded_thickness"].values
    # An experiment's window may leave a gap below the layer, which is none of its thickness.
    height = L0 + u[2, -1] - (u[2, 0] if "sample_displacement" in dataset else 0.0)
    nodal = [name for name in ("pressure", "pressure_std") if name in dataset]
    states = [dataset[name].values == state for name in _STATUS for state in _STATES]
    stacked = np.stack([height, *(dataset[name].values for name in nodal), *np.asarray(states, float)])
    thickness, *others = under_pixels(stacked, X, u[:2, -1], x, y)
    unloaded = under_pixels(L0, X, np.zeros_like(X), x, y)
    maps = {
        "thickness": variable(IMAGE, thickness, **_labels(dataset["thickness"])),
        "compression": variable(IMAGE, 1.0 - thickness / unloaded, **_labels(dataset["compression"])),
    }
    maps |= {name: variable(IMAGE, others.pop(0), **_labels(dataset[name])) for name in nodal}
    shares = np.stack(others).reshape(len(_STATUS), len(_STATES), *x.shape)
    off = np.isnan(thickness)
    for name, share in zip(_STATUS, shares, strict=True):
        status = np.where(off, -1, np.argmax(np.nan_to_num(share), axis=0)).astype(np.int8)
        maps[name] = (IMAGE, status, dataset[name].attrs)
    return maps


def _labels(values: xr.DataArray) -> dict[str, str]:
    return {"units": values.attrs["units"], "long_name": values.attrs["long_name"]}


def _measured(dataset: xr.Dataset, measured: ThicknessMap | None) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Find the measured thickness [mm], NaN where it is no data, and where that is."""
    if measured is not None:
        missing = np.asarray(measured.mask)
        return np.where(missing, np.nan, measured.values), missing
    if "imposed_thickness" not in dataset:
        return None, None
    missing = dataset["missing"].values.astype(bool)
    return np.where(missing, np.nan, dataset["imposed_thickness"].values), missing
