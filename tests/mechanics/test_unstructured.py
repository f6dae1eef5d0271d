"""Unstructured cells against exact fields, derivatives of an energy, and the structured layer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.internal import layer_body
from opfem.mechanics.unstructured import unstructured_cells
from opfem.model import LayerMesh
from opfem.model.deformation import ProductSum, kinematics
from tests.oracles import warped_thickness
from tests.tolerances import ROUNDOFF
from tests.verification import meshes

KINDS = ["hex8", "tet4", "tet10"]
MATERIAL = op.MooneyRivlin(c10=2.2e-3, c01=7.03e-4, bulk=0.11612)
RANDOM = np.random.default_rng(0)
G = RANDOM.uniform(-0.2, 0.2, (3, 3))


def patch(kind):
    points, cells = meshes.patch_cube()
    if kind != "hex8":
        points, cells = meshes.tetrahedra(points, cells)
    if kind == "tet10":
        points, cells = meshes.quadratic(points, cells)
    return points, unstructured_cells(points, cells, kind)


def random_displacement(points):
    return jnp.asarray(0.003 * np.random.default_rng(1).standard_normal(points.shape))


def energy(cells, u):
    return jnp.sum(MATERIAL.energy(cells.displacement_gradient(u)) * cells.weight)


def force_and_volume(cells, u):
    k = kinematics(cells.displacement_gradient(u))
    P = MATERIAL.first_piola(k, MATERIAL.volumetric_stress(k.volume_change))
    return cells.assemble(cells.nodal_vectors(P * cells.weight)), k.J


def stiffness(cells, u):
    k = kinematics(cells.displacement_gradient(u))
    volumetric = ProductSum(direct=((MATERIAL.bulk * k.J**2, k.G, k.G),))
    A = MATERIAL.tangent(k, MATERIAL.volumetric_stress(k.volume_change)) + volumetric
    return cells.matrices(A.scaled(cells.weight))


@pytest.mark.parametrize("kind", KINDS)
def test_affine_field_and_volume_are_exact(kind):
    points, cells = patch(kind)
    assert float(jnp.sum(cells.weight)) == pytest.approx(1.0, rel=ROUNDOFF)
    H = cells.displacement_gradient(jnp.asarray(G @ points))
    np.testing.assert_allclose(H, np.broadcast_to(G[..., None, None], H.shape), rtol=0, atol=ROUNDOFF)


def test_quadratic_tetrahedra_represent_quadratic_fields():
    points, cells = patch("tet10")
    # The gradient of x y is (y, x): its mean over the unit cube is (½, ½), and the rule integrates it exactly.
    u = np.stack([points[0] * points[1], np.zeros(points.shape[1]), points[2] ** 2])
    mean = np.einsum("iJqe,qe->iJ", cells.displacement_gradient(jnp.asarray(u)), cells.weight)
    np.testing.assert_allclose(mean, [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], rtol=0, atol=ROUNDOFF)


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_and_matrices_are_derivatives_of_the_energy(kind):
    points, cells = patch(kind)
    u = random_displacement(points)

    directions = jnp.asarray(np.random.default_rng(3).standard_normal((4, *points.shape)))

    def along(cells, u, v):
        _, power = jax.jvp(lambda u: energy(cells, u), (u,), (v,))
        force, change = jax.jvp(lambda u: force_and_volume(cells, u)[0], (u,), (v,))
        product = jnp.einsum("abike,bke->aie", stiffness(cells, u), cells.gather(v))
        return power, change, jnp.sum(force * v), product

    many = eqx.filter_jit(lambda cells, u: jax.lax.map(lambda v: along(cells, u, v), directions))
    power, change, expected, products = many(cells, u)
    np.testing.assert_allclose(power, expected, rtol=0, atol=ROUNDOFF * np.abs(power).max())
    np.testing.assert_allclose(jax.vmap(cells.assemble)(products), change, rtol=0, atol=ROUNDOFF * np.abs(change).max())


@pytest.mark.parametrize("kind", KINDS)
def test_assembly_adds_every_cell_once(kind):
    points, cells = patch(kind)
    vectors = np.random.default_rng(2).standard_normal(cells.gather(jnp.asarray(points)).shape)
    expected = np.zeros_like(points)
    nodes = np.asarray(cells.cells)
    for a in range(nodes.shape[0]):
        for e in range(nodes.shape[1]):
            expected[:, nodes[a, e]] += vectors[a, :, e]
    np.testing.assert_allclose(cells.assemble(jnp.asarray(vectors)), expected, rtol=0, atol=1e-14)
    compiled = eqx.filter_jit(lambda cells, v: cells.assemble(v))
    first, again = (compiled(cells, jnp.asarray(vectors)) for _ in range(2))
    np.testing.assert_allclose(first, expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(first, again)


def test_hexahedra_are_those_of_the_layer():
    mesh = LayerMesh(jnp.asarray(warped_thickness(2, 3, (0.9, 0.8))), jnp.array((0.9, 0.8)), 2)
    X = np.asarray(mesh.positions())
    _, index = meshes.grid(np.arange(4), np.arange(3), np.arange(3))
    cells = unstructured_cells(X.reshape(3, -1), index, "hex8")
    u = random_displacement(X.reshape(3, -1))
    body = layer_body(mesh, MATERIAL, "full")
    expected, smallest = eqx.filter_jit(lambda body, u: body.internal_force(u))(body, u.reshape(X.shape))
    force, J = eqx.filter_jit(lambda cells, u: force_and_volume(cells, u))(cells, u)
    np.testing.assert_allclose(force, expected.reshape(3, -1), rtol=0, atol=ROUNDOFF * np.abs(force).max())
    assert float(jnp.min(J)) == pytest.approx(float(smallest), rel=ROUNDOFF)


@pytest.mark.parametrize("kind", KINDS)
def test_inverted_cell_is_named(kind):
    points, index = meshes.patch_cube()
    if kind != "hex8":
        points, index = meshes.tetrahedra(points, index)
    index[2, [0, 1]] = index[2, [1, 0]]
    if kind == "tet10":
        points, index = meshes.quadratic(points, index)
    with pytest.raises(ValueError, match=r"det\(dX/dξ\) .* for cells 2 \(-?\d"):
        unstructured_cells(points, index, kind)


def test_list_of_nodes_is_checked():
    points, index = meshes.patch_cube()
    with pytest.raises(ValueError, match=r"cells of hex8 must be integers of shape \(elements, 8\), got \(7, 4\)"):
        unstructured_cells(points, index[:, :4], "hex8")
    with pytest.raises(ValueError, match="nodes 0 to 14"):
        unstructured_cells(points[:, :-1], index, "hex8")
