"""Pressure on faces of an unstructured mesh that stays normal to them while they deform.

Force and load stiffness are those of the deformed face, so statics under pressure converges
quadratically. It serves verification; the pressure of contact is in `interaction`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_GAUSS = 0.5 / np.sqrt(3.0)


def _quadrilateral() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    points = np.array([(0.5 + a * _GAUSS, 0.5 + b * _GAUSS) for a in (-1, 1) for b in (-1, 1)])
    s, t = ((np.where(corners[:, k], points[:, None, k], 1.0 - points[:, None, k])) for k in range(2))
    signs = 2.0 * corners - 1.0
    return s * t, np.stack([signs[:, 0] * t, s * signs[:, 1]], axis=1), np.full(4, 0.25)


# Shape functions `(points, corners)`, their derivatives `(points, 2, corners)` and the points' weights.
_RULES = {
    3: (np.full((1, 3), 1.0 / 3.0), np.array([[[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]]), np.array([0.5])),
    4: _quadrilateral(),
}


class FollowerPressure(eqx.Module):
    """A uniform pressure on faces of the deformed body.

    Attributes:
        pressure: Pressure [MPa] on the current area, positive towards the body.
        faces: Nodes of every face, three or four, right-handed about the outward normal.
    """

    pressure: Float[Array, ""]
    faces: Int[np.ndarray | Array, "faces corners"]

    def forces(self, x: Float[Array, "3 nodes"]) -> Float[Array, "faces corners 3"]:
        """Compute the forces [N] on the nodes of every face from the current positions [mm]."""
        return jax.vmap(self._force)(self._corners(x))

    def stiffness(self, x: Float[Array, "3 nodes"]) -> Float[Array, "faces corners 3 corners 3"]:
        """Compute the derivative of `forces` by the positions of the face's own nodes [N/mm]."""
        return jax.vmap(jax.jacfwd(self._force))(self._corners(x))

    def _corners(self, x: Array) -> Float[Array, "faces corners 3"]:
        return jnp.moveaxis(jnp.take(x, jnp.asarray(self.faces), axis=1), 0, -1)

    def _force(self, corners: Float[Array, "corners 3"]) -> Float[Array, "corners 3"]:
        N, dN, weights = (jnp.asarray(rule, corners.dtype) for rule in _RULES[corners.shape[0]])
        tangents = jnp.einsum("qma,ai->qmi", dN, corners)
        normal = jnp.cross(tangents[:, 0], tangents[:, 1])  # times the current area
        return -self.pressure * jnp.einsum("q,qa,qi->ai", weights, N, normal)
