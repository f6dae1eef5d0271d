"""Standardised residuals of observations of solved states, as `fit_parameters` minimises them.

Thickness maps, forces and side bulges belong to one state; increments of axial displacement to two.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float

from ..inverse.measured_surface import interface_heights, noise_std, project_map
from ..inverse.observations import ForceReading, SideBulge
from ..measurement import ThicknessMap
from ..measurement.oct import AxialIncrement
from ..solvers import Solution
from .loaded_states import LoadedState

# Fixed-point iterations for the reference position of a spatial point: at 40 % strain they reduce the error to 1e-8.
_ITERATIONS = 20


def residual(observed: Any, state: int, states: Sequence[LoadedState], scale: Array) -> Float[Array, " n"]:
    """Compute the residual of an observation: computed minus measured value over the standard deviation [-].

    Args:
        observed: A `ThicknessMap`, `ForceReading`, `AxialIncrement` or `SideBulge`.
        state: Number of the observed state; an increment has its own two.
        states: What observations see of the solved states.
        scale: Factor of computed increments [-].
    """
    if isinstance(observed, AxialIncrement):
        computed = scale * axial_increment(states[observed.before], states[observed.after], observed.points)
        return (computed - observed.values) / observed.std
    seen = states[state]
    if isinstance(observed, ForceReading):
        return jnp.atleast_1d((-seen.force[2] - observed.force) / observed.std)
    if isinstance(observed, SideBulge):
        return (bulge(seen, observed.side, observed.depth) - observed.displacement) / observed.std
    measured = project_map(seen.mesh, observed, noise_std("fit_parameters", observed))
    return measured.misfit(interface_heights(seen.mesh, seen.displacement[:, -1])).ravel()


def axial_increment(
    before: Solution | LoadedState, after: Solution | LoadedState, points: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """Compute u_z(after) - u_z(before) [mm] at spatial points [mm] of the state before."""
    X, u = before.positions, before.displacement
    step = after.displacement[2] - u[2]
    nz, ny, nx = (count - 1 for count in step.shape)
    sides = X[0, 0, 0, -1], X[1, 0, -1, 0]
    p = points.T

    def at(field, place):
        j, i = ny * place[1] / sides[1], nx * place[0] / sides[0]
        height = map_coordinates(X[2, -1], [j, i], order=1, mode="nearest")
        return map_coordinates(field, [nz * place[2] / height, j, i], order=1, mode="nearest")

    def closer(_, place):
        return p - jnp.stack([at(part, place) for part in u])

    return at(step, jax.lax.fori_loop(0, _ITERATIONS, closer, p))


def bulge(solution: Solution | LoadedState, side: str, depth: Float[Array, " n"]) -> Float[Array, " n"]:
    """Compute the outward displacement [mm] of the middle of a side at distances from the window [mm]."""
    axis, end = "xy".index(side[0]), -int(side[1])
    u = jnp.take(solution.displacement, end, axis=3 - axis)  # (3, nz+1, nodes along the side)
    z = jnp.take(solution.positions[2], end, axis=2 - axis) + u[2]
    middle = (u.shape[2] - 1) / 2.0
    nodes = np.array([int(np.floor(middle)), int(np.ceil(middle))])
    outward = (1.0 if end else -1.0) * jnp.mean(u[axis][:, nodes], axis=1)
    return jnp.interp(depth, jnp.mean(z[:, nodes], axis=1), outward)


def source_of(observed: Any) -> str:
    """Name the kind of an observation: χ² is reported by source."""
    names = {ThicknessMap: "thickness", ForceReading: "force", AxialIncrement: "phase", SideBulge: "bulge"}
    return names[type(observed)]
