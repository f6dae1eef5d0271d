"""Energies of an explicit solve at its outputs, and the checks on them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .explicit_step import Dynamics, Motion
from .solution import RESULTS

# Limit of kinetic over total energy of a quasi-static solve, and the initial share of the load that it excludes.
_MOST_KINETIC, _START = 0.01, 0.1
# Energies below this many roundings of shear modulus times volume are too small to judge a balance by.
_ROUNDINGS = 100.0
# The same in any precision.
_LEAST_ENERGY = 1e-7


class History(eqx.Module):
    """History at the outputs; NaN at those not reached.

    Attributes:
        time: Times [s].
        energies: By name [N mm].
        increment: Time increment before each [s].
        steps: Increments so far.
        floor: Energy [N mm] below which the balance is not checked.
    """

    time: Float[Array, " outputs"]
    energies: dict[str, Float[Array, " outputs"]]
    increment: Float[Array, " outputs"]
    steps: Array
    floor: Array

    def at(self, k: Any, m: Motion, energies: dict[str, Array], increment: Any, steps: Any) -> "History":
        """Add an output."""
        return History(
            self.time.at[k].set(m.time),
            {name: values.at[k].set(energies[name]) for name, values in self.energies.items()},
            self.increment.at[k].set(increment),
            self.steps + steps,
            self.floor,
        )

    @property
    def _scale(self) -> Array:
        """Largest energy up to every output."""
        parts = [jnp.abs(values) for name, values in self.energies.items() if name != "total"]
        sizes = jnp.max(jnp.stack(parts), axis=0)
        return jnp.maximum(jax.lax.cummax(jnp.where(jnp.isfinite(sizes), sizes, 0.0)), self.floor)

    @property
    def drift(self) -> Array:
        """Largest error of the energy balance, over the largest energy until then [-]."""
        total = self.energies["total"]
        return jnp.nanmax(jnp.abs(total - total[0]) / self._scale)

    @property
    def kinetic_ratio(self) -> Array:
        """Largest kinetic energy after the start of the load, over the largest energy until then [-]."""
        late = jnp.arange(self.time.size) > _START * (self.time.size - 1) * (1.0 + 1e-6)
        return jnp.nanmax(jnp.where(late, self.energies["kinetic"] / self._scale, 0.0))

    def status(self, most_drift: float) -> RESULTS:
        """Return the status of a run by its energies."""
        broken = jnp.any(jnp.isfinite(self.time) & ~jnp.isfinite(self.energies["total"]))
        moving = self.kinetic_ratio > _MOST_KINETIC
        result = RESULTS.where(moving, RESULTS.kinetic_energy_high, RESULTS.successful)
        result = RESULTS.where(self.drift > most_drift, RESULTS.energy_drifts, result)
        return RESULTS.where(broken, RESULTS.element_inverted, result)


def begin_history(dynamics: Dynamics, m: Motion, outputs: int) -> History:
    """Initialise with the energies of a state."""
    empty = jnp.full(outputs + 1, jnp.nan, float)
    energies = {name: empty.at[0].set(value) for name, value in dynamics.energies(m).items()}
    body = dynamics.force.body
    share = max(_LEAST_ENERGY, _ROUNDINGS * float(jnp.finfo(empty.dtype).eps))
    volume = jnp.sum(body.cells.volume * jnp.ones_like(body.cells.slope_x[:1]))
    floor = jnp.asarray(share * body.material.shear * volume, float)
    return History(empty.at[0].set(0.0), energies, empty, jnp.zeros((), int), floor)
