"""Gaussian smoothing of a map and of its noise, as dense matrices along each axis.

`ThicknessMap.smoothed` is built on these. Matrices keep everything traceable, differentiable in the
width, and exact at the edges, where a map continues at its edge value.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Map, Scalar, ScalarLike

FWHM_PER_STD = 2.3548200450309493
"""Full width at half maximum of a Gaussian over its standard deviation: 2 sqrt(2 ln 2)."""

WHITE_NOISE_LENGTH = FWHM_PER_STD / (4 * math.pi) ** 0.5
"""FWHM, in pixels, of the Gaussian whose correlated noise has the power per area of white noise of equal std."""

# Below this fraction of a pixel a Gaussian is one pixel wide; the floor keeps width zero differentiable.
_NARROWEST = 1e-2


def _std_in_pixels(fwhm: ScalarLike, spacing: ScalarLike) -> Scalar:
    return jnp.maximum(fwhm / FWHM_PER_STD / spacing, _NARROWEST)


def gaussian_matrix(count: int, spacing: ScalarLike, fwhm: ScalarLike) -> Float[Array, "count count"]:
    """Build the matrix that smooths `count` samples in a line by a Gaussian.

    Samples outside the line equal the edge sample, out to `2 count`, so the first and last column
    hold the tails of the Gaussian. Rows add up to one.

    Args:
        count: Number of samples.
        spacing: Distance between samples [mm].
        fwhm: Full width at half maximum [mm]; zero gives the identity.
    """
    std = _std_in_pixels(fwhm, spacing)
    weight = jnp.exp(-0.5 * (jnp.arange(2 * count) / std) ** 2)
    tail = jnp.cumsum(weight[::-1])[::-1]
    index = jnp.arange(count)
    matrix = weight[jnp.abs(index[:, None] - index[None, :])]
    matrix = matrix.at[:, 0].set(tail[index]).at[:, -1].set(tail[count - 1 - index])
    return matrix / matrix.sum(axis=1, keepdims=True)


def noise_correlation(count: int, spacing: ScalarLike, noise_length: ScalarLike) -> Float[Array, "count count"]:
    """Build the correlation between samples in a line of noise that was once white.

    White noise smoothed by a Gaussian of std s has the correlation exp(-d²/(4 s²)) at distance d.

    Args:
        count: Number of samples.
        spacing: Distance between samples [mm].
        noise_length: FWHM [mm] of that Gaussian; zero gives the identity.
    """
    std = _std_in_pixels(noise_length, spacing)
    index = jnp.arange(count)
    return jnp.exp(-(((index[:, None] - index[None, :]) / (2 * std)) ** 2))


@jax.jit
def smooth(values: Map, spacing: tuple[ScalarLike, ScalarLike], fwhm: ScalarLike) -> Map:
    """Smooth a map by a Gaussian of width `fwhm` [mm]; `spacing` is (dx, dy) [mm]."""
    ny, nx = values.shape
    return gaussian_matrix(ny, spacing[1], fwhm) @ values @ gaussian_matrix(nx, spacing[0], fwhm).T


@jax.jit
def smoothed_variance(
    variance: Map, spacing: tuple[ScalarLike, ScalarLike], fwhm: ScalarLike, noise_length: ScalarLike
) -> Map:
    """Compute the variance that noise keeps after `smooth`.

    With smoothing matrix G and noise correlation C along each axis, a sample of noise of uniform
    std s keeps s² (G C Gᵀ)_ii = s² Σ_j M_ij, M = G ∘ (G C). Where the std varies, M is applied to the
    variance: exact for white noise (C = I, M = G²), else an upper bound, since
    2 s_j s_k ≤ s_j² + s_k².

    Args:
        variance: Variance of the noise before [mm²].
        spacing: Distance between samples (dx, dy) [mm].
        fwhm: Width of the smoothing Gaussian [mm].
        noise_length: FWHM [mm] of the Gaussian that correlated the noise; zero when white.

    Returns:
        Variance of the noise after [mm²]; larger at the edges, where the edge sample counts for all beyond it.
    """

    def weights(count: int, step: ScalarLike) -> Array:
        G = gaussian_matrix(count, step, fwhm)
        return G * (G @ noise_correlation(count, step, noise_length))

    ny, nx = variance.shape
    return weights(ny, spacing[1]) @ variance @ weights(nx, spacing[0]).T
