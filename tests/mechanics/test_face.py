"""Faces of the layer: areas and integration against shape functions."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from opfem.mechanics.face import (
    area_vector,
    assemble_face,
    gather_face,
    nodal_area_vector,
    quadrature,
    size,
    surface_tangents,
    to_nodes,
    tributary_area,
)
from tests.oracles import FACE, warped_thickness
from tests.tolerances import ROUNDOFF

RULES = pytest.mark.parametrize("rule", ["gauss2", "gauss3", "nodes"])
NX, NY, EXTENT = 3, 2, (1.5, 0.8)


def flat(stretch=(1.0, 1.0), slope=(0.0, 0.0)):
    y, x = np.meshgrid(np.linspace(0, EXTENT[1], NY + 1), np.linspace(0, EXTENT[0], NX + 1), indexing="ij")
    return jnp.array(np.stack([stretch[0] * x, stretch[1] * y, slope[0] * x + slope[1] * y + 0.5]))


@pytest.fixture
def warped():
    """A curved face whose elements are no longer rectangles."""
    face = np.array(flat())
    face[2] = warped_thickness(NY, NX, EXTENT)
    return jnp.array(face + 0.05 * np.random.default_rng(0).standard_normal(face.shape))


def at_points(values, q, j, i):
    """Interpolate nodal values of face (j, i) with the rule's shape functions, in a loop."""
    return sum(q.N[:, a, None] * np.asarray(values)[:, j + y, i + x] for a, (x, y) in enumerate(FACE))


@RULES
def test_shape_functions_and_weights_add_up(rule):
    q = quadrature(rule)
    np.testing.assert_allclose(q.weights.sum(), 1.0, ROUNDOFF)
    np.testing.assert_allclose(q.N.sum(axis=1), 1.0, ROUNDOFF)
    np.testing.assert_allclose(q.dN.sum(axis=2), 0.0, atol=ROUNDOFF)


@pytest.mark.parametrize(("rule", "degree"), [("gauss2", 3), ("gauss3", 5), ("nodes", 1)])
def test_rule_integrates_polynomials_of_its_degree(rule, degree):
    q = quadrature(rule)
    x, y = (q.N @ np.array([corner[k] for corner in FACE]) for k in (0, 1))
    for m, n in itertools.product(range(degree + 1), repeat=2):
        np.testing.assert_allclose(np.sum(q.weights * x**m * y**n), 1 / ((m + 1) * (n + 1)), ROUNDOFF)
    too_high = np.sum(q.weights * x ** (degree + 1))
    assert abs(too_high - 1 / (degree + 2)) > 1e-4


@RULES
def test_area_of_a_stretched_and_tilted_face(rule):
    face = flat(stretch=(1.3, 0.9), slope=(0.4, -0.2))
    _, xi, eta = surface_tangents(gather_face(face), rule)
    vector = area_vector(xi, eta)
    flat_area = 1.3 * 0.9 * EXTENT[0] * EXTENT[1] / (NX * NY)
    slopes = np.array([0.4 / 1.3, -0.2 / 0.9])
    expected = flat_area * np.array([-slopes[0], -slopes[1], 1.0])
    np.testing.assert_allclose(vector, np.broadcast_to(expected[:, None, None, None], vector.shape), ROUNDOFF)
    np.testing.assert_allclose(size(vector), flat_area * np.sqrt(1 + slopes @ slopes), ROUNDOFF)


@RULES
def test_position_and_tangents_equal_a_loop(rule, warped):
    q = quadrature(rule)
    position, xi, eta = surface_tangents(gather_face(warped), rule)
    for j, i in itertools.product(range(NY), range(NX)):
        np.testing.assert_allclose(position[:, :, j, i], at_points(warped, q, j, i).T, ROUNDOFF, 10 * ROUNDOFF)
    step = 1e-3  # the map is bilinear, so a chord between two points of one edge is the tangent
    local = np.stack([(q.N @ np.array([corner[k] for corner in FACE])) for k in (0, 1)])

    def bilinear(s, t, j, i):
        weights = [(s if x else 1 - s) * (t if y else 1 - t) for x, y in FACE]
        return sum(w * np.asarray(warped)[:, j + y, i + x, None] for w, (x, y) in zip(weights, FACE, strict=True))

    for j, i in itertools.product(range(NY), range(NX)):
        s, t = local
        chord = (bilinear(s + step, t, j, i) - bilinear(s, t, j, i)) / step
        np.testing.assert_allclose(xi[:, :, j, i], chord, atol=1e-3 * ROUNDOFF / step)
        chord = (bilinear(s, t + step, j, i) - bilinear(s, t, j, i)) / step
        np.testing.assert_allclose(eta[:, :, j, i], chord, atol=1e-3 * ROUNDOFF / step)


