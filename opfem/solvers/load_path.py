"""Load path of a solve: the equilibrium solves that led to a state, recorded for derivatives."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .tangent import Unknowns


class Recorded(NamedTuple):
    """Equilibrium solves, in arrays of fixed length."""

    x: Unknowns
    fraction: Float[Array, " n"]
    hold_active: Bool[Array, " n"]
    viscosity: Float[Array, " n"]


class Path(NamedTuple):
    """Load path of a solve.

    Attributes:
        solves: Recorded solves; None without derivatives.
        length: Number of solves that led to the initial state of the next one, which may be viscous.
        kept: Number of solves that led to the last converged state.
    """

    solves: Recorded | None
    length: Array
    kept: Array

    @classmethod
    def begin(cls, unknowns: Unknowns, zero: Array, limit: int | None) -> "Path":
        """Start an empty path of at most `limit` solves; None: without record."""
        none = jnp.zeros((), int)
        if limit is None:
            return cls(None, none, none)
        slot = Recorded(unknowns, zero, jnp.asarray(False), zero)
        return cls(jax.tree.map(lambda v: jnp.zeros((limit, *v.shape), v.dtype), slot), none, none)

    def next(self, accepted: Array, snaps: Array, converged: Array) -> tuple["Path", Array]:
        """Extend the path by a solve, or restore its converged part; also return whether it is extended."""
        extended = accepted | (snaps & converged)
        length = jnp.where(extended, self.length + 1, jnp.where(snaps, self.length, self.kept))
        return self._replace(length=length, kept=jnp.where(accepted, length, self.kept)), extended

    def written(self, solve: Recorded, extended: Array) -> Recorded | None:
        """Append a solve to the record, if the path is extended."""
        if self.solves is None:
            return None

        def write(slots, value):
            value = jnp.where(extended, value, slots[jnp.minimum(self.length, slots.shape[0] - 1)])
            return jax.lax.dynamic_update_index_in_dim(slots, value, self.length, axis=0)

        return jax.tree.map(write, self.solves, solve)
