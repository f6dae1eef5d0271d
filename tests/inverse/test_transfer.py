"""The layer's transfer function against its closed form's table (docs/validation.md, table B) and its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.linear_layer import poisson_ratio, transfer_function
from opfem.inverse.prior import wave_numbers

# μG/h over x = k h, for Poisson's ratios 0.3, 0.45, 0.475, 0.49, 0.499, 0.5 (docs/validation.md, table B, bonded).
RATIOS = (0.3, 0.45, 0.475, 0.49, 0.499, 0.5)
BONDED = {
    0.1: (0.2859153, 0.0928613, 0.0501610, 0.0225700, 0.00523796, 0.00327441),
    0.3: (0.2873234, 0.1065126, 0.0678089, 0.0430388, 0.0275730, 0.0258255),
    1.0: (0.2910263, 0.1672642, 0.1442016, 0.1299617, 0.1212645, 0.1202908),
    3.0: (0.2174263, 0.1656349, 0.1567677, 0.1513946, 0.1481486, 0.1477868),
    10.0: (0.0700000, 0.0550000, 0.0525000, 0.0510000, 0.0501000, 0.0500000),
}
SLIP_OVER_1_MINUS_NU = {0.1: 0.499999, 0.3: 0.499912, 1.0: 0.490895, 3.0: 0.322104, 10.0: 0.100000}


def scaled(x, poisson, base):
    """Evaluate μG/h, with a thickness and a modulus that must drop out."""
    thickness, shear = 0.37, 5.8e-3
    return shear / thickness * transfer_function(jnp.asarray(x) / thickness, thickness, shear, poisson, base)


@pytest.mark.parametrize("x", BONDED)
def test_bonded_layer_follows_the_table(x):
    assert scaled(x, jnp.array(RATIOS), "bonded") == pytest.approx(np.array(BONDED[x]), rel=2e-6, abs=6e-8)


@pytest.mark.parametrize("x", SLIP_OVER_1_MINUS_NU)
def test_slipping_layer_follows_the_table(x):
    expected = (1.0 - np.array(RATIOS)) * SLIP_OVER_1_MINUS_NU[x]
    assert scaled(x, jnp.array(RATIOS), "slip") == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("base", ["bonded", "slip"])
@pytest.mark.parametrize("poisson", RATIOS)
def test_limits_and_no_jumps(base, poisson):
    shallow = (1 - 2 * poisson) / (2 * (1 - poisson)) if base == "bonded" else 0.5 * (1 - poisson)
    assert scaled(0.0, poisson, base) == pytest.approx(shallow, abs=1e-12)
    assert scaled(1e5, poisson, base) == pytest.approx((1 - poisson) / 1e5, rel=1e-12)
    for edge in (1e-4, 300.0):
        below, above = (float(scaled(edge * f, poisson, base)) for f in (1 - 1e-9, 1 + 1e-9))
        assert above == pytest.approx(below, rel=1e-7, abs=1e-8)


@pytest.mark.parametrize(("poisson", "uniform", "peak"), [(0.47541, 4.04, 15.0), (0.499, 0.17, 13.8), (0.5, 0.0, 13.7)])
def test_uniform_pressure_hardly_indents_a_bonded_incompressible_layer(poisson, uniform, peak):
    """docs/validation.md test 40, mm/MPa: its figures are of moduli between 5.80 and 5.87 kPa, the layer's own."""
    shear = 2 * (2.23e-3 + 7.03e-4)
    gain = transfer_function(jnp.linspace(0.0, 20.0, 401), 0.5, shear, poisson, "bonded")
    assert gain[0] == pytest.approx(uniform, rel=0.012, abs=1e-12)
    assert gain.max() == pytest.approx(peak, rel=0.012)


def test_derivatives_are_finite_everywhere():
    slope = jax.vmap(jax.grad(lambda k: transfer_function(k, 0.5, 1.0, 0.475, "bonded")))
    assert jnp.all(jnp.isfinite(slope(jnp.array([0.0, 1e-5, 1.0, 50.0, 1e4]))))


def test_poisson_ratio():
    assert poisson_ratio(op.NeoHooke(0.5, bulk=jnp.inf)) == 0.5
    material = op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=20 * 2 * (2.23e-3 + 7.03e-4))
    assert poisson_ratio(material) == pytest.approx(0.47541, abs=1e-5)


def test_wave_numbers_are_those_of_the_cosines():
    k = wave_numbers((5, 9), (0.25, 0.5))
    assert k[0, 1] == pytest.approx(np.pi / (9 * 0.25))
    assert k[2, 0] == pytest.approx(2 * np.pi / (5 * 0.5))
    assert k[3, 4] == pytest.approx(np.hypot(k[3, 0], k[0, 4]))
