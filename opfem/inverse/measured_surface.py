"""The measured map projected onto mesh-spaced cubic splines, with its precision.

The map is projected once; the representation error, what the splines cannot follow, is kept apart from the noise.
The deformed interface is compared at spatial positions: its height at every node of the mesh's undeformed grid.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import concrete
from .._types import Map, ScalarLike
from ..measurement import ThicknessMap
from ..mechanics.interface_point import locate
from ..model import HeightField, LayerMesh
from ..solvers.compiling import QuickJit

Nodes = Float[Array, "my mx"]
# Gaussian standard deviation over its full width at half maximum.
_PER_FWHM = 1.0 / np.sqrt(8.0 * np.log(2.0))
# Bending penalty of the splines over the mean precision of a node: it determines masked nodes only.
_BENDING = 1e-6
# Tolerance of the layer's edge, in elements: the round-off of a pixel's coordinate.
_ON_EDGE = 1e-9


class MeasuredSurface(eqx.Module):
    """A measured surface at the nodes of the mesh's grid.

    Attributes:
        surface: Height of the measured surface at the grid's nodes [mm].
        to_rows: Spline values of pixel rows from node rows `(py, my)`.
        to_columns: Spline values of pixel columns from node columns `(px, mx)`.
        certainty: Reciprocal standard deviation of every pixel [1/mm], correlation included; 0 for masked pixels.
        representation: Representation error, pixels minus the surface [mm]; 0 for masked pixels.
        informed: Number of spline coefficients that the pixels determine [-].
        model_std: Standard deviation of the model error that `certainty` includes [mm].
    """

    surface: Nodes
    to_rows: Float[Array, "py my"]
    to_columns: Float[Array, "px mx"]
    certainty: Map
    representation: Map
    informed: Array
    model_std: Array

    def misfit(self, heights: Nodes) -> Map:
        """Compute the standardised misfit of interface heights [mm] at every pixel [-]."""
        return self.misfit_change(heights - self.surface)

    def misfit_change(self, change: Nodes) -> Map:
        """Compute the change of the misfit [-] with a change of the interface heights [mm]."""
        return self.certainty * (self.to_rows @ change @ self.to_columns.T)

    @property
    def precision(self) -> Nodes:
        """Precision of the surface at every node [1/mm²]: row sums of the inverse covariance."""
        return jnp.abs(self.to_rows).T @ self.certainty**2 @ jnp.abs(self.to_columns)

    @property
    def representation_rms(self) -> Array:
        """Root mean square of the representation error [mm]."""
        counted = jnp.sum(self.certainty > 0)
        return jnp.sqrt(jnp.sum(self.representation**2) / jnp.maximum(counted, 1))


def project_map(
    mesh: LayerMesh, thickness: ThicknessMap, std: ScalarLike | Map, model_std: ScalarLike = 0.0
) -> MeasuredSurface:
    """Project a map onto the mesh's splines.

    Noise correlated over less than about two elements enters as white noise of the same power at long waves, which
    slightly overestimates its short waves. The model error, one value per element, enters in the same way.

    Args:
        mesh: The layer's mesh.
        thickness: The measured map.
        std: Standard deviation of the noise of its pixels [mm], a number or a map.
        model_std: Standard deviation of the computed height [mm].
    """
    (hx, hy), (my, mx) = mesh.spacing, mesh.thickness.shape
    rows, inside_y = _spline_values(thickness.y / hy, my - 1)
    columns, inside_x = _spline_values(thickness.x / hx, mx - 1)
    counted = inside_y[:, None] & inside_x & ~thickness.mask
    pixels = hx * hy / (thickness.spacing[0] * thickness.spacing[1])  # in an element's area
    variance = jnp.broadcast_to(std, thickness.shape) ** 2 * _correlated_pixels(thickness) + model_std**2 * pixels
    sigma = jnp.sqrt(variance)
    certainty = jnp.where(counted, 1.0 / jnp.where(counted, sigma, 1.0), 0.0)
    values = jnp.where(counted, thickness.values, 0.0)

    weight = certainty**2
    precision = jnp.sum(weight) / (my * mx)
    bends_y, bends_x = (jnp.asarray(_bending(n)) for n in (my, mx))

    def normal(v):
        data = rows.T @ (weight * (rows @ v @ columns.T)) @ columns
        return data + _BENDING * precision * (bends_y @ v + v @ bends_x)

    right = rows.T @ (weight * values) @ columns
    surface, _ = jax.scipy.sparse.linalg.cg(normal, right, tol=1e-12, maxiter=40 * max(my, mx))
    representation = jnp.where(counted, values - rows @ surface @ columns.T, 0.0)
    share = (rows**2).T @ weight @ columns**2 / jnp.where(precision > 0, precision, 1.0)
    return MeasuredSurface(
        surface, rows, columns, certainty, representation, jnp.sum(share > 1e-3), jnp.asarray(model_std)
    )


@QuickJit
def unresolved_std(surfaces: MeasuredSurface, std: Float[Array, "maps py px"]) -> Array:
    """Compute the root mean square of what splines of the mesh cannot follow in maps, beyond their noise [mm].

    The layer's mesh misses about as much: of the published coin 6.3 µm on 20×20 elements, 1.9 µm on 40×40.

    Args:
        surfaces: The projected maps, stacked.
        std: Standard deviation of the noise of their pixels [mm].
    """
    counted = surfaces.certainty > 0
    excess = jnp.sum(jnp.where(counted, surfaces.representation**2 - std**2, 0.0)) / jnp.maximum(jnp.sum(counted), 1)
    return jnp.sqrt(jnp.maximum(excess, 0.0))


@QuickJit
def interface_heights(mesh: LayerMesh, u: Float[Array, "3 my mx"]) -> Nodes:
    """Compute the height of the deformed interface [mm] at the positions of the mesh's undeformed nodes.

    Beyond the layer's edges the edge value continues.

    Args:
        mesh: The layer's mesh.
        u: Displacement of the interface's nodes [mm].
    """
    (hx, hy), (my, mx) = mesh.spacing, mesh.thickness.shape
    to_y, to_x = (jnp.asarray(_interpolation(n)) for n in (my, mx))

    def spline(values):
        return HeightField(to_y @ values @ to_x.T, jnp.stack([-hx, -hy]), jnp.stack([hx, hy]), "cubic")

    motion = jax.tree_util.Partial(_both, jax.vmap(spline)(u[:2]))
    place, far = jnp.stack(mesh.plane()), jnp.stack([hx * (mx - 1), hy * (my - 1)])
    below = locate(motion, place, far, jnp.stack([hx, hy]))
    return spline(mesh.thickness + u[2])(*below.at)[0]


def _both(fields: HeightField, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Evaluate several fields, stacked, and their slopes."""
    return jax.vmap(lambda field: field(x, y))(fields)


