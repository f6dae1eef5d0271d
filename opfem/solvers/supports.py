"""Supports: prescribed displacements, and the rigid motions that only friction resists."""

from typing import NamedTuple

import numpy as np

from ..model.palpation import SIDES


class Supports(NamedTuple):
    """Kinds of boundary conditions, static: they determine the compiled solve."""

    window: str  # "contact", "roller" or "bonded"
    interface: str  # "contact", "traction", "uz" or "bonded"
    sides: tuple[str, str, str, str]
    spring: bool  # whether an in-plane spring supports the window face

    def free(self, node_shape: tuple[int, ...]) -> np.ndarray:
        """Build the mask of unknowns, 1 where free, `(3, nz+1, ny+1, nx+1)`."""
        free = np.ones((3, *node_shape))
        for side, kind in zip(SIDES, self.sides, strict=True):
            if kind == "roller":
                component, where = ("x", "y").index(side[0]), 0 if side[1] == "0" else -1
                free[(component, ..., where) if component == 0 else (component, slice(None), where)] = 0.0
        for kind, layer in ((self.window, 0), (self.interface, -1)):
            if kind in ("roller", "uz"):
                free[2, layer] = 0.0
            if kind == "bonded":
                free[:, layer] = 0.0
        return free

    @property
    def drifts(self) -> tuple[bool, bool, bool]:
        """Rigid in-plane motions that only friction resists: along x, along y, about z."""
        if self.spring or "bonded" in (self.window, self.interface):
            return (False, False, False)
        x = "roller" not in self.sides[:2]
        y = "roller" not in self.sides[2:]
        return (x, y, x and y)
