"""Kinematics of one deformation gradient F = I + H, and the tensor algebra that material laws are written in.

Fields carry leading (3, 3) axes and any trailing shape, so one law serves every mesh.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Tensor = Float[Array, "3 3 *points"]
Entries = list[list[Float[Array, "*points"]]]


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
    h = unstacked(H)
    minors = _minors(h)
    determinant = sum(h[0][k] * minors[0][k] for k in range(3))
    # J - 1 from H: near-incompressible stress is bulk times this small number.
    change = _trace(h) + _trace(minors) + determinant
    C = product(transpose(F), F)
    c = unstacked(C)
    I1, I2 = _trace(c), _trace(_minors(c))
    return Kinematics(F=F, C=C, G=cofactor(F) / (1.0 + change), volume_change=change, I1=I1, I2=I2)


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
        """Multiply by a number per point."""
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

    def block(self, i: int | Array, k: int | Array) -> Tensor:
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


def unstacked(A: Tensor) -> Entries:
    """Split a tensor into its entries, once: reverse mode then stacks them in one operation.

    Each separate A[i, j] would add a whole tensor of zeros in reverse mode.
    """
    parts = jax.lax.split(A.reshape(9, *A.shape[2:]), [1] * 9)
    return [[part[0] for part in parts[3 * i : 3 * i + 3]] for i in range(3)]


def product(A: Tensor, B: Tensor) -> Tensor:
    """Multiply two fields of 3×3 matrices, point by point."""
    terms = [A[:, m, None] * B[None, m] for m in range(3)]
    return terms[0] + terms[1] + terms[2]


def cofactor(A: Tensor) -> Tensor:
    """Compute the cofactor matrix, det(A) A^(-T)."""
    return _stacked(_minors(unstacked(A)))


def inverse_cube_root(J: Array) -> Array:
    """Compute J^(-1/3); XLA's float64 log and exp are scalar on CPU, so they start in float32."""
    if J.dtype != jnp.float64:
        return jnp.exp(jnp.log(J) * (-1.0 / 3.0))
    y = jnp.exp(jnp.log(jax.lax.stop_gradient(J).astype(jnp.float32)) * (-1.0 / 3.0)).astype(J.dtype)
    for _ in range(2):
        y = y * (4.0 - J * y**3) / 3.0
    return y


def _minors(a: Entries) -> Entries:
    def minor(i: int, j: int) -> Array:
        m, n, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        return a[m][p] * a[n][q] - a[m][q] * a[n][p]

    return [[minor(i, j) for j in range(3)] for i in range(3)]


def _trace(a: Entries) -> Array:
    return a[0][0] + a[1][1] + a[2][2]


def _stacked(a: Entries) -> Tensor:
    return jnp.stack([jnp.stack(row) for row in a])
