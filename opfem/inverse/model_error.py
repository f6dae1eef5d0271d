"""Discretisation error of the interface height, by Richardson extrapolation, and what it changes in a fit."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import Traction
from ..optimise.conjugate_gradients import plus
from ..solvers import Newton, Solution, solve
from .measured_surface import interface_heights
from .objective import Objective, interface_displacement, normal_traction
from .uncertainty import Posterior
from .warm_start import interpolated

# Second-order convergence: on half as many elements along each axis the error is four times as large.
_SECOND_ORDER = 3.0


def mesh_error(solution: Solution, solver: Newton = Newton()) -> Float[Array, "half_my half_mx"]:
    """Estimate the discretisation error of the interface height by a solve on half as many elements along each axis.

    The error is a third of the difference (Richardson extrapolation of a second-order method). It is overestimated
    where half of the mesh does not resolve the load. Refine the mesh where it is well above the map's noise per
    element.

    Args:
        solution: A solve under a traction, such as `TractionFit.solution`.
        solver: Settings of the solve on half the mesh.

    Returns:
        Height on the mesh minus true height [mm], at every other node of the interface.

    Raises:
        ValueError: If the load is no `Traction`, or the number of elements along an axis is odd or below 8 (x, y).
        ConvergenceError: If the solve on half the mesh fails.
    """
    palpation, load = solution.palpation, solution.load
    if not isinstance(load, Traction):
        raise ValueError(f"mesh_error needs a solve under a Traction, got {type(load).__name__}.")
    if not can_halve(palpation.elements):
        raise ValueError(
            "mesh_error needs even numbers of elements (nx, ny, nz), 8 or more along x and y, got "
            f"{palpation.elements}."
        )
    nx, ny, nz = palpation.elements
    half = dataclasses.replace(palpation, elements=(nx // 2, ny // 2, nz // 2))
    dead = Traction(-solution.traction[2], load.lateral)
    coarse = solve(half, jax.tree.map(_every_other, dead), solver, progress=False)
    fine = interface_heights(palpation.mesh(), solution.displacement[:, -1])
    return (interface_heights(half.mesh(), coarse.displacement[:, -1]) - _every_other(fine)) / _SECOND_ORDER


def can_halve(elements: tuple[int, int, int]) -> bool:
    """Return whether half as many elements are a mesh, of at least four along x and y."""
    return not any(n % 2 for n in elements) and min(elements[:2]) >= 8


def _every_other(values: Array) -> Array:
    return values[..., ::2, ::2] if jnp.ndim(values) >= 2 else values


class FollowedError(NamedTuple):
    """Mesh error of a fit.

    Attributes:
        height: Root mean square of that of the interface height [mm].
        normal: Change of the normal traction that makes the fit follow it [MPa].
        moved: Change of the interface's displacement with it [mm].
    """

    height: Array
    normal: Float[Array, "maps my mx"]
    moved: Float[Array, "maps 3 my mx"]


def followed_error(posterior: Posterior, objective: Objective, solutions: list[Solution]) -> FollowedError:
    """Estimate the mesh error under every map's traction, and the change of the fit that follows it.

    Args:
        posterior: Posterior of the fit.
        objective: Its objective.
        solutions: The layer under the fitted traction of every map.

    Raises:
        ConvergenceError: If a solve on half the mesh fails.
    """
    surfaces = objective.surfaces
    errors = jnp.stack([mesh_error(one, objective.solver) for one in solutions])
    heights = interpolated(errors, *surfaces.surface.shape)
    nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), posterior.residual_structure())
    change = {**nothing, "maps": jax.vmap(lambda one, change: one.misfit_change(change))(surfaces, heights)}
    followed = plus(change, posterior.solve(change).residual, -1.0)
    height = jnp.sqrt(jnp.mean(errors**2))
    return FollowedError(height, normal_traction(followed), interface_displacement(followed))
