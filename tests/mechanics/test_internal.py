"""The layer's forces and stiffness: loops over elements, patch test, rigid motions, zero modes."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.hex8 import assemble, gather
from opfem.mechanics.internal import layer_body
from opfem.model import LayerMesh
from tests.oracles import CELL, assemble_dense, cauchy_stress, first_piola, random_rotation, warped_thickness
from tests.tolerances import ROUNDOFF

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
MATERIAL = op.MooneyRivlin(C10, C01, BULK)
EXTENT = (0.9, 0.8)
NX, NY, NZ = 2, 3, 2
SHAPE = (NZ + 1, NY + 1, NX + 1)
EYE = np.eye(3)
FORMS = pytest.mark.parametrize("form", ["mean_dilatation", "full"])

_force = eqx.filter_jit(lambda body, u: body.internal_force(u))
_energy_and_slope = eqx.filter_jit(lambda body, u: jax.value_and_grad(body.energy)(u))
_stiffness = eqx.filter_jit(lambda body, u: body.cell_stiffness(u))


def energy_of(body, u):
    return _energy_and_slope(body, u)[0]


def warped_body(form, elements=(NX, NY, NZ)):
    """A layer of uneven thickness: no element is a box, all have sloping tops and bottoms."""
    nx, ny, nz = elements
    mesh = LayerMesh(jnp.array(warped_thickness(ny, nx, EXTENT)), jnp.array(EXTENT), nz)
    return mesh, layer_body(mesh, MATERIAL, form)


@pytest.fixture(scope="module")
def deformed():
    """Nodal displacements of a crumpled layer: strains of about 15%."""
    return 0.03 * np.random.default_rng(0).standard_normal((3, *SHAPE))


def affine(mesh, F):
    """Displacement of a uniform deformation gradient."""
    return jnp.einsum("ij,jzyx->izyx", jnp.array(F - EYE), mesh.positions())


GAUSS = [0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3)]


def element_points(X):
    """Shape gradients dN/dX `(8, 3)` and volumes of the eight Gauss points of one element, X `(8, 3)`."""
    found = []
    for point in itertools.product(GAUSS, repeat=3):
        dN = np.empty((8, 3))
        for a, corner in enumerate(CELL):
            ends = [(t if c else 1 - t, 1.0 if c else -1.0) for t, c in zip(point, corner, strict=True)]
            dN[a] = [
                ends[0][1] * ends[1][0] * ends[2][0],
                ends[0][0] * ends[1][1] * ends[2][0],
                ends[0][0] * ends[1][0] * ends[2][1],
            ]
        to_X = X.T @ dN
        found.append((dN @ np.linalg.inv(to_X), np.linalg.det(to_X) / 8))
    return found


def loop_over_elements(mesh, u, form):
    """Internal force, energy and smallest J by plain loops over elements and Gauss points."""
    X = np.asarray(mesh.positions())
    force, energy, smallest = np.zeros_like(u), 0.0, np.inf
    for k, j, i in itertools.product(range(mesh.layers), range(u.shape[2] - 1), range(u.shape[3] - 1)):
        nodes = [(k + z, j + y, i + x) for x, y, z in CELL]
        points = element_points(np.array([X[:, *node] for node in nodes]))
        nodal = np.array([u[:, *node] for node in nodes])
        gradients = [EYE + nodal.T @ dN for dN, _ in points]
        J = np.array([np.linalg.det(F) for F in gradients])
        volumes = np.array([volume for _, volume in points])
        mean = np.sum(J * volumes) / volumes.sum()
        smallest = min(smallest, J.min())
        for F, (dN, volume), J_point in zip(gradients, points, J, strict=True):
            J_volume = J_point if form == "full" else mean
            P = first_piola(F, C10, C01, BULK, J_volume)
            for node, slope in zip(nodes, dN, strict=True):
                force[:, *node] += P @ slope * volume
            b = J_point ** (-2 / 3) * F @ F.T
            isochoric = C10 * (np.trace(b) - 3) + C01 * (np.trace(np.linalg.inv(b)) - 3)
            energy += volume * (isochoric + BULK / 2 * (J_volume - 1) ** 2)
    return force, energy, smallest


def assert_close(got, expected, rtol=ROUNDOFF):
    """Compare whole fields: small entries are as exact as the largest."""
    np.testing.assert_allclose(got, expected, rtol, rtol * np.abs(expected).max())


@FORMS
def test_force_and_energy_equal_a_loop(form, deformed):
    mesh, body = warped_body(form)
    force, energy, smallest = loop_over_elements(mesh, deformed, form)
    got, J = _force(body, jnp.array(deformed))
    assert_close(got, force)
    np.testing.assert_allclose(J, smallest, ROUNDOFF)
    np.testing.assert_allclose(energy_of(body, jnp.array(deformed)), energy, ROUNDOFF)


@FORMS
def test_force_is_the_derivative_of_energy(form, deformed):
    _, body = warped_body(form)
    u = jnp.array(deformed)
    assert_close(_force(body, u)[0], _energy_and_slope(body, u)[1])


@FORMS
def test_05_stiffness_is_the_derivative_of_force(form, deformed):
    _, body = warped_body(form)
    u = jnp.array(deformed)
    size = u.size
    derivative = jax.jit(jax.jacfwd(lambda v: body.internal_force(v)[0]))(u).reshape(size, size)
    K = assemble_dense(np.asarray(_stiffness(body, u)))
    assert_close(K, derivative)
    assert_close(K, K.T)


@FORMS
def test_stiffness_keeps_constant_fields_of_the_linear_layer(form):
    """At rest a uniform strain e costs ½ e·C·e per volume, with Lamé's constants."""
    mesh, body = warped_body(form)
    K = assemble_dense(np.asarray(_stiffness(body, jnp.zeros((3, *SHAPE)))))
    strain = np.array([[0.1, 0.3, -0.2], [0.3, -0.4, 0.5], [-0.2, 0.5, 0.2]])
    u = np.asarray(affine(mesh, EYE + strain)).ravel()
    shear = 2 * (C10 + C01)
    density = shear * np.sum(strain**2) + (BULK - 2 / 3 * shear) * np.trace(strain) ** 2 / 2
    # Bilinear thickness between nodes: the volume is the mean of corners, element by element.
    L0 = np.asarray(mesh.thickness)
    corners = (L0[1:, 1:] + L0[:-1, 1:] + L0[1:, :-1] + L0[:-1, :-1]) / 4
    volume = corners.sum() * EXTENT[0] * EXTENT[1] / (NX * NY)
    np.testing.assert_allclose(u @ K @ u / 2, density * volume, ROUNDOFF)


