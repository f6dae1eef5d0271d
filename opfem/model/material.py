"""Hyperelastic materials of the layer: an isochoric energy plus U(J) = (bulk/2)(J-1)².

Stress and tangent are closed forms; `energy` is the oracle that tests differentiate. Here are the laws
in the modified invariants; those in principal stretches are in `stretch_material`.
"""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import Leaf, check_finite, check_modulus, check_positive
from .._repr import with_units
from .deformation import (
    Kinematics,
    ProductSum,
    Tensor,
    identity_like,
    inverse_cube_root,
    kinematics,
    product,
    transpose,
)
from .plausible import check_modulus_unit

Numbers = Array | np.ndarray
"""On the device, or on the host (`stability`)."""
LogStrain = Float[Numbers, "3 *points"]


class AbstractMaterial(eqx.Module):
    """An isotropic law; `shear` and `bulk` are its moduli at rest [MPa], each a field or a property.

    `calibrated` is the least and the largest principal stretch [-] of the tests that its numbers come from; solves
    compare theirs with it (`stats["beyond_calibration"]`). None: unknown.
    """

    bulk: eqx.AbstractVar[Array]
    calibrated: tuple[float, float] | None = eqx.field(static=True, default=None, kw_only=True)
    if TYPE_CHECKING:  # as an abstract field it would count as an argument of laws whose shear modulus is a property

        @property
        def shear(self) -> Array:
            """Initial shear modulus [MPa]."""
            ...

    def __check_init__(self):
        check_modulus_unit(f"{type(self).__name__} shear modulus", self.shear)

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        raise NotImplementedError

    def isochoric_piola(self, k: Kinematics) -> Tensor:
        """Compute the isochoric part of the first Piola–Kirchhoff stress [MPa]."""
        raise NotImplementedError

    def isochoric_tangent(self, k: Kinematics) -> ProductSum:
        """Compute the derivative of `isochoric_piola` by F [MPa]: A[i, J, k, L] = dP[i, J]/dF[k, L]."""
        raise NotImplementedError

    def log_stiffness(self, strain: LogStrain) -> Float[Numbers, "3 3 *points"]:
        """Compute d²ψ/dε_a dε_b [MPa] by principal log strains, at constant volume; in NumPy where all is NumPy."""
        raise NotImplementedError

    def energy(self, H: Tensor) -> Float[Array, "*points"]:
        """Compute the strain-energy density [MPa] per reference volume."""
        k = kinematics(H)
        return self.isochoric_energy(k) + self.volumetric_energy(k.volume_change)

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
        """
        return self.isochoric_piola(k) + (mean_stress * k.J) * k.G

    def tangent(self, k: Kinematics, mean_stress: Array) -> ProductSum:
        """Compute A[i, J, k, L] = dP[i, J]/dF[k, L] [MPa] at constant dU/dJ.

        The stiffness of U itself, U'' cof F ⊗ cof F, is left to the element form: it acts on
        the point's volume or on the element's.
        """
        pressure = mean_stress * k.J
        geometric = ProductSum(direct=((pressure, k.G, k.G),), crossed=((-pressure, k.G, k.G),))
        return self.isochoric_tangent(k) + geometric


class AbstractInvariantMaterial(AbstractMaterial):
    """A law in the modified invariants Ī1 = J^(-2/3) I1 and Ī2 = J^(-4/3) I2, linear in Ī2.

    Source:
        Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, ch. 6.
    """

    def slopes(self, I1_change: Numbers) -> tuple[Any, Any]:
        """Return dψ/dĪ1 and dψ/dĪ2 [MPa] at Ī1 - 3."""
        raise NotImplementedError

    def curvature(self, I1_change: Numbers) -> Any:
        """Return d²ψ/dĪ1² [MPa] at Ī1 - 3; None where it is zero for any stretch."""
        return None

    @property
    def shear(self) -> Array:
        """Initial shear modulus [MPa]."""
        a, b = self.slopes(jnp.zeros_like(self.bulk))
        return 2.0 * (a + b)

    def log_stiffness(self, strain: LogStrain) -> Float[Numbers, "3 3 *points"]:
        """Compute d²ψ/dε_a dε_b [MPa] by principal log strains, at constant volume."""
        xp = np if isinstance(strain, np.ndarray) else jnp
        squares = xp.exp(2.0 * strain)
        I1_change = squares.sum(axis=0) - 3.0
        by_I1, by_I2 = (xp.asarray(slope) for slope in self.slopes(I1_change))
        stiffness = on_diagonal(4.0 * (by_I1 * squares + by_I2 / squares))
        curvature = self.curvature(I1_change)
        return stiffness if curvature is None else stiffness + 4.0 * curvature * squares[:, None] * squares

    def isochoric_piola(self, k: Kinematics) -> Tensor:
        """Compute the isochoric part of the first Piola–Kirchhoff stress [MPa]."""
        a, b, D, pull = self._terms(k)
        return 2.0 * (a * k.F + b * D) - pull * k.G

    def isochoric_tangent(self, k: Kinematics) -> ProductSum:
        """Compute the derivative of `isochoric_piola` by F [MPa]."""
        a, b, D, pull = self._terms(k)
        F, G, C = k.F, k.G, k.C
        B = product(F, transpose(F))
        eye = jnp.broadcast_to(identity_like(F), F.shape)
        one = jnp.ones_like(a)
        # Half of the coefficient along G ⊗ G, which then needs no separate term.
        stretch = 4.0 / 3.0 * (a * F + 2.0 * b * D) - 2.0 / 9.0 * (a * k.I1 + 4.0 * b * k.I2) * G
        tangent = ProductSum(
            direct=((4.0 * b, F, F), (-one, stretch, G), (-one, G, stretch)),
            crossed=((-2.0 * b, F, F), (pull, G, G)),
            legs=((one, 2.0 * (a + b * k.I1) * eye - 2.0 * b * B, eye), (-2.0 * b, eye, C)),
        )
        j = inverse_cube_root(k.J) ** 2
        curvature = self.curvature(j * k.I1 - 3.0)
        if curvature is None:
            return tangent
        slope = (2.0 * j) * (F - (k.I1 / 3.0) * G)  # dĪ1/dF
        return tangent + ProductSum(direct=((curvature, slope, slope),))

    def _terms(self, k: Kinematics) -> tuple[Array, Array, Tensor, Array]:
        j = inverse_cube_root(k.J) ** 2
        by_I1, by_I2 = self.slopes(j * k.I1 - 3.0)
        a, b = by_I1 * j, by_I2 * j * j
        D = k.I1 * k.F - product(k.F, k.C)
        return a, b, D, 2.0 / 3.0 * (a * k.I1 + 2.0 * b * k.I2)


def on_diagonal(values: LogStrain) -> Float[Numbers, "3 3 *points"]:
    """Put values on the diagonal of matrices."""
    return values[:, None] * np.eye(3).reshape(3, 3, *[1] * (values.ndim - 1))


class MooneyRivlin(AbstractInvariantMaterial):
    """Mooney–Rivlin: ψ = c10 (Ī1 - 3) + c01 (Ī2 - 3) + (bulk/2)(J - 1)².

    Ī1 = J^(-2/3) I1 and Ī2 = J^(-4/3) I2. Abaqus: *HYPERELASTIC, MOONEY-RIVLIN with C10, C01
    and D1 = 2/bulk. Initial shear modulus 2 (c10 + c01).

    Args:
        c10: Coefficient of Ī1 [MPa].
        c01: Coefficient of Ī2 [MPa]; c10 + c01 is positive. One of them may be negative, as fits to silicones have it:
            the law is then stable up to some stretch, and a solve beyond it reports so (`RESULTS`).
        bulk: Bulk modulus [MPa], positive. opfem never guesses it: a published deck with D=0
            means bulk = 20 shear in Abaqus/Explicit and incompressible in a hybrid element.

    Raises:
        ValueError: If a number is out of its range.
    """

    c10: Array = eqx.field(converter=Leaf("MooneyRivlin.c10", "MPa"))
    c01: Array = eqx.field(converter=Leaf("MooneyRivlin.c01", "MPa"))
    bulk: Array = eqx.field(converter=Leaf("MooneyRivlin.bulk", "MPa"))

    def __check_init__(self):
        check_finite("MooneyRivlin.c10", "MPa", self.c10)
        check_finite("MooneyRivlin.c01", "MPa", self.c01)
        check_positive("MooneyRivlin shear modulus 2 (c10 + c01)", "MPa", 2.0 * (self.c10 + self.c01))
        check_modulus("MooneyRivlin.bulk", "MPa", self.bulk)

    def slopes(self, I1_change: Numbers) -> tuple[Any, Any]:
        """Return c10 and c01 [MPa]."""
        return self.c10, self.c01

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        j = k.J ** (-2.0 / 3.0)
        return self.c10 * (j * k.I1 - 3.0) + self.c01 * (j * j * k.I2 - 3.0)


class NeoHooke(AbstractInvariantMaterial):
    """Neo-Hooke: ψ = c10 (Ī1 - 3) + (bulk/2)(J - 1)², with Ī1 = J^(-2/3) I1.

    Abaqus: *HYPERELASTIC, NEO HOOKE with C10 = c10 and D1 = 2/bulk. Initial shear modulus 2 c10.

    Args:
        c10: Half the initial shear modulus [MPa], positive.
        bulk: Bulk modulus [MPa], positive.

    Raises:
        ValueError: If a number is out of its range.
    """

    c10: Array = eqx.field(converter=Leaf("NeoHooke.c10", "MPa"))
    bulk: Array = eqx.field(converter=Leaf("NeoHooke.bulk", "MPa"))

    def __check_init__(self):
        check_positive("NeoHooke.c10", "MPa", self.c10)
        check_modulus("NeoHooke.bulk", "MPa", self.bulk)

    def slopes(self, I1_change: Numbers) -> tuple[Any, Any]:
        """Return c10 and zero [MPa]."""
        return self.c10, jnp.zeros_like(self.c10)

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        return self.c10 * (k.J ** (-2.0 / 3.0) * k.I1 - 3.0)


class Yeoh(AbstractInvariantMaterial):
    """Yeoh: ψ = c10 (Ī1 - 3) + c20 (Ī1 - 3)² + c30 (Ī1 - 3)³ + (bulk/2)(J - 1)².

    Abaqus: *HYPERELASTIC, YEOH with C10, C20, C30, D1 = 2/bulk and D2 = D3 = 0. Initial shear modulus 2 c10.

    Args:
        c10: Coefficient of Ī1 - 3 [MPa], positive.
        c20: Coefficient of its square [MPa], often negative: see `MooneyRivlin` on its stability.
        c30: Coefficient of its cube [MPa], of any sign.
        bulk: Bulk modulus [MPa], positive.

    Raises:
        ValueError: If a number is out of its range.
    """

    c10: Array = eqx.field(converter=Leaf("Yeoh.c10", "MPa"))
    c20: Array = eqx.field(converter=Leaf("Yeoh.c20", "MPa"))
    c30: Array = eqx.field(converter=Leaf("Yeoh.c30", "MPa"))
    bulk: Array = eqx.field(converter=Leaf("Yeoh.bulk", "MPa"))

    def __check_init__(self):
        check_positive("Yeoh.c10", "MPa", self.c10)
        check_finite("Yeoh.c20", "MPa", self.c20)
        check_finite("Yeoh.c30", "MPa", self.c30)
        check_modulus("Yeoh.bulk", "MPa", self.bulk)

    def slopes(self, I1_change: Numbers) -> tuple[Any, Any]:
        """Return dψ/dĪ1 and zero [MPa] at Ī1 - 3."""
        return self.c10 + (2.0 * self.c20 + 3.0 * self.c30 * I1_change) * I1_change, jnp.zeros_like(self.c10)

    def curvature(self, I1_change: Numbers) -> Any:
        """Return d²ψ/dĪ1² [MPa] at Ī1 - 3."""
        return 2.0 * self.c20 + 6.0 * self.c30 * I1_change

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        x = k.J ** (-2.0 / 3.0) * k.I1 - 3.0
        return ((self.c30 * x + self.c20) * x + self.c10) * x
