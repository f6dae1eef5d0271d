"""Warm start of a fit: unknowns from the linear estimate, or from the traction of another fit."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.ndimage import zoom

from ..solvers.compiling import QuickJit
from .linear_layer import solve_linear
from .objective import Objective
from .preconditioner import Unknowns
from .prior import on_nodes


@QuickJit
def from_linear_estimate(objective: Objective) -> Unknowns:
    """Start from the small-strain estimate of a flat layer."""
    spacing, prior = objective.palpation.mesh().spacing, objective.prior

    def one(surface):
        white = solve_linear(objective.palpation, surface, prior).x
        return on_nodes(prior, white.shape) + prior.expand(white, spacing)

    return objective.white(jax.vmap(one)(objective.surfaces))


def from_normal(start: ArrayLike, objective: Objective) -> Unknowns:
    """Start from a normal traction [MPa] on nodes of this mesh or another, interpolated by cubic splines."""
    return objective.white(interpolated(start, *objective.surfaces.surface.shape))


def interpolated(start: ArrayLike, maps: int, my: int, mx: int) -> Float[Array, "maps my mx"]:
    """Interpolate a normal traction to the nodes of a mesh."""
    each = np.asarray(start, float)
    each = each[None] if each.ndim == 2 else each
    if each.ndim != 3 or each.shape[0] != maps or min(each.shape[1:]) < 4 or not np.all(np.isfinite(each)):
        raise ValueError(
            f"fit_traction.start [MPa] must be finite, one array of at least 4 × 4 interface nodes for each of {maps} "
            f"maps, such as {(my, mx)}; got shape {np.shape(start)}."
        )
    factors = my / each.shape[1], mx / each.shape[2]
    return jnp.asarray(np.stack([np.asarray(zoom(one, factors, order=3, mode="mirror")) for one in each]))
