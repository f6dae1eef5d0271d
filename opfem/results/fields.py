"""Fields of a solution on other points: where the interface lies, and what lies under an image pixel.

Part of `to_xarray` and `summary`; plain arrays on the host.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.interface_point import NodalField, locate
from ..solvers import ExperimentSolution, Solution
from ..solvers.compiling import QuickJit


def under_pixels(
    field: Float[np.ndarray, "*fields my mx"],
    positions: Float[np.ndarray, "2 my mx"],
    lateral: Float[np.ndarray, "2 my mx"],
    x: Float[np.ndarray, "py px"],
    y: Float[np.ndarray, "py px"],
) -> Float[np.ndarray, "*fields py px"]:
    """Read interface fields at spatial points: at the interface point that has moved there.

    Args:
        field: Values at the interface nodes, of one field or of several.
        positions: Reference x and y of the interface nodes, a regular grid from 0 [mm].
        lateral: Displacement of these nodes along x and y [mm].
        x: Spatial positions along image columns [mm].
        y: Spatial positions along image rows [mm].

    Returns:
        The fields at these points, in their own units; NaN where no interface point lies.
    """
    stacked = field.reshape(-1, *field.shape[-2:])
    found = _under_pixels(*(jnp.asarray(v) for v in (stacked, positions[:, -1, -1], lateral, np.stack([x, y]))))
    return np.asarray(found).reshape(*field.shape[:-2], *x.shape)


def pressure_image(solution: Solution | ExperimentSolution) -> Float[Array, "py px"]:
    """Read the contact pressure [MPa] on the pixels of the solution's thickness map; NaN where no interface lies.

    Args:
        solution: What `solve` returned; works under jit, vmap and grad.
    """
    grid, surface = solution.thickness, solution.positions[:2, -1]
    place = jnp.stack(jnp.meshgrid(grid.x, grid.y))
    pressure = _under_pixels(solution.pressure[None], surface[:, -1, -1], solution.displacement[:2, -1], place)
    return jnp.where(grid.mask, jnp.nan, pressure[0])


@QuickJit
def _under_pixels(fields: Array, far: Array, lateral: Array, place: Array) -> Array:
    my, mx = lateral.shape[1:]
    size = far / jnp.array([mx - 1, my - 1])
    below = locate(NodalField(lateral, size), place, far, size)
    return jnp.where(jnp.all(below.found, axis=0), NodalField(fields, size)(*below.at)[0], jnp.nan)


def node_areas(
    x: Float[np.ndarray, "ny nx"], y: Float[np.ndarray, "ny nx"], z: Float[np.ndarray, "ny nx"]
) -> Float[np.ndarray, "ny nx"]:
    """Compute the area [mm²] that belongs to each node of a surface: a quarter of each facet around it.

    Args:
        x: Positions of the nodes along x [mm].
        y: Positions of the nodes along y [mm].
        z: Positions of the nodes along z [mm].
    """
    point = np.stack([x, y, z], axis=-1)
    one = point[1:, 1:] - point[:-1, :-1]
    other = point[1:, :-1] - point[:-1, 1:]
    quarter = np.linalg.norm(np.cross(one, other), axis=-1) / 8.0
    areas = np.zeros(x.shape)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            areas[rows, columns] += quarter
    return areas
