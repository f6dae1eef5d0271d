"""Whole solves with each element: incompressible closed forms, and elements against each other."""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op

C10, C01 = 2.2e-3, 7.03e-4  # MPa; docs/validation.md, MR20
SHEAR = 2 * (C10 + C01)
L0, SIDE = 0.5, 1.0  # mm


def squeezed(material, stretch: float, sides="free") -> tuple[float, op.Solution]:
    """Compress a lubricated hybrid layer; return its Cauchy stress σ_zz [MPa]."""
    layer = op.Layer(L0, material)
    palpation = op.Palpation(layer, (SIDE, SIDE), (2, 2, 2), op.Roller(), op.Roller(), sides=sides, element="hybrid")
    solution = op.solve(palpation, op.Displacement((stretch - 1) * L0), op.Newton(rtol=1e-8))
    np.testing.assert_allclose(solution.stress_zz, solution.stress_zz[0, 0], rtol=1e-6)
    return float(solution.stress_zz[0, 0]), solution


@pytest.mark.slow
@pytest.mark.parametrize("element", ["reduced", "hybrid", "tet4", "tet10"])
def test_07_08_uniform_compression_to_half_the_thickness(element):
    """docs/validation.md, table A [MPa]; under contact in test_closed_forms."""
    layer = op.Layer(L0, op.MooneyRivlin(C10, C01, bulk=20 * SHEAR))
    for sides, expected in (("free", 12.807315e-3), ("roller", 68.587463e-3)):
        palpation = op.Palpation(layer, (SIDE, SIDE), (4, 4, 2), op.Roller(), op.Roller(), sides=sides, element=element)
        solution = op.solve(palpation, op.Displacement(-0.5 * L0), op.Newton(rtol=1e-9))
        np.testing.assert_allclose(solution.stress_zz, -expected, rtol=1e-7)
        np.testing.assert_allclose(solution.pressure, expected, rtol=1e-7)


@pytest.mark.slow
def test_contact_patch_of_quadratic_tetrahedra():
    """A flat sample without friction finds a uniform pressure, as it does on hexahedra."""
    window, sample = op.Contact(op.HardOverclosure(), 0.0), op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.0)
    layer = op.Layer(L0, op.MooneyRivlin(C10, C01, bulk=20 * SHEAR))
    flat = op.Imprint(op.ThicknessMap(np.full((5, 5), 0.7 * L0), extent=(SIDE, SIDE)))
    pressures = [
        op.solve(
            op.Palpation(layer, (SIDE, SIDE), (4, 4, 2), window, sample, element=element), flat, op.Newton(rtol=1e-10)
        ).pressure
        for element in ("mean_dilatation", "tet10")
    ]
    np.testing.assert_allclose(pressures[1], pressures[0], rtol=1e-6)


def mooney_rivlin(stretch: float) -> float:
    return 2 * (stretch**2 - 1 / stretch) * (C10 + C01 / stretch)


@pytest.mark.parametrize("ratio", [1e5, np.inf])
def test_10_incompressible_uniaxial_mooney_rivlin(ratio):
    for stretch in (0.5, 0.8, 1.3):
        stress, solution = squeezed(op.MooneyRivlin(C10, C01, bulk=ratio * SHEAR), stretch)
        assert stress == pytest.approx(mooney_rivlin(stretch), rel=1e-3 if np.isfinite(ratio) else 1e-7)
        assert float(solution.stats["min_volume_ratio"]) == pytest.approx(1.0, abs=1e-4 if np.isfinite(ratio) else 1e-7)


@pytest.mark.slow
def test_10_incompressible_equibiaxial_mooney_rivlin():
    """Squeezing by λ⁻² spreads by λ both ways: the equibiaxial state plus a pressure."""
    for stretch in (1.1, 1.3):
        stress, _ = squeezed(op.MooneyRivlin(C10, C01, bulk=1e5 * SHEAR), stretch**-2)
        expected = 2 * (stretch**2 - stretch**-4) * (C10 + C01 * stretch**2)
        assert -stress == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_10_incompressible_plane_strain_mooney_rivlin():
    stretch = 0.7
    sides = {"y0": "roller", "y1": "roller"}
    stress, _ = squeezed(op.MooneyRivlin(C10, C01, bulk=1e5 * SHEAR), stretch, sides)
    assert stress / stretch == pytest.approx(2 * (C10 + C01) * (stretch - stretch**-3), rel=1e-3)


