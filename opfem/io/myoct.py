"""TIFF stacks of myOCT: dB on 16 bits, with their limits and grid as JSON in a tag.

Called by the reader of TIFF files where that JSON is there. Its depths count from the focus; only their steps are used.
"""

import json
from typing import Any

import numpy as np
import tifffile

from ..measurement import MeasurementError
from ..measurement.grid import LENGTH_UNITS

_TAGS = (305, 270)  # Software, and ImageDescription in older files
_VERSION = 3
_LEVELS = 2**16 - 2  # steps from the lowest level, 1, to the highest; 0 is no data
_UNITS = {**LENGTH_UNITS, "millimeters": 1.0, "milimeters": 1.0, "microns": 1e-3, "meters": 1e3}


def myoct_description(file: tifffile.TiffFile) -> dict[str, Any] | None:
    """Read myOCT's description of a stack; None for other stacks."""
    for tag in _TAGS:
        found = file.pages.first.tags.get(tag)
        text = found.value if found is not None else ""
        if isinstance(text, str) and text.startswith("{"):
            try:
                said = json.loads(text)
            except (ValueError, RecursionError):
                continue
            if isinstance(said, dict) and "version" in said and ("clim" in said or "c" in said):
                return said
    return None


def decoded(values: np.ndarray, said: dict[str, Any]) -> np.ndarray:
    """Turn levels into dB; NaN where there are no data."""
    limits = said.get("clim")
    if said["version"] != _VERSION or values.dtype != np.uint16:
        raise MeasurementError(
            f"is myOCT's of version {str(said['version'])[:20]!r} in {values.dtype}; read it with "
            f"myOCT and write it again, which makes version {_VERSION} in uint16."
        )
    try:
        low, high = sorted(float(limit) for limit in limits)  # pyright: ignore[reportOptionalIterable]
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not (np.isfinite([low, high]).all() and low < high):
        raise MeasurementError(f"myOCT's clim must be two numbers [dB], got {str(limits)[:60]}.")
    decibels = (values.astype(np.float32) - 1.0) * np.float32((high - low) / _LEVELS) + np.float32(low)
    decibels[values == 0] = np.nan
    return decibels


def spacing_of(said: dict[str, Any], axis: str) -> float | None:
    """Distance between samples along an axis [mm]; None where it is not stated, or not even."""
    try:
        grid = said["metadata"][axis]
        positions = np.asarray(grid["values"], float).ravel() * _UNITS[grid["units"]]
    except (KeyError, TypeError, ValueError):
        return None
    steps = np.diff(positions)
    even = steps.size > 0 and np.isfinite(steps).all() and np.ptp(steps) <= 1e-3 * abs(steps.mean())
    return float(abs(steps.mean())) if even else None
