"""Kinematics of one deformation gradient F = I + H, and the tensor algebra that material laws are written in.

Fields carry leading (3, 3) axes and any trailing shape, so one law serves every mesh.
"""

from collections.abc import Callable

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


class ProductSum(eqx.Module):
    """A tangent A[i, J, k, L] as a sum of products of two tensors, each with a factor.

    A hundred numbers per point say what its 81 entries are, and a change of frame changes only these.

    Attributes:
        direct: Terms factor P[i, J] Q[k, L], each (factor, P, Q).
        crossed: Terms factor P[i, L] Q[k, J].
        legs: Terms factor X[i, k] Y[J, L].
    """

    direct: tuple[tuple[Array, Tensor, Tensor], ...] = ()
    crossed: tuple[tuple[Array, Tensor, Tensor], ...] = ()
    legs: tuple[tuple[Array, Tensor, Tensor], ...] = ()

    def __add__(self, other: "ProductSum") -> "ProductSum":
        return ProductSum(
            _joined(self.direct + other.direct),
            _joined(self.crossed + other.crossed),
            _joined(self.legs + other.legs),
        )

    def scaled(self, scale: Array) -> "ProductSum":
        """Multiply with a number per point."""
        kinds = (self.direct, self.crossed, self.legs)
        return ProductSum(*(tuple((scale * factor, P, Q) for factor, P, Q in terms) for terms in kinds))

    def referred(self, refer: Callable[[Tensor], Tensor]) -> "ProductSum":
        """Change the frame of the axes J and L.

        Args:
            refer: Changes the frame of a tensor's second axis.
        """

        def both(terms):
            return tuple((factor, refer(P), refer(Q)) for factor, P, Q in terms)

        legs = tuple((factor, X, transpose(refer(transpose(refer(Y))))) for factor, X, Y in self.legs)
        return ProductSum(both(self.direct), both(self.crossed), legs)

    def block(self, i: int, k: int) -> Tensor:
        """Compute A[i, :, k, :] as `(J, L, *points)`."""
        terms = [(f * P[i])[:, None] * Q[k][None] for f, P, Q in self.direct]
        terms += [(f * P[i])[None] * Q[k][:, None] for f, P, Q in self.crossed]
        terms += [(f * X[i, k]) * Y for f, X, Y in self.legs]
        return sum(terms[1:], start=terms[0])

    def entries(self) -> Float[Array, "3 3 3 3 *points"]:
        """Compute A[i, J, k, L]."""
        rows = [jnp.stack([self.block(i, k) for k in range(3)], axis=1) for i in range(3)]  # (J, k, L)
        return jnp.stack(rows)


def _joined(terms: tuple[tuple[Array, Tensor, Tensor], ...]) -> tuple[tuple[Array, Tensor, Tensor], ...]:
    """Add the factors of terms that have the same two tensors."""
    factors: dict[tuple[int, int], Array] = {}
    for factor, P, Q in terms:
        known = factors.get((id(P), id(Q)))
        factors[id(P), id(Q)] = factor if known is None else known + factor
    tensors = {(id(P), id(Q)): (P, Q) for _, P, Q in terms}
    return tuple((factor, *tensors[key]) for key, factor in factors.items())


def identity_like(F: Tensor) -> Array:
    """Build the identity with trailing axes of size one."""
    return jnp.eye(3, dtype=F.dtype).reshape((3, 3) + (1,) * (F.ndim - 2))


def transpose(A: Tensor) -> Tensor:
    """Swap the two tensor axes."""
    return jnp.swapaxes(A, 0, 1)


def product(A: Tensor, B: Tensor) -> Tensor:
    """Multiply two fields of 3×3 matrices, point by point."""
    return A[:, 0, None] * B[None, 0] + A[:, 1, None] * B[None, 1] + A[:, 2, None] * B[None, 2]


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
