"""Supports: prescribed displacements, and the rigid motions that only friction resists."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.face import tributary_area
from ..model.palpation import SIDES
from .stencil import Nodal


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


def drift_modes(positions: Nodal, supports: Supports) -> Float[Array, "modes 2 my mx"] | None:
    """Build orthonormal rigid motions of the window face that no support prevents; None without any.

    Weights are areas: a projection on them is the mean in-plane motion of the face.
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


def rigid_drift(
    positions: Nodal, face: Float[Array, "2 my mx"], modes: Float[Array, "modes 2 my mx"], supports: Supports
) -> Float[Array, "2 mz my mx"]:
    """Compute the rigid in-plane motion of the body that has the same modes at the window face as `face`.

    Args:
        positions: Reference positions of the nodes [mm].
        face: In-plane displacement of the window face [mm].
        modes: Modes of `drift_modes`.
        supports: The supports.
    """
    x, y = positions[:2] - jnp.mean(positions[:2], axis=(1, 2, 3), keepdims=True)
    one, none = jnp.ones_like(x), jnp.zeros_like(x)
    candidates = (jnp.stack([one, none]), jnp.stack([none, one]), jnp.stack([-y, x]))
    motions = jnp.stack([motion for motion, drifts in zip(candidates, supports.drifts, strict=True) if drifts])
    motions, modes = motions.astype(face.dtype), modes.astype(face.dtype)
    measured = jnp.tensordot(modes, jnp.moveaxis(motions[:, :, 0], 0, -1), 3)  # modes, motions
    return jnp.tensordot(_solve_small(measured, jnp.tensordot(modes, face, 3)), motions, 1)


def _solve_small(A: Array, b: Array) -> Array:
    """Solve a system of at most three unknowns by Cramer's rule, without LAPACK."""
    n = b.shape[0]
    if n == 1:
        return b / A[0]

    def determinant(A):
        if n == 2:
            return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        return jnp.dot(A[0], jnp.cross(A[1], A[2]))

    whole = determinant(A)
    columns = [jnp.concatenate([A[:, :k], b[:, None], A[:, k + 1 :]], axis=1) for k in range(n)]
    return jnp.stack([determinant(column) / whole for column in columns])
