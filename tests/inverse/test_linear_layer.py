"""Estimates without finite elements: right where their assumptions hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.model.homogeneous import cauchy_stress

MATERIAL = op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)


def palpation(window=None, elements=(20, 16, 2)):
    sample = op.Contact(op.HardOverclosure(), 0.0)
    return op.Palpation(op.Layer(0.5, MATERIAL), (5.0, 4.0), elements, window or op.Roller(), sample)


def test_linear_estimate_of_one_wave():
    """A wave of indentation of 1 μm on a layer that slips: its pressure is over the transfer function."""
    experiment = palpation()
    x = np.linspace(0.0, 5.0, 201) * np.ones((161, 1))
    # The mesh's cosines are mirrored half an element beyond its edges.
    k = 3 * np.pi / (21 * 0.25)
    thickness = op.ThicknessMap(0.5 - 1e-3 * np.cos(k * (x + 0.125)), extent=(5.0, 4.0), std=1e-5)
    estimate = op.linear_estimate(experiment, thickness, op.Tikhonov(1, 1e-3))
    x = experiment.mesh().plane()[0]
    ratio = 5.866e-3 / 0.11732
    poisson = (3 - 2 * ratio) / (6 + 2 * ratio)
    depth = k * 0.5
    gain = 0.5 / 5.866e-3 * (1 - poisson) / depth * (np.cosh(2 * depth) - 1) / (np.sinh(2 * depth) + 2 * depth)
    assert estimate.normal == pytest.approx(np.cos(k * (np.asarray(x) + 0.125)) * 1e-3 / gain, abs=2e-3 * 1e-3 / gain)
    assert estimate.heights == pytest.approx(np.asarray(thickness.sample(*experiment.mesh().plane())), abs=2e-6)


def test_linear_estimate_falls_back_to_the_prior_without_data():
    thickness = op.ThicknessMap(np.full((21, 21), 0.48), extent=(5.0, 4.0), std=1e3)
    estimate = op.linear_estimate(palpation(), thickness, op.Matern(0.5, 1e-3, mean=4e-3))
    assert estimate.normal == pytest.approx(4e-3, rel=1e-6)


def test_linear_estimate_works_under_jit_and_derivatives():
    x, y = np.meshgrid(np.linspace(0, 5, 41), np.linspace(0, 4, 33))
    values = jnp.asarray(0.48 - 0.01 * np.exp(-((x - 2) ** 2) - (y - 2) ** 2))

    def peak(values, std):
        return jnp.max(
            op.linear_estimate(
                palpation(), op.ThicknessMap(values, extent=(5.0, 4.0), std=2e-3), op.Matern(0.5, std)
            ).normal
        )

    assert jax.jit(peak)(values, 1e-3) == pytest.approx(float(peak(values, 1e-3)), rel=1e-6)


@pytest.mark.parametrize("bulk", [0.0293, 0.11732, 5.8, np.inf])
def test_uniaxial_stress_has_free_sides(bulk):
    """Against the minimum of the energy over the lateral stretch; for neo-Hooke incompressible μ(λ² - 1/λ)."""
    stretch = jnp.array([0.4, 0.7, 0.95, 1.0, 1.2])
    stress = cauchy_stress(op.NeoHooke(2.93e-3, bulk=bulk), stretch)
    if np.isinf(bulk):
        assert stress == pytest.approx(np.asarray(5.86e-3 * (stretch**2 - 1 / stretch)), rel=1e-10, abs=1e-16)
        return

    def energy(axial, lateral):
        H = jnp.diag(jnp.array([lateral, lateral, axial]) - 1.0)
        return op.NeoHooke(2.93e-3, bulk=bulk).energy(H)

    @jax.jit
    @jax.vmap
    def expected(axial):
        slope, curvature = jax.grad(energy, 1), jax.grad(jax.grad(energy, 1), 1)
        step = lambda _, side: side - slope(axial, side) / curvature(axial, side)  # noqa: E731
        side = jax.lax.fori_loop(0, 50, step, axial**-0.5)
        return jax.grad(energy)(axial, side) / side**2

    assert stress == pytest.approx(np.asarray(expected(stretch)), rel=1e-6, abs=1e-12)


def test_uniaxial_estimate_takes_every_point_by_itself():
    thickness = op.ThicknessMap(np.full((21, 21), 0.4), extent=(5.0, 4.0))
    pressure = op.uniaxial_estimate(palpation(), thickness)
    assert pressure.shape == (17, 21)
    assert pressure == pytest.approx(-float(cauchy_stress(MATERIAL, jnp.asarray(0.8))), rel=1e-12)
