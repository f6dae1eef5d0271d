"""Fields of a solution on other points: where the interface lies, and what lies under an image pixel.

Part of `to_xarray` and `summary`; plain arrays on the host.
"""

import numpy as np
from jaxtyping import Bool, Float

from ..measurement.grid import bilinear

# Each step reduces the error by the lateral displacement gradient, about 0.3 on a sharp map.
_MOST_STEPS = 60
# A pixel is found when its interface point is this close [element sizes].
_FOUND = 1e-6


def under_pixels(
    field: Float[np.ndarray, "ny nx"],
    positions: Float[np.ndarray, "2 ny nx"],
    lateral: Float[np.ndarray, "2 ny nx"],
    x: Float[np.ndarray, "my mx"],
    y: Float[np.ndarray, "my mx"],
) -> tuple[Float[np.ndarray, "my mx"], Bool[np.ndarray, "my mx"]]:
    """Read an interface field at spatial points: at the interface point that has moved there.

    Args:
        field: Values at the interface nodes.
        positions: Reference x and y of the interface nodes, a regular grid from 0 [mm].
        lateral: Displacement of these nodes along x and y [mm].
        x: Spatial positions along image columns [mm].
        y: Spatial positions along image rows [mm].

    Returns:
        The field at these points, in its own unit, and where it holds: False where no interface point lies.
    """
    reach = positions[:, -1, -1]
    spacing = np.array([positions[0, 0, 1] - positions[0, 0, 0], positions[1, 1, 0] - positions[1, 0, 0]])
    origin = np.zeros(2)

    def at(values, X, Y):
        return np.asarray(bilinear(values, origin, (spacing[0], spacing[1]), X, Y))

    X, Y = x, y
    error = np.full(x.shape, np.inf)
    for _ in range(_MOST_STEPS):
        new_X, new_Y = x - at(lateral[0], X, Y), y - at(lateral[1], X, Y)
        error = np.maximum(np.abs(new_X - X) / spacing[0], np.abs(new_Y - Y) / spacing[1])
        X, Y = new_X, new_Y
        if error.max() < _FOUND:
            break
    beyond = np.maximum(np.abs(X / reach[0] - 0.5), np.abs(Y / reach[1] - 0.5)) - 0.5
    inside = beyond <= _FOUND
    # Where the interface folds over, the search does not settle: no single point lies under the pixel.
    holds = inside & (error < _FOUND)
    return np.where(holds, at(field, X, Y), np.nan), holds


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
