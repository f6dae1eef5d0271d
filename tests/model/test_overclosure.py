"""Pressure–overclosure laws against closed forms and table E of docs/validation.md."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

P0, C0 = 2.0, 0.01
LAW = op.ExponentialOverclosure(pressure=P0, clearance=C0)
SCALE = jnp.asarray(0.5)
TABLE = op.TabularOverclosure(pressure=[0.0, 0.01, 0.5, 0.6], clearance=[0.009, 0.002, -0.001, -0.02])
ALL_LAWS = pytest.mark.parametrize(
    "law",
    [op.HardOverclosure(), op.LinearOverclosure(7.0), LAW, TABLE],
    ids=["hard", "linear", "exponential", "tabular"],
)
EPS = np.finfo(float).eps
# Overclosure, in units of c0, where the docstring says that the tangent takes over.
TANGENT_FROM = 6.0


def pressure_and_slope(law, clearance):
    clearance = jnp.asarray(clearance, float)
    return jax.jvp(lambda g: law.pressure_at(g, SCALE), (clearance,), (jnp.ones_like(clearance),))


def exponential(clearance, p0=P0, c0=C0):
    """Pressure and slope in closed form."""
    s = 1 - np.asarray(clearance) / c0
    top = 1 + TANGENT_FROM
    slope = -p0 / (c0 * (np.e - 1)) * ((1 + np.clip(s, 0, top)) * np.exp(np.clip(s, 0, top)) - 1)
    p = p0 / (np.e - 1) * np.clip(s, 0, top) * np.expm1(np.clip(s, 0, top)) - slope * c0 * np.maximum(s - top, 0)
    return p, np.where(s > 0, slope, 0.0)


# c/c0, p/p0, -c0 p'/p0
TABLE_E = [
    (0.9, 0.0061207, 0.1255254),
    (0.5, 0.1887703, 0.8572994),
    (0.0, 1.0, 2.5819767),
    (-0.5, 3.0393929, 5.9386199),
    (-1.0, 7.4365637, 12.318799),
]


@pytest.mark.parametrize(("c", "p", "slope"), TABLE_E)
def test_22_exponential_law_equals_table_e(c, p, slope):
    got, derivative = pressure_and_slope(LAW, c * C0)
    np.testing.assert_allclose([got / P0, -C0 * derivative / P0], [p, slope], rtol=0, atol=1e-6)


def test_exponential_law_equals_its_closed_form():
    clearance = C0 * np.linspace(-8.0, 2.0, 401)
    got, derivative = pressure_and_slope(LAW, clearance)
    p, slope = exponential(clearance)
    np.testing.assert_allclose(got, p, ROUNDOFF, ROUNDOFF * P0)
    np.testing.assert_allclose(derivative, slope, ROUNDOFF, ROUNDOFF * P0 / C0)


@pytest.mark.parametrize(("where", "slope"), [(1.0, 0.0), (-TANGENT_FROM, (8 * np.exp(7) - 1) / (np.e - 1))])
def test_22_exponential_law_has_one_slope_at_its_joints(where, slope):
    steps = 1e-7 * np.array([-1.0, 0.0, 1.0])
    p, derivative = pressure_and_slope(LAW, C0 * (where + steps))
    np.testing.assert_allclose(-C0 / P0 * derivative, slope, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(p / P0, exponential(C0 * where)[0] / P0, rtol=1e-6, atol=1e-6)


def test_exponential_law_ends_at_its_clearance():
    assert LAW.zero_pressure_clearance == C0
    assert LAW.pressure_at(jnp.asarray(C0), SCALE) == 0.0
    assert LAW.pressure_at(jnp.asarray(C0 * (1 - 1e-6)), SCALE) > 0.0


@ALL_LAWS
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_22_laws_are_finite_a_thousand_clearances_away(law, side):
    far = jnp.asarray(side * 1e3 * C0)
    p, slope = pressure_and_slope(law, far)
    assert np.isfinite(p)
    assert np.isfinite(slope)
    assert (p > 0 and slope < 0) if side < 0 else (p == 0 and slope == 0)
    by_law = jax.grad(lambda model: model.pressure_at(far, SCALE))(law)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_law))


@ALL_LAWS
def test_slope_equals_a_central_difference(law):
    clearance = C0 * np.array([-7.5, -3.0, -0.2, 0.3, 0.8, 1.5])
    step = 1e-6 * C0
    difference = (
        law.pressure_at(jnp.asarray(clearance + step), SCALE) - law.pressure_at(jnp.asarray(clearance - step), SCALE)
    ) / (2 * step)
    slope = pressure_and_slope(law, clearance)[1]
    np.testing.assert_allclose(slope, difference, FINITE_DIFFERENCE, FINITE_DIFFERENCE * np.abs(slope).max())


def test_linear_and_hard_laws_are_lines():
    clearance = jnp.array([-0.02, -0.01, 0.01])
    np.testing.assert_allclose(op.LinearOverclosure(7.0).pressure_at(clearance, SCALE), [0.14, 0.07, 0.0], ROUNDOFF)
    hard = op.HardOverclosure(stiffness_ratio=20.0).pressure_at(clearance, SCALE)
    np.testing.assert_allclose(hard, [0.2, 0.1, 0.0], ROUNDOFF)
    assert op.HardOverclosure().zero_pressure_clearance == 0.0
    assert op.LinearOverclosure(7.0).zero_pressure_clearance == 0.0


def test_tabular_law_passes_through_its_rows_and_goes_straight_on():
    rows = np.column_stack([TABLE.clearance, TABLE.pressure])
    between = 0.5 * (rows[1:] + rows[:-1])
    beyond = rows[-1] + 10 * (rows[-1] - rows[-2])
    points = np.vstack([[[1.0, 0.0]], rows, between, beyond])
    np.testing.assert_allclose(TABLE.pressure_at(jnp.asarray(points[:, 0]), SCALE), points[:, 1], ROUNDOFF, 1e-16)
    np.testing.assert_allclose(TABLE.clearance_at(jnp.asarray(points[1:, 1]), SCALE), points[1:, 0], ROUNDOFF, 1e-16)


@pytest.mark.parametrize(
    "law", [op.HardOverclosure(), op.LinearOverclosure(7.0), TABLE], ids=["hard", "linear", "table"]
)
def test_a_point_that_just_touches_is_held(law):
    touching = law.zero_pressure_clearance
    p, slope = pressure_and_slope(law, touching)
    assert p == 0.0
    np.testing.assert_allclose(slope, pressure_and_slope(law, touching - 1e-3)[1], ROUNDOFF)


@ALL_LAWS
def test_clearance_is_the_inverse_of_pressure_over_twelve_decades(law):
    p = P0 * np.logspace(-8, 4, 97)
    clearance = law.clearance_at(jnp.asarray(p), SCALE)
    got, slope = pressure_and_slope(law, clearance)
    # Near its start a law has lost the digits of the distance from there, which makes its pressure.
    lost = 4 * EPS * np.abs(clearance * slope) / p
    assert np.all(np.abs(got / p - 1) <= ROUNDOFF + lost)


def test_23_clearance_of_the_exponential_law_at_ten_kpa():
    np.testing.assert_allclose(LAW.clearance_at(jnp.asarray(0.01), SCALE), 9.094e-3, atol=0.5e-6)


@ALL_LAWS
def test_clearance_of_no_pressure_is_where_pressure_starts(law):
    assert law.clearance_at(jnp.asarray(0.0), SCALE) == law.zero_pressure_clearance


@ALL_LAWS
def test_slope_of_the_inverse_is_the_inverse_slope(law):
    p = jnp.asarray(P0 * np.logspace(-6, 3, 10))
    clearance, slope = jax.jvp(lambda v: law.clearance_at(v, SCALE), (p,), (jnp.ones_like(p),))
    np.testing.assert_allclose(slope * pressure_and_slope(law, clearance)[1], 1.0, atol=FINITE_DIFFERENCE)


@ALL_LAWS
def test_jit_equals_eager_and_vmap_a_loop(law):
    clearance = jnp.asarray(C0 * np.linspace(-7.5, 1.5, 7))
    eager = law.pressure_at(clearance, SCALE)
    np.testing.assert_allclose(jax.jit(lambda g: law.pressure_at(g, SCALE))(clearance), eager, ROUNDOFF)
    np.testing.assert_allclose(jax.vmap(lambda g: law.pressure_at(g, SCALE))(clearance), eager, ROUNDOFF)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.HardOverclosure(0.0), r"HardOverclosure\.stiffness_ratio \[-\] must be positive, got 0\.0\."),
        (lambda: op.LinearOverclosure(-1.0), r"LinearOverclosure\.stiffness \[MPa/mm\] must be positive, got -1\.0\."),
        (lambda: op.LinearOverclosure(np.nan), r"LinearOverclosure\.stiffness \[MPa/mm\] must be positive, got nan\."),
        (lambda: op.ExponentialOverclosure(0.0, 0.01), r"pressure \(p0\) \[MPa\] must be positive, got 0\.0\."),
        (lambda: op.ExponentialOverclosure(2.0, -0.01), r"clearance \(c0\) \[mm\] must be positive, got -0\.01\."),
        (
            lambda: op.TabularOverclosure([0.0], [0.0]),
            r"two lists of one length, at least 2, got shapes \(1,\)",
        ),
        (
            lambda: op.TabularOverclosure([0.1, 0.2], [0.0, -0.1]),
            r"pressure \[MPa\] must rise from 0, got \[0\.1, 0\.2\]\.",
        ),
        (
            lambda: op.TabularOverclosure([0.0, 0.2], [0.0, 0.1]),
            r"clearance \[mm\] must fall .*got \[0\.0, 0\.1\]\. Overcl",
        ),
        (lambda: op.TabularOverclosure([0.0, np.nan], [0.0, -0.1]), r"pressure \[MPa\] must be finite"),
        (lambda: op.ExponentialOverclosure("2", 0.01), r"pressure \(p0\) \[MPa\] must be a number, got '2'\."),
    ],
)
def test_constructor_names_field_unit_and_value(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()
