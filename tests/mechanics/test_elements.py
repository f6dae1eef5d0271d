"""What all elements of the layer share, whatever their cells and form; the plain two are in test_internal."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics import internal
from opfem.mechanics.internal import layer_body
from opfem.model import LayerMesh
from tests.oracles import assemble_dense, cauchy_stress, random_rotation, warped_thickness
from tests.tolerances import ROUNDOFF

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
MATERIAL = op.MooneyRivlin(C10, C01, BULK)
EXTENT, ELEMENTS = (0.9, 0.8), (4, 2, 2)
EYE = np.eye(3)
OTHERS = ["hybrid", "reduced", "tet4", "tet10"]
EVERY = pytest.mark.parametrize("element", OTHERS)
WITHOUT_UNKNOWN = pytest.mark.parametrize("element", ["reduced", "tet4", "tet10"])

_force = eqx.filter_jit(lambda body, u, p: body.internal_force(u, p)[0])
_stiffness = eqx.filter_jit(lambda body, u, p: body.cell_stiffness(u, p))
_energy_slope = eqx.filter_jit(lambda body, u: jax.grad(body.energy)(u))
_tangent_of_force = eqx.filter_jit(lambda body, u, p: jax.jacfwd(lambda v: body.internal_force(v, p)[0])(u))
_missed = eqx.filter_jit(lambda body, u, p: body.volume_residual(u, p))


def warped(element):
    nx, ny, nz = ELEMENTS
    mesh = LayerMesh(jnp.array(warped_thickness(ny, nx, EXTENT)), jnp.array(EXTENT), nz)
    return mesh, layer_body(mesh, MATERIAL, element)


def moved(mesh, F):
    return jnp.einsum("ij,jzyx->izyx", jnp.array(F - EYE), mesh.positions())


def own_stress(body, u):
    """The mean stress that the volume asks for: zero volume residual."""
    if body.form != "hybrid":
        return None
    zero = jnp.zeros(ELEMENTS[::-1])
    return BULK * _missed(body, u, zero) / body.cells.volume[0]


@pytest.fixture(scope="module")
def crumpled():
    nx, ny, nz = ELEMENTS
    return jnp.array(0.02 * np.random.default_rng(0).standard_normal((3, nz + 1, ny + 1, nx + 1)))


def assert_close(got, expected, scale=1.0):
    expected = np.asarray(expected)
    np.testing.assert_allclose(got, expected, atol=scale * ROUNDOFF * np.abs(expected).max())


@WITHOUT_UNKNOWN
def test_force_is_the_derivative_of_energy(element, crumpled):
    _, body = warped(element)
    assert_close(_force(body, crumpled, None), _energy_slope(body, crumpled))


@pytest.mark.parametrize("element", ["reduced", "tet4"])
def test_05_stiffness_is_the_derivative_of_force(element, crumpled):
    _, body = warped(element)
    K = assemble_dense(np.asarray(_stiffness(body, crumpled, None)))
    assert_close(K, np.asarray(_tangent_of_force(body, crumpled, None)).reshape(K.shape))
    assert_close(K, K.T)


def test_05_point_tangent_of_quadratic_tetrahedra_is_the_derivative_of_force(crumpled):
    _, body = warped("tet10")
    v = jnp.array(np.random.default_rng(1).standard_normal(crumpled.shape))
    H = body.cells.displacement_gradient(v)
    stress = jnp.einsum("iJkLqzyx,kLqzyx->iJqzyx", body.point_tangent(crumpled), H)
    got = body.cells.assemble(body.cells.nodal_vectors(stress))
    assert_close(got, jax.jvp(lambda u: body.internal_force(u)[0], (crumpled,), (v,))[1])


def test_hybrid_is_mean_dilatation_with_its_stress_taken_out(crumpled):
    """At the stress that the volume asks for, force and energy are the same, and so is the condensed stiffness."""
    _, hybrid = warped("hybrid")
    _, mean = warped("mean_dilatation")
    p = own_stress(hybrid, crumpled)
    assert_close(_force(hybrid, crumpled, p), _force(mean, crumpled, None))
    np.testing.assert_allclose(hybrid.energy(crumpled, p), mean.energy(crumpled), ROUNDOFF)
    condensed = hybrid.cell_stiffness(crumpled, p, jnp.array(BULK))
    assert_close(condensed, _stiffness(mean, crumpled, None))


def test_volume_vectors_are_the_derivative_of_volume(crumpled):
    _, body = warped("hybrid")
    zero = jnp.zeros(ELEMENTS[::-1])
    v = jnp.array(np.random.default_rng(2).standard_normal(crumpled.shape))
    got = jnp.sum(body.volume_vectors(crumpled) * body.cells.gather(v), axis=(0, 1))
    assert_close(got, jax.jvp(lambda u: body.volume_residual(u, zero), (crumpled,), (v,))[1])


def test_incompressible_volume_residual_ignores_the_stress(crumpled):
    mesh, _ = warped("hybrid")
    body = layer_body(mesh, op.MooneyRivlin(C10, C01, bulk=jnp.inf), "hybrid")
    zero = jnp.zeros(ELEMENTS[::-1])
    np.testing.assert_array_equal(_missed(body, crumpled, zero + 1.0), _missed(body, crumpled, zero))


@EVERY
def test_01_rigid_motion_rotates_the_forces_of_a_deformed_state(element, crumpled):
    mesh, body = warped(element)
    rng = np.random.default_rng(3)
    Q, shift = random_rotation(rng), rng.standard_normal(3)
    X = np.asarray(mesh.positions())
    turned = jnp.array(np.einsum("ij,jzyx->izyx", Q, X + np.asarray(crumpled)) + shift[:, None, None, None] - X)
    p = own_stress(body, crumpled)
    expected = np.einsum("ij,jzyx->izyx", Q, _force(body, crumpled, p))
    assert_close(_force(body, turned, p), expected, 10)
    np.testing.assert_allclose(body.energy(turned, p), body.energy(crumpled, p), 10 * ROUNDOFF)


PATCH_F = EYE + 0.2 * np.random.default_rng(4).uniform(-1, 1, (3, 3))


@EVERY
def test_03_patch_of_an_affine_displacement_has_uniform_stress(element):
    mesh, body = warped(element)
    u = moved(mesh, PATCH_F)
    p = own_stress(body, u)
    residual = np.asarray(_force(body, u, p))
    np.testing.assert_allclose(residual[:, 1:-1, 1:-1, 1:-1], 0.0, atol=ROUNDOFF * np.abs(residual).max())
    _, sigma, _ = eqx.filter_jit(lambda b, v, q: b.fields(v, q))(body, u, p)
    expected = cauchy_stress(PATCH_F, C10, C01, BULK)
    assert_close(sigma, np.broadcast_to(expected[:, :, None, None, None, None], sigma.shape))


@EVERY
def test_cells_fill_the_layer(element):
    mesh, body = warped(element)
    L0 = np.asarray(mesh.thickness)
    nx, ny, _ = ELEMENTS
    corners = (L0[1:, 1:] + L0[:-1, 1:] + L0[1:, :-1] + L0[:-1, :-1]) / 4
    volume = corners.sum() * EXTENT[0] * EXTENT[1] / (nx * ny)
    total = float(jnp.sum(jnp.broadcast_to(body.cells.weight, (*body.cells.weight.shape[:1], *cells_of(body)))))
    # Straight diagonals cut the bilinear top; what they miss is the warp of a cell.
    assert total == pytest.approx(volume, rel=ROUNDOFF if element not in ("tet4", "tet10") else 0.05)


@pytest.mark.parametrize("element", ["full", "mean_dilatation", *OTHERS])
def test_single_precision_stays_single(element, crumpled):
    """The tangent is assembled in float32; one constant in float64 would double its cost."""
    _, body = warped(element)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), body)
    u = crumpled.astype(jnp.float32)
    p = None if body.form != "hybrid" else jnp.zeros(ELEMENTS[::-1], jnp.float32)
    results = [_force(single, u, p), _stiffness(single, u, p)]
    results += [single.volume_vectors(u)] if body.form == "hybrid" else []
    results += [single.point_tangent(u)] if element == "tet10" else []
    assert {result.dtype for result in results} == {jnp.dtype("float32")}


def cells_of(body):
    return body.cells.slope_x.shape[1:]


@pytest.mark.parametrize("element", ["reduced", "tet4"])
def test_02_every_element_has_six_zero_modes(element):
    assert zero_modes(warped(element)[1]) == {6}


def test_02_reduced_without_hourglass_control_has_eighteen(monkeypatch):
    monkeypatch.setattr(internal, "HOURGLASS", 0.0)
    assert zero_modes(warped("reduced")[1]) == {18}


def test_02_quadratic_tetrahedra_have_six_zero_modes():
    mesh = LayerMesh(jnp.array(warped_thickness(2, 2, EXTENT)), jnp.array(EXTENT), 2)
    body = layer_body(mesh, MATERIAL, "tet10")
    K = np.asarray(jax.jacfwd(lambda v: body.internal_force(v)[0])(jnp.zeros((3, 3, 3, 3)))).reshape(81, 81)
    assert count_zeros(K) == 6


def zero_modes(body) -> set[int]:
    nx, ny, nz = ELEMENTS
    K = np.asarray(body.cell_stiffness(jnp.zeros((3, nz + 1, ny + 1, nx + 1))))
    return {count_zeros(k) for k in np.transpose(K, (0, 5, 6, 1, 3, 2, 4)).reshape(-1, 24, 24)}


def count_zeros(K: np.ndarray) -> int:
    eigenvalues = np.linalg.eigvalsh(K)
    return int((np.abs(eigenvalues) < 10 * ROUNDOFF * eigenvalues.max()).sum())


@pytest.mark.parametrize("element", ["full", "tet4", "tet10"])
def test_assembly_is_the_transpose_of_gathering(element):
    _, body = warped(element)
    nx, ny, nz = ELEMENTS
    nodal = np.random.default_rng(5).standard_normal((3, nz + 1, ny + 1, nx + 1))
    gathered = np.asarray(body.cells.gather(jnp.array(nodal)))
    values = np.random.default_rng(6).standard_normal(gathered.shape)
    np.testing.assert_allclose(
        np.sum(gathered * values), np.sum(nodal * np.asarray(body.cells.assemble(jnp.array(values)))), ROUNDOFF
    )
