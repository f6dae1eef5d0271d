"""The finished sweep as one labelled dataset."""

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr

from .design import Points
from .outputs import ERROR, Label
from .store import Outcome

_NAMES = {"component": ["x", "y", "z"], "lateral": ["x", "y"]}


def table(points: Points, read: Callable[[int], Outcome], attributes: dict[str, Any]) -> xr.Dataset:
    """Lay out the points of a sweep by their axes.

    Args:
        points: The points.
        read: Returns the outcome of each.
        attributes: Further attributes of the sweep.
    """
    columns, labels = _columns(len(points), read)
    status, message, seconds, *outputs = columns.items()
    variables = {}
    for name, values in (status, message, seconds, *outputs):
        label = labels[name]
        if label.dims == (name,) and (values == values[:1]).all():  # positions, the same at all points
            variables[name] = (label.dims, values[0], _attributes(label, points))
            continue
        dims = label.dims or tuple(f"{name}_{axis}" for axis in range(values.ndim - 1))
        if dims == (name,):
            name = f"{name}_position"
        shaped = values.reshape(points.shape + values.shape[1:])
        variables[name] = ((*points.dims, *dims), shaped, _attributes(label, points))
    coordinates = {
        name: (points.dims if points.axes is None else (name,), values, _unit(points.units.get(name)))
        for name, values in points.coordinates.items()
    }
    used = {dim for dims, *_ in variables.values() for dim in dims}
    coordinates |= {name: ((name,), np.array(words)) for name, words in _NAMES.items() if name in used}
    coordinates |= {name: variables.pop(name) for name in list(variables) if variables[name][0] == (name,)}
    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def _columns(count: int, read: Callable[[int], Outcome]) -> tuple[dict[str, np.ndarray], dict[str, Label]]:
    """Collect each output at all points, NaN where a point has none."""
    status, message, seconds = [], [], np.full(count, np.nan)
    arrays: dict[str, np.ndarray] = {}
    labels = {
        "status": Label(long_name="how the point ended"),
        "message": Label(long_name="why it failed"),
        "wall_time": Label(units="s", long_name="wall time, of a point in a batch its share"),
    }
    absent: dict[str, list[int]] = {}
    for i in range(count):
        outcome = read(i)
        words = outcome.message
        ended = outcome.status
        seconds[i] = outcome.seconds
        for name, value in outcome.values.items():
            if name not in arrays:
                arrays[name] = np.zeros((count, *value.shape), value.dtype)
                absent[name] = list(range(i))
                labels[name] = outcome.labels[name]
            if arrays[name].shape[1:] == value.shape:
                arrays[name][i] = value
            else:
                absent[name].append(i)
                ended, words = ERROR, f"{name} has shape {value.shape}, elsewhere {arrays[name].shape[1:]}"
        for name in arrays.keys() - outcome.values.keys():
            absent[name].append(i)
        status.append(ended)
        message.append(words)
    for name, where in absent.items():
        if where:
            arrays[name] = arrays[name].astype(np.result_type(arrays[name].dtype, float))
            arrays[name][where] = np.nan
    return {"status": np.array(status), "message": np.array(message), "wall_time": seconds, **arrays}, labels


def _attributes(label: Label, points: Points) -> dict[str, str]:
    unit, per = label.units, points.units.get(label.per or "")
    if label.per is not None:
        unit = None if unit is None or per is None else f"{unit} / ({per})"
    return _unit(unit) | ({"long_name": label.long_name} if label.long_name else {})


def _unit(unit: str | None) -> dict[str, str]:
    return {} if unit is None else {"units": unit}
