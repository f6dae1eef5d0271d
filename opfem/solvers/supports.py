"""Which displacements are prescribed, and which rigid motions that leaves to friction."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.face import tributary_area
from ..model.palpation import SIDES
from .stencil import Nodal


class Supports(NamedTuple):
    """Which displacements are prescribed: static, so that it shapes the compiled solve."""

    window: str  # "contact", "roller" or "bonded"
    interface: str  # "contact", "traction", "uz" or "bonded"
    sides: tuple[str, str, str, str]
    spring: bool  # an in-plane spring holds the window face

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


def drift_modes(positions: Nodal, supports: Supports) -> Float[Array, "modes 2 my mx"] | None:
    """Build orthonormal rigid motions of the window face that no support prevents; None without any.

    Weighted by area: what they measure is the mean in-plane motion of the face.
    """
    X = positions[:2, 0]
    area = tributary_area(positions[:, 0])
    centred = X - jnp.sum(area * X, axis=(1, 2), keepdims=True) / jnp.sum(area)
    zero = jnp.zeros_like(area)
    candidates = (jnp.stack([area, zero]), jnp.stack([zero, area]), area * jnp.stack([-centred[1], centred[0]]))
    modes: list[Array] = []
    for drifts, mode in zip(supports.drifts, candidates, strict=True):
        if drifts:
            for other in modes:
                mode = mode - jnp.sum(mode * other) * other
            modes.append(mode / jnp.sqrt(jnp.sum(mode**2)))
    return jnp.stack(modes) if modes else None
