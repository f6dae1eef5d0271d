"""Hyperelastic materials of the layer, written for the deformation gradient F = I + H.

Each law is an isochoric energy of the modified invariants plus U(J) = (bulk/2)(J-1)². Stress
and tangent are closed forms; `energy` is the oracle that tests differentiate. The fields carry
leading (3, 3) axes and any trailing shape, so one law serves every mesh.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import as_leaf, check_finite, check_positive

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


class AbstractMaterial(eqx.Module):
    """A law whose isochoric energy is linear in the modified invariants, plus U(J)."""

    bulk: eqx.AbstractVar[Array]

    @property
    def shear(self) -> Array:
        """Initial shear modulus [MPa]."""
        c10, c01 = self.coefficients()
        return 2.0 * (c10 + c01)

    def coefficients(self) -> tuple[Array, Array]:
        """Return dψ/dĪ1 and dψ/dĪ2 [MPa]."""
        raise NotImplementedError

    def energy(self, H: Tensor) -> Float[Array, "*points"]:
        """Compute the strain-energy density [MPa] per reference volume."""
        k = kinematics(H)
        return self.isochoric_energy(k) + self.volumetric_energy(k.volume_change)

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        c10, c01 = self.coefficients()
        j = k.J ** (-2.0 / 3.0)
        return c10 * (j * k.I1 - 3.0) + c01 * (j * j * k.I2 - 3.0)

    def volumetric_energy(self, volume_change: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Compute U(J) [MPa] from J - 1."""
        return 0.5 * self.bulk * volume_change**2

    def volumetric_stress(self, volume_change: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Compute dU/dJ [MPa] from J - 1: the mean Cauchy stress."""
        return self.bulk * volume_change

    def first_piola(self, k: Kinematics, mean_stress: Array) -> Tensor:
        """Compute the first Piola–Kirchhoff stress [MPa].

        Args:
            k: Kinematics of the point.
            mean_stress: dU/dJ [MPa]; of the point itself, or of its element's mean dilatation.

        Source:
            Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, ch. 6.
        """
        a, b, D, pull = self._terms(k)
        return 2.0 * (a * k.F + b * D) + (mean_stress * k.J - pull) * k.G

    def tangent(self, k: Kinematics, mean_stress: Array) -> Float[Array, "3 3 3 3 *points"]:
        """Compute A[i, J, k, L] = dP[i, J]/dF[k, L] [MPa] at constant dU/dJ.

        The stiffness of U itself, U'' cof F ⊗ cof F, is left to the element form: it acts on
        the point's volume or on the element's.
        """
        a, b, D, pull = self._terms(k)
        eye = identity_like(k.F)
        F, G, C = k.F, k.G, k.C
        B = product(F, transpose(F))
        same = eye[:, None, :, None] * eye[None, :, None, :]
        crossed = G[:, None, None, :] * transpose(G)[None, :, :, None]
        stretch = 4.0 / 3.0 * (a * F + 2.0 * b * D)
        volume = 4.0 / 9.0 * (a * k.I1 + 4.0 * b * k.I2) + mean_stress * k.J
        return (
            (2.0 * (a + b * k.I1)) * same
            + (4.0 * b) * outer(F, F)
            - (2.0 * b) * (eye[:, None, :, None] * C[None, :, None, :])
            - (2.0 * b) * (F[:, None, None, :] * transpose(F)[None, :, :, None])
            - (2.0 * b) * (B[:, None, :, None] * eye[None, :, None, :])
            - outer(stretch, G)
            - outer(G, stretch)
            + volume * outer(G, G)
            + (pull - mean_stress * k.J) * crossed
        )

    def _terms(self, k: Kinematics) -> tuple[Array, Array, Tensor, Array]:
        c10, c01 = self.coefficients()
        j = k.J ** (-2.0 / 3.0)
        a, b = c10 * j, c01 * j * j
        D = k.I1 * k.F - product(k.F, k.C)
        return a, b, D, 2.0 / 3.0 * (a * k.I1 + 2.0 * b * k.I2)


class MooneyRivlin(AbstractMaterial):
    """Mooney–Rivlin: ψ = c10 (Ī1 - 3) + c01 (Ī2 - 3) + (bulk/2)(J - 1)².

    Ī1 = J^(-2/3) I1 and Ī2 = J^(-4/3) I2. Abaqus: *HYPERELASTIC, MOONEY-RIVLIN with C10, C01
    and D1 = 2/bulk. Initial shear modulus 2 (c10 + c01).

    Args:
        c10: Coefficient of Ī1 [MPa], positive.
        c01: Coefficient of Ī2 [MPa], zero or positive.
        bulk: Bulk modulus [MPa], positive. opfem never guesses it: a published deck with D=0
            means bulk = 20 shear in Abaqus/Explicit and incompressible in a hybrid element.

    Raises:
        ValueError: If a number is out of its range.
    """

    c10: Array = eqx.field(converter=as_leaf)
    c01: Array = eqx.field(converter=as_leaf)
    bulk: Array = eqx.field(converter=as_leaf)

    def __check_init__(self):
        check_finite("MooneyRivlin.c10", "MPa", self.c10)
        check_finite("MooneyRivlin.c01", "MPa", self.c01)
        check_positive("MooneyRivlin shear modulus 2 (c10 + c01)", "MPa", 2.0 * (self.c10 + self.c01))
        check_positive("MooneyRivlin.bulk", "MPa", self.bulk)

    def coefficients(self) -> tuple[Array, Array]:
        """Return c10 and c01 [MPa]."""
        return self.c10, self.c01


class NeoHooke(AbstractMaterial):
    """Neo-Hooke: ψ = (shear/2)(Ī1 - 3) + (bulk/2)(J - 1)², with Ī1 = J^(-2/3) I1.

    Abaqus: *HYPERELASTIC, NEO HOOKE with C10 = shear/2 and D1 = 2/bulk.

    Args:
        c10: Half the initial shear modulus [MPa], positive.
        bulk: Bulk modulus [MPa], positive.

    Raises:
        ValueError: If a number is out of its range.
    """

    c10: Array = eqx.field(converter=as_leaf)
    bulk: Array = eqx.field(converter=as_leaf)

    def __check_init__(self):
        check_positive("NeoHooke.c10", "MPa", self.c10)
        check_positive("NeoHooke.bulk", "MPa", self.bulk)

    def coefficients(self) -> tuple[Array, Array]:
        """Return c10 and zero [MPa]."""
        return self.c10, jnp.zeros_like(self.c10)


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