@pytest.mark.slow
def test_10_incompressible_uniaxial_yeoh():
    c10, c20, c30 = 2.9e-3, -4e-4, 1e-4
    for stretch in (0.6, 1.4):
        stress, _ = squeezed(op.Yeoh(c10, c20, c30, bulk=1e5 * 2 * c10), stretch)
        change = stretch**2 + 2 / stretch - 3
        slope = c10 + 2 * c20 * change + 3 * c30 * change**2
        assert stress == pytest.approx(2 * (stretch**2 - 1 / stretch) * slope, rel=1e-3)


@pytest.mark.slow
def test_10_incompressible_uniaxial_ogden():
    """W = Σ m/α (Σ λ^α - 3): opfem's mu is m α / 2."""
    m, alpha = np.array([4e-3, -1e-3]), np.array([1.8, -2.5])
    for stretch in (0.6, 1.4):
        mu = m * alpha / 2
        stress, _ = squeezed(op.Ogden(mu, alpha, bulk=1e5 * mu.sum()), stretch)
        expected = np.sum(m * (stretch**alpha - stretch ** (-alpha / 2)))
        assert stress == pytest.approx(expected, rel=1e-3)


def bumpy() -> op.Imprint:
    y, x = np.meshgrid(np.linspace(0, 2, 33), np.linspace(0, 2, 33), indexing="ij")
    return op.Imprint(op.ThicknessMap(0.42 - 0.04 * np.cos(np.pi * x) * np.cos(np.pi * y), extent=(2.0, 2.0)))


def imprinted(element: str, bulk: float, settings=op.Newton()) -> op.Solution:
    window, sample = op.Contact(op.HardOverclosure(), 0.1), op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.1)
    layer = op.Layer(0.5, op.MooneyRivlin(C10, C01, bulk))
    return op.solve(op.Palpation(layer, (2.0, 2.0), (8, 8, 4), window, sample, element=element), bumpy(), settings)


@pytest.mark.slow
def test_hybrid_equals_mean_dilatation_under_friction():
    """The same element by another road."""
    elements, settings = ("hybrid", "mean_dilatation"), op.Newton(rtol=1e-10)
    hybrid, mean = (imprinted(element, 20 * SHEAR, settings) for element in elements)
    np.testing.assert_allclose(hybrid.pressure, mean.pressure, rtol=1e-6)
    np.testing.assert_allclose(hybrid.displacement, mean.displacement, atol=1e-8)
    fields = [op.layer_fields(solution) for solution in (hybrid, mean)]
    np.testing.assert_allclose(fields[0].stress, fields[1].stress, atol=1e-6 * float(jnp.abs(fields[1].stress).max()))


@pytest.mark.slow
def test_other_elements_agree_with_mean_dilatation_under_friction():
    """tet10 shares neither shape functions nor quadrature with it; reduced is a little softer."""
    force = {
        element: -float(imprinted(element, 20 * SHEAR).stats["force_sample"][2])
        for element in ("mean_dilatation", "tet10", "reduced")
    }
    assert force["tet10"] == pytest.approx(force["mean_dilatation"], rel=0.003)
    assert force["mean_dilatation"] * 0.99 < force["reduced"] < force["mean_dilatation"]


@pytest.mark.slow
def test_krylov_iterations_of_hybrid_do_not_grow_with_the_bulk_modulus():
    counts = []
    for ratio in (20.0, 1e3, 1e5, np.inf):
        stats = imprinted("hybrid", ratio * SHEAR).stats
        counts.append(int(stats["krylov_steps"]) / int(stats["newton_steps"]))
    assert max(counts) < 1.2 * counts[0]
    assert max(counts) < 15


def test_elements_are_checked():
    layer = op.Layer(0.5, op.NeoHooke(c10=2.9e-3, bulk=np.inf))
    with pytest.raises(ValueError, match="finite bulk modulus"):
        op.Palpation(layer, (1.0, 1.0), (2, 2, 2), op.Roller(), op.Roller())
    finite = op.Layer(0.5, op.NeoHooke(c10=2.9e-3, bulk=0.1))
    with pytest.raises(ValueError, match="even numbers"):
        op.Palpation(finite, (1.0, 1.0), (2, 3, 2), op.Roller(), op.Roller(), element="tet10")
