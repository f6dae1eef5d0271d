"""Kinematics of one deformation gradient F = I + H, and the tensor algebra that material laws are written in.

Fields carry leading (3, 3) axes and any trailing shape, so one law serves every mesh.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Tensor = Float[Array, "3 3 *points"]


class Kinematics(eqx.Module):
    """Quantities of one deformation gradient that stress and tangent share.

    Attributes:
        F: Deformation gradient [-].
        C: Right Cauchy–Green tensor [-].
        G: Inverse transpose of F [-].
        volume_change: J - 1 [-], computed without cancellation.
        I1: First invariant of C [-].
        I2: Second invariant of C [-].
    """

    F: Tensor
    C: Tensor
    G: Tensor
    volume_change: Float[Array, "*points"]
    I1: Float[Array, "*points"]
    I2: Float[Array, "*points"]

    @property
    def J(self) -> Float[Array, "*points"]:
        """Volume ratio [-]."""
        return 1.0 + self.volume_change


def kinematics(H: Tensor) -> Kinematics:
    """Compute what a law needs from the displacement gradient H [-]."""
    F = H + identity_like(H)
    cof = cofactor(F)
    trace = H[0, 0] + H[1, 1] + H[2, 2]
    minors = cofactor(H)
    determinant = sum(H[0, k] * minors[0, k] for k in range(3))
    # J - 1 from H: near-incompressible stress is bulk times this small number.
    change = trace + minors[0, 0] + minors[1, 1] + minors[2, 2] + determinant
    C = product(transpose(F), F)
    I1 = C[0, 0] + C[1, 1] + C[2, 2]
    C_minors = cofactor(C)
    I2 = C_minors[0, 0] + C_minors[1, 1] + C_minors[2, 2]
    return Kinematics(F=F, C=C, G=cof / (1.0 + change), volume_change=change, I1=I1, I2=I2)


def identity_like(F: Tensor) -> Array:
    """Build the identity with trailing axes of size one."""
    return jnp.eye(3, dtype=F.dtype).reshape((3, 3) + (1,) * (F.ndim - 2))


def transpose(A: Tensor) -> Tensor:
    """Swap the two tensor axes."""
    return jnp.swapaxes(A, 0, 1)


def product(A: Tensor, B: Tensor) -> Tensor:
    """Multiply two fields of 3×3 matrices, point by point."""
    return A[:, 0, None] * B[None, 0] + A[:, 1, None] * B[None, 1] + A[:, 2, None] * B[None, 2]


def outer(A: Tensor, B: Tensor) -> Float[Array, "3 3 3 3 *points"]:
    """Form A[i, J] B[k, L]."""
    return A[:, :, None, None] * B[None, None]


def cofactor(A: Tensor) -> Tensor:
    """Compute the cofactor matrix, det(A) A^(-T)."""
    rows = [
        [
            A[(i + 1) % 3, (j + 1) % 3] * A[(i + 2) % 3, (j + 2) % 3]
            - A[(i + 1) % 3, (j + 2) % 3] * A[(i + 2) % 3, (j + 1) % 3]
            for j in range(3)
        ]
        for i in range(3)
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
