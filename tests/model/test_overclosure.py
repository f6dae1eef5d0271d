"""Pressure–overclosure laws against closed forms and table E of VALIDATION.md."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

P0, C0 = 2.0, 0.01
LAW = op.ExponentialOverclosure(pressure=P0, clearance=C0)
SCALE = jnp.asarray(0.5)
ALL_LAWS = pytest.mark.parametrize(
    "law", [op.HardOverclosure(), op.LinearOverclosure(7.0), LAW], ids=["hard", "linear", "exponential"]
)
EPS = np.finfo(float).eps
# Overclosure, in units of c0, where the docstring says that the tangent takes over.
TANGENT_FROM = 6.0


def pressure_and_slope(law, clearance):
    clearance = jnp.asarray(clearance, float)
    return jax.jvp(lambda g: law.pressure(g, SCALE), (clearance,), (jnp.ones_like(clearance),))


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
def test_exponential_law_equals_table_e(c, p, slope):
    got, derivative = pressure_and_slope(LAW, c * C0)
    np.testing.assert_allclose([got / P0, -C0 * derivative / P0], [p, slope], rtol=0, atol=1e-6)


def test_exponential_law_equals_its_closed_form():
    clearance = C0 * np.linspace(-8.0, 2.0, 401)
    got, derivative = pressure_and_slope(LAW, clearance)
    p, slope = exponential(clearance)
    np.testing.assert_allclose(got, p, ROUNDOFF, ROUNDOFF * P0)
    np.testing.assert_allclose(derivative, slope, ROUNDOFF, ROUNDOFF * P0 / C0)


@pytest.mark.parametrize(("where", "slope"), [(1.0, 0.0), (-TANGENT_FROM, (8 * np.exp(7) - 1) / (np.e - 1))])
def test_exponential_law_has_one_slope_at_its_joints(where, slope):
    steps = 1e-7 * np.array([-1.0, 0.0, 1.0])
    p, derivative = pressure_and_slope(LAW, C0 * (where + steps))
    np.testing.assert_allclose(-C0 / P0 * derivative, slope, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(p / P0, exponential(C0 * where)[0] / P0, rtol=1e-6, atol=1e-6)


def test_exponential_law_ends_at_its_clearance():
    assert LAW.zero_pressure_clearance == C0
    assert LAW.pressure(jnp.asarray(C0), SCALE) == 0.0
    assert LAW.pressure(jnp.asarray(C0 * (1 - 1e-6)), SCALE) > 0.0


@ALL_LAWS
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_laws_are_finite_a_thousand_clearances_away(law, side):
    far = jnp.asarray(side * 1e3 * C0)
    p, slope = pressure_and_slope(law, far)
    assert np.isfinite(p)
    assert np.isfinite(slope)
    assert (p > 0 and slope < 0) if side < 0 else (p == 0 and slope == 0)
    by_law = jax.grad(lambda model: model.pressure(far, SCALE))(law)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_law))


@ALL_LAWS
def test_slope_equals_a_central_difference(law):
    clearance = C0 * np.array([-7.5, -3.0, -0.2, 0.3, 0.8, 1.5])
    step = 1e-6 * C0
    difference = (
        law.pressure(jnp.asarray(clearance + step), SCALE) - law.pressure(jnp.asarray(clearance - step), SCALE)
    ) / (2 * step)
    slope = pressure_and_slope(law, clearance)[1]
    np.testing.assert_allclose(slope, difference, FINITE_DIFFERENCE, FINITE_DIFFERENCE * np.abs(slope).max())


def test_linear_and_hard_laws_are_lines():
    clearance = jnp.array([-0.02, -0.01, 0.01])
    np.testing.assert_allclose(op.LinearOverclosure(7.0).pressure(clearance, SCALE), [0.14, 0.07, 0.0], ROUNDOFF)
    hard = op.HardOverclosure(stiffness_ratio=20.0).pressure(clearance, SCALE)
    np.testing.assert_allclose(hard, [0.2, 0.1, 0.0], ROUNDOFF)
    assert op.HardOverclosure().zero_pressure_clearance == 0.0
    assert op.LinearOverclosure(7.0).zero_pressure_clearance == 0.0


@pytest.mark.parametrize("law", [op.HardOverclosure(), op.LinearOverclosure(7.0)], ids=["hard", "linear"])
def test_a_point_that_just_touches_is_held(law):
    p, slope = pressure_and_slope(law, 0.0)
    assert p == 0.0
    assert slope == pressure_and_slope(law, -1e-3)[1]


@ALL_LAWS
def test_clearance_is_the_inverse_of_pressure_over_twelve_decades(law):
    p = P0 * np.logspace(-8, 4, 97)
    clearance = law.clearance(jnp.asarray(p), SCALE)
    # Near c0 a clearance has lost the digits of s = 1 - g/c0, the distance that makes pressure.
    lost = 4 * EPS / np.sqrt(p * (np.e - 1) / P0) if law is LAW else 0.0
    np.testing.assert_allclose(law.pressure(clearance, SCALE) / p, 1.0, rtol=0, atol=np.max(ROUNDOFF + lost))
    error = np.abs(np.asarray(law.pressure(clearance, SCALE)) / p - 1)
    assert np.all(error <= ROUNDOFF + lost)


def test_clearance_of_the_exponential_law_at_ten_kpa():
    np.testing.assert_allclose(LAW.clearance(jnp.asarray(0.01), SCALE), 9.094e-3, atol=0.5e-6)


@ALL_LAWS
def test_clearance_of_no_pressure_is_where_pressure_starts(law):
    assert law.clearance(jnp.asarray(0.0), SCALE) == law.zero_pressure_clearance


@ALL_LAWS
def test_slope_of_the_inverse_is_the_inverse_slope(law):
    p = jnp.asarray(P0 * np.logspace(-6, 3, 10))
    clearance, slope = jax.jvp(lambda v: law.clearance(v, SCALE), (p,), (jnp.ones_like(p),))
    np.testing.assert_allclose(slope * pressure_and_slope(law, clearance)[1], 1.0, atol=FINITE_DIFFERENCE)


@ALL_LAWS
def test_jit_equals_eager_and_vmap_a_loop(law):
    clearance = jnp.asarray(C0 * np.linspace(-7.5, 1.5, 7))
    eager = law.pressure(clearance, SCALE)
    np.testing.assert_allclose(jax.jit(lambda g: law.pressure(g, SCALE))(clearance), eager, ROUNDOFF)
    np.testing.assert_allclose(jax.vmap(lambda g: law.pressure(g, SCALE))(clearance), eager, ROUNDOFF)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.HardOverclosure(0.0), r"HardOverclosure\.stiffness_ratio \[-\] must be positive, got 0\.0\."),
        (lambda: op.LinearOverclosure(-1.0), r"LinearOverclosure\.stiffness \[MPa/mm\] must be positive, got -1\.0\."),
        (lambda: op.LinearOverclosure(np.nan), r"LinearOverclosure\.stiffness \[MPa/mm\] must be positive, got nan\."),
        (lambda: op.ExponentialOverclosure(0.0, 0.01), r"pressure \(p0\) \[MPa\] must be positive, got 0\.0\."),
        (lambda: op.ExponentialOverclosure(2.0, -0.01), r"clearance \(c0\) \[mm\] must be positive, got -0\.01\."),
        (lambda: op.ExponentialOverclosure("2", 0.01), r"pressure \(p0\) \[MPa\] must be a number, got '2'\."),
    ],
)
def test_constructor_names_field_unit_and_value(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()