@FORMS
def test_rigid_motion_causes_no_force(form):
    mesh, body = warped_body(form)
    rng = np.random.default_rng(1)
    for _ in range(3):
        u = affine(mesh, random_rotation(rng)) + jnp.array(rng.standard_normal(3))[:, None, None, None]
        force, J = _force(body, u)
        np.testing.assert_allclose(force, 0.0, atol=10 * ROUNDOFF * BULK * EXTENT[0] * EXTENT[1])
        np.testing.assert_allclose(J, 1.0, ROUNDOFF)
        assert abs(energy_of(body, u)) < ROUNDOFF * BULK


@FORMS
def test_01_rigid_motion_rotates_the_forces_of_a_deformed_state(form, deformed):
    mesh, body = warped_body(form)
    rng = np.random.default_rng(2)
    Q, shift = random_rotation(rng), rng.standard_normal(3)
    X = np.asarray(mesh.positions())
    moved = np.einsum("ij,jzyx->izyx", Q, X + deformed) + shift[:, None, None, None] - X
    expected = np.einsum("ij,jzyx->izyx", Q, _force(body, jnp.array(deformed))[0])
    assert_close(_force(body, jnp.array(moved))[0], expected, 10 * ROUNDOFF)
    np.testing.assert_allclose(energy_of(body, jnp.array(moved)), energy_of(body, jnp.array(deformed)), 10 * ROUNDOFF)


@FORMS
def test_forces_of_a_free_layer_balance(form, deformed):
    mesh, body = warped_body(form)
    f = np.asarray(_force(body, jnp.array(deformed))[0])
    x = np.asarray(mesh.positions()) + deformed
    scale = np.abs(f).sum()
    np.testing.assert_allclose(f.sum(axis=(1, 2, 3)), 0.0, atol=ROUNDOFF * scale)
    moment = np.cross(x, f, axis=0).sum(axis=(1, 2, 3))
    np.testing.assert_allclose(moment, 0.0, atol=ROUNDOFF * scale)


PATCH_F = EYE + 0.2 * np.random.default_rng(3).uniform(-1, 1, (3, 3))


