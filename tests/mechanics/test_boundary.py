"""Window, sample and sides: taking nodal values, adding forces and matrices back, pressure on folded sides."""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.boundary import Parts, add_matrices, put, take
from opfem.mechanics.face import area_vector, assemble_face, gather_face, surface_tangents
from opfem.mechanics.interaction import ContactFace, RigidSurface
from tests.oracles import assemble_dense
from tests.tolerances import ROUNDOFF

NX, NY = 5, 3
PLACES = pytest.mark.parametrize("place", Parts._fields)
LAYERS = pytest.mark.parametrize("nz", [1, 2, 3])


def nodal(nz, seed=0):
    return np.random.default_rng(seed).standard_normal((3, nz + 1, NY + 1, NX + 1))


def brick(nz, height=0.4):
    z, y, x = np.meshgrid(*(np.linspace(0, e, n + 1) for e, n in ((height, nz), (0.9, NY), (1.5, NX))), indexing="ij")
    return np.stack([x, y, z])


@pytest.mark.parametrize(("nz", "low", "high"), [(1, (0, 1), (0, 1)), (2, (0, 1), (1, 2)), (3, (0, 2), (1, 3))])
def test_window_has_the_lower_half_of_the_sides_and_sample_the_upper(nz, low, high):
    X = jnp.array(brick(nz, height=float(nz)))
    for place, (first, last) in (("window_sides", low), ("sample_sides", high)):
        assert (float(take(X, place)[2].min()), float(take(X, place)[2].max())) == (first, last)


@LAYERS
def test_sides_run_once_around_the_layer_and_face_outward(nz):
    X = brick(nz)
    strip = take(jnp.array(X), "window_sides")
    np.testing.assert_array_equal(strip[..., 0], strip[..., -1])
    corners = {(0.0, 0.0), (1.5, 0.0), (1.5, 0.9), (0.0, 0.9)}
    assert corners <= {tuple(np.round(p, 12)) for p in np.asarray(strip[:2, 0]).T}
    assert strip.shape[-1] == 2 * (NX + NY) + 1
    position, xi, eta = surface_tangents(strip, "gauss2")
    area = np.asarray(area_vector(xi, eta))
    outward = np.asarray(position[:2]) - np.array([0.75, 0.45])[:, None, None, None]
    assert np.all(np.sum(area[:2] * outward, axis=0) > 0)
    np.testing.assert_allclose(area[2], 0.0, atol=ROUNDOFF)


@PLACES
@LAYERS
def test_put_is_the_transpose_of_take(nz, place):
    u = nodal(nz)
    taken = np.asarray(take(jnp.array(u), place))
    f = np.random.default_rng(1).standard_normal(taken.shape)
    np.testing.assert_allclose(
        np.sum(taken * f), np.sum(u * np.asarray(put(jnp.array(f), place, u.shape))), 100 * ROUNDOFF
    )


@PLACES
@LAYERS
def test_matrices_act_on_the_nodes_of_their_part(nz, place):
    u = nodal(nz)
    part = take(jnp.array(u), place)
    rows, columns = part.shape[1] - 1, part.shape[2] - 1
    M = np.random.default_rng(2).standard_normal((4, 4, 3, 3, rows, columns))
    K = add_matrices(jnp.zeros((nz, 8, 8, 3, 3, NY, NX)), jnp.array(M), place)
    product = (assemble_dense(np.asarray(K)) @ u.ravel()).reshape(u.shape)
    on_faces = jnp.einsum("abijyx,bjyx->aiyx", M, gather_face(part))
    np.testing.assert_allclose(product, put(assemble_face(on_faces), place, u.shape), 10 * ROUNDOFF, 100 * ROUNDOFF)


def side_face(above):
    contact = op.Contact(op.LinearOverclosure(7.0), friction=0.0)
    numbers = (jnp.asarray(v, float) for v in (0.0, 0.3, 0.5))
    offset, element_size, stiffness = numbers
    return ContactFace(
        contact, RigidSurface(None, None), offset, None, element_size, stiffness, above, "gauss2", rolls=True
    )


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
        face = side_face(above)
        force = np.asarray(face.force(jnp.ones(()), strip, face.initial_history(strip))).sum(axis=(1, 2))
        depth = overclosure + 0.0005
        np.testing.assert_allclose(force, [0, 0, -sign * 7.0 * depth * max(lean, 0.0)], 1e-9, ROUNDOFF)
