"""Whole solves against closed forms: uniform compression, the layer's transfer function."""

import numpy as np
import pytest
from scipy.optimize import brentq

import opfem as op
from tests.experiments import flat_map, published_palpation

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612  # MPa; docs/validation.md, MR20
MATERIAL = op.MooneyRivlin(c10=C10, c01=C01, bulk=BULK)
WIDE = (5.0, 5.0)  # mm
ACCURATE = op.Newton(rtol=1e-8)


def cauchy(axial: float, lateral: float) -> np.ndarray:
    """Principal Cauchy stresses (lateral, lateral, axial) [MPa] at given stretches."""
    J = axial * lateral**2
    b = np.array([lateral**2, lateral**2, axial**2]) * J ** (-2 / 3)
    return 2 / J * (C10 * (b - b.sum() / 3) - C01 * (1 / b - (1 / b).sum() / 3)) + BULK * (J - 1)


def test_oracle_reproduces_table_a():
    lateral = brentq(lambda t: cauchy(0.5, t)[0], 1.0, 2.0)
    assert lateral == pytest.approx(1.3879736, abs=1e-7)
    assert 1e3 * cauchy(0.5, lateral)[2] == pytest.approx(-12.807315, abs=1e-6)
    assert 1e3 * cauchy(0.9, 1.0)[2] == pytest.approx(-12.504048, abs=1e-6)


SLOW = [pytest.param(element, marks=pytest.mark.slow) for element in ("full", "reduced", "hybrid", "tet4")]


@pytest.mark.parametrize("element", ["mean_dilatation", *SLOW])
@pytest.mark.parametrize("sides", ["free", "roller"])
def test_07_08_uniform_compression(sides, element):
    """docs/validation.md tests 7 and 8: lubricated and confined compression."""
    palpation = published_palpation(0.0, 0.0, MATERIAL, extent=WIDE, sides=sides, element=element)
    for stretch in (0.9, 0.8, 0.7, 0.6, 0.5):
        solution = op.solve(palpation, op.Imprint(flat_map(0.5 * stretch, WIDE)), ACCURATE)
        u = np.asarray(solution.displacement)
        reached = 1.0 + float(np.mean(u[2, -1] - u[2, 0])) / 0.5
        sunk = float(solution.stats["max_penetration"]) / 0.5  # into the window: elements are flat
        assert reached - sunk == pytest.approx(stretch, abs=0.005)  # short of it by the approach
        lateral = 1.0 if sides == "roller" else brentq(lambda t, s=reached: cauchy(s, t)[0], 0.99, 2.0)
        expected = -cauchy(reached, lateral)[2]
        np.testing.assert_allclose(solution.pressure, expected, rtol=1e-6)
        np.testing.assert_allclose(-np.asarray(solution.stress_zz), expected, rtol=1e-6)
        np.testing.assert_allclose(-np.asarray(solution.traction[2]), expected * lateral**2, rtol=1e-6)


def test_30_friction_bracket():
    """docs/validation.md test 30: the force between flat plates rises from free spreading to a bonded layer."""
    flat = op.Imprint(flat_map(0.45, WIDE))
    solutions = [
        op.solve(published_palpation(friction, friction, MATERIAL, extent=WIDE), flat, ACCURATE)
        for friction in (0.0, 0.01, 0.05, 0.12, 0.3, 1.0)
    ]
    forces = np.array([-float(s.stats["force_sample"][2]) for s in solutions])
    assert np.all(np.diff(forces) > 0)
    shortened = [-float(np.mean(s.displacement[2, -1] - s.displacement[2, 0])) for s in solutions]
    stretch = 1 - shortened[0] / 0.5
    lateral = brentq(lambda t: cauchy(stretch, t)[0], 0.99, 2.0)
    assert forces[0] == pytest.approx(-cauchy(stretch, lateral)[2] * 25 * lateral**2, rel=1e-6)
    bonded = published_palpation(op.Bonded(), op.Bonded(), MATERIAL, extent=WIDE)
    held = op.solve(bonded, op.Displacement(-shortened[-1], lateral="fixed"))
    assert forces[-1] == pytest.approx(-float(held.stats["force_sample"][2]), rel=0.02)
    slip = [float((s.contact_status == 2).mean()) for s in solutions]
    assert slip[0] == 1.0
    assert slip[-1] == 0.0
    assert np.all(np.diff(slip) <= 0)


def transfer(x: float, nu: float, bonded: bool) -> float:
    """μG/h of docs/validation.md, table B."""
    sinh, cosh = np.sinh(2 * x), np.cosh(2 * x)
    if bonded:
        return (1 - nu) / x * ((3 - 4 * nu) * sinh - 2 * x) / ((3 - 4 * nu) * cosh + 2 * x**2 + 5 - 12 * nu + 8 * nu**2)
    return (1 - nu) / x * (cosh - 1) / (sinh + 2 * x)


def test_transfer_reproduces_table_b():
    assert transfer(1.0, 0.475, True) == pytest.approx(0.1442016, abs=1e-7)
    assert transfer(3.0, 0.475, False) == pytest.approx(0.525 * 0.322104, abs=1e-6)


@pytest.mark.parametrize("window", ["bonded", pytest.param("roller", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kh", [1.0, 3.0])
def test_17_18_transfer_function(kh, window):
    """docs/validation.md tests 17 and 18, half a wavelength between rollers: 40 elements per wavelength, 16 deep."""
    h, nu, shear = 0.5, 0.475, 2 * (C10 + C01)
    length = np.pi * h / kh
    bulk = 2 * shear * (1 + nu) / (3 * (1 - 2 * nu))
    x = np.linspace(0, length, 21)
    wave = np.cos(np.pi * x / length)
    support = op.Bonded() if window == "bonded" else op.Roller()
    palpation = op.Palpation(
        op.Layer(h, op.MooneyRivlin(C10, C01, bulk)),
        extent=(length, 0.1 * length),
        elements=(20, 2, 16),
        window=support,
        sample=op.Contact(op.HardOverclosure(), 0.0),
        sides="roller",
    )
    applied = 1e-3 * shear * wave * np.ones((3, 1))
    solution = op.solve(palpation, op.Traction(applied), op.Newton(increments=1))
    np.testing.assert_allclose(solution.traction[2], -applied, rtol=0, atol=1e-12)
    weight = np.r_[0.5, np.ones(19), 0.5]
    uz = np.asarray(solution.displacement[2, -1, 1])
    gain = -np.sum(weight * uz * wave) / np.sum(weight * wave**2) / (1e-3 * shear)
    assert shear * gain / h == pytest.approx(transfer(kh, nu, window == "bonded"), rel=0.01)


def test_traction_with_friction_resists_spreading():
    """A uniform traction with friction spreads less than without, and comes back as it went in."""
    shapes = {}
    for friction in (0.0, 0.3):
        solution = op.solve(published_palpation(friction, friction), op.Traction(2e-3))
        np.testing.assert_allclose(solution.traction[2], -2e-3, rtol=1e-9)
        lateral = np.hypot(*np.asarray(solution.traction[:2]))
        assert lateral.max() <= friction * 2e-3 * (1 + 1e-9)
        shapes[friction] = float(solution.displacement[0, -1, 3, -1])
    assert 0 < shapes[0.3] < 0.9 * shapes[0.0]


def test_uniform_frictionless_layer_needs_no_hold():
    solution = op.solve(published_palpation(0.0, 0.0), op.Imprint(flat_map(0.45)), ACCURATE)
    assert bool(solution.result == op.RESULTS.successful)
    assert np.abs(np.asarray(solution.stats["force_hold"])).max() < 1e-10
