"""Contact's arguments, and the elastic slip and sticking stiffness that they mean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import ROUNDOFF

LAW = op.HardOverclosure()
PRESSURE = jnp.array([0.0, 1e-3, 0.02])
SIZE = jnp.asarray(0.25)


def test_default_elastic_slip_is_half_a_percent_of_the_element():
    contact = op.Contact(LAW, friction=0.15)
    slip = 0.005 * 0.25
    np.testing.assert_allclose(contact.slip_limit(PRESSURE, SIZE), [slip] * 3, ROUNDOFF)
    np.testing.assert_allclose(contact.stick_stiffness(PRESSURE, SIZE), 0.15 * np.array(PRESSURE) / slip, ROUNDOFF)


def test_elastic_slip_replaces_the_default():
    contact = op.Contact(LAW, friction=0.15, elastic_slip=1e-3)
    np.testing.assert_allclose(contact.slip_limit(PRESSURE, SIZE), [1e-3] * 3, ROUNDOFF)
    np.testing.assert_allclose(contact.stick_stiffness(PRESSURE, SIZE), 150 * np.array(PRESSURE), ROUNDOFF)


def test_stick_slope_is_a_constant_stiffness_where_closed():
    contact = op.Contact(LAW, friction=0.15, stick_slope=30.0)
    np.testing.assert_allclose(contact.stick_stiffness(PRESSURE, SIZE), [0.0, 30.0, 30.0], ROUNDOFF)
    np.testing.assert_allclose(contact.slip_limit(PRESSURE, SIZE), 0.005 * np.array(PRESSURE), ROUNDOFF)


@pytest.mark.parametrize("given", [{}, {"elastic_slip": 1e-3}, {"stick_slope": 30.0}])
def test_every_way_slides_at_friction_times_pressure(given):
    contact = op.Contact(LAW, friction=0.15, **given)
    bound = contact.stick_stiffness(PRESSURE, SIZE) * contact.slip_limit(PRESSURE, SIZE)
    np.testing.assert_allclose(bound, 0.15 * np.array(PRESSURE), ROUNDOFF)


def test_friction_may_be_zero():
    contact = op.Contact(LAW, friction=0)
    np.testing.assert_array_equal(contact.stick_stiffness(PRESSURE, SIZE), 0.0)


def test_numbers_are_leaves():
    contact = op.Contact(op.LinearOverclosure(5), friction=1, elastic_slip=1)
    leaves = jax.tree.leaves(contact)
    assert len(leaves) == 3
    assert all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.Contact(LAW, friction=-0.1), r"Contact\.friction \[-\] must be zero or positive, got -0\.1\."),
        (lambda: op.Contact(LAW, friction=np.nan), r"Contact\.friction \[-\] must be zero or positive, got nan\."),
        (lambda: op.Contact(LAW, 0.1, elastic_slip=0.0), r"Contact\.elastic_slip \[mm\] must be positive, got 0\.0\."),
        (
            lambda: op.Contact(LAW, 0.1, stick_slope=-1.0),
            r"Contact\.stick_slope \[MPa/mm\] must be positive, got -1\.0\.",
        ),
        (
            lambda: op.Contact(LAW, 0.1, elastic_slip=1e-3, stick_slope=30.0),
            r"elastic_slip \[mm\] or stick_slope \[MPa/mm\], got both\. Pass one\.",
        ),
    ],
)
def test_constructor_names_field_unit_and_value(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()


def test_law_must_be_a_law(annotations_unchecked):
    with pytest.raises(
        ValueError, match=r"Contact\.law must be an overclosure law such as HardOverclosure\(\), got 2\.0\."
    ):
        op.Contact(2.0, 0.1)
