"""Stress of a material law in homogeneous tests, uniaxial, equibiaxial or planar, with free sides."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement.stress_strain import Mode
from .deformation import kinematics
from .material import AbstractMaterial

# Fixed-point iterations for the volume ratio; each reduces the error by about shear / bulk.
_VOLUME_STEPS = 60
# Which principal direction is free of stress, and which is loaded.
_FREE, _LOADED = 0, 2


def principal_stretches(stretch: Array, mode: Mode, J: Array | float = 1.0) -> Float[Array, "3 *points"]:
    """Compute the principal stretches of a test [-]: the first direction is free of stress, the last is loaded.

    Args:
        stretch: Along the load [-].
        mode: "uniaxial", "equibiaxial" or "planar".
        J: Volume ratio [-].
    """
    if mode == "uniaxial":
        side = jnp.sqrt(J / stretch)
        return jnp.stack([side, side, stretch])
    other = stretch if mode == "equibiaxial" else jnp.ones_like(stretch)
    return jnp.stack([J / (stretch * other), other, stretch])


def cauchy_stress(
    material: AbstractMaterial, stretch: Array, mode: Mode = "uniaxial", incompressible: bool = False
) -> Array:
    """Compute the Cauchy stress along the load [MPa] at a stretch [-], free directions without stress."""
    return _stress(material, stretch, mode, incompressible)[0]


def nominal_stress(
    material: AbstractMaterial, stretch: Array, mode: Mode = "uniaxial", incompressible: bool = False
) -> Array:
    """Compute the force along the load over the initial area [MPa] at a stretch [-].

    Args:
        material: The law.
        stretch: Deformed over initial length along the load [-].
        mode: "uniaxial", "equibiaxial" or "planar".
        incompressible: Whether to keep the volume, whatever `material.bulk` is.
    """
    cauchy, J = _stress(material, stretch, mode, incompressible)
    return cauchy * J / stretch


def _stress(material: AbstractMaterial, stretch: Array, mode: Mode, incompressible: bool) -> tuple[Array, Array]:
    def isochoric(J):
        principal = principal_stretches(stretch, mode, J)
        zero = jnp.zeros_like(stretch)
        rows = [[principal[i] - 1.0 if i == j else zero for j in range(3)] for i in range(3)]
        P = material.isochoric_piola(kinematics(jnp.stack([jnp.stack(row) for row in rows])))
        return tuple(P[a, a] * principal[a] / J for a in (_FREE, _LOADED))

    def closer(_, J):
        return 1.0 - isochoric(J)[0] / material.bulk

    J = jnp.ones_like(stretch)
    if not incompressible:
        J = jax.lax.fori_loop(0, _VOLUME_STEPS, closer, J)
    free, loaded = isochoric(J)
    return loaded - free, J
