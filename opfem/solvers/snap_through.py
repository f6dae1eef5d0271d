"""Snap-through with viscous regularisation: viscosity increases after failures and decreases as the motion decays."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .increments import Trial
from .newton import Newton

# A snap-through begins at increments cut down to the first share of their full size, unless they are already below the
# second one.
_SHARES = (0.26, 0.05)
# Viscosity [-]: first, factor of change, treated as zero below, given up above.
_FIRST = 1.5
_FACTOR = 3.0
_NEGLIGIBLE = 1e-6
_LARGEST = 100.0
# Relative residual of viscous solves over that of a result, and their limit of Newton steps.
_VISCOUS_RTOL = 10.0
_VISCOUS_STEPS = 12
# Limit of solves of one snap-through.
_MAX_SOLVES = 80


class SnapThrough(NamedTuple):
    """State of a snap-through.

    Attributes:
        viscosity: Viscosity of the next solve, zero except during a snap-through [-].
        speed: Viscosity times the largest displacement of the last viscous solve [mm].
        solves: Solves of the current snap-through.
    """

    viscosity: Float[Array, ""]
    speed: Float[Array, ""]
    solves: Array

    @classmethod
    def begin(cls, dtype: jnp.dtype) -> "SnapThrough":
        """Start without viscosity."""
        zero = jnp.zeros((), dtype)
        return cls(zero, zero, jnp.zeros((), int))

    def limits(self, settings: Newton) -> tuple[Array, Array]:
        """Return tolerance and limit of Newton steps of the next solve; viscous ones are looser and shorter."""
        viscous = self.viscosity > 0
        rtol = jnp.where(viscous, _VISCOUS_RTOL * settings.rtol, settings.rtol)
        return rtol, jnp.where(viscous, _VISCOUS_STEPS, settings.max_steps)

    def next(self, trial: Trial, accepted: Array, full: Array) -> tuple["SnapThrough", Array]:
        """Begin, continue or end a snap-through; also return whether it continues."""
        viscosity, speed = self._changed(trial)
        is_short = (trial.increment <= _SHARES[0] * full) & (trial.increment > _SHARES[1] * full)
        begins = ~trial.converged & ~trial.snapping & is_short
        viscosity = jnp.where(begins, _FIRST, viscosity)
        in_limits = (viscosity <= _LARGEST) & (self.solves < _MAX_SOLVES)
        continues = begins | (trial.snapping & ~accepted & in_limits)
        solves = jnp.where(continues, self.solves + 1, 0)
        return SnapThrough(jnp.where(continues, viscosity, 0.0), speed, solves), continues

    def _changed(self, trial: Trial) -> tuple[Array, Array]:
        """Compute viscosity and speed after a solve of a snap-through."""
        speed = self.viscosity * trial.furthest
        decays = (speed < self.speed) & (trial.steps <= _VISCOUS_STEPS // 2)
        factor = jnp.where(trial.steps <= _VISCOUS_STEPS // 4, _FACTOR**2, _FACTOR)
        lower = jnp.where(decays | (trial.steps == 0), self.viscosity / factor, self.viscosity)
        lower = jnp.where(lower < _NEGLIGIBLE, 0.0, lower)
        higher = _FACTOR * jnp.maximum(self.viscosity, _NEGLIGIBLE)
        viscosity = jnp.where(trial.converged, lower, higher)
        return (
            jnp.where(trial.snapping, viscosity, 0.0),
            jnp.where(trial.converged & trial.snapping, speed, 0.0),
        )
