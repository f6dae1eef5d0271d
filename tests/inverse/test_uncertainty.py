"""The linear-Gaussian oracle (docs/validation.md test 39): posterior, degrees of freedom and misfit in closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import opfem as op
from opfem.inverse.linear_layer import poisson_ratio, transfer_function
from opfem.inverse.uncertainty import Posterior
from opfem.optimise.conjugate_gradients import least_squares

# A line of 5 mm, periodic, with 128 points; noise of 2 μm; a Gaussian prior of 2 kPa over 0.5 mm.
LENGTH, POINTS, THICKNESS = 5.0, 128, 0.5
NOISE, PRIOR_STD, PRIOR_LENGTH = 2e-3, 2e-3, 0.5
MATERIAL = op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=20 * 2 * (2.23e-3 + 7.03e-4))


@pytest.fixture(scope="module")
def modes():
    """Gain [mm/MPa] and prior variance [MPa²] of the real Fourier modes."""
    k = 2 * np.pi / LENGTH * np.repeat(np.arange(POINTS // 2 + 1), 2)[1:-1]
    gain = transfer_function(jnp.asarray(k), THICKNESS, MATERIAL.shear, poisson_ratio(MATERIAL), "bonded")
    variance = (
        PRIOR_STD**2 * np.sqrt(2 * np.pi) * PRIOR_LENGTH * np.exp(-((k * PRIOR_LENGTH) ** 2) / 2) * POINTS / LENGTH
    )
    return gain, jnp.asarray(variance)


@pytest.fixture(scope="module")
def posterior(modes):
    gain, variance = modes
    rows = -gain * jnp.sqrt(variance) / NOISE
    white = jnp.zeros(POINTS)
    J = lx.FunctionLinearOperator(lambda v: (rows * v, v), jax.eval_shape(lambda: white))
    return Posterior(white, J, lambda r: r / (1.0 + 0.5 * rows**2))  # a preconditioner that is off by up to 2


def test_standard_deviation(modes, posterior):
    """Posterior standard deviation 0.0661 kPa; the solver's covariance is the formula's to 1e-6."""
    gain, variance = modes
    formula = variance / (1.0 + variance * gain**2 / NOISE**2)
    assert 1e3 * np.sqrt(np.mean(formula)) == pytest.approx(0.0661, rel=0.01)
    spread = jnp.sqrt(variance)
    for mode in (0, 1, 8, 30, 90):
        row = spread * posterior.covariance(spread * jnp.zeros(POINTS).at[mode].set(1.0))
        assert row[mode] == pytest.approx(float(formula[mode]), rel=1e-6)


def test_degrees_of_freedom_and_expected_misfit(modes, posterior):
    """Effective degrees of freedom 12.9, expected χ² of the residual 115.1 of 128."""
    gain, variance = modes
    seen = variance * gain**2 / NOISE**2
    dof = float(jnp.sum(seen / (1.0 + seen)))
    assert dof == pytest.approx(12.9, rel=0.01)
    assert POINTS - dof == pytest.approx(115.1, rel=0.01)
    _, (misfit, _), _ = jax.vmap(posterior.draw)(jax.random.split(jax.random.key(0), 1000))
    determined = jnp.sum(misfit**2, axis=1)
    assert jnp.mean(determined) == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / 1000))


def test_draws_have_the_posterior_covariance(modes, posterior):
    gain, variance = modes
    formula = 1.0 / (1.0 + variance * gain**2 / NOISE**2)
    draws, _, _ = jax.vmap(posterior.draw)(jax.random.split(jax.random.key(1), 2000))
    assert jnp.mean(draws**2 / formula, axis=0) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 2000))


def test_data_of_shorter_waves_fall_faster_than_the_gain_down_to_the_noise(modes):
    """The discrete Picard condition (docs/validation.md test 40)."""
    gain, variance = modes
    truth, noise = jax.random.normal(jax.random.key(2), (2, 4000, POINTS))
    data = gain * jnp.sqrt(variance) * truth + NOISE * noise
    held = jnp.sqrt(jnp.mean(data**2, axis=0))
    shorter = int(jnp.argmax(gain))
    seen = shorter + int(jnp.argmax(held[shorter:] < 2.0 * NOISE))
    # The two waves of each length agree but for sampling: every other one.
    assert jnp.all(jnp.diff((held / gain)[shorter:seen:2]) < 0.0)
    assert seen - shorter >= 6
    assert held[seen + 4 :] == pytest.approx(NOISE, rel=0.06)


def test_a_system_that_is_cut_short_is_told(posterior):
    never = eqx.tree_at(lambda p: p.rtol, posterior, 0.0)
    with pytest.warns(UserWarning, match="limit of 200 iterations"):
        never.draw(jax.random.key(0))


def test_least_squares_against_numpy():
    rng = np.random.default_rng(0)
    A, b = jnp.asarray(rng.standard_normal((30, 12))), jnp.asarray(rng.standard_normal(30))
    solved = least_squares(lambda x: A @ x, lambda r: A.T @ r, lambda g: g / jnp.sum(A**2, axis=0), b, 1e-12, 100)
    assert solved.x == pytest.approx(np.linalg.lstsq(np.asarray(A), np.asarray(b))[0], abs=1e-10)
    assert solved.gradient == pytest.approx(np.asarray(A.T @ b))
    assert solved.relative_gradient <= 1e-12
    assert 0 < solved.iterations <= 30


def test_least_squares_stops_at_the_most_iterations():
    A = jnp.diag(jnp.linspace(1.0, 1e4, 50))
    solved = least_squares(lambda x: A @ x, lambda r: A.T @ r, lambda g: g, jnp.ones(50), 1e-12, 5)
    assert solved.iterations == 5
    assert solved.relative_gradient > 1e-12
