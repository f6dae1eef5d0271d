"""VALIDATION 13: Cook's membrane at finite strain, plane strain, K/µ = 4999; who locks and who does not.

Source of the reference: quadratic elements with linear discontinuous pressure, 8² to 64², extrapolated.
"""

import numpy as np
import pytest

import opfem as op
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.tolerances import SOLVER
from tests.verification import meshes
from tests.verification.statics import at, body, held, nearest, nodal_areas

pytestmark = pytest.mark.slow

SHEAR, BULK = 80.1938, 400889.8
TIP_Y, TIP_X = 6.934, -5.832
TIP_Y_AT_20 = 7.185
SMALL_STRAIN = 0.08047549567  # tip u_y [mm] per newton, reference element, linear limit
COOK = 0.015


def tip(n, form, bulk=BULK, kind="hex8", force=100.0, increments=4):
    """Displacement of (48, 60), and the solution."""
    points, hexahedra = meshes.cook(n)
    edge = meshes.boundary_faces(hexahedra, points, lambda X: at(X[0], 48.0))
    load = nodal_areas(points, edge) * force / 16.0  # a dead shear of force / 16 mm² on the edge
    cells = hexahedra if kind == "hex8" else meshes.divided(hexahedra)
    solid = body(points, cells, op.NeoHooke(SHEAR / 2, bulk), form)
    root = at(points[0], 0.0)
    fixed = held(points, x=root, y=root, z=True)
    dead = np.stack([0 * load, load, 0 * load])
    solution = solve_statics(StaticProblem(solid, points, fixed, force=dead), StaticSettings(increments=increments))
    return solution.displacement[:, nearest(points, 48.0, 60.0, 0.0)], solution


@pytest.mark.parametrize("form", ["mean_dilatation", "hybrid"])
def test_13_tip_of_cooks_membrane(form):
    u, _ = tip(32, form)
    assert u[1] == pytest.approx(TIP_Y, rel=COOK)
    assert u[0] == pytest.approx(TIP_X, rel=COOK)


@pytest.mark.parametrize("form", ["mean_dilatation", "hybrid"])
def test_13_tip_at_twenty_shear_moduli(form):
    u, _ = tip(32, form, bulk=20 * SHEAR)
    assert u[1] == pytest.approx(TIP_Y_AT_20, rel=COOK)


def test_13_hybrid_is_mean_dilatation_at_any_bulk_modulus():
    for bulk in (20 * SHEAR, BULK):
        np.testing.assert_allclose(tip(8, "hybrid", bulk)[0], tip(8, "mean_dilatation", bulk)[0], rtol=SOLVER)


def test_13_krylov_iterations_do_not_depend_on_the_bulk_modulus():
    most = [max(max(tip(8, "hybrid", ratio * SHEAR)[1].krylov_iterations)) for ratio in (1e3, 1e5, np.inf)]
    assert max(most) <= min(most) + 2
    assert max(most) <= 20


@pytest.mark.parametrize(("form", "kind", "share"), [("full", "hex8", 0.37), ("mean_dilatation", "hex8", 0.99)])
def test_13_small_strain_guard(form, kind, share):
    """VALIDATION: 37% of the reference with plain hexahedra on 32², 99% with the mean dilatation (B-bar)."""
    u, _ = tip(32, form, kind=kind, force=1e-3, increments=1)
    assert u[1] / 1e-3 / SMALL_STRAIN == pytest.approx(share, abs=0.01)


def test_13_linear_tetrahedra_lock():
    """Worse than plain hexahedra on the same nodes, and hardly better on twice as many along each side."""
    coarse, fine = (tip(n, "full", kind="tet4")[0][1] / TIP_Y for n in (8, 16))
    assert fine < tip(16, "full")[0][1] / TIP_Y < 0.5
    assert fine < 1.5 * coarse
