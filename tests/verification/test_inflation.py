"""VALIDATION 11 and 12: Rivlin's thick sphere and cylinder under internal follower pressure, incompressible.

An octant and a quarter with eight hexahedra through a wall whose outer radius is twice the inner one.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.follower_pressure import FollowerPressure
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.verification import meshes
from tests.verification.statics import at, body, held

pytestmark = pytest.mark.slow

SHEAR = 0.005806
RADII = np.linspace(1.0, 2.0, 9)
INFLATION = 0.01
LARGEST_SPHERE = 0.81642
"""Largest pressure of the sphere, in shear moduli."""


def sphere_pressure(a):
    """Pressure in shear moduli at the inner stretch a."""
    b = (1 + (a**3 - 1) / 8) ** (1 / 3)
    return 0.5 * (4 / b + b**-4 - 4 / a - a**-4)


def cylinder_pressure(a):
    """Pressure in shear moduli at the inner stretch a."""
    b = (1 + (a**2 - 1) / 4) ** 0.5
    return np.log(a / b) + 0.5 * (b**-2 - a**-2)


def inflated(shape, pressure=1.0, stretch=None, throw=True, arc=6, **settings):
    """The wall under a pressure in shear moduli, or at a mean inner stretch whose pressure is found."""
    sphere = shape == "sphere"
    points, cells = meshes.sphere_octant(arc, RADII) if sphere else meshes.cylinder_sector(16, RADII, 0.2)
    radius = np.linalg.norm(points if sphere else points[:2], axis=0)
    inside = at(radius, 1.0)
    fixed = held(points, x=at(points[0], 0.0), y=at(points[1], 0.0), z=at(points[2], 0.0) | (not sphere))
    faces = meshes.boundary_faces(cells, points, lambda X: inside)
    control = None
    if stretch is not None:
        outward = points / radius if sphere else np.stack([*points[:2] / radius, 0 * radius])
        control = (np.where(inside, outward, 0.0) / inside.sum(), stretch - 1.0)
    problem = StaticProblem(
        body(points, cells, op.NeoHooke(0.5 * SHEAR, jnp.inf), "hybrid"),
        points,
        fixed,
        pressure=FollowerPressure(jnp.asarray(pressure * SHEAR), faces),
        control=control,
    )
    solution = solve_statics(problem, StaticSettings(increments=4, **settings), throw)
    x = points + solution.displacement
    return solution, np.linalg.norm(x if sphere else x[:2], axis=0)[inside].mean()


@pytest.mark.parametrize(("stretch", "reference"), [(1.25, 0.551869), (1.5, 0.755433), (2.0, 0.806927)])
def test_11_pressure_of_rivlins_sphere(stretch, reference):
    assert sphere_pressure(stretch) == pytest.approx(reference, abs=1e-6)
    solution, _ = inflated("sphere", stretch=stretch)
    assert solution.load_factor == pytest.approx(reference, rel=INFLATION)


def test_11_sphere_under_load_control():
    """Below the largest pressure the load is carried at the stretch of the closed form."""
    solution, stretch = inflated("sphere", pressure=0.7)
    assert solution.status == "successful"
    assert sphere_pressure(stretch) == pytest.approx(0.7, rel=INFLATION)
    assert max(len(steps) for steps in solution.residuals) <= 6


def test_11_sphere_fails_cleanly_above_its_largest_pressure():
    pressure = 0.85
    solution, stretch = inflated("sphere", pressure, throw=False, arc=4, max_cuts=3)
    assert solution.status == "increment_too_small"
    assert solution.load_fraction * pressure == pytest.approx(LARGEST_SPHERE, rel=INFLATION)
    assert np.isfinite(solution.displacement).all()
    assert 1.6 < stretch < 1.8281 * (1 + INFLATION)
    assert sphere_pressure(stretch) == pytest.approx(solution.load_factor * pressure, rel=INFLATION)


@pytest.mark.parametrize(("stretch", "reference"), [(1.25, 0.275712), (1.5, 0.428228), (2.0, 0.574054)])
def test_12_pressure_of_rivlins_cylinder(stretch, reference):
    assert cylinder_pressure(stretch) == pytest.approx(reference, abs=1e-6)
    found, _ = inflated("cylinder", stretch=stretch)
    assert found.load_factor == pytest.approx(reference, rel=INFLATION)
    loaded, at_load = inflated("cylinder", pressure=reference)
    assert cylinder_pressure(at_load) == pytest.approx(reference, rel=INFLATION)
    assert max(len(steps) for steps in loaded.residuals) <= 6
