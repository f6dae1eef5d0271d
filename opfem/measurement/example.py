"""A made-up measurement to try things on: a ridged and dotted stiff target under a 5 by 5 mm layer.

`opfem palpate example` uses it; it has what real maps have: noise, a hole, and a corner of lift-off.
"""

import jax.numpy as jnp
import numpy as np

from .thickness import Step, ThicknessMap

EXAMPLE_LAYER = 0.5
"""Unloaded thickness of the layer of `example_map` [mm]."""

_SIDE, _SAMPLES, _STD = 5.0, 201, 2e-3
_DOTS = ((1.5, 3.6), (2.6, 3.9), (3.6, 3.4), (3.9, 1.4), (3.1, 2.4))


def _bump(distance: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-0.5 * (distance / width) ** 2)


def _true_thickness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the loaded thickness [mm] without noise: compressed by up to 30%, lifted off at one corner."""
    strain = np.full_like(x, 0.10)
    # Two ridges, bent so that they line up with no mesh line.
    for start in (1.0, 2.0):
        middle = start + 0.15 * np.sin(2 * np.pi * x / 4.0)
        strain += 0.12 * _bump(y - middle, 0.22) / (1 + np.exp((x - 3.0) / 0.2))
    for x_dot, y_dot in _DOTS:
        strain += 0.17 * _bump(np.hypot(x - x_dot, y - y_dot), 0.24)
    corner = 1 / (1 + np.exp((np.hypot(x - _SIDE, y - _SIDE) - 1.0) / 0.12))
    strain = (1 - corner) * strain - 0.012 * corner
    return EXAMPLE_LAYER * (1 - strain)


def example_map(seed: int = 0) -> ThicknessMap:
    """Make a synthetic measured map of a 0.5 mm layer pressed onto a ridged and dotted target.

    The strain reaches 30%. White noise of 2 µm std is added, a hole of about 0.3 mm is masked and not filled,
    and in the corner at large x and y the sample is clear of the layer (thickness slightly above 0.5 mm).

    Args:
        seed: Seed of the noise.
    """
    x, y = np.meshgrid(*2 * [np.linspace(0.0, _SIDE, _SAMPLES)])
    noise = _STD * np.random.default_rng(seed).standard_normal(x.shape)
    angle = np.arctan2(y - 3.0, x - 0.8)
    hole = np.hypot(x - 0.8, y - 3.0) < 0.3 * (1 + 0.25 * np.cos(3 * angle))
    values = _true_thickness(x, y) + noise
    values[hole] = np.median(values[~hole])
    step = Step("example", seed=seed)
    return ThicknessMap(jnp.asarray(values), extent=(_SIDE, _SIDE), std=_STD, mask=hole, steps=(step,))
