"""Hyper-parameters: samples of a known prior give it back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.discrepancy import next_factor

SHAPE, EXTENT = (21, 21), jnp.array([5.0, 5.0])


@pytest.fixture
def mesh():
    palpation = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(5.0, 5.0),
        elements=(20, 20, 2),
        window=op.Bonded(),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), 0.05),
    )
    return palpation.mesh()


def samples(prior, mesh, n=12):
    spacing = mesh.spacing
    return jax.vmap(lambda white: prior.expand(white, spacing))(jax.random.normal(jax.random.key(0), (n, *SHAPE)))


def test_matern_is_found_from_its_own_fields(mesh):
    truth = op.Matern(0.7, 2e-3)
    chosen, change = op.Matern(0.4, 1e-3).maximum_likelihood(samples(truth, mesh), mesh.spacing, EXTENT)
    assert chosen.std == pytest.approx(2e-3, rel=0.05)
    assert chosen.length == pytest.approx(0.7, rel=0.05)
    assert change == pytest.approx(np.log(2.0), rel=0.1)


def test_tikhonov_is_found_from_its_own_fields(mesh):
    truth = op.Tikhonov(1, 300.0)
    chosen, _ = op.Tikhonov(1, 50.0).maximum_likelihood(samples(truth, mesh), mesh.spacing, EXTENT)
    assert chosen.weight == pytest.approx(300.0, rel=0.03)


def test_total_variation_has_no_likelihood(mesh):
    prior = op.TotalVariation(30.0, 2e-3)
    with pytest.raises(
        ValueError, match=r'needs Matern\(\.\.\.\) or Tikhonov\(\.\.\.\), got TotalVariation.*"discrepancy"'
    ):
        prior.maximum_likelihood(samples(op.Matern(0.7, 2e-3), mesh), mesh.spacing, EXTENT)


@pytest.mark.parametrize("root", [-3.0, -1.0, 0.5, 3.0])
def test_discrepancy_is_found_in_few_fits(root):
    """χ² that falls with the fourth power of a small standard deviation, ever less of a large one, to a floor."""
    tried, factor = [], 0.0
    for _ in range(7):
        tried.append((factor, 4.0 * np.log(np.tanh(1.0)) - 4.0 * np.log(np.tanh(np.exp(factor - root)))))
        factor = next_factor(tried)
    assert factor == pytest.approx(root, abs=0.02)


@pytest.mark.parametrize("prior", [op.Matern(0.7, 2e-3), op.Tikhonov(2, 300.0)])
def test_scaled_multiplies_the_standard_deviation(prior, mesh):
    spacing = mesh.spacing
    white = jax.random.normal(jax.random.key(1), SHAPE)
    assert prior.scaled(3.0).expand(white, spacing) == pytest.approx(3.0 * np.asarray(prior.expand(white, spacing)))
