"""How `to_xarray` labels a variable: dims, values, unit and a name in words."""

from typing import Any

import numpy as np

NODES = ("y", "x")
"""Dims of the layer's interface nodes."""

Variable = tuple[tuple[str, ...], Any, dict[str, Any]]


def variable(dims: tuple[str, ...], values: Any, units: str, long_name: str, **attrs: Any) -> Variable:
    """Label values.

    Args:
        dims: Names of the axes.
        values: Array of any kind.
        units: Unit of the values.
        long_name: What they are, in words.
        attrs: More attributes.
    """
    return dims, np.asarray(values), {"units": units, "long_name": long_name, **attrs}