@FORMS
def test_03_patch_of_an_affine_displacement_has_uniform_stress(form):
    mesh, body = warped_body(form)
    u = affine(mesh, PATCH_F)
    residual = np.asarray(_force(body, u)[0])
    np.testing.assert_allclose(residual[:, 1:-1, 1:-1, 1:-1], 0.0, atol=ROUNDOFF * np.abs(residual).max())
    sigma = np.asarray(eqx.filter_jit(lambda b, v: b.fields(v)[1])(body, u))
    expected = cauchy_stress(PATCH_F, C10, C01, BULK)
    assert_close(sigma, np.broadcast_to(expected[:, :, None, None, None, None], sigma.shape))


@FORMS
def test_03_patch_finds_the_affine_displacement_from_its_boundary(form):
    """Newton's method on the interior nodes alone, started away from the answer."""
    mesh, body = warped_body(form)
    exact = np.asarray(affine(mesh, PATCH_F))
    inner = np.zeros(exact.shape, bool)
    inner[:, 1:-1, 1:-1, 1:-1] = True
    u = exact + 0.02 * inner * np.random.default_rng(4).standard_normal(exact.shape)
    for _ in range(6):
        K = assemble_dense(np.asarray(_stiffness(body, jnp.array(u))))[np.ix_(inner.ravel(), inner.ravel())]
        u[inner] -= np.linalg.solve(K, np.asarray(_force(body, jnp.array(u))[0])[inner])
    np.testing.assert_allclose(u, exact, atol=10 * ROUNDOFF)


@FORMS
def test_02_every_element_has_six_zero_modes(form):
    """The rigid motions and no hourglass: eigenvalues of warped elements at rest."""
    _, body = warped_body(form)
    K = np.transpose(_stiffness(body, jnp.zeros((3, *SHAPE))), (0, 5, 6, 1, 3, 2, 4)).reshape(-1, 24, 24)
    for element in K:
        eigenvalues = np.linalg.eigvalsh(element)
        zero = np.abs(eigenvalues) < 10 * ROUNDOFF * eigenvalues.max()
        assert zero.sum() == 6
        assert eigenvalues[~zero].min() > 1e-4 * eigenvalues.max()


@FORMS
def test_only_the_plain_element_locks_in_bending(form):
    """u = (x z, 0, 0) in every element has no mean dilatation; plain Gauss points resist it with bulk."""
    box = LayerMesh(jnp.full((NY + 1, NX + 1), 1.0), jnp.array([NX * 0.5, NY * 0.5]), NZ)
    K = np.asarray(_stiffness(layer_body(box, MATERIAL, form), jnp.zeros((3, *SHAPE))))[0, ..., 0, 0]
    bend = np.array([[(x - 0.5) * (z - 0.5) * 0.25, 0.0, 0.0] for x, y, z in CELL])
    shear = 2 * (C10 + C01)
    second_moment = 0.5**3 * 0.5**2 / 12  # ∫ z² of a 0.5 mm cube, which 2×2×2 points integrate exactly
    expected = shear * (2 / 3 + 1 / 2) * second_moment + (form == "full") * BULK / 2 * second_moment
    np.testing.assert_allclose(np.einsum("ai,abij,bj->", bend, K, bend) / 2, expected, ROUNDOFF)


def test_assembly_is_the_transpose_of_gathering():
    rng = np.random.default_rng(5)
    nodal, elements = rng.standard_normal((3, *SHAPE)), rng.standard_normal((8, 3, NZ, NY, NX))
    left = np.sum(np.asarray(gather(jnp.array(nodal))) * elements)
    np.testing.assert_allclose(left, np.sum(nodal * np.asarray(assemble(jnp.array(elements)))), ROUNDOFF)


def test_gathering_follows_the_node_order():
    nodal = np.arange(3 * np.prod(SHAPE)).reshape(3, *SHAPE).astype(float)
    got = np.asarray(gather(jnp.array(nodal)))
    for k, j, i in itertools.product(range(NZ), range(NY), range(NX)):
        for a, (x, y, z) in enumerate(CELL):
            np.testing.assert_array_equal(got[a, :, k, j, i], nodal[:, k + z, j + y, i + x])


def test_jit_equals_eager_and_vmap_a_loop(deformed):
    _, body = warped_body("mean_dilatation")
    both = jnp.stack([jnp.array(deformed), 0.5 * jnp.array(deformed)])
    lanes = jax.jit(jax.vmap(lambda v: body.internal_force(v)[0]))(both)
    for u, lane in zip(both, lanes, strict=True):
        assert_close(_force(body, u)[0], body.internal_force(u)[0])
        assert_close(lane, body.internal_force(u)[0])
