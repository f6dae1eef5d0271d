"""VALIDATION 14: a nearly incompressible block pressed on a quarter of its top (Reese; deal.II step-44).

One quarter of the block, 1 × 1 × 1 mm: symmetry at x = 0 and y = 0, a base that slides, a top that moves only
up and down, and a dead pressure on its part within half a millimetre of the axis. The reference is a quadratic
element with linear discontinuous pressure, 6³.
"""

import numpy as np
import pytest

import opfem as op
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.verification import meshes
from tests.verification.statics import at, body, held, nearest, nodal_areas

SHEAR, NU = 80.194, 0.4999
BULK = 2 * SHEAR * (1 + NU) / (3 * (1 - 2 * NU))
COMPRESSION = 0.02
JUMP = 0.05
LEVELS = {20: 0.2195, 40: 0.423, 60: 0.585, 80: 0.694}


def pressed(n, level, form="hybrid", increments=None):
    """Compression at the centre of the top, and the solution."""
    points, cells = meshes.unit_cube(n)
    top = at(points[2], 1.0)
    loaded = meshes.boundary_faces(cells, points, lambda X: at(X[2], 1.0) & (X[0] < 0.5 + 1e-9) & (X[1] < 0.5 + 1e-9))
    force = np.zeros(points.shape)
    force[2] = -4.0 * level * nodal_areas(points, loaded)
    fixed = held(points, x=at(points[0], 0.0) | top, y=at(points[1], 0.0) | top, z=at(points[2], 0.0))
    solid = body(points, cells, op.NeoHooke(0.5 * SHEAR, BULK), form)
    settings = StaticSettings(increments=increments or level // 10)
    solution = solve_statics(StaticProblem(solid, points, fixed, force=force), settings)
    return -solution.displacement[2, nearest(points, 0.0, 0.0, 1.0)], solution


@pytest.mark.slow
@pytest.mark.parametrize(("level", "reference"), LEVELS.items())
def test_14_compression_and_pressure_of_the_block(level, reference):
    """The pressure is singular along the load's edge, so what is small is the mean jump, not the largest."""
    compression, solution = pressed(8, level)
    assert compression == pytest.approx(reference, rel=COMPRESSION)
    p = solution.mean_stress.reshape(8, 8, 8)
    jumps = np.concatenate([np.abs(np.diff(p, axis=axis)).ravel() for axis in range(3)])
    assert jumps.mean() < JUMP * np.ptp(p)
