"""What is observed of solved states, as one protocol: the standardised residual of the states that a model gives.

Beside thickness maps and forces of one state: increments between two states, and the bulge of a free side.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float

from .._checks import as_leaf, check_finite, check_positive
from ..measurement import ThicknessMap
from ..measurement.oct import AxialIncrement
from ..solvers import Solution
from .data import ForceReading
from .noise import noise_std
from .observation import interface_heights, observe

# Fixed-point iterations that find a spatial point's reference position: at 40 % of strain 1e-8 of the first error.
_ITERATIONS = 20


class SideBulge(eqx.Module):
    """Outward displacement of a free side of the layer, in the middle of that side.

    Attributes:
        depth: Spatial distances from the window `(n,)` [mm].
        displacement: Outward `(n,)` [mm].
        std: Its standard deviation [mm], a number or `(n,)`.
        side: "x0", "x1", "y0" or "y1"; static.
    """

    depth: Float[Array, " n"]
    displacement: Float[Array, " n"]
    std: Array
    side: str = eqx.field(static=True)

    def __init__(self, side: Literal["x0", "x1", "y0", "y1"], depth: Any, displacement: Any, std: Any):
        """State a bulge.

        Args:
            side: Which side.
            depth: Distances from the window [mm], shape (n,).
            displacement: Outward [mm], shape (n,).
            std: Standard deviation [mm], a number or shape (n,).

        Raises:
            ValueError: For an unknown side, and shapes that do not match.
        """
        if side not in ("x0", "x1", "y0", "y1"):
            raise ValueError(f"SideBulge.side must be x0, x1, y0 or y1, got {side!r}.")
        self.side = side
        self.depth = as_leaf(depth, "SideBulge.depth", "mm")
        self.displacement = as_leaf(displacement, "SideBulge.displacement", "mm")
        self.std = as_leaf(std, "SideBulge.std", "mm")
        if self.depth.ndim != 1 or self.depth.shape != self.displacement.shape:
            raise ValueError(
                f"SideBulge.depth and displacement [mm] must be two lists of one length, got shapes {self.depth.shape} "
                f"and {self.displacement.shape}."
            )
        check_finite("SideBulge.displacement", "mm", self.displacement)
        check_positive("SideBulge.std", "mm", self.std)


def residual(
    observed: Any, state: int, states: tuple[Solution, ...], scale: Array, model_std: float
) -> Float[Array, " n"]:
    """Compare an observation with solved states: computed minus measured, over its standard deviation [-].

    Args:
        observed: A `ThicknessMap`, `ForceReading`, `AxialIncrement` or `SideBulge`.
        state: Number of the state it is of; an increment knows its own.
        states: The solved states.
        scale: What measured increments are multiplied with [-].
        model_std: Standard deviation of increments that the model itself computes [mm].
    """
    if isinstance(observed, AxialIncrement):
        computed = scale * axial_increment(states[observed.before], states[observed.after], observed.points)
        return (computed - observed.values) / jnp.sqrt(observed.std**2 + model_std**2)
    solution = states[state]
    if isinstance(observed, ForceReading):
        return jnp.atleast_1d((-solution.stats["force_sample"][2] - observed.force) / observed.std)
    if isinstance(observed, SideBulge):
        return (bulge(solution, observed.side, observed.depth) - observed.displacement) / observed.std
    mesh = solution.palpation.mesh()
    seen = observe(mesh, observed, noise_std("fit_parameters", observed))
    return seen.misfit(interface_heights(mesh, solution.displacement[:, -1])).ravel()


def axial_increment(before: Solution, after: Solution, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
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


def bulge(solution: Solution, side: str, depth: Float[Array, " n"]) -> Float[Array, " n"]:
    """Compute the outward displacement [mm] of the middle of a side at distances from the window [mm]."""
    axis, end = "xy".index(side[0]), -int(side[1])
    u = jnp.take(solution.displacement, end, axis=3 - axis)  # (3, nz+1, nodes along the side)
    z = jnp.take(solution.positions[2], end, axis=2 - axis) + u[2]
    middle = (u.shape[2] - 1) / 2.0
    nodes = np.array([int(np.floor(middle)), int(np.ceil(middle))])
    outward = (1.0 if end else -1.0) * jnp.mean(u[axis][:, nodes], axis=1)
    return jnp.interp(depth, jnp.mean(z[:, nodes], axis=1), outward)


def source_of(observed: Any) -> str:
    """Name the kind of an observation, for χ² by source."""
    names = {ThicknessMap: "thickness", ForceReading: "force", AxialIncrement: "phase", SideBulge: "bulge"}
    return names[type(observed)]
