"""Axial displacement between two states at points of the first: what phase measures, and friction fits compare."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ..._checks import as_leaf, check_finite, check_non_negative, check_positive
from ..._types import Scalar


class AxialIncrement(eqx.Module):
    """u_z(after) - u_z(before) at points of the state before.

    Attributes:
        points: Positions (x, y, z) in the state before, `(n, 3)` [mm].
        values: Displacements along z, negative towards the window `(n,)` [mm].
        std: Their standard deviation [mm], a number or `(n,)`, taken as independent.
        scale_std: Relative standard deviation of the scale that all share [-]: wavelength over index.
        before: Which state is the first, of those that are solved one after the other; static.
        after: Which is the second; static.
    """

    points: Float[Array, "n 3"]
    values: Float[Array, " n"]
    std: Array
    scale_std: Scalar
    before: int = eqx.field(static=True)
    after: int = eqx.field(static=True)

    def __init__(self, points: Any, values: Any, std: Any, scale_std: Any = 0.01, *, before: int = 0, after: int = 1):
        """Make increments from arrays.

        Args:
            points: Positions before, shape (n, 3) [mm].
            values: Displacements, shape (n,) [mm].
            std: Standard deviation [mm], a number or shape (n,).
            scale_std: Relative standard deviation of the common scale [-].
            before: Number of the first state, from 0.
            after: Number of the second.

        Raises:
            ValueError: For shapes that do not match, numbers out of range, and one state twice.
        """
        self.points = as_leaf(points, "AxialIncrement.points", "mm")
        self.values = as_leaf(values, "AxialIncrement.values", "mm")
        self.std = as_leaf(std, "AxialIncrement.std", "mm")
        self.scale_std = as_leaf(scale_std, "AxialIncrement.scale_std", "-")
        self.before, self.after = before, after
        n = self.values.shape
        if self.values.ndim != 1 or self.points.shape != (*n, 3) or self.std.shape not in ((), n):
            raise ValueError(
                "AxialIncrement needs points (n, 3), values (n,) and std, a number or (n,), got shapes "
                f"{self.points.shape}, {self.values.shape} and {self.std.shape}."
            )
        check_finite("AxialIncrement.points", "mm", self.points)
        check_finite("AxialIncrement.values", "mm", self.values)
        check_positive("AxialIncrement.std", "mm", self.std)
        check_non_negative("AxialIncrement.scale_std", "-", self.scale_std)
        if before == after:
            raise ValueError(f"AxialIncrement.before and after must be two states, got {before} twice.")
