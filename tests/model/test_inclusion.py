"""Which points lie inside an inclusion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (
            op.Cylinder(centre=(1.0, 2.0), radius=0.5, depth=(0.2, 0.8)),
            [(1.0, 2.0, 0.5), (1.49, 2.0, 0.21), (0.7, 1.7, 0.79)],
            [(1.51, 2.0, 0.5), (1.4, 2.4, 0.5), (1.0, 2.0, 0.19), (1.0, 2.0, 0.81)],
        ),
        (
            op.Sphere(centre=(1.0, 2.0, 0.5), radius=0.4),
            [(1.0, 2.0, 0.5), (1.0, 2.39, 0.5), (1.2, 2.2, 0.7)],
            [(1.0, 2.41, 0.5), (1.3, 2.3, 0.7)],
        ),
        (
            op.Box(low=(0.0, 1.0, 0.2), high=(2.0, 3.0, 0.4)),
            [(0.1, 1.1, 0.21), (1.9, 2.9, 0.39)],
            [(2.1, 2.0, 0.3), (1.0, 0.9, 0.3), (1.0, 2.0, 0.1), (1.0, 2.0, 0.5)],
        ),
        (
            op.HalfSpace(point=(2.5, 0.0, 0.0), normal=(1.0, 0.0, 0.0)),
            [(2.6, 7.0, -3.0)],
            [(2.4, 7.0, -3.0)],
        ),
        (
            op.HalfSpace(point=(0.0, 0.0, 1.0), normal=(1.0, 0.0, 2.0)),
            [(0.0, 5.0, 1.01), (2.0, 5.0, 0.01)],
            [(0.0, 5.0, 0.99), (2.0, 5.0, -0.01)],
        ),
    ],
)
def test_points_inside_and_outside(shape, inside, outside):
    for points, expected in ((inside, True), (outside, False)):
        x, y, depth = jnp.array(points).T
        np.testing.assert_array_equal(shape.contains(x, y, depth), expected)
        np.testing.assert_array_equal(jax.jit(lambda s, *at: s.contains(*at))(shape, x, y, depth), expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.Cylinder((1.0, 2.0, 3.0), 0.5, (0.0, 1.0)), r"Cylinder\.centre \[mm\] must be \(x, y\), got shape"),
        (lambda: op.Cylinder((1.0, 2.0), -0.5, (0.0, 1.0)), r"Cylinder\.radius \[mm\] must be positive, got -0\.5"),
        (lambda: op.Cylinder((1.0, 2.0), 0.5, (1.0, 0.5)), r"\(from, to\) with from < to, got \[1\.0, 0\.5\]"),
        (lambda: op.Sphere((1.0, 2.0), 0.5), r"Sphere\.centre \[mm\] must be \(x, y, depth\), got shape \(2,\)"),
        (lambda: op.Sphere((1.0, 2.0, np.nan), 0.5), r"Sphere\.centre \[mm\] must be finite"),
        (lambda: op.Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), r"Box\.low \[mm\] must lie below Box\.high"),
        (lambda: op.HalfSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), r"HalfSpace\.normal \[-\] must be a direction"),
    ],
)
def test_constructors_name_field_unit_and_value(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_numbers_are_written_with_their_units():
    shape = op.Cylinder((1.0, 2.0), 0.5, (0.0, 1.0))
    assert repr(shape) == "Cylinder(centre=(1, 2) mm, radius=0.5 mm, depth=(0, 1) mm)"