def _spline_values(t: Float[Array, " points"], cells: int) -> tuple[Array, Array]:
    """Return the matrix from node values to spline values at points, in cells; and which points lie on the layer."""
    distance = jnp.abs(t[:, None] - np.arange(-1, cells + 2))
    basis = (jnp.maximum(2.0 - distance, 0.0) ** 3 - 4.0 * jnp.maximum(1.0 - distance, 0.0) ** 3) / 6.0
    inside = (t >= -_ON_EDGE) & (t <= cells + _ON_EDGE)
    return jnp.where(inside[:, None], basis @ jnp.asarray(_interpolation(cells + 1)), 0.0), inside


def _interpolation(n: int) -> np.ndarray:
    """Return the matrix from node values to cubic B-spline coefficients, one more at each end (not-a-knot)."""
    rows = np.zeros((n + 2, n + 2))
    rows[np.arange(n)[:, None], np.arange(n)[:, None] + [0, 1, 2]] = np.array([1.0, 4.0, 1.0]) / 6.0
    rows[n, :5] = rows[n + 1, -5:] = [1.0, -4.0, 6.0, -4.0, 1.0]
    return np.linalg.inv(rows)[:, :n]


def _bending(n: int) -> np.ndarray:
    second = np.diff(np.eye(n), n=2, axis=0)
    return second.T @ second


def _correlated_pixels(thickness: ThicknessMap) -> Array:
    """Compute the number of pixels that share one pixel's noise: the sum of the correlations with all pixels."""
    scale = thickness.noise_length * _PER_FWHM

    def along(spacing, n):
        d = spacing * jnp.arange(1, n)
        return 1.0 + 2.0 * jnp.sum(jnp.exp(-(d**2) / jnp.where(scale > 0, 4.0 * scale**2, 1.0))) * (scale > 0)

    return along(thickness.spacing[0], thickness.shape[1]) * along(thickness.spacing[1], thickness.shape[0])


def noise_std(caller: str, thickness: ThicknessMap) -> Array:
    """Return the standard deviation of a map's noise [mm].

    Raises:
        ValueError: If it is missing or not positive; a fit weighs map against prior by it.
    """
    if not isinstance(thickness, ThicknessMap):
        raise ValueError(f"{caller} needs a ThicknessMap, got {type(thickness).__name__}.")
    if thickness.std is None:
        raise ValueError(
            f"{caller} needs the standard deviation of the map's noise, thickness.std [mm], got None. "
            "Measure it on a flat target or between repeated scans, and pass read_thickness(..., std=0.002)."
        )
    std, mask = concrete(thickness.std), concrete(thickness.mask)
    if std is not None and mask is not None:
        used = np.broadcast_to(std, thickness.shape)[~mask]
        if not (used > 0).all():
            raise ValueError(
                f"{caller}: thickness.std [mm] must be positive where pixels are data, got {used.min():g}. "
                "A pixel of zero noise would outweigh all others; pass the standard deviation between repeated scans."
            )
    return thickness.std
