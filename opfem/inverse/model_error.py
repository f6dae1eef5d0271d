"""Discretisation error of the interface height, by Richardson extrapolation."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import Traction
from ..solvers import Newton, Solution, solve
from .measured_surface import interface_heights

# Second-order convergence: on half as many elements along each axis the error is four times as large.
_SECOND_ORDER = 3.0


def mesh_error(solution: Solution, solver: Newton = Newton()) -> Float[Array, "half_my half_mx"]:
    """Estimate the discretisation error of the interface height by a solve on half as many elements along each axis.

    The error is a third of the difference (Richardson extrapolation of a second-order method). It is overestimated
    where half of the mesh does not resolve the load. Its root mean square is the default of `fit_traction(model_std=)`.
    Refine the mesh where it is well above the map's noise per element.

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
