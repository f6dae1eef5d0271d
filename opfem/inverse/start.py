"""Where a fit starts."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.ndimage import zoom

from ..solvers.compiling import QuickJit
from .estimates import solve_linear
from .misfit import Misfit
from .preconditioner import Unknowns
from .prior import on_nodes


@QuickJit
def from_estimate(misfit: Misfit) -> Unknowns:
    """Start where small-strain elasticity of a flat layer ends."""
    spacing, prior = misfit.palpation.mesh().spacing, misfit.prior

    def one(observation):
        white = solve_linear(misfit.palpation, observation, prior).x
        return on_nodes(prior, white.shape) + prior.expand(white, spacing)

    return misfit.white(jax.vmap(one)(misfit.observations))


def from_normal(start: ArrayLike, misfit: Misfit) -> Unknowns:
    """Start from a normal traction [MPa] on nodes of this mesh or another, brought to its own by cubic splines."""
    return misfit.white(on_mesh(start, *misfit.observations.surface.shape))


def on_mesh(start: ArrayLike, maps: int, my: int, mx: int) -> Float[Array, "maps my mx"]:
    """Bring a normal traction to a mesh's own nodes."""
    each = np.asarray(start, float)
    each = each[None] if each.ndim == 2 else each
    if each.ndim != 3 or each.shape[0] != maps or min(each.shape[1:]) < 4 or not np.all(np.isfinite(each)):
        raise ValueError(
            f"fit_traction.start [MPa] must be finite, one array of at least 4 × 4 interface nodes for each of {maps} "
            f"maps, such as {(my, mx)}; got shape {np.shape(start)}."
        )
    factors = my / each.shape[1], mx / each.shape[2]
    return jnp.asarray(np.stack([np.asarray(zoom(one, factors, order=3, mode="mirror")) for one in each]))
