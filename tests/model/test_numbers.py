"""Numbers of any type become float64 leaves; what is none is refused by the name of its argument."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import ELEMENTS, EXTENT, L0, bumpy_map, published_palpation
from tests.tolerances import ROUNDOFF

LAW = op.ExponentialOverclosure(pressure=2.0, clearance=0.01)
# Exact in half precision, so that every type below holds the same number.
NUMBER = 0.25
MAP = np.full((5, 6), NUMBER)
TYPES = {
    "float32": np.float32,
    "float16": np.float16,
    "big-endian double": lambda v: np.asarray(v, ">f8"),
    "big-endian single": lambda v: np.asarray(v, ">f4"),
    "extended": np.longdouble,
    "jax single": lambda v: jnp.asarray(v, jnp.float32),
    "jax bfloat16": lambda v: jnp.asarray(v, jnp.bfloat16),
}
TAKES_A_NUMBER = {
    "c10": lambda v: op.MooneyRivlin(v, 1e-3, 0.1).c10,
    "neo-hooke": lambda v: op.NeoHooke(v, 5.0).c10,
    "shear of hencky": lambda v: op.Hencky(v, 5.0).shear,
    "bulk": lambda v: op.Yeoh(1e-3, 1e-4, 1e-4, v).bulk,
    "L0": lambda v: op.Layer(v, op.NeoHooke(1e-3, 0.1)).thickness,
    "friction": lambda v: op.Contact(LAW, v).friction,
    "elastic_slip": lambda v: op.Contact(LAW, 0.1, elastic_slip=v).elastic_slip,
    "p0": lambda v: op.ExponentialOverclosure(v, 0.01).pressure,
    "stiffness": lambda v: op.LinearOverclosure(v).stiffness,
    "stiffness_ratio": lambda v: op.HardOverclosure(v).stiffness_ratio,
    "normal": lambda v: op.Traction(v).normal,
    "uz": lambda v: op.Displacement(v).uz,
    "hold": lambda v: published_palpation(hold=v).hold,
    "std of a prior": lambda v: op.Matern(length=1.0, std=v).std,
    "median": lambda v: op.LogNormal(v, 0.1).median,
    "std of a map": lambda v: op.ThicknessMap(MAP, extent=EXTENT, std=v).std,
    "spacing of a map": lambda v: op.ThicknessMap(MAP, spacing=v).spacing[0],
}
TAKES_A_MAP = {
    "map": lambda v: op.ThicknessMap(v, extent=EXTENT).values,
    "std of a map": lambda v: op.ThicknessMap(MAP, extent=EXTENT, std=v).std,
    "normal": lambda v: op.Traction(v).normal,
    "uz": lambda v: op.Displacement(v).uz,
    "mean of a prior": lambda v: op.Matern(length=1.0, std=1e-3, mean=v).mean,
    "c10 of every element": lambda v: op.NeoHooke(v, 5.0).c10,
}


@pytest.mark.parametrize("make", TYPES.values(), ids=TYPES)
@pytest.mark.parametrize("take", TAKES_A_NUMBER.values(), ids=TAKES_A_NUMBER)
def test_a_number_of_any_type_is_float64(take, make, annotations_unchecked):
    leaf = take(make(NUMBER))
    assert leaf.dtype == jnp.float64
    assert leaf == NUMBER


@pytest.mark.parametrize("make", TYPES.values(), ids=TYPES)
@pytest.mark.parametrize("take", TAKES_A_MAP.values(), ids=TAKES_A_MAP)
def test_an_array_of_any_type_is_float64(take, make, annotations_unchecked):
    leaf = take(make(MAP))
    assert leaf.dtype == jnp.float64
    np.testing.assert_array_equal(leaf, MAP)


@pytest.mark.parametrize("kind", ["i2", ">i4", "u1", "int64"])
def test_integers_are_numbers(kind, annotations_unchecked):
    assert op.Displacement(np.zeros((5, 6), kind)).uz.dtype == jnp.float64
    assert op.Contact(LAW, np.ones((), kind)[()]).friction.dtype == jnp.float64


@pytest.mark.parametrize("wrong", ["2", True, None, 1j, [[1.0], [1.0, 2.0]], np.array(["a"]), object()])
def test_what_is_no_number_is_refused_by_name(wrong, annotations_unchecked):
    for make, name in (
        (lambda: op.MooneyRivlin(wrong, 1e-3, 0.1), r"MooneyRivlin\.c10 \[MPa\] must be a number"),
        (lambda: op.Displacement(wrong), r"Displacement\.uz \[mm\] must be a number"),
        (lambda: op.Contact(LAW, wrong), r"Contact\.friction \[-\] must be a number"),
        (lambda: op.ThicknessMap(wrong, extent=EXTENT), r"ThicknessMap\.values \[mm\] must be a number"),
        (lambda: op.Matern(wrong, 1e-3), r"Matern\.length \[mm\] must be a number"),
    ):
        with pytest.raises(ValueError, match=name):
            make()


def test_numbers_stay_traceable():
    """Also in a list, and from a single-precision trace."""
    bulk = jax.grad(lambda v: op.Ogden([v, 1e-3], [2.0, -2.0], 0.1).shear)(1e-3)
    assert bulk == 1.0
    single = jax.jit(lambda v: op.NeoHooke(v, 0.1).c10)(jnp.float32(NUMBER))
    assert single.dtype == jnp.float64


@pytest.mark.parametrize("kind", ["f2", "f4", ">f4", ">f8", "longdouble"])
def test_axes_and_settings_take_any_type(kind, annotations_unchecked):
    data = op.sweep(lambda c10: op.NeoHooke(1e-3 * c10, 5.0).shear, {"c10": np.asarray([NUMBER, 0.5], kind)})
    np.testing.assert_allclose(data.value, [2e-3 * NUMBER, 1e-3], ROUNDOFF)
    assert data.c10.dtype == np.float64
    number = np.asarray(NUMBER, kind)[()]
    assert op.Newton(rtol=number).as_leaves().rtol.dtype == jnp.float64
    explicit = op.Explicit(duration=number, safety=number, increment=number)
    assert {type(v) for v in (explicit.duration, explicit.safety, explicit.increment)} == {float}


def test_every_type_solves_to_the_same_map():
    """float32 numbers that float64 holds exactly change nothing; a float32 map by the rounding of its pixels."""
    single, measured = np.float32, bumpy_map()
    expected = op.solve(published_palpation(NUMBER), op.Imprint(measured))
    rounded = op.ThicknessMap(np.asarray(measured.values, single), extent=np.array(EXTENT, single))
    got = op.solve(
        published_palpation(single(NUMBER), thickness=single(L0), extent=np.array(EXTENT, ">f4")), op.Imprint(rounded)
    )
    scale = float(jnp.max(expected.pressure))
    assert got.pressure.dtype == jnp.float64
    np.testing.assert_allclose(got.pressure, expected.pressure, rtol=0, atol=1e-4 * scale)
    load = op.Traction(np.full((ELEMENTS[1] + 1, ELEMENTS[0] + 1), 2e-3, single))
    assert op.solve(published_palpation(), load).displacement.dtype == jnp.float64


def _single(part):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, part)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda p, i: (_single(p), i), "palpation.layer.thickness"),
        (lambda p, i: (p, _single(i)), "load.thickness.values"),
        (lambda p, i: (dataclasses.replace(p, window=_single(p.window)), i), "palpation.window.law.stiffness_ratio"),
    ],
)
def test_a_solve_names_what_is_single_and_says_to_build_it_again(change, name):
    palpation, load = change(published_palpation(), op.Imprint(bumpy_map()))
    with pytest.raises(ValueError, match=rf"Newton needs float64.*float32 in {name}\. It was made while jax_enable"):
        op.solve(palpation, load)


def test_a_solve_says_how_to_switch_64_bit_numbers_on():
    with jax.enable_x64(False):
        palpation, load = published_palpation(), op.Imprint(bumpy_map())
        with pytest.raises(ValueError, match=r'in palpation\.layer\.thickness\. Before .*jax_enable_x64", True'):
            op.solve(palpation, load)


@pytest.mark.parametrize(
    ("law", "changes"),
    [
        (LAW, {"pressure": 1.0, "clearance": 0.02}),
        (op.TabularOverclosure([0.0, 1.0], [0.01, 0.0]), {"pressure": [0.0, 2.0], "clearance": [0.02, 0.0]}),
        (op.LinearOverclosure(7.0), {"stiffness": 3.0}),
        (op.HardOverclosure(), {"stiffness_ratio": 10.0}),
        (op.Contact(LAW, 0.1, elastic_slip=1e-3), {"friction": 0.2, "elastic_slip": 2e-3}),
        (op.Hencky(1e-3, 0.1), {"shear": 2e-3, "bulk": 0.2}),
        (op.NeoHooke(1e-3, 0.1), {"c10": 2e-3}),
    ],
)
def test_a_field_is_named_like_its_argument(law, changes):
    """So `dataclasses.replace`, `eqx.tree_at` and the paths of sweeps and fits reach it."""
    for name, value in changes.items():
        replaced = dataclasses.replace(law, **{name: value})
        at = eqx.tree_at(lambda part, name=name: getattr(part, name), law, jnp.asarray(value, float))
        np.testing.assert_allclose(getattr(replaced, name), value, ROUNDOFF)
        np.testing.assert_allclose(getattr(at, name), value, ROUNDOFF)
