"""The traction fit on data of its own model: it finds the truth, and knows how well."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.forward import press
from opfem.inverse.observation import _spline_values, interface_heights
from opfem.solvers.derivative import follow_path
from opfem.solvers.discretise import discretise
from opfem.solvers.stepping import attempt, begin, unfinished

NOISE, SIDE, ELEMENTS = 2e-3, 1.5, (12, 12, 2)
PRIOR = op.Matern(length=0.6, std=1.5e-3, mean=3e-3)


def palpation(elements=ELEMENTS, window=0.15, sample=0.05):
    return op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(SIDE, SIDE),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
    )


def measured(normal, experiment, seed=0, pixels=101):
    """Simulate a map of the interface under a traction [MPa], with white noise."""
    mesh = experiment.mesh()
    u = op.solve(experiment, op.Traction(normal)).displacement[:, -1]
    basis, _ = _spline_values(jnp.linspace(0.0, ELEMENTS[0], pixels), ELEMENTS[0])
    heights = basis @ interface_heights(mesh, u) @ basis.T
    noise = NOISE * np.random.default_rng(seed).standard_normal(heights.shape)
    return op.ThicknessMap(heights + noise, extent=(SIDE, SIDE), std=NOISE)


@pytest.fixture(scope="module")
def truth():
    """Normal traction [MPa] of up to 7 kPa, drawn from the prior."""
    white = jax.random.normal(jax.random.key(5), (13, 13))
    return 3e-3 + PRIOR.expand(white, palpation().mesh().spacing)


@pytest.fixture(scope="module")
def fit(truth):
    experiment = palpation()
    return op.fit_traction(experiment, measured(truth, experiment), PRIOR, draws=12)


@pytest.mark.slow
def test_fit_finds_the_traction(fit, truth):
    error = jnp.linalg.norm(fit.normal - truth) / jnp.linalg.norm(truth - truth.mean())
    assert fit.result == op.FitStatus.successful
    assert error < 0.05
    thickness = measured(truth, palpation())
    linear = op.linear_estimate(palpation(), thickness, PRIOR).normal
    assert error < 0.2 * jnp.linalg.norm(linear - truth) / jnp.linalg.norm(truth - truth.mean())


@pytest.mark.slow
def test_fit_knows_how_well_it_did(fit, truth):
    z = (fit.normal - truth) / fit.normal_std
    # About 115 degrees of freedom, and standard deviations from 12 draws.
    assert 0.75 < float(jnp.sqrt(jnp.mean(z**2))) < 1.35
    assert 0.5 < fit.reduced_chi2 < 1.6
    assert 0.5 * fit.observed < fit.effective_dof < fit.observed
    assert fit.stats["misfit_rms"] < 0.5 * NOISE
    assert fit.stats["representation_rms"] == pytest.approx(NOISE, rel=0.05)


@pytest.mark.slow
def test_covariance_agrees_with_draws(fit):
    weights = jnp.zeros((13, 13)).at[3:8, 4:9].set(1.0 / 25)
    variance = float(jnp.sum(weights * fit.covariance(weights)))
    samples = jnp.sum(weights * fit.deviations, axis=(1, 2))
    n = samples.size
    assert jnp.mean(samples**2) == pytest.approx(variance, rel=4 * np.sqrt(2 / n))


@pytest.mark.slow
def test_jacobian_of_the_fit_against_exact_derivatives():
    """Kept tangents give products to 1e-3 of those through `follow_path`, forward and transposed."""
    experiment, settings = palpation((6, 6, 2)), op.Newton(max_path=12).as_leaves()
    normal = 3e-3 + 1e-3 * jax.random.normal(jax.random.key(0), (7, 7))
    change = jax.random.normal(jax.random.key(1), (7, 7))

    def exact(normal):
        problem = discretise(experiment, op.Traction(normal), None, settings.face_rule)
        frozen = jax.lax.stop_gradient(problem)
        end = jax.lax.while_loop(
            unfinished, lambda s: attempt(frozen, s, settings), begin(frozen.initial_state(), settings, True)
        )
        return follow_path(problem, problem.initial_state(), end.path, end.kept, settings)[1].u[:, -1]

    def kept(normal):
        return press(experiment, op.Traction(normal), settings).u

    u, expected = jax.jit(lambda p: jax.jvp(exact, (p,), (change,)))(normal)
    v, slope = jax.jit(lambda p: jax.jvp(kept, (p,), (change,)))(normal)
    assert v == pytest.approx(np.asarray(u), abs=1e-12)
    assert jnp.linalg.norm(slope - expected) < 3e-3 * jnp.linalg.norm(expected)
    weights = jax.random.normal(jax.random.key(2), u.shape)
    pulled = jax.jit(lambda p: jax.vjp(kept, p)[1](weights)[0])(normal)
    reference = jax.jit(lambda p: jax.vjp(exact, p)[1](weights)[0])(normal)
    assert jnp.linalg.norm(pulled - reference) < 3e-3 * jnp.linalg.norm(reference)


def test_errors_say_what_to_do():
    thickness = op.ThicknessMap(np.full((11, 11), 0.45), extent=(SIDE, SIDE))
    with pytest.raises(ValueError, match="standard deviation"):
        op.fit_traction(palpation(), thickness, PRIOR)
    bonded = op.Palpation(palpation().layer, (SIDE, SIDE), ELEMENTS, palpation().window, op.Bonded())
    with pytest.raises(ValueError, match=r"sample=Contact\(law, friction\), got sample=Bonded"):
        op.fit_traction(bonded, thickness, PRIOR)
    with pytest.raises(ValueError, match=r"Matern\.length \[mm\].*element"):
        op.fit_traction(palpation(), thickness, op.Matern(0.05, 1e-3))
    with pytest.raises(ValueError, match="at least 4 elements"):
        op.fit_traction(palpation((3, 12, 2)), thickness, PRIOR)
