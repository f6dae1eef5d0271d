"""A sweep as columns of numbers, one entry a point: for a table, a picture, and its lowest and highest points.

Read from the dataset of a sweep; maps and other arrays stay there.
"""

import csv
import io
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from .design import POINT
from .outputs import GOOD

_VECTORS = ("component", "lateral")
_OF_A_POINT = ("status", "message", "wall_time")


class SweepColumns(NamedTuple):
    """What is one number a point.

    Attributes:
        axes: Values of each axis.
        outputs: Each output; of a vector its components, as `force_sample_z`.
        units: Of axes and outputs, where they are known.
        status: How each point ended.
        message: Why it failed.
        wall_time: Of each point [s].
        shape: Of the grid, the last axis running fastest; None where points form none.
    """

    axes: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    units: dict[str, str]
    status: np.ndarray
    message: np.ndarray
    wall_time: np.ndarray
    shape: tuple[int, ...] | None

    @property
    def good(self) -> np.ndarray:
        """Which points have a result."""
        return np.isin(self.status, GOOD)

    def at(self, point: int) -> str:
        """Name a point by its axes."""
        return ", ".join(f"{name} {self.written(name, values[point])}" for name, values in self.axes.items())

    def written(self, name: str, value: object) -> str:
        """Write a value of an axis or an output with its unit."""
        text = value if isinstance(value, str) else f"{value:.4g}"
        return text if self.units.get(name, "1") == "1" else f"{text} {self.units[name]}"

    def title(self, name: str) -> str:
        """Name an axis or an output and its unit."""
        return name if self.units.get(name, "1") == "1" else f"{name} [{self.units[name]}]"

    def read_in(self, units: Mapping[str, tuple[float, str]]) -> "SweepColumns":
        """Convert numbers to the units that people read them in.

        Args:
            units: A factor and another unit for each unit that is not read as it is.
        """

        def converted(numbers: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            known = {name: units[unit][0] for name, unit in self.units.items() if unit in units}
            return {name: known[name] * values if name in known else values for name, values in numbers.items()}

        named = {name: units.get(unit, (1.0, unit))[1] for name, unit in self.units.items()}
        return self._replace(axes=converted(self.axes), outputs=converted(self.outputs), units=named)

    def ends(self, name: str) -> tuple[int, int] | None:
        """Find the points of the lowest and of the highest value of an output; None where no point has one."""
        known = np.flatnonzero(self.good & np.isfinite(self.outputs[name].astype(float)))
        if not known.size:
            return None
        values = self.outputs[name][known]
        return int(known[np.argmin(values)]), int(known[np.argmax(values)])


def columns(data: xr.Dataset) -> SweepColumns:
    """Read the columns of a sweep.

    Args:
        data: What `sweep` returned.
    """
    dims = data["status"].dims
    is_grid = dims != (POINT,)
    named = dims if is_grid else [str(name) for name, values in data.coords.items() if values.dims == dims]
    axes = {str(name): data[name].broadcast_like(data["status"]).transpose(*dims).values.ravel() for name in named}
    outputs, units = {}, {name: str(data[name].attrs["units"]) for name in axes if "units" in data[name].attrs}
    for variable, values in data.data_vars.items():
        of_point, more = values.dims[: len(dims)] == dims, values.dims[len(dims) :]
        if variable in _OF_A_POINT or not of_point or values.dtype.kind not in "fiub":
            continue
        if more and not (len(more) == 1 and more[0] in _VECTORS):
            continue
        parts = {f"{variable}_{part}": values.sel({more[0]: part}) for part in data[more[0]].values} if more else {}
        for name, part in (parts or {str(variable): values}).items():
            outputs[name] = part.values.ravel()
            units |= {name: str(values.attrs["units"])} if "units" in values.attrs else {}
    status, message, wall_time = (
        data[name].values.ravel() if name in data else np.full(data["status"].size, absent)
        for name, absent in zip(_OF_A_POINT, ("", "", np.nan), strict=True)
    )
    return SweepColumns(axes, outputs, units, status, message, wall_time, data["status"].shape if is_grid else None)


def csv_bytes(data: xr.Dataset) -> bytes:
    """Encode a sweep as a table with a row for each point: axes, outputs of one number, and how the point ended.

    Args:
        data: What `sweep` returned.
    """
    parts = columns(data)
    numbers = {**parts.axes, **parts.outputs}
    words = {"status": parts.status, "message": parts.message, "wall_time [s]": parts.wall_time}
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*map(parts.title, numbers), *words])
    table.writerows([_written(value) for value in row] for row in zip(*numbers.values(), *words.values(), strict=True))
    return text.getvalue().encode()


def _written(value: object) -> str:
    return str(value) if isinstance(value, str) else f"{value:.8g}"
