"""Stable range of a material law: Drucker's criterion over uniaxial, equibiaxial and planar deformation.

A softening law has no unique solution. Solves compare their stretches with the stable range afterwards: on the host for
known numbers, inside the program for traced ones.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .deformation import Kinematics
from .material import AbstractMaterial

# Exponents of the stretch in each mode, all at constant volume.
_EXPONENTS = {"uniaxial": [1.0, -0.5, -0.5], "equibiaxial": [1.0, 1.0, -2.0], "planar": [1.0, 0.0, -1.0]}
_MODES = np.array(list(_EXPONENTS.values())).T
# Stretches sampled in each mode, from the smallest reached to the largest, and the tolerance of their ends.
_SAMPLES = 200
_ROUNDING = 1e-6
# Stretches sampled by `stable_stretches`: their spacing is a thousandth.
_FINE = 2001


def extreme_stretches(k: Kinematics) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute the smallest and the largest principal stretch of a field [-], without volume change; no derivative.

    Eigenvalues of J^(-2/3) C by the trigonometric solution of its characteristic cubic.

    Args:
        k: Of the field.
    """
    k = jax.lax.stop_gradient(k)
    j = k.J ** (-2.0 / 3.0)
    mean, I2 = j * k.I1 / 3.0, j * j * k.I2
    radius = jnp.sqrt(jnp.maximum(mean**2 - I2 / 3.0, jnp.finfo(mean.dtype).tiny ** 0.5))
    angle = jnp.arccos(jnp.clip((2.0 * mean**3 - mean * I2 + 1.0) / (2.0 * radius**3), -1.0, 1.0)) / 3.0
    smallest, largest = (mean + 2.0 * radius * jnp.cos(angle + shift) for shift in (2.0 * np.pi / 3.0, 0.0))
    # One reduction for both: each would be a separate program.
    ends = jnp.max(jnp.stack([-smallest, largest]).reshape(2, -1), axis=1)
    return jnp.sqrt(jnp.maximum(-ends[0], 0.0)), jnp.sqrt(ends[1])


@np.errstate(all="ignore")  # of a solve that failed, stretches may be anything
def unstable_stretch(material: AbstractMaterial, smallest: Any, largest: Any) -> Array:
    """Find the stretch nearest to rest at which a law loses stability, among those reached [-]; 0 where it does not.

    The work of every small change on its own stress change must be positive, dσ : dε > 0, at constant volume. Modes
    are followed as far as all three of their principal stretches were reached.

    Args:
        material: The law.
        smallest: Smallest principal stretch reached [-].
        largest: Largest principal stretch reached [-].

    Source:
        Abaqus Analysis Guide, Hyperelastic behavior of rubberlike materials, "Material stability".
    """
    inputs = material, smallest, largest
    xp = jnp if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs)) else np
    material, smallest, largest = jax.tree.map(xp.asarray, inputs)
    low, high = xp.log(smallest), xp.log(largest)
    strain = _MODES[:, :, None] * (low + (high - low) * np.linspace(0.0, 1.0, _SAMPLES))
    reached = xp.all((strain >= low - _ROUNDING) & (strain <= high + _ROUNDING), axis=0)
    unstable = reached & ~_is_stable(material, strain)
    size = xp.max(xp.abs(strain), axis=0)
    first = xp.argmin(xp.where(unstable, size, np.inf))
    at = strain.reshape(3, -1)[:, first]
    stretch = xp.exp(at[xp.argmax(xp.abs(at))])
    return jnp.asarray(xp.where(xp.any(unstable), stretch, 0.0))


def stable_stretches(material: AbstractMaterial, low: float = 0.3, high: float = 3.0) -> dict[str, tuple[float, float]]:
    """Find the stretches around rest over which a law is stable in each mode [-].

    Args:
        material: The law, of known, uniform numbers.
        low: Least sampled stretch [-].
        high: Largest sampled stretch [-].

    Returns:
        Least and largest stable stretch of every mode; `low` and `high` where it is stable throughout.
    """
    material = jax.tree.map(np.asarray, material)
    log = np.linspace(np.log(low), np.log(high), _FINE)
    rest = int(np.argmin(np.abs(log)))
    ranges: dict[str, tuple[float, float]] = {}
    for mode, exponents in _EXPONENTS.items():
        unstable = ~_is_stable(material, np.array(exponents)[:, None] * log)
        below, above = np.flatnonzero(unstable[:rest]), np.flatnonzero(unstable[rest:])
        ends = log[below[-1]] if below.size else log[0], log[rest + above[0]] if above.size else log[-1]
        ranges[mode] = float(np.exp(ends[0])), float(np.exp(ends[1]))
    return ranges


def _is_stable(material: AbstractMaterial, strain: Any) -> Any:
    """Return where dσ : dε > 0 for every small change at constant volume."""
    xp = np if isinstance(strain, np.ndarray) else jnp
    H = xp.asarray(material.log_stiffness(strain))
    # At constant volume the third strain is minus the sum of the others.
    D11, D22 = (H[a, a] + H[2, 2] - 2.0 * H[a, 2] for a in range(2))
    D12 = H[0, 1] - H[0, 2] - H[1, 2] + H[2, 2]
    return (D11 + D22 > 0) & (D11 * D22 > D12**2)
