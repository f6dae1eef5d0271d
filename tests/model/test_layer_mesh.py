"""The layer's thickness and the mesh made of it."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.model import LayerMesh
from tests.oracles import warped_thickness
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

MATERIAL = op.NeoHooke(1e-3, 0.1)
EXTENT = (3.0, 2.0)


def palpation(thickness, elements=(6, 4, 2), extent=EXTENT):
    return op.Palpation(op.Layer(thickness, MATERIAL), extent, elements, op.Bonded(), op.Bonded())


def tilted(x, y):
    return 0.5 + 0.02 * x - 0.03 * y


@pytest.fixture
def tilted_map():
    """A plane on a grid coarser than the mesh, of which a corner is off the layer: bilinear sampling is exact."""
    x, y = np.meshgrid(np.linspace(-1.0, 4.0, 6), np.linspace(-0.5, 2.5, 4))
    return op.ThicknessMap(tilted(x, y), extent=(5.0, 3.0), origin=(-1.0, -0.5))


def test_a_number_is_a_flat_layer():
    mesh = palpation(0.5).mesh()
    np.testing.assert_array_equal(mesh.thickness, np.full((5, 7), 0.5))
    assert mesh.elements == (6, 4, 2)
    assert mesh.node_shape == (3, 5, 7)
    np.testing.assert_allclose(mesh.spacing, [0.5, 0.5], ROUNDOFF)


def test_a_map_is_sampled_at_the_nodes(tilted_map):
    mesh = palpation(tilted_map).mesh()
    for j, i in itertools.product(range(5), range(7)):
        np.testing.assert_allclose(mesh.thickness[j, i], tilted(0.5 * i, 0.5 * j), ROUNDOFF)


def test_a_map_smaller_than_the_layer_continues_at_its_edge():
    thickness = op.ThicknessMap(np.array([[0.4, 0.5], [0.4, 0.5]]), extent=(1.0, 2.0), origin=(1.0, 0.0))
    mesh = palpation(thickness).mesh()
    np.testing.assert_allclose(mesh.thickness, np.tile([0.4, 0.4, 0.4, 0.45, 0.5, 0.5, 0.5], (5, 1)), ROUNDOFF)


def test_positions_of_a_warped_layer():
    thickness = warped_thickness(4, 6, EXTENT)
    X = np.asarray(LayerMesh(jnp.array(thickness), jnp.array(EXTENT), 3).positions())
    assert X.shape == (3, 4, 5, 7)
    for k, j, i in itertools.product(range(4), range(5), range(7)):
        np.testing.assert_allclose(X[:, k, j, i], [0.5 * i, 0.5 * j, thickness[j, i] * k / 3], ROUNDOFF, 1e-15)


def test_element_size_is_the_root_of_its_area():
    mesh = LayerMesh(jnp.full((3, 5), 0.5), jnp.array([4.0, 8.0]), 1)
    np.testing.assert_allclose(mesh.spacing, [1.0, 4.0], ROUNDOFF)
    np.testing.assert_allclose(mesh.element_size, 2.0, ROUNDOFF)


def test_positions_follow_the_derivative_of_the_map(tilted_map):
    def height(scale):
        scaled = op.ThicknessMap(tilted_map.values * scale, extent=tilted_map.extent, origin=tilted_map.origin)
        return jnp.sum(palpation(scaled).mesh().positions()[2])

    difference = (height(1.0 + 1e-4) - height(1.0 - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(height)(1.0), difference, FINITE_DIFFERENCE)


@pytest.mark.parametrize(
    ("thickness", "message"),
    [
        (-0.5, r"Layer\.thickness \[mm\] must be positive, got -0\.5\."),
        (0.0, r"Layer\.thickness \[mm\] must be positive, got 0\.0\."),
        (np.nan, r"Layer\.thickness \[mm\] must be positive, got nan\."),
        (np.full((3, 4), 0.5), r"a ThicknessMap, got an array of shape \(3, 4\)\. Pass ThicknessMap\(values, extent"),
    ],
)
def test_layer_names_field_unit_and_value(thickness, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        op.Layer(thickness, MATERIAL)
