"""Effective resolution: what a point of the true traction is smeared over in the fitted one."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..solvers.compiling import QuickJit
from .misfit import Misfit, carried
from .posterior import Posterior
from .preconditioner import Unknowns

# Points along each axis.
_GRID = 4
# Passes that find what to ask of a bed of springs so that the layer carries a change at single points.
_PASSES = 4
# Full width at half maximum over the standard deviation of a Gaussian.
_FWHM = np.sqrt(8.0 * np.log(2.0))


def resolution(posterior: Posterior, misfit: Misfit) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "maps n"]]:
    """Compute the width of the resolution kernel on a grid of points.

    Points are far apart, so one solve finds the kernels of all; each is looked at up to half the way to the next.

    Returns:
        Points (x, y) [mm]; widths [mm], see `TractionFit.resolution_width`.
    """
    mesh = misfit.palpation.mesh()
    (hx, hy), (my, mx) = (float(h) for h in mesh.spacing), mesh.thickness.shape
    rows, columns = (np.unique(np.round((np.arange(_GRID) + 0.5) / _GRID * (n - 1)).astype(int)) for n in (my, mx))
    points = np.zeros((posterior.white.normal.shape[0], my, mx))
    points[:, rows[:, None], columns] = 1.0
    image = np.asarray(_image(posterior, misfit, jnp.asarray(points)))
    reach_y, reach_x = (max(int(np.diff(n).min()) // 2, 1) if n.size > 1 else max(my, mx) for n in (rows, columns))
    widths = np.empty((len(image), rows.size, columns.size))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            near = image[:, max(row - reach_y, 0) : row + reach_y + 1, max(column - reach_x, 0) : column + reach_x + 1]
            with np.errstate(divide="ignore", invalid="ignore"):  # of a fit that failed
                squares = np.sum(near**2, axis=(1, 2)) / image[:, row, column] ** 2 * hx * hy
            widths[:, i, j] = _FWHM * np.sqrt(squares / np.pi)
    y, x = np.meshgrid(rows * hy, columns * hx, indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2), widths.reshape(len(image), -1)


def _image(posterior: Posterior, misfit: Misfit, points: Array) -> Array:
    """Fit the change of the maps that a change of the traction at some nodes makes."""
    slope = _slope(posterior.white, misfit)
    change = jax.tree.map(jnp.zeros_like, posterior.white)
    carries = jnp.zeros_like(points)
    for _ in range(_PASSES + 1):
        change = change._replace(normal=change.normal + _asked(misfit, (points - carries) / slope))
        residuals = posterior.push(change)
        carries = carried(residuals)
    told = {name: part if name == "maps" else jax.tree.map(jnp.zeros_like, part) for name, part in residuals.items()}
    return carried(posterior.push(posterior.solve(told).x))


@QuickJit
def _slope(white: Unknowns, misfit: Misfit) -> Array:
    """Compute the derivative of the normal traction by the latent field [-]: 1 unless it is kept non-negative."""
    latent = misfit.latent(white)
    return jax.jvp(misfit.latent_to_normal, (latent,), (jnp.ones_like(latent),))[1]


@QuickJit
def _asked(misfit: Misfit, normal: Array) -> Array:
    return jax.vmap(lambda part: misfit.prior.whiten(part, misfit.palpation.mesh().spacing))(normal)
