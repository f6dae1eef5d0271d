"""The points of a sweep: grids, zipped lists and designs from `scipy.stats.qmc`.

First part of a sweep; points are known before anything is computed, and their order never changes.
"""

import dataclasses
import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

POINT = "point"
"""Dimension of points that form no grid."""
RESERVED = (POINT, "status", "message", "wall_time")


@dataclasses.dataclass(frozen=True)
class Points:
    """Points in their order.

    Attributes:
        columns: Value of each argument at each point `(points,)`.
        axes: The axes of a grid, in order, the last running fastest; None where points form no grid.
        units: Units that came with axes.
    """

    columns: dict[str, np.ndarray]
    axes: dict[str, np.ndarray] | None
    units: dict[str, str]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def with_units(self, units: Mapping[str, str]) -> "Points":
        """Take the units of axes from a table of units; raise ValueError where they contradict their own."""
        for name in self.columns:
            own, given = self.units.get(name), units.get(name)
            if own is not None and given is not None and own != given:
                raise ValueError(f"Axis {name!r} of the sweep comes in {own!r}, got units {given!r}. Leave one out.")
        known = {name: unit for name, unit in units.items() if name in self.columns}
        return dataclasses.replace(self, units={**known, **self.units})

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the table."""
        return (POINT,) if self.axes is None else tuple(self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return (len(self),) if self.axes is None else tuple(len(values) for values in self.axes.values())

    @property
    def coordinates(self) -> dict[str, np.ndarray]:
        """Values that label the table: axes of a grid, else columns."""
        return self.columns if self.axes is None else self.axes


def grid(axes: Mapping[str, Any]) -> Points:
    """Combine every value of each axis with every value of the others.

    Args:
        axes: Values of each argument: a list, an array or a one-dimensional `xarray.DataArray`, whose units are kept.

    Raises:
        ValueError: If an axis is empty, has more than one dimension, contains NaN, or repeats a value.
    """
    values, units = _read(axes)
    for name, axis in values.items():
        if len(np.unique(axis)) < len(axis):
            raise ValueError(f"Axis {name!r} of the sweep must contain each value once, got {_short(axis)}.")
    mesh = np.meshgrid(*values.values(), indexing="ij")
    columns = {name: column.ravel() for name, column in zip(values, mesh, strict=True)}
    return Points(columns, values, units)


def zip_(axes: Mapping[str, Any]) -> Points:
    """Take the first values of all axes as the first point, the second as the second, and so on.

    Args:
        axes: Values of each argument, all of one length.

    Raises:
        ValueError: If lengths differ, a point is there twice, or an axis is not as `grid` wants it.

    Example:
        >>> import opfem as op
        >>> points = op.zip_({"c10": [1e-3, 2e-3], "bulk": [0.06, 0.12]})
        >>> len(points)
        2
    """
    values, units = _read(axes)
    lengths = {name: len(axis) for name, axis in values.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"zip_ needs axes of one length, got {lengths}.")
    rows = list(zip(*(axis.tolist() for axis in values.values()), strict=True))
    if len(set(rows)) < len(rows):
        raise ValueError(f"zip_ needs each point once, got {len(rows) - len(set(rows))} of {len(rows)} twice.")
    return Points(values, None, units)


def sample(
    bounds: Mapping[str, tuple[float, float]], unit_points: Float[np.ndarray, "points axes"], log: Sequence[str] = ()
) -> Points:
    """Stretch points of the unit cube, as `scipy.stats.qmc` draws them, over ranges of the arguments.

    Args:
        bounds: Lowest and highest value of each argument.
        unit_points: Points in the unit cube, columns in the order of `bounds` [-].
        log: Arguments that are spread evenly by their logarithm.

    Raises:
        ValueError: If the columns are not as many as the bounds, or a range is not one.

    Example:
        >>> from scipy.stats import qmc
        >>> import opfem as op
        >>> cube = qmc.Sobol(d=2, rng=0).random(8)
        >>> points = op.sample({"c10": (1e-3, 1e-2), "friction": (0.0, 0.3)}, cube, log=["c10"])
    """
    cube = np.asarray(unit_points, float)
    if cube.ndim != 2 or cube.shape[1] != len(bounds) or cube.size == 0 or cube.min() < 0 or cube.max() > 1:
        raise ValueError(
            f"sample.unit_points [-] must be (points, {len(bounds)}) between 0 and 1, got shape {cube.shape}. "
            f"scipy.stats.qmc.Sobol(d={len(bounds)}).random(n) draws such points."
        )
    for name in log:
        known_name("sample.log", name, bounds)
    columns = {}
    for column, (name, (low, high)) in zip(cube.T, bounds.items(), strict=True):
        if not (np.isfinite([low, high]).all() and low < high and (low > 0 or name not in log)):
            wanted = "two positive numbers, the lower first, for log" if name in log else "two numbers, the lower first"
            raise ValueError(f"sample.bounds[{name!r}] must be {wanted}, got {(low, high)}.")
        columns[name] = low * (high / low) ** column if name in log else low + (high - low) * column
    return zip_(columns)


def check_arguments(fn: Callable, points: Points) -> None:
    """Raise ValueError unless the axes are arguments of the function, and all that it needs."""
    name = getattr(fn, "__name__", "fn")
    parameters = inspect.signature(fn).parameters
    if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        by_name = [key for key, p in parameters.items() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        for axis in points.columns:
            known_name(f"Axis of the sweep: argument of {name}", axis, by_name)
    missing = [
        key
        for key, p in parameters.items()
        if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL) and key not in points.columns
    ]
    if missing:
        raise ValueError(
            f"{name} needs {', '.join(missing)}, which no axis gives. Add an axis of one value, or a default."
        )


def known_name(what: str, name: Any, known: Any) -> None:
    """Raise ValueError unless a name is among those known; suggest the nearest."""
    if name not in known:
        near = difflib.get_close_matches(str(name), [str(k) for k in known], n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{what} must be one of {', '.join(map(str, known)) or 'none'}, got {name!r}.{hint}")


def _read(axes: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    if not isinstance(axes, Mapping) or not axes:
        raise ValueError(f"The axes of a sweep must be a dict of argument names and values, got {axes!r}.")
    values, units = {}, {}
    for name, axis in axes.items():
        values[name] = _read_axis(name, axis)
        if isinstance(axis, xr.DataArray) and "units" in axis.attrs:
            units[name] = axis.attrs["units"]
    return values, units


def _read_axis(name: str, axis: Any) -> np.ndarray:
    if not isinstance(name, str) or name in RESERVED:
        raise ValueError(f"An axis of a sweep cannot be called {name!r}; {', '.join(RESERVED)} have their own meaning.")
    values = np.asarray(axis)
    if values.ndim != 1:
        raise ValueError(
            f"Axis {name!r} of the sweep must be a list of numbers, got shape {values.shape}. A fixed value is a list "
            "of one; for maps sweep an index, and index the maps in the function: maps[index]."
        )
    if values.size == 0:
        raise ValueError(f"Axis {name!r} of the sweep is empty. Give it at least one value, or leave it out.")
    if values.dtype.kind not in "fiubU":
        raise ValueError(f"Axis {name!r} of the sweep must contain numbers or words, got {_short(values)}.")
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise ValueError(f"Axis {name!r} of the sweep must not contain NaN, got {_short(values)}.")
    return values.astype(float) if values.dtype.kind == "f" else values


def _short(values: np.ndarray) -> str:
    return np.array2string(values, threshold=8, edgeitems=3, separator=", ")
