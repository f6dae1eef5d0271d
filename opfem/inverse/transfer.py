"""Transfer function of a layer at small strain: indentation per pressure of one wave number.

u_z(h) = -G(k) p cos(k x) for a pressure p cos(k x) on a layer of thickness h. It gives the linear estimate, and from it
the preconditioner and the warm start of a fit.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import ScalarLike
from ..model.material import AbstractMaterial

Base = Literal["bonded", "slip"]
# Beyond this k h the layer is a half-space to round-off; hyperbolic functions would overflow.
_DEEP = 300.0
# Below this k h numerator and denominator cancel; G differs from its limit by less than 1e-8.
_SHALLOW = 1e-4


def poisson_ratio(material: AbstractMaterial) -> Array:
    """Compute Poisson's ratio at small strain [-]; 1/2 for an infinite bulk modulus."""
    ratio = material.shear / material.bulk
    return (3.0 - 2.0 * ratio) / (6.0 + 2.0 * ratio)


def transfer_function(
    k: Float[Array, "*modes"],
    thickness: ScalarLike,
    shear: ScalarLike,
    poisson: ScalarLike | Float[Array, "*ratios"],
    base: Base,
) -> Array:
    """Compute G(k) [mm/MPa], indentation per pressure.

    Args:
        k: Wave numbers [1/mm].
        thickness: Thickness of the layer [mm].
        shear: Shear modulus [MPa].
        poisson: Poisson's ratio [-], 1/2 included.
        base: Boundary condition of the other face: "bonded", or "slip" without friction.

    Source:
        Plane-strain elasticity of a layer; for the bonded one Johnson, Contact Mechanics, section 5.8.
    """
    x = jnp.clip(k * thickness, _SHALLOW, _DEEP)
    # Hyperbolic functions divided by exp(2 x).
    decay = jnp.exp(-4.0 * x)
    sinh, cosh, one = 0.5 * (1.0 - decay), 0.5 * (1.0 + decay), jnp.exp(-2.0 * x)
    if base == "bonded":
        a = 3.0 - 4.0 * poisson
        above = a * sinh - 2.0 * x * one
        below = a * cosh + (2.0 * x**2 + 5.0 - 12.0 * poisson + 8.0 * poisson**2) * one
        shallow = (1.0 - 2.0 * poisson) / (2.0 * (1.0 - poisson))
    else:
        above = cosh - one
        below = sinh + 2.0 * x * one
        shallow = 0.5 * (1.0 - poisson)
    moderate = (1.0 - poisson) / x * above / below
    deep = (1.0 - poisson) / jnp.maximum(k * thickness, _DEEP)
    per_shear = jnp.where(k * thickness < _SHALLOW, shallow, jnp.where(k * thickness > _DEEP, deep, moderate))
    return per_shear * thickness / shear


def wave_numbers(shape: tuple[int, ...], spacing: tuple[ScalarLike, ScalarLike]) -> Float[Array, "my mx"]:
    """Compute the wave number [1/mm] of every mode of a two-dimensional cosine transform on nodes."""
    (my, mx), (hx, hy) = shape, spacing
    ky = jnp.pi * jnp.arange(my) / (my * hy)
    kx = jnp.pi * jnp.arange(mx) / (mx * hx)
    return jnp.sqrt(ky[:, None] ** 2 + kx**2)
