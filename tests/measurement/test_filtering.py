"""Smoothing and its effect on noise, against NumPy loops, SciPy and statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from opfem.measurement.filtering import (
    FWHM_PER_STD,
    WHITE_NOISE_LENGTH,
    gaussian_matrix,
    noise_correlation,
    smooth,
    smoothed_variance,
)
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF, SAMPLING

SPACING = (0.05, 0.02)
FWHM = 0.15


def loop_smooth(values, spacing, fwhm):
    """Weigh every sample of the plane, continued at its edge values, around every pixel."""
    ny, nx = values.shape
    reach_y, reach_x = 2 * ny - 1, 2 * nx - 1
    smoothed = np.zeros_like(values)
    for j in range(ny):
        for i in range(nx):
            total = weights = 0.0
            for q in range(j - reach_y, j + reach_y + 1):
                for p in range(i - reach_x, i + reach_x + 1):
                    square = ((p - i) * spacing[0]) ** 2 + ((q - j) * spacing[1]) ** 2
                    weight = np.exp(-4 * np.log(2) * square / fwhm**2)
                    total += weight * values[min(max(q, 0), ny - 1), min(max(p, 0), nx - 1)]
                    weights += weight
            smoothed[j, i] = total / weights
    return smoothed


@pytest.fixture
def values():
    return np.random.default_rng(0).uniform(0.3, 0.5, (7, 5))


def test_smooth_equals_a_loop(values):
    np.testing.assert_allclose(smooth(jnp.array(values), SPACING, 0.06), loop_smooth(values, SPACING, 0.06), ROUNDOFF)


def test_smooth_equals_scipy():
    values = np.random.default_rng(1).uniform(0.3, 0.5, (40, 60))
    std = [FWHM / FWHM_PER_STD / SPACING[1], FWHM / FWHM_PER_STD / SPACING[0]]
    other = scipy.ndimage.gaussian_filter(values, std, mode="nearest", truncate=9.0)
    np.testing.assert_allclose(smooth(jnp.array(values), SPACING, FWHM), other, ROUNDOFF)


def test_smooth_keeps_a_constant():
    flat = jnp.full((7, 5), 0.45)
    np.testing.assert_allclose(smooth(flat, SPACING, FWHM), flat, ROUNDOFF)


def test_no_width_changes_nothing(values):
    np.testing.assert_array_equal(smooth(jnp.array(values), SPACING, 0.0), values)
    np.testing.assert_array_equal(noise_correlation(4, 0.1, 0.0), np.eye(4))


def test_smooth_is_differentiable_in_width(values):
    def energy(fwhm):
        return (smooth(jnp.array(values), SPACING, fwhm) ** 2).sum()

    step = 1e-5
    central = (energy(FWHM + step) - energy(FWHM - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(energy)(FWHM), central, FINITE_DIFFERENCE)
    assert jax.grad(energy)(0.0) == 0.0


def loop_variance(covariance, matrix):
    """Variances of `matrix @ noise`, summed entry by entry."""
    count = len(matrix)
    out = np.zeros(count)
    for i in range(count):
        for j in range(count):
            for k in range(count):
                out[i] += matrix[i, j] * covariance[j, k] * matrix[i, k]
    return out


def dense_smoothing(shape):
    """Matrix of `smooth` on flattened maps, a column per pixel."""
    columns = []
    for index in range(shape[0] * shape[1]):
        unit = np.zeros(shape)
        unit.flat[index] = 1.0
        columns.append(np.asarray(smooth(jnp.array(unit), SPACING, FWHM)).ravel())
    return np.array(columns).T


def positions(shape):
    y, x = np.meshgrid(np.arange(shape[0]) * SPACING[1], np.arange(shape[1]) * SPACING[0], indexing="ij")
    return x.ravel(), y.ravel()


def test_variance_of_white_noise_that_varies_is_exact(values):
    variance = values**2
    exact = loop_variance(np.diag(variance.ravel()), dense_smoothing(values.shape)).reshape(values.shape)
    np.testing.assert_allclose(smoothed_variance(jnp.array(variance), SPACING, FWHM, 0.0), exact, ROUNDOFF)


@pytest.mark.parametrize("noise_length", [0.03, 0.1])
def test_variance_of_uniform_correlated_noise_is_exact(noise_length):
    shape = (7, 5)
    x, y = positions(shape)
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    correlation = np.exp(-square / (4 * (noise_length / FWHM_PER_STD) ** 2))
    exact = 4.0 * loop_variance(correlation, dense_smoothing(shape)).reshape(shape)
    ours = smoothed_variance(jnp.full(shape, 4.0), SPACING, FWHM, noise_length)
    np.testing.assert_allclose(ours, exact, ROUNDOFF)


def test_variance_of_correlated_noise_that_varies_is_a_bound(values):
    noise_length = 0.08
    x, y = positions(values.shape)
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    correlation = np.exp(-square / (4 * (noise_length / FWHM_PER_STD) ** 2))
    std = values.ravel()
    exact = loop_variance(std[:, None] * correlation * std, dense_smoothing(values.shape)).reshape(values.shape)
    ours = smoothed_variance(jnp.array(values**2), SPACING, FWHM, noise_length)
    assert (ours >= exact * (1 - ROUNDOFF)).all()
    assert (ours <= 1.1 * exact).all()


def test_variance_agrees_with_the_spread_of_draws():
    shape, std = (7, 5), 0.003
    noise = std * jax.random.normal(jax.random.key(0), (4000, *shape))
    spread = jax.vmap(lambda draw: smooth(draw, SPACING, FWHM))(noise).std(axis=0)
    predicted = jnp.sqrt(smoothed_variance(jnp.full(shape, std**2), SPACING, FWHM, 0.0))
    # 4000 draws know a std to 1.1%, one standard error.
    np.testing.assert_allclose(spread, predicted, SAMPLING)


def test_interior_variance_approaches_the_continuum():
    """Far from edges white noise keeps dx dy / (4 pi s²) of its variance."""
    std = 0.2 / FWHM_PER_STD
    ours = smoothed_variance(jnp.ones((101, 61)), SPACING, 0.2, 0.0)[50, 30]
    np.testing.assert_allclose(ours, SPACING[0] * SPACING[1] / (4 * np.pi * std**2), 1e-9)


def test_white_noise_length_keeps_power_per_area():
    """Correlation exp(-d²/4s²) integrates to 4 pi s²; white noise to one pixel."""
    std = WHITE_NOISE_LENGTH / FWHM_PER_STD
    np.testing.assert_allclose(4 * np.pi * std**2, 1.0, ROUNDOFF)


def test_gaussian_matrix_rows_are_weights():
    matrix = gaussian_matrix(30, 0.01, 0.2)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, ROUNDOFF)
    assert (matrix >= 0).all()
