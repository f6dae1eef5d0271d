"""Hyper-parameters: samples of a known prior give it back."""

import equinox as eqx
import jax
import numpy as np
import pytest

import opfem as op
from opfem.inverse.hyperparameters import most_likely, next_factor, rescaled

SHAPE = (21, 21)


class _Fit(eqx.Module):
    palpation: op.Palpation


@pytest.fixture
def fit():
    palpation = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(5.0, 5.0),
        elements=(20, 20, 2),
        window=op.Bonded(),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), 0.05),
    )
    return _Fit(palpation)


def samples(prior, fit, n=12):
    spacing = fit.palpation.mesh().spacing
    return jax.vmap(lambda white: prior.expand(white, spacing))(jax.random.normal(jax.random.key(0), (n, *SHAPE)))


def test_matern_is_found_from_its_own_fields(fit):
    truth = op.Matern(0.7, 2e-3)
    chosen, change = most_likely.__wrapped__(op.Matern(0.4, 1e-3), samples(truth, fit), fit)
    assert chosen.std == pytest.approx(2e-3, rel=0.05)
    assert chosen.length == pytest.approx(0.7, rel=0.05)
    assert change == pytest.approx(np.log(2.0), rel=0.1)


def test_tikhonov_is_found_from_its_own_fields(fit):
    truth = op.Tikhonov(1, 300.0)
    chosen, _ = most_likely.__wrapped__(op.Tikhonov(1, 50.0), samples(truth, fit), fit)
    assert chosen.weight == pytest.approx(300.0, rel=0.03)


def test_total_variation_has_no_likelihood(fit):
    prior = op.TotalVariation(30.0, 2e-3)
    with pytest.raises(
        ValueError, match=r'needs Matern\(\.\.\.\) or Tikhonov\(\.\.\.\), got TotalVariation.*"discrepancy"'
    ):
        most_likely.__wrapped__(prior, samples(op.Matern(0.7, 2e-3), fit), fit)


@pytest.mark.parametrize("root", [-3.0, -1.0, 0.5, 3.0])
def test_discrepancy_is_found_in_few_fits(root):
    """χ² that falls with the fourth power of a small standard deviation, ever less of a large one, to a floor."""
    tried, factor = [], 0.0
    for _ in range(7):
        tried.append((factor, 4.0 * np.log(np.tanh(1.0)) - 4.0 * np.log(np.tanh(np.exp(factor - root)))))
        factor = next_factor(tried)
    assert factor == pytest.approx(root, abs=0.02)


@pytest.mark.parametrize("prior", [op.Matern(0.7, 2e-3), op.Tikhonov(2, 300.0)])
def test_rescaled_multiplies_the_standard_deviation(prior, fit):
    spacing = fit.palpation.mesh().spacing
    white = jax.random.normal(jax.random.key(1), SHAPE)
    assert rescaled(prior, 3.0).expand(white, spacing) == pytest.approx(3.0 * np.asarray(prior.expand(white, spacing)))