@RULES
def test_to_nodes_is_a_partition_of_unity(rule):
    q = quadrature(rule)
    density = np.random.default_rng(1).standard_normal((len(q.weights), 2, NY, NX))
    nodal = np.asarray(to_nodes(jnp.array(density), rule))
    assert nodal.shape == (2, NY + 1, NX + 1)
    np.testing.assert_allclose(nodal.sum(axis=(1, 2)), np.einsum("q,qcji->c", q.weights, density), ROUNDOFF)


@RULES
def test_to_nodes_equals_a_loop(rule):
    q = quadrature(rule)
    density = np.random.default_rng(2).standard_normal((len(q.weights), NY, NX))
    expected = np.zeros((NY + 1, NX + 1))
    for j, i, point in itertools.product(range(NY), range(NX), range(len(q.weights))):
        for a, (x, y) in enumerate(FACE):
            expected[j + y, i + x] += q.weights[point] * q.N[point, a] * density[point, j, i]
    np.testing.assert_allclose(to_nodes(jnp.array(density), rule), expected, ROUNDOFF, ROUNDOFF)


def test_assembly_is_the_transpose_of_gathering():
    rng = np.random.default_rng(3)
    nodal, faces = rng.standard_normal((2, NY + 1, NX + 1)), rng.standard_normal((4, 2, NY, NX))
    left = np.sum(np.asarray(gather_face(jnp.array(nodal))) * faces)
    right = np.sum(nodal * np.asarray(assemble_face(jnp.array(faces))))
    np.testing.assert_allclose(left, right, ROUNDOFF)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.4, -0.2)])
def test_tributary_areas_sum_to_the_area(slope):
    area = np.asarray(tributary_area(flat(slope=slope)))
    whole = EXTENT[0] * EXTENT[1] * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    np.testing.assert_allclose(area.sum(), whole, ROUNDOFF)
    inner = area[1:-1, 1:-1]
    np.testing.assert_allclose(inner, whole / (NX * NY), ROUNDOFF)
    np.testing.assert_allclose(area[0, 0], whole / (4 * NX * NY), ROUNDOFF)
    np.testing.assert_allclose(area[0, 1:-1], whole / (2 * NX * NY), ROUNDOFF)


def test_tributary_area_of_a_warped_face_is_lumped_corner_by_corner(warped):
    """Every element gives a node a quarter of the parallelogram that its two edges there span."""
    x = np.asarray(warped)
    expected = np.zeros((NY + 1, NX + 1))
    for j, i in itertools.product(range(NY), range(NX)):
        for a, b in FACE:
            node = x[:, j + b, i + a]
            edges = x[:, j + b, i + 1 - a] - node, x[:, j + 1 - b, i + a] - node
            expected[j + b, i + a] += np.linalg.norm(np.cross(*edges)) / 4
    np.testing.assert_allclose(tributary_area(warped), expected, ROUNDOFF)


def test_area_vectors_sum_to_what_the_rim_encloses(warped):
    """∫ n da = ½ ∮ x × dx, whatever the face does inside its rim."""
    x = np.asarray(warped)
    rim = np.concatenate([x[:, 0, :-1].T, x[:, :-1, -1].T, x[:, -1, :0:-1].T, x[:, :0:-1, 0].T])
    enclosed = 0.5 * np.cross(rim, np.roll(rim, -1, axis=0)).sum(axis=0)
    np.testing.assert_allclose(np.asarray(nodal_area_vector(warped)).sum(axis=(1, 2)), enclosed, ROUNDOFF)
