"""Contact against closed forms: a sphere on a bonded layer, and what a penalty must do."""

import numpy as np
import pytest

import opfem as op
from opfem.model import AbstractOverclosure
from opfem.solvers.solution import OPEN

pytestmark = pytest.mark.slow

L0 = 0.5  # mm
SHEAR, NU = 0.0058, 0.475  # MPa, -
BULK = 2.0 * SHEAR * (1.0 + NU) / (3.0 * (1.0 - 2.0 * NU))
LAYER = op.Layer(L0, op.MooneyRivlin(c10=0.4 * SHEAR, c01=0.1 * SHEAR, bulk=BULK))


def press_sphere(radius: float, chi: float, per_element: int, width: int, layers: int) -> tuple[op.Solution, float]:
    """Press a paraboloid into a quarter of a wide bonded layer, by a thousandth of its thickness.

    Args:
        radius: Contact radius [mm] of the closed form.
        chi: Depth × sphere radius / radius² of the closed form [-].
        per_element: Elements along the contact radius.
        width: Elements along the quarter's side.
        layers: Elements through the layer.

    Returns:
        The solution and the sphere's radius [mm].
    """
    depth = 1e-3 * L0
    R = chi * radius**2 / depth
    side = width * radius / per_element
    x = np.linspace(0.0, side, width + 1)
    surface = L0 - depth + (x[:, None] ** 2 + x**2) / (2.0 * R)
    palpation = op.Palpation(
        LAYER,
        extent=(side, side),
        elements=(width, width, layers),
        window=op.Bonded(),
        sample=op.Contact(op.HardOverclosure(), friction=0.0),
        sides="roller",
    )
    return op.solve(palpation, op.Imprint(op.ThicknessMap(surface, extent=(side, side))), op.Newton(increments=1)), R


@pytest.mark.parametrize(
    ("ratio", "kappa", "chi", "per_element", "width", "layers"),
    [(1.0, 1.3780, 0.5788, 6, 30, 6), (0.4, 1.0407, 0.7521, 4, 44, 8)],
    ids=["a/h=1", "a/h=0.4"],
)
def test_20_sphere_on_a_bonded_layer(ratio, kappa, chi, per_element, width, layers):
    """P = 8 µ a³ κ / (3 (1 - ν) R), δ = χ a² / R; measured: 0.2% and 0.7% above."""
    a = ratio * L0
    solution, R = press_sphere(a, chi, per_element, width, layers)
    force = 8.0 * SHEAR * a**3 * kappa / (3.0 * (1.0 - NU) * R)
    assert -4.0 * solution.stats["force_sample"][2] == pytest.approx(force, rel=0.03)
    closed = np.flatnonzero(solution.contact_status[0] != OPEN)
    assert closed.max() == pytest.approx(per_element, abs=1)


def hills() -> op.ThicknessMap:
    """Thickness [mm] of a layer that a flat surface touches on its hills only."""
    x = np.linspace(0.0, 2.0, 13)
    return op.ThicknessMap(L0 + 0.05 * np.cos(np.pi * x[:, None]) * np.cos(np.pi * x), extent=(2.0, 2.0))


def press_flat(law: AbstractOverclosure, friction: float = 0.0) -> op.Solution:
    """Press a flat surface into the hills of a bonded layer, contact at the nodes."""
    flat = op.ThicknessMap(np.full((13, 13), L0), extent=(2.0, 2.0))
    palpation = op.Palpation(
        op.Layer(hills(), LAYER.material),
        extent=(2.0, 2.0),
        elements=(12, 12, 2),
        window=op.Bonded(),
        sample=op.Contact(law, friction),
    )
    return op.solve(palpation, op.Imprint(flat), op.Newton(rtol=1e-8, face_rule="nodes"))


def gaps(solution: op.Solution) -> np.ndarray:
    """Compute the clearance [mm] of every node of the interface from the flat surface."""
    return L0 - np.asarray(solution.positions[2, -1] + solution.displacement[2, -1])


def test_25_contact_pushes_where_it_touches_and_nowhere_else():
    """The recovered pressure differs from the law's by how a node's share of the area is taken, 0.4%."""
    stiffness = 100.0  # MPa/mm
    solution = press_flat(op.LinearOverclosure(stiffness))
    gap = gaps(solution)
    pressure = np.asarray(solution.pressure)
    assert (pressure >= 0.0).all()
    assert (pressure[gap > 0.0] == 0.0).all()
    np.testing.assert_allclose(pressure[gap < 0.0], -stiffness * gap[gap < 0.0], rtol=0.01)
    assert 10 < (gap > 0.0).sum() < gap.size - 10


def test_25_penetration_falls_as_one_over_the_penalty():
    """Measured: -0.996 and -0.999."""
    stiffness = np.array([10.0, 30.0, 100.0])  # MPa/mm; the layer's own is 0.25
    depth = [float(press_flat(op.LinearOverclosure(k)).stats["max_penetration"]) for k in stiffness]
    np.testing.assert_allclose(np.diff(np.log(depth)) / np.diff(np.log(stiffness)), -1.0, atol=0.05)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_25_hard_contact_leaves_neither_penetration_nor_a_gap_under_pressure(friction):
    """Measured: 1e-5 µm; the force changes with the stiffness by 2e-7 without friction, by 2e-6 with it."""
    force = []
    for ratio in (30.0, 100.0):
        solution = press_flat(op.HardOverclosure(ratio, exact=True), friction)
        gap, pressure = gaps(solution), np.asarray(solution.pressure)
        assert (pressure >= 0.0).all()
        assert gap.min() > -1e-7
        np.testing.assert_allclose(gap[pressure > 0.0], 0.0, atol=1e-7)
        assert 10 < (pressure == 0.0).sum() < gap.size - 10
        force.append(float(solution.stats["force_sample"][2]))
    assert force[0] == pytest.approx(force[1], rel=1e-6 if friction == 0.0 else 1e-5)


def test_25_a_penalty_tends_to_hard_contact():
    """Its error in force falls as 1/stiffness."""
    hard = press_flat(op.HardOverclosure(exact=True)).stats["force_sample"][2]
    error = [float(press_flat(op.LinearOverclosure(k)).stats["force_sample"][2] - hard) for k in (30.0, 100.0)]
    assert error[0] / error[1] == pytest.approx(100.0 / 30.0, rel=0.05)
