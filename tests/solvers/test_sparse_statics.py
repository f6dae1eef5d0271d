"""Sparse statics and the saddle point system: against dense algebra, closed forms, and clean failure."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csc_array

import opfem as op
from opfem.mechanics.internal import layer_body
from opfem.model import LayerMesh
from opfem.solvers.saddle_point import SaddlePoint
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.verification import meshes
from tests.verification.statics import at, body, held

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
MATERIAL = op.MooneyRivlin(C10, C01, BULK)


@pytest.mark.parametrize("inverse_bulk", [0.0, 1e-4, 0.05])
def test_saddle_point_solves_the_whole_system(inverse_bulk):
    rng = np.random.default_rng(0)
    A = rng.standard_normal((12, 12))
    A, B, V = A @ A.T + np.eye(12), rng.standard_normal((4, 12)), rng.uniform(0.5, 2.0, 4)
    gamma = 20.0
    augmented = A + gamma * B.T @ np.diag(1 / V) @ B
    system = SaddlePoint(csc_array(augmented), csc_array(B), V, inverse_bulk, 1.0, gamma)
    ru, rp = rng.standard_normal(12), rng.standard_normal(4)
    got = system.solve(ru, rp, 1e-12, 50)
    whole = np.block([[A, B.T], [B, -inverse_bulk * np.diag(V)]])
    expected = np.linalg.solve(whole, np.concatenate([ru, rp]))
    np.testing.assert_allclose(np.concatenate([got.u, got.mean_stress]), expected, rtol=1e-9, atol=1e-10)
    assert got.converged


def test_penalty_of_the_bulk_modulus_itself_is_direct():
    """γ = κ eliminates the mean stress: the preconditioner is the inverse."""
    rng = np.random.default_rng(1)
    B, V = rng.standard_normal((4, 12)), rng.uniform(0.5, 2.0, 4)
    augmented = 3.0 * np.eye(12) + 20.0 * B.T @ np.diag(1 / V) @ B
    system = SaddlePoint(csc_array(augmented), csc_array(B), V, 1 / 20.0, 1.0, 20.0)
    assert system.solve(rng.standard_normal(12), rng.standard_normal(4), 1e-12, 50).iterations <= 2


def test_a_system_that_does_not_converge_says_so():
    rng = np.random.default_rng(2)
    B, V = rng.standard_normal((20, 60)), rng.uniform(0.5, 2.0, 20)
    augmented = np.diag(rng.uniform(1.0, 50.0, 60)) + 20.0 * B.T @ np.diag(1 / V) @ B
    system = SaddlePoint(csc_array(augmented), csc_array(B), V, 0.0, 1.0, 20.0)
    right = rng.standard_normal(60), rng.standard_normal(20)
    short = system.solve(*right, 1e-12, 2)
    assert (short.iterations, short.converged) == (2, False)
    assert system.solve(*right, 1e-12, 200).converged
    assert system.solve(np.zeros(60), np.zeros(20), 1e-12, 2)[2:] == (0, True)


def compressed(form, stretch=0.5, **settings):
    """Lubricated compression of a distorted cube: nominal stress [kPa] and the solution."""
    points, cells = meshes.patch_cube()
    bottom, top = at(points[2], 0.0), at(points[2], 1.0)
    fixed = held(points, x=at(points[0], 0.0), y=at(points[1], 0.0), z=bottom | top)
    u = np.zeros(points.shape)
    u[2, top] = stretch - 1.0
    problem = StaticProblem(body(points, cells, MATERIAL, form), points, fixed, displacement=u)
    solution = solve_statics(problem, StaticSettings(**settings))
    return 1e3 * solution.reaction[2, top].sum(), solution


@pytest.mark.parametrize("form", ["full", "mean_dilatation", "reduced", "hybrid"])
def test_07_lubricated_compression_of_a_distorted_cube(form):
    nominal, solution = compressed(form, increments=4)
    assert nominal == pytest.approx(-24.672919, rel=1e-7)  # table A, as printed
    assert solution.status == "successful"
    assert solution.smallest_J == pytest.approx(0.9632354, rel=1e-6)
    assert max(steps[-1] for steps in solution.residuals) < 1e-9
    assert (solution.mean_stress is not None) == (form == "hybrid")


def test_same_bits_twice():
    first, again = (compressed("hybrid", 0.7)[1].displacement for _ in range(2))
    np.testing.assert_array_equal(first, again)


def tensile(force, throw=True):
    """A bar of neo-Hooke with one free end under a dead force [N]; its tangent is sound at any tension."""
    points, cells = meshes.grid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0, 2.0])
    end = at(points[2], 2.0)
    dead = np.zeros(points.shape)
    dead[2, end] = force / end.sum()
    fixed = held(points, x=at(points[0], 0.0), y=at(points[1], 0.0), z=at(points[2], 0.0))
    solid = body(points, cells, op.Yeoh(c10=1e-3, c20=-1e-4, c30=0.0, bulk=0.04), "mean_dilatation")
    return solve_statics(StaticProblem(solid, points, fixed, force=dead), StaticSettings(increments=4), throw)


def test_load_beyond_what_the_body_carries_is_refused():
    """Yeoh's law with a negative second coefficient softens: nominal tension has a largest value."""
    assert tensile(5e-4).load_fraction == 1.0
    with pytest.raises(RuntimeError, match=r"No equilibrium beyond 0\.\d+ of the load"):
        tensile(1e-2)
    last = tensile(1e-2, throw=False)
    assert last.status == "increment_too_small"
    assert 0.0 < last.load_fraction < 1.0
    assert last.load_factor == last.load_fraction
    # What comes back is the equilibrium at that fraction.
    assert -last.reaction[2].sum() == pytest.approx(1e-2 * last.load_fraction, rel=1e-6)


def test_cells_of_a_layer_are_refused():
    mesh = LayerMesh(jnp.full((2, 2), 0.5), jnp.array((1.0, 1.0)), 1)
    points = np.asarray(mesh.positions()).reshape(3, -1)
    with pytest.raises(ValueError, match="must have UnstructuredCells, got LayerCells"):
        solve_statics(StaticProblem(layer_body(mesh, MATERIAL, "full"), points, np.zeros(points.shape, bool)))
