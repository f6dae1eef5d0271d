"""Shapes of inclusions in a sample: which points lie inside.

x and y as for the layer; depth [mm] counts from the sample's highest point towards the plate.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool

from .._checks import Leaf, check_finite, check_positive, concrete
from .._repr import with_units
from .._types import Points


def _check_vector(field: str, names: str, value: Array) -> None:
    expected = names.count(",") + 1
    if value.shape != (expected,):
        raise ValueError(f"{field} [mm] must be {names}, got shape {value.shape}.")
    check_finite(field, "mm", value)


class AbstractInclusion(eqx.Module):
    """A region of space."""

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def contains(self, x: Points, y: Points, depth: Points) -> Bool[Array, "*points"]:
        """Return which points [mm] lie inside."""
        raise NotImplementedError


class Cylinder(AbstractInclusion):
    """An upright cylinder.

    Args:
        centre: (x, y) of its axis [mm].
        radius: Radius [mm].
        depth: (from, to) [mm].

    Raises:
        ValueError: If a number is out of range.
    """

    centre: Array = eqx.field(converter=Leaf("Cylinder.centre", "mm"))
    radius: Array = eqx.field(converter=Leaf("Cylinder.radius", "mm"))
    depth: Array = eqx.field(converter=Leaf("Cylinder.depth", "mm"))

    def __check_init__(self):
        _check_vector("Cylinder.centre", "(x, y)", self.centre)
        check_positive("Cylinder.radius", "mm", self.radius)
        _check_vector("Cylinder.depth", "(from, to)", self.depth)
        depth = concrete(self.depth)
        if depth is not None and depth[0] >= depth[1]:
            raise ValueError(f"Cylinder.depth [mm] must be (from, to) with from < to, got {depth.tolist()}.")

    def contains(self, x: Points, y: Points, depth: Points) -> Bool[Array, "*points"]:
        """Return which points [mm] lie inside."""
        across = (x - self.centre[0]) ** 2 + (y - self.centre[1]) ** 2 <= self.radius**2
        return across & (depth >= self.depth[0]) & (depth <= self.depth[1])


class Sphere(AbstractInclusion):
    """A sphere.

    Args:
        centre: (x, y, depth) [mm].
        radius: Radius [mm].

    Raises:
        ValueError: If a number is out of range.
    """

    centre: Array = eqx.field(converter=Leaf("Sphere.centre", "mm"))
    radius: Array = eqx.field(converter=Leaf("Sphere.radius", "mm"))

    def __check_init__(self):
        _check_vector("Sphere.centre", "(x, y, depth)", self.centre)
        check_positive("Sphere.radius", "mm", self.radius)

    def contains(self, x: Points, y: Points, depth: Points) -> Bool[Array, "*points"]:
        """Return which points [mm] lie inside."""
        cx, cy, deep = self.centre
        return (x - cx) ** 2 + (y - cy) ** 2 + (depth - deep) ** 2 <= self.radius**2


class Box(AbstractInclusion):
    """A box along the axes.

    Args:
        low: (x, y, depth) of the corner with the smallest numbers [mm].
        high: (x, y, depth) of the opposite corner [mm].

    Raises:
        ValueError: If a number is out of range.
    """

    low: Array = eqx.field(converter=Leaf("Box.low", "mm"))
    high: Array = eqx.field(converter=Leaf("Box.high", "mm"))

    def __check_init__(self):
        _check_vector("Box.low", "(x, y, depth)", self.low)
        _check_vector("Box.high", "(x, y, depth)", self.high)
        low, high = concrete(self.low), concrete(self.high)
        if low is not None and high is not None and np.any(low >= high):
            raise ValueError(
                f"Box.low [mm] must lie below Box.high in x, y and depth, got {low.tolist()} and {high.tolist()}."
            )

    def contains(self, x: Points, y: Points, depth: Points) -> Bool[Array, "*points"]:
        """Return which points [mm] lie inside."""
        inside = (x >= self.low[0]) & (x <= self.high[0]) & (y >= self.low[1]) & (y <= self.high[1])
        return inside & (depth >= self.low[2]) & (depth <= self.high[2])


class HalfSpace(AbstractInclusion):
    """All that lies on one side of a plane.

    Args:
        point: (x, y, depth) of a point on the plane [mm].
        normal: Direction (x, y, depth) [-], of any length, from the plane into the inclusion.

    Raises:
        ValueError: If a number is out of range.
    """

    point: Array = eqx.field(converter=Leaf("HalfSpace.point", "mm"))
    normal: Array = eqx.field(converter=Leaf("HalfSpace.normal", "-"))

    def __check_init__(self):
        _check_vector("HalfSpace.point", "(x, y, depth)", self.point)
        _check_vector("HalfSpace.normal", "(x, y, depth)", self.normal)
        normal = concrete(self.normal)
        if normal is not None and not normal.any():
            raise ValueError("HalfSpace.normal [-] must be a direction (x, y, depth), got (0, 0, 0).")

    def contains(self, x: Points, y: Points, depth: Points) -> Bool[Array, "*points"]:
        """Return which points [mm] lie inside."""
        px, py, deep = self.point
        along_x, along_y, down = self.normal
        return along_x * (x - px) + along_y * (y - py) + down * (depth - deep) >= 0.0
