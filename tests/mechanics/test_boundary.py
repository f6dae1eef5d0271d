"""Window, sample and sides: taking nodal values, adding forces and matrices back, pressure on folded sides."""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.boundary import Bodies, Touching, add_matrices, is_side, put, take, to_touching
from opfem.mechanics.contact_body import RigidSurface
from opfem.mechanics.contact_face import ContactFace
from opfem.mechanics.face import area_vector, gather_face, surface_tangents
from tests.oracles import assemble_dense
from tests.tolerances import ROUNDOFF

NX, NY = 5, 3
BODIES = pytest.mark.parametrize("body", Bodies._fields)
SIDES = pytest.mark.parametrize("with_sides", [True, False], ids=["with sides", "face only"])
LAYERS = pytest.mark.parametrize("nz", [1, 2, 3])


def nodal(nz, seed=0):
    return np.random.default_rng(seed).standard_normal((3, nz + 1, NY + 1, NX + 1))


def brick(nz, height=0.4):
    z, y, x = np.meshgrid(*(np.linspace(0, e, n + 1) for e, n in ((height, nz), (0.9, NY), (1.5, NX))), indexing="ij")
    return np.stack([x, y, z])


@LAYERS
@BODIES
def test_the_face_comes_first_then_the_sides(nz, body):
    u = nodal(nz)
    corners = take(jnp.array(u), body, with_sides=True)
    own = gather_face(jnp.array(u[:, 0 if body == "window" else -1])).reshape(4, 3, -1)
    np.testing.assert_array_equal(corners[..., ~is_side((nz, NY, NX))], own)
    np.testing.assert_array_equal(take(jnp.array(u), body, with_sides=False), own)
    assert is_side((nz, NY, NX)).sum() == (nz + 1) // 2 * 2 * (NX + NY)


@pytest.mark.parametrize(("nz", "low", "high"), [(1, (0, 1), (0, 1)), (2, (0, 1), (1, 2)), (3, (0, 2), (1, 3))])
def test_window_has_the_lower_half_of_the_sides_and_sample_the_upper(nz, low, high):
    X = jnp.array(brick(nz, height=float(nz)))
    for body, (first, last) in (("window", low), ("sample", high)):
        z = take(X, body, with_sides=True)[:, 2, is_side((nz, NY, NX))]
        assert (float(z.min()), float(z.max())) == (first, last)


@LAYERS
@BODIES
def test_sides_run_once_around_the_layer_and_face_outward(nz, body):
    corners = take(jnp.array(brick(nz)), body, with_sides=True)[..., is_side((nz, NY, NX))]
    position, xi, eta = surface_tangents(corners, "gauss2")
    area = np.asarray(area_vector(xi, eta))
    outward = np.asarray(position[:2]) - np.array([0.75, 0.45])[:, None, None]
    assert np.all(np.sum(area[:2] * outward, axis=0) > 0)
    np.testing.assert_allclose(area[2], 0.0, atol=ROUNDOFF)
    height = 0.4 * ((nz + 1) // 2) / nz
    np.testing.assert_allclose(
        np.abs(area).mean(axis=1).sum(axis=1), [2 * 0.9 * height, 2 * 1.5 * height, 0], ROUNDOFF, ROUNDOFF
    )


@BODIES
@LAYERS
@SIDES
def test_corner_values_return_to_the_nodes_they_came_from(nz, body, with_sides):
    """Taking is a linear map; adding corners into nodes and putting these into the layer is its transpose."""
    u = nodal(nz)
    taken = np.asarray(take(jnp.array(u), body, with_sides))
    f = np.random.default_rng(1).standard_normal(taken.shape)
    touching = to_touching(jnp.array(f), (nz, NY, NX))
    assert isinstance(touching, Touching)
    np.testing.assert_allclose(touching.total, f.sum(axis=(0, 2)), 100 * ROUNDOFF)
    back = np.asarray(put(touching, body, u.shape))
    np.testing.assert_allclose(np.sum(taken * f), np.sum(u * back), 100 * ROUNDOFF)


@BODIES
@LAYERS
@SIDES
def test_matrices_act_on_the_nodes_of_their_faces(nz, body, with_sides):
    u = nodal(nz)
    corners = take(jnp.array(u), body, with_sides)
    M = np.random.default_rng(2).standard_normal((4, 4, 3, 3, corners.shape[-1]))
    K = add_matrices(jnp.zeros((nz, 8, 8, 3, 3, NY, NX)), jnp.array(M), body)
    product = (assemble_dense(np.asarray(K)) @ u.ravel()).reshape(u.shape)
    on_faces = to_touching(jnp.einsum("abijf,bjf->aif", M, corners), (nz, NY, NX))
    np.testing.assert_allclose(product, put(on_faces, body, u.shape), 10 * ROUNDOFF, 100 * ROUNDOFF)


def side_face(above):
    contact = op.Contact(op.LinearOverclosure(7.0), friction=0.0)
    numbers = (jnp.asarray(v, float) for v in (0.0, 0.3, 0.5))
    offset, element_size, stiffness = numbers
    sides = jnp.array([True])
    return ContactFace(contact, RigidSurface(None, None), offset, None, element_size, stiffness, above, "gauss2", sides)


@pytest.mark.parametrize("above", [True, False], ids=["sample", "window"])
def test_a_side_feels_only_the_surface_that_it_has_turned_towards(above):
    """A strip that leans over its own height is pushed on its projected area, where that faces the surface."""
    overclosure = 0.01
    for lean in (0.3, 0.0, -0.3):
        z, x = np.meshgrid([0.0, 0.001], [0.0, 1.0], indexing="ij")
        sign = 1.0 if above else -1.0
        # Seen from outside (south), x runs right and z up; lean moves the far edge outward, along -y.
        y = -lean * (1 - z / 0.001 if above else z / 0.001)
        strip = jnp.array(np.stack([x, y, z + sign * (overclosure if above else overclosure + 0.001)]))
        strip = gather_face(strip).reshape(4, 3, 1)
        face = side_face(above)
        force = np.asarray(face.force(face.locate(jnp.ones(()), strip), face.initial_history(strip))).sum(axis=(0, 2))
        depth = overclosure + 0.0005
        np.testing.assert_allclose(force, [0, 0, -sign * 7.0 * depth * max(lean, 0.0)], 1e-9, ROUNDOFF)
