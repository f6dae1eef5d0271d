"""Load increments: growth after easy solves, cut-back after failures, repetition until hard contact has no gap."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .newton import Newton

# Gap of hard contact after an increment at full load, over that before, up to which another one follows. Two lifted
# corners on 100×100×6 elements (`benchmarks/tissue.py lifted`) leave 2.2 µm of penetration at 0.5 and 0.05 µm at 0.9,
# in 112 and 149 Newton steps: each increment leaves about 0.6 of the gap.
_LEAST_SETTLING = 0.8
# Growth of the increment after a solve of at most half of the allowed Newton steps, and its reduction after a failure.
_GROWTH, _CUT = 1.5, 0.5
# The rest of the load is one increment if it exceeds the next one by less than 1 %: no increment of round-off follows.
_REST = 1.01


class Trial(NamedTuple):
    """Outcome of one equilibrium solve.

    Attributes:
        increment: Its load increment [-].
        hold_active: Whether the in-plane hold was active.
        snapping: Whether it is part of a snap-through.
        converged: Whether it converged.
        steps: Newton steps.
        furthest: Largest displacement along one axis [mm].
        missed_gap: Largest gap or penetration of hard contact [mm].
        no_gap: Tolerance of this gap [mm].
    """

    increment: Array
    hold_active: Array
    snapping: Array
    converged: Array
    steps: Array
    furthest: Array
    missed_gap: Array
    no_gap: Array


class Increments(NamedTuple):
    """State of the load increments.

    Attributes:
        size: Next load increment [-].
        attempts: Solves tried.
        accepted: Increments accepted.
        missed_gap: Gap or penetration of hard contact at the last converged state that more increments can reduce [mm].
        failed: Whether the solve has failed.
        exhausted: Whether the limit of increments was reached.
    """

    size: Float[Array, ""]
    attempts: Array
    accepted: Array
    missed_gap: Float[Array, ""]
    failed: Array
    exhausted: Array

    @classmethod
    def begin(cls, settings: Newton, dtype: jnp.dtype) -> "Increments":
        """Start with equal increments."""
        none, no = jnp.zeros((), int), jnp.asarray(False)
        return cls((1.0 / settings.increments) * jnp.ones((), dtype), none, none, jnp.zeros((), dtype), no, no)

    def is_cut(self, settings: Newton) -> Array:
        """Return whether the next increment is smaller than an equal part of the load."""
        return self.size * settings.increments < 0.999

    def ahead(self, fraction: Array) -> Array:
        """Compute the increment from a load fraction."""
        left = 1.0 - fraction
        return jnp.where(left < _REST * self.size, left, self.size)

    def next(
        self, trial: Trial, accepted: Array, lost: Array, lost_hold: Array, full: Array, settings: Newton
    ) -> "Increments":
        """Grow, keep or cut the increment.

        Args:
            trial: The last solve.
            accepted: Whether its state was accepted.
            lost: Whether it failed.
            lost_hold: Whether it failed for lack of the hold, which is then restored.
            full: Largest increment [-].
            settings: Settings of the solve.
        """
        cut = jnp.where(lost & ~lost_hold, _CUT * trial.increment, trial.increment)
        grown = jnp.minimum(_GROWTH * self.size, full)
        grown = jnp.where(trial.steps <= settings.max_steps // 2, grown, self.size)
        settles = (trial.increment > 0) | (trial.missed_gap < _LEAST_SETTLING * self.missed_gap)
        missed_gap = jnp.where(settles & (trial.missed_gap > trial.no_gap), trial.missed_gap, 0.0)
        attempts = self.attempts + 1
        exhausted = attempts >= settings.max_increments
        return Increments(
            size=jnp.where(accepted, grown, cut),
            attempts=attempts,
            accepted=self.accepted + accepted,
            missed_gap=jnp.where(accepted, missed_gap, self.missed_gap),
            failed=lost & ~lost_hold & (cut < settings.min_increment) | exhausted,
            exhausted=exhausted,
        )
