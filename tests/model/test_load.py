"""Loads: what their constructors accept and refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op


def thickness_map(mask=None, **given):
    return op.ThicknessMap(np.full((4, 5), 0.45), extent=(4.0, 3.0), mask=mask, **given)


@pytest.fixture
def mask():
    mask = np.zeros((4, 5), bool)
    mask[1, 2] = mask[3, 3] = True
    return mask


def test_imprint_refuses_masked_pixels_that_are_not_filled(mask):
    message = r"Imprint\.thickness must have no masked pixels, got 2 of 20 .*Fill them first: thickness\.filled\(\)\."
    with pytest.raises(ValueError, match=message):
        op.Imprint(thickness_map(mask))


def test_imprint_takes_filled_pixels(mask):
    assert op.Imprint(thickness_map(mask).filled()).thickness.is_filled


def test_imprint_takes_a_traced_map():
    def lowest(values):
        return op.Imprint(op.ThicknessMap(values, extent=(4.0, 3.0))).thickness.values.min()

    assert jax.jit(lowest)(jnp.full((4, 5), 0.45)) == 0.45


def test_imprint_refuses_an_unknown_interpolation(annotations_unchecked):
    with pytest.raises(ValueError, match=r"Imprint\.interpolation must be one of .*'cubic'.*, got 'linear'\."):
        op.Imprint(thickness_map(), interpolation="linear")


def test_imprint_refuses_a_bare_array(annotations_unchecked):
    with pytest.raises(ValueError, match=r"Imprint\.thickness must be a ThicknessMap, got"):
        op.Imprint(np.full((4, 5), 0.45))


@pytest.mark.parametrize("normal", [0.01, np.full((3, 4), 0.01), 1])
def test_traction_takes_a_number_or_nodes(normal):
    load = op.Traction(normal)
    assert load.normal.shape == np.shape(normal)
    assert jnp.issubdtype(load.normal.dtype, jnp.floating)
    assert load.lateral is None


@pytest.mark.parametrize("uz", [-0.01, np.full((3, 4), -0.01)])
def test_displacement_takes_a_number_or_nodes(uz):
    load = op.Displacement(uz)
    assert load.uz.shape == np.shape(uz)
    assert load.lateral == "free"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.Traction(np.nan), r"Traction\.normal \[MPa\] must be finite, got nan\."),
        (lambda: op.Traction(np.array([[0.1, np.inf]])), r"Traction\.normal \[MPa\] must be finite, got values from"),
        (lambda: op.Traction(np.ones(4)), r"Traction\.normal \[MPa\] must be a number or .*, got shape \(4,\)\."),
        (lambda: op.Traction(0.1, lateral=np.ones((3, 4))), r"\(2, ny\+1, nx\+1\), x then y, got shape \(3, 4\)\."),
        (lambda: op.Traction(0.1, stiffness=-1.0), r"Traction\.stiffness \[MPa/mm\] must be zero or positive"),
        (lambda: op.Traction(0.1, lateral=np.ones((3, 3, 4))), r"x then y, got shape \(3, 3, 4\)\."),
        (
            lambda: op.Traction(0.1, lateral=np.full((2, 3, 4), np.nan)),
            r"Traction\.lateral \[MPa\] must be finite, got",
        ),
        (lambda: op.Displacement(np.inf), r"Displacement\.uz \[mm\] must be finite, got inf\."),
        (lambda: op.Displacement(np.ones(3)), r"Displacement\.uz \[mm\] must be a number or .*, got shape \(3,\)\."),
        (
            lambda: op.Displacement(-0.1, lateral="held"),
            r'Displacement\.lateral must be "free" or "fixed", got \'held\'\.',
        ),
    ],
)
def test_constructor_names_field_unit_and_value(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()
