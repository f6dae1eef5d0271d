"""VALIDATION 3: a distorted patch under affine boundary displacements has uniform stress, in every form."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.model.deformation import kinematics
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics
from tests.oracles import first_piola
from tests.verification import meshes
from tests.verification.statics import FORMS, body, tetrahedral

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
PATCH = 1e-10
"""VALIDATION's own tolerance: equilibrium is found to 1e-12 and multiplied by the patch's conditioning."""


@eqx.filter_jit
def _stress(solid, u, mean_stress):
    """First Piola–Kirchhoff stress at every point, each form's own volume change in dU/dJ."""
    H = solid.cells.displacement_gradient(u)
    k = kinematics(H)
    weight = solid.cells.weight
    mean = jnp.sum(k.volume_change * weight, axis=0) / jnp.sum(weight, axis=0)
    stress = solid.material.volumetric_stress(k.volume_change if solid.form in ("full", "reduced") else mean)
    if mean_stress is not None:
        stress = jnp.broadcast_to(mean_stress, weight.shape)
    return solid.material.first_piola(k, jnp.broadcast_to(stress, weight.shape))


@pytest.mark.parametrize(("kind", "form"), FORMS)
def test_03_patch_has_uniform_stress(kind, form):
    H = 0.2 * np.random.default_rng(3).uniform(-1, 1, (3, 3))
    points, cells = tetrahedral(*meshes.patch_cube(), kind)
    solid = body(points, cells, op.MooneyRivlin(C10, C01, BULK), form)
    outside = ((np.abs(points) < 1e-12) | (np.abs(points - 1) < 1e-12)).any(axis=0)
    assert (~outside).sum() >= 8
    problem = StaticProblem(solid, points, np.broadcast_to(outside, points.shape), displacement=H @ points)
    solution = solve_statics(problem, StaticSettings(rtol=1e-13, krylov_rtol=1e-12))
    np.testing.assert_allclose(solution.displacement, H @ points, rtol=0, atol=PATCH)
    mean_stress = None if solution.mean_stress is None else jnp.asarray(solution.mean_stress)
    P = np.asarray(_stress(solid, jnp.asarray(solution.displacement), mean_stress))
    expected = first_piola(np.eye(3) + H, C10, C01, BULK)
    np.testing.assert_allclose(
        P, np.broadcast_to(expected[..., None, None], P.shape), rtol=0, atol=PATCH * np.abs(P).max()
    )
