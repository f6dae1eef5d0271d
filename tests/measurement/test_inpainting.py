"""Filling of holes, against harmonic functions and a direct solve."""

import jax
import jax.numpy as jnp
import numpy as np

from opfem.measurement.inpainting import harmonic_fill
from tests.tolerances import FINITE_DIFFERENCE, SOLVER


def hole(shape=(12, 15)):
    mask = np.zeros(shape, bool)
    mask[3:8, 4:11] = True
    mask[0:2, 12:] = True
    return mask


def direct_fill(values, mask, spacing):
    """Solve the five-point Laplace equation row by row, with a dense matrix."""
    ny, nx = values.shape
    number = {tuple(p): k for k, p in enumerate(np.argwhere(mask))}
    matrix, right = np.zeros((len(number), len(number))), np.zeros(len(number))
    for (j, i), k in number.items():
        for dj, di, weight in ((0, 1, spacing[0]), (0, -1, spacing[0]), (1, 0, spacing[1]), (-1, 0, spacing[1])):
            if 0 <= j + dj < ny and 0 <= i + di < nx:
                matrix[k, k] += weight**-2
                if mask[j + dj, i + di]:
                    matrix[k, number[j + dj, i + di]] -= weight**-2
                else:
                    right[k] += weight**-2 * values[j + dj, i + di]
    filled = values.copy()
    filled[mask] = np.linalg.solve(matrix, right)
    return filled


def test_equals_a_direct_solve():
    values = np.random.default_rng(0).uniform(0.3, 0.5, (12, 15))
    for spacing in [(0.1, 0.1), (0.1, 0.03)]:
        ours = harmonic_fill(jnp.array(values), jnp.array(hole()), spacing)
        np.testing.assert_allclose(ours, direct_fill(values, hole(), spacing), SOLVER)


def test_restores_a_plane():
    mask = np.zeros((12, 15), bool)
    mask[2:10, 3:12] = True
    y, x = np.mgrid[0:12, 0:15] * 0.1
    plane = 0.4 + 0.02 * x - 0.01 * y
    ours = harmonic_fill(jnp.array(np.where(mask, 9.0, plane)), jnp.array(mask), (0.1, 0.1))
    np.testing.assert_allclose(ours, plane, SOLVER)


def test_keeps_data_and_stays_between():
    values = np.random.default_rng(1).uniform(0.3, 0.5, (12, 15))
    ours = np.asarray(harmonic_fill(jnp.array(values), jnp.array(hole()), (1.0, 1.0)))
    np.testing.assert_array_equal(ours[~hole()], values[~hole()])
    assert ours[hole()].min() > 0.3
    assert ours[hole()].max() < 0.5


def test_no_hole_and_flat_rim():
    values = jnp.full((12, 15), 0.4)
    np.testing.assert_array_equal(harmonic_fill(values, jnp.zeros((12, 15), bool), (1.0, 1.0)), values)
    mask = jnp.zeros((12, 15), bool).at[2, 3].set(True)
    np.testing.assert_allclose(harmonic_fill(values.at[2, 3].set(5.0), mask, (1.0, 1.0)), values, SOLVER)


def test_placeholder_has_no_influence():
    values = np.random.default_rng(2).uniform(0.3, 0.5, (12, 15))
    mask = jnp.array(hole())
    low = harmonic_fill(jnp.where(mask, 0.01, values), mask, (1.0, 1.0))
    high = harmonic_fill(jnp.where(mask, 5.0, values), mask, (1.0, 1.0))
    np.testing.assert_array_equal(low, high)


def test_says_when_it_did_not_converge():
    values = jnp.array(np.random.default_rng(3).uniform(0.3, 0.5, (12, 15)))
    ours = harmonic_fill(values, jnp.array(hole()), (1.0, 1.0), max_iterations=1)
    assert jnp.isnan(ours[jnp.array(hole())]).all()
    assert jnp.isfinite(ours[~jnp.array(hole())]).all()


def test_derivative_forward_and_reverse():
    rng = np.random.default_rng(4)
    values, direction = jnp.array(rng.uniform(0.3, 0.5, (12, 15))), jnp.array(rng.normal(size=(12, 15)))
    mask = jnp.array(hole())

    def energy(v):
        return (harmonic_fill(v, mask, (0.1, 0.07)) ** 2).sum()

    step = 1e-4
    central = (energy(values + step * direction) - energy(values - step * direction)) / (2 * step)
    forward = jax.jvp(energy, (values,), (direction,))[1]
    reverse = (jax.grad(energy)(values) * direction).sum()
    np.testing.assert_allclose(forward, central, FINITE_DIFFERENCE)
    np.testing.assert_allclose(reverse, central, FINITE_DIFFERENCE)


def test_large_hole_converges():
    """Two thirds of a map missing in one piece, the hardest case that readers let through with max_missing raised."""
    x = np.linspace(0, 5, 150)
    values = 0.4 + 0.05 * np.sin(3 * x)[:, None] * np.ones(150)
    mask = np.zeros((150, 150), bool)
    mask[:, :100] = True
    ours = harmonic_fill(jnp.array(values), jnp.array(mask), (1.0, 1.0))
    assert jnp.isfinite(ours).all()
