"""In-plane hold: constraint of the rigid motions of the window face that neither supports nor friction prevent.

Rigid motions are represented by orthonormal modes of the face. `hold_release` decides when friction replaces the hold.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.boundary import Nodal
from ..mechanics.face import tributary_area
from .supports import Supports

Modes = Float[Array, "modes 2 my mx"]


class HoldBalance(NamedTuple):
    """In-plane hold force of one body, the friction that could replace it, and the normal force [N]."""

    hold: Array
    capacity: Array
    normal: Array


def drift_modes(positions: Nodal, supports: Supports) -> Modes | None:
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
    positions: Nodal, face: Float[Array, "2 my mx"], modes: Modes, supports: Supports
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


def rigid_part(modes: Modes | None, face: Float[Array, "2 my mx"]) -> Float[Array, "2 my mx"]:
    """Compute the rigid part of in-plane nodal values at the window."""
    if modes is None:
        return jnp.zeros_like(face)
    modes = modes.astype(face.dtype)
    return jnp.tensordot(jnp.tensordot(modes, face, 3), modes, 1)


def without_rigid_part(modes: Modes | None, r: Nodal, hold_active: Array) -> Nodal:
    """Project the rigid motions of the active hold out of a nodal field."""
    if modes is None:
        return r
    face = r[:2, 0] - jnp.where(hold_active, rigid_part(modes, r[:2, 0]), 0.0)
    return jax.lax.dynamic_update_slice(r, face[:, None], (0, 0, 0, 0))


def without_drift(positions: Nodal, modes: Modes | None, supports: Supports, u: Nodal, hold_active: Array) -> Nodal:
    """Translate and rotate a body until its window face has no rigid motion of the active hold."""
    if modes is None:
        return u
    drift = rigid_drift(positions, u[:2, 0], modes, supports)
    return jnp.concatenate([u[:2] - jnp.where(hold_active, drift, 0.0), u[2:]])


def lateral_size(positions: Nodal, hold: Float[Array, "2 my mx"]) -> Array:
    """Compute the size of the hold force [N]: its resultant, and its moment over the mean radius of the face."""
    X = positions[:2, 0]
    arm = X - jnp.mean(X, axis=(1, 2), keepdims=True)
    radius = jnp.mean(jnp.sqrt(jnp.sum(arm**2, axis=0)))
    lateral = jnp.sum(hold, axis=(1, 2))
    moment = jnp.sum(arm[0] * hold[1] - arm[1] * hold[0]) / radius
    return jnp.sqrt(jnp.sum(lateral**2)) + jnp.abs(moment)
