"""VALIDATION 19: a rigid, flat, frictionless circular punch on a bonded layer (Hayes).

P = 4 µ a w κ/(1 - ν) at a vanishing depth w. The displacement is prescribed under the punch; cells shrink
to a hundredth of the radius at its edge, where the pressure is singular.
"""

import numpy as np
import pytest

import opfem as op
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.verification import meshes
from tests.verification.statics import at, body, held

PUNCH = 0.02
TABLE_D = {
    0.2: {0.3: 1.2066, 0.475: 1.2652, 0.5: 1.2806},
    0.4: {0.3: 1.4726, 0.475: 1.6371, 0.5: 1.6837},
    1.0: {0.3: 2.4835, 0.475: 3.3134, 0.5: 3.6187},
    2.0: {0.3: 4.3532, 0.475: 7.4316, 0.5: 9.1495},
}
CASES = [(a, nu, value) for a, row in TABLE_D.items() for nu, value in row.items()]


def graded(length, first, most, ratio):
    """Positions from 0 to `length` in steps that grow from `first` to `most` at the largest."""
    steps = [first]
    while sum(steps) < length:
        steps.append(min(steps[-1] * ratio, most))
    return np.concatenate([[0.0], np.cumsum(steps)]) * length / sum(steps)


def stiffness(a, nu, edge=0.01, ratio=1.4, core=3, reach=4.0):
    """κ of a punch of radius a on a layer of height one, and the solution."""
    shear, depth, first = 1.0, 1e-6 * min(a, 1.0), edge * a
    inner = a - graded(0.6 * a, first, 0.2, ratio)[::-1]
    outer = a + graded(reach, first, 0.5, ratio)[1:]
    z = 1.0 - graded(1.0, first, 0.15, ratio)[::-1]
    points, cells = meshes.quarter_disc(core, [0.5], [*inner, *outer], z)
    top, base = at(points[2], 1.0), at(points[2], 0.0)
    radius = np.hypot(points[0], points[1])
    under = top & (radius < a * meshes.polygon_radius(core) + 0.1 * first)
    fixed = held(points, x=at(points[0], 0.0) | base, y=at(points[1], 0.0) | base, z=base | under)
    u = np.zeros(points.shape)
    u[2, under] = -depth
    bulk = np.inf if nu == 0.5 else 2 * shear * (1 + nu) / (3 * (1 - 2 * nu))
    solid = body(points, cells, op.NeoHooke(0.5 * shear, bulk), "hybrid")
    solution = solve_statics(StaticProblem(solid, points, fixed, displacement=u), StaticSettings(rtol=1e-7))
    force = -4.0 * solution.reaction[2, under].sum()
    return force * (1 - nu) / (4.0 * shear * a * depth), solution


@pytest.mark.slow
@pytest.mark.parametrize(("a", "nu", "reference"), CASES)
def test_19_flat_punch_on_a_bonded_layer(a, nu, reference):
    assert stiffness(a, nu)[0] == pytest.approx(reference, rel=PUNCH)
