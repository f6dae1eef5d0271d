"""opfem against CalculiX on displacements given by a formula: the same element at the same mesh, and the limit."""

import numpy as np
import pytest

import opfem as op
from tests.reference.cases import formula_family, load_case, normal_force
from tests.tolerances import RATE

pytestmark = pytest.mark.slow

PARTS = 4  # opfem solves a quarter


@pytest.mark.parametrize("n", [8, 16])
@pytest.mark.parametrize("variant", ["B1", "B2", "B3"])
def test_full_element_matches_force_energy_and_displacement(shared, variant, n):
    """Measured: 1e-7 at most, which is CalculiX's printed precision."""
    _, about = load_case(shared, f"fam_{variant}_C3D8_n{n}_k20")
    expected = about["results"]
    solution = op.solve(*formula_family(variant, n, "full"))
    middle = n // 8
    assert PARTS * normal_force(solution) == pytest.approx(-expected["top_force_N"][2], rel=1e-3)
    assert PARTS * solution.stats["strain_energy"] == pytest.approx(expected["strain_energy_Nmm"], rel=1e-3)
    assert solution.displacement[2, middle, 0, 0] == pytest.approx(expected["uz_centre_mid"], rel=1e-3)
    assert solution.displacement[0, middle, 0, -1] == pytest.approx(expected["ux_side_mid"], rel=1e-3)


def test_mean_dilatation_refines_towards_quadratic_elements():
    """Without clamped edges the limit, 0.0081564 N (C3D20R), has five digits; 24 elements are 0.05% away."""
    solutions = {n: op.solve(*formula_family("B3", n, "mean_dilatation")) for n in (8, 16, 24)}
    errors = {n: abs(PARTS * normal_force(solution) / 0.0081564 - 1.0) for n, solution in solutions.items()}
    assert errors[24] < 0.001
    assert np.log2(errors[8] / errors[16]) == pytest.approx(2.0, abs=RATE)
