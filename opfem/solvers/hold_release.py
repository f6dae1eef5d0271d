"""Release of the in-plane hold: friction replaces it where it can balance the hold force."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from .in_plane_hold import HoldBalance
from .increments import Trial

# The hold is released when friction can balance its force with this margin.
_MARGIN = 0.5
# Without the hold, an increment is cut down to this share of its full size before the hold is restored.
_LEAST_RELEASED = 0.2
# A lateral force below this share of the normal one is balanced to round-off.
_BALANCED = 1e-4


class HoldRelease(NamedTuple):
    """State of the in-plane hold.

    Attributes:
        can_release: Whether friction could balance the hold force.
        failed: Whether an increment without the hold failed.
        slides: Whether the hold force has a lateral component at the last converged state.
    """

    can_release: Array
    failed: Array
    slides: Array

    @classmethod
    def begin(cls) -> "HoldRelease":
        """Start without a balance of forces."""
        no = jnp.asarray(False)
        return cls(no, no, no)

    def is_active(self, was_active: Array) -> Array:
        """Return whether the hold is active in the next solve."""
        return (was_active & ~(self.can_release & ~self.failed)) | self.failed

    def is_pending(self, is_active: Array) -> Array:
        """Return whether an increment without the hold must follow."""
        return is_active & self.can_release & ~self.failed

    def next(self, trial: Trial, lost: Array, full: Array) -> tuple["HoldRelease", Array]:
        """Restore the hold after a few cuts of the increment without it; also return whether this happens."""
        restored = lost & ~trial.hold_active & (trial.increment < _LEAST_RELEASED * full)
        return self._replace(failed=self.failed | restored), restored

    def balanced(self, bodies: Sequence[HoldBalance], accepted: Array) -> "HoldRelease":
        """Update from the forces of an accepted state: whether friction suffices, and whether the hold is loaded."""
        can = [(body.capacity > 0) & (body.hold <= _MARGIN * body.capacity) for body in bodies]
        slides = [body.hold > _BALANCED * body.normal for body in bodies]
        return self._replace(
            can_release=jnp.where(accepted, functools.reduce(jnp.logical_and, can), self.can_release),
            slides=jnp.where(accepted, functools.reduce(jnp.logical_or, slides), self.slides),
        )
