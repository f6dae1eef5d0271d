"""The thickness map that a microscope would measure of a solved layer: on its own pixels, with its noise.

Where the full volume counts, `oct_scene` and `simulate_oct` make that instead.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._checks import as_leaf, check_non_negative, check_positive
from .._types import ScalarLike
from ..measurement import Step, ThicknessMap
from ..measurement.grid import pair
from ..solvers import ExperimentSolution, Solution
from .fields import under_pixels


def measured_thickness(
    solution: Solution | ExperimentSolution, spacing: Any, std: ScalarLike = 0.0, seed: int = 0
) -> ThicknessMap:
    """Measure a solved layer: its thickness at pixels in space over the whole layer, with noise.

    Args:
        solution: One solution, outside jit.
        spacing: (dx, dy) between pixels [mm], or one number for both; rounded to divide the layer's extent.
        std: Standard deviation of the noise, normal and independent from pixel to pixel [mm].
        seed: Of the noise.

    Raises:
        ValueError: For a failed solution, or a number out of range.

    Example:
        >>> import opfem as op
        >>> def as_measured(truth):
        ...     return op.measured_thickness(truth, spacing=0.02, std=0.002, seed=1)
    """
    step = np.asarray(pair("measured_thickness.spacing (dx, dy)", spacing))
    check_positive("measured_thickness.spacing (dx, dy)", "mm", step)
    check_non_negative("measured_thickness.std", "mm", as_leaf(std, "measured_thickness.std", "mm"))
    u, X = np.asarray(solution.displacement), np.asarray(solution.positions)
    if u.ndim != 4 or not np.isfinite(u).all():
        raise ValueError("measured_thickness needs one solution that converged, got several, or NaN fields.")
    extent = X[:2, -1, -1, -1]
    nx, ny = (max(2, int(np.rint(length / size)) + 1) for length, size in zip(extent, step, strict=True))
    x, y = np.meshgrid(np.linspace(0.0, extent[0], nx), np.linspace(0.0, extent[1], ny))
    # Of the layer itself: the window may leave a gap.
    thickness = under_pixels((X + u)[2, -1] - u[2, 0], X[:2, -1], u[:2, -1], x, y)
    noise = float(std) * np.random.default_rng(seed).standard_normal(thickness.shape)
    mask = ~np.isfinite(thickness)
    return ThicknessMap(
        np.where(mask, 1.0, thickness) + noise,
        extent=jnp.asarray(extent),
        std=float(std) or None,
        mask=mask,
        steps=(Step("simulated", std=std, seed=seed),),
    )
