"""opfem against CalculiX: prescribed displacement, friction decks, the coin's contact."""

import numpy as np
import pytest

import opfem as op
from tests.reference.cases import (
    FIELD,
    coin,
    drifted,
    imprint_map,
    layer,
    load_case,
    nodal_map,
    normal_force,
    relative_error,
    top_stress,
)

pytestmark = pytest.mark.slow


def prescribed(shared, n: int, element: str) -> op.Solution:
    case, _ = load_case(shared, "coin_presc_uz_bottom_slip_C3D8" + {20: "_20x20x2", 40: "", 80: "_80x80x8"}[n])
    palpation = op.Palpation(layer(), (FIELD, FIELD), (n, n, n // 10), op.Roller(), op.Roller(), element=element)
    return op.solve(palpation, op.Displacement(nodal_map(case, 2, n)))


def test_prescribed_displacement_matches_force_and_stress(shared):
    case, _ = load_case(shared, "coin_presc_uz_bottom_slip_C3D8")
    solution = prescribed(shared, 40, "full")
    assert normal_force(solution) == pytest.approx(0.13587, rel=0.005)
    assert relative_error(solution.stress_zz, top_stress(case)) < 0.005


def test_mean_dilatation_refines_towards_quadratic_elements(shared):
    # C3D20R at 40x40x4: 0.13469 N; full integration at the same meshes: 0.13639, 0.13587, 0.13532 N.
    forces = [normal_force(prescribed(shared, n, "mean_dilatation")) for n in (20, 40, 80)]
    errors = np.abs(np.array(forces) - 0.1347)
    assert errors[1] < 0.005 * 0.1347
    assert errors[2] <= errors[1] + 1e-4
    assert errors[2] < 0.003 * 0.1347


@pytest.mark.parametrize(
    ("name", "thickness", "elements", "frictions", "force"),
    [
        ("fricsim_low_0p5N_0p12_quarter_C3D8", 0.4769376, (25, 25, 6), (0.12, 0.05), 0.7881),
        ("fricsim_med_0p5N_0p15_2_quarter_C3D8", 0.5188, (25, 25, 3), (0.15, 0.01), 0.4456),
    ],
)
def test_friction_decks_match_force(shared, name, thickness, elements, frictions, force):
    case, about = load_case(shared, name)
    L0 = about["layer"]["H"]
    assert pytest.approx(thickness, abs=1e-3) == L0
    uz = float(np.min(case["imprint_uz"]))
    window, sample = (op.Contact(op.LinearOverclosure(10.0), f, stick_slope=0.1) for f in frictions)
    palpation = op.Palpation(
        layer(L0), (2.5, 2.5), elements, window, sample, sides={"x0": "roller", "y0": "roller"}, element="full"
    )
    flat = op.ThicknessMap(np.full((26, 26), L0 + uz), extent=(2.5, 2.5))
    solution = op.solve(palpation, op.Imprint(flat))
    assert 4.0 * normal_force(solution) == pytest.approx(force, rel=0.02)


@pytest.mark.parametrize(
    ("name", "window", "sample", "stiffness", "force"),
    [
        ("smoothcoin_muwin0p15_mutop0_C3D8", 0.15, 0.0, 10.0, 0.18794),
        ("smoothcoin_muwin0p15_mutop0p05_C3D8", 0.15, 0.05, 10.0, 0.21633),
    ],
)
def test_smoothed_coin_with_friction_matches_force_and_stress(shared, name, window, sample, stiffness, force):
    case, _ = load_case(shared, name)
    solution = op.solve(coin(window, sample, stiffness), op.Imprint(imprint_map(case)))
    assert normal_force(solution) == pytest.approx(force, rel=0.02)
    assert relative_error(solution.stress_zz, top_stress(case)) < 0.05


def test_sharp_frictionless_coin_matches_where_the_reference_drifted_to(shared):
    # Without friction the reference drifts by 0.15 mm on weak springs; opfem holds the layer, so the
    # map is moved instead.
    case, _ = load_case(shared, "coin_ccxcontact_top_mu0_bottom_slip_C3D8")
    bottom = np.abs(case["nodes"][:, 2]) < 1e-9
    drift = case["u"][bottom, :2].mean(axis=0)
    load = op.Imprint(drifted(imprint_map(case), drift))
    solution = op.solve(coin(None, 0.0, 20.0), load)
    assert normal_force(solution) == pytest.approx(0.14012, rel=0.10)
    lateral = np.abs(np.asarray(solution.stats["force_hold"])).max()
    assert lateral < 0.005 * normal_force(solution)
