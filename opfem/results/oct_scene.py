"""What an OCT microscope would see of a solved layer: its deformed surface, and how its points move between two states.

`simulate_oct` makes volumes of it whose truth is the solution.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array
from scipy.interpolate import RectBivariateSpline

from ..inverse.measured_surface import interface_heights
from ..measurement import ThicknessMap
from ..model import Palpation
from ..solvers import ExperimentSolution, Solution

_ITERATIONS = 30  # of the inverse map; each gains a digit at strains of 30 %
_CLOSE = 1e-9  # mm
# Pixels of a surface per element. Bilinear between nodes, it lies 0.6 µm rms beside the cubic splines that fits and
# imprints take it for (coin, 16×16×4 elements); a hundredth of that at 8.
_FINER = 8


class OctScene(eqx.Module):
    """A scene for `simulate_oct(system, scene.surface, increment=scene.increment, ...)`.

    Attributes:
        surface: Depth of the interface between layer and sample [mm]; cubic splines through its nodes, finely sampled.
        increment: Displacement (u_x, u_y, u_z) [mm] from the first state to the second at points (x, y, z) [mm] of the
            first; None for one state. Below the interface the sample moves as its surface.
    """

    surface: ThicknessMap
    increment: Callable[[Any, Any, Any], tuple[np.ndarray, np.ndarray, np.ndarray]] | None = eqx.field(static=True)


def oct_scene(solution: Solution | ExperimentSolution, before: Solution | ExperimentSolution | None = None) -> OctScene:
    """Make a scene of a solution, or of the increment between two of them.

    Args:
        solution: A solved state.
        before: An earlier state of the same mesh; the scene is then of it, and its increment leads to `solution`.

    Raises:
        ValueError: For states of two meshes.
    """
    if before is None:
        return OctScene(_surface(solution), None)
    if before.displacement.shape != solution.displacement.shape:
        raise ValueError(
            f"oct_scene needs two states of one mesh, got displacements of shape {before.displacement.shape} and "
            f"{solution.displacement.shape}."
        )
    surface = _surface(before)
    start, positions = before.displacement, before.positions
    step = solution.displacement - start

    def increment(x: Any, y: Any, z: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points = jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(c, float) for c in (x, y, z))))
        moved = np.asarray(_moved(points, positions, start, step))
        return moved[0], moved[1], moved[2]

    return OctScene(surface, increment)


def _surface(solution: Solution | ExperimentSolution) -> ThicknessMap:
    """Sample the cubic splines through the interface's nodes on a fine grid."""
    stated = solution.palpation if isinstance(solution, Solution) else solution.experiment
    mesh = stated.mesh() if isinstance(stated, Palpation) else stated.layer_mesh()
    heights = np.asarray(interface_heights(mesh, solution.displacement[:, -1]))
    rows, columns = heights.shape
    spline = RectBivariateSpline(
        np.arange(rows), np.arange(columns), heights, kx=min(3, rows - 1), ky=min(3, columns - 1)
    )
    fine_rows, fine_columns = (np.linspace(0, count - 1, _FINER * (count - 1) + 1) for count in heights.shape)
    return ThicknessMap(spline(fine_rows, fine_columns), extent=stated.extent)


@jax.jit
def _moved(points: Array, positions: Array, displacement: Array, step: Array) -> Array:
    """Interpolate a step at points that were displaced: at X = x - u(X), by fixed-point iteration."""

    def unfinished(carry):
        count, _, change = carry
        return (count < _ITERATIONS) & (change >= _CLOSE)

    def closer(carry):
        count, reference, _ = carry
        after = points - _at(displacement, reference, positions)
        return count + 1, after, jnp.max(jnp.abs(after - reference))

    begin = (0, points, jnp.asarray(jnp.inf, points.dtype))
    return _at(step, jax.lax.while_loop(unfinished, closer, begin)[1], positions)


def _at(field: Array, points: Array, positions: Array) -> Array:
    """Interpolate a nodal field trilinearly at reference points; outside the layer its edge value holds."""
    _, nz, ny, nx = (count - 1 for count in positions.shape)
    x, y, z = points
    i = nx * (x - positions[0, 0, 0, 0]) / (positions[0, 0, 0, -1] - positions[0, 0, 0, 0])
    j = ny * (y - positions[1, 0, 0, 0]) / (positions[1, 0, -1, 0] - positions[1, 0, 0, 0])
    thickness = map_coordinates(positions[2, -1], [j, i], order=1, mode="nearest")
    k = nz * z / thickness
    return jnp.stack([map_coordinates(part, [k, j, i], order=1, mode="nearest") for part in field])
