"""Derivatives through a solve: against central differences, forward against reverse, jit, vmap.

Central differences solve to 1e-11. The states lie away from kinks: the step changes no contact status,
else the difference would not agree to the tolerance.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import FINITE_DIFFERENCE, SOLVER

SIZE = (2.0, 2.0)
ACCURATE = op.Newton(rtol=1e-11, increments=4)
# The best one counts: a small one passes no kink and has little curvature, a large one drowns the solver's own error.
STEPS = (3e-6, 1e-5, 1e-4)
Numbers = dict[str, Any]


def bump(n: int, depth: float = 0.08) -> np.ndarray:
    """One bump off centre on n × n points."""
    y, x = np.meshgrid(np.linspace(0, 2, n), np.linspace(0, 2, n), indexing="ij")
    return depth * np.exp(-(((x - 0.8) / 0.5) ** 2) - ((y - 1.1) / 0.6) ** 2) + 0.03


def measure(solution: op.Solution) -> jax.Array:
    """Weigh every kind of output into one number of order one; no two nodes count the same."""
    total = jnp.zeros(())
    rim = solution.thickness.shape[0] // 8  # pixels there may leave the layer, all at once
    outputs = {
        "pressure": 1e3 * solution.pressure,
        "window": 1e3 * solution.window.pressure,
        "traction": 1e3 * solution.traction,
        "stress": 1e3 * solution.stress_zz,
        "slip": 10.0 * solution.slip,
        "thickness": 10.0 * solution.thickness.values[rim : -rim or None, rim : -rim or None],
        "energy": 1e3 * solution.stats["strain_energy"],
        "dissipation": 1e3 * solution.stats["friction_dissipation"],
        "approach": 1e3 * solution.stats["approach"],
    }
    for seed, field in enumerate(outputs.values()):
        weights = np.random.default_rng(seed).uniform(0.5, 1.5, field.shape)
        total = total + jnp.mean(weights * field)
    return total


def contacts(numbers: Numbers) -> dict[str, op.Contact]:
    law = op.ExponentialOverclosure(numbers["p0"], numbers["c0"]) if "p0" in numbers else op.HardOverclosure(exact=True)
    return {
        "window": op.Contact(op.HardOverclosure(), numbers["window_friction"]),
        "sample": op.Contact(law, numbers["sample_friction"]),
    }


def frictional_imprint(numbers: Numbers, element: str = "mean_dilatation") -> op.Solution:
    layer = op.Layer(numbers["L0"], op.MooneyRivlin(numbers["c10"], numbers["c01"], numbers["bulk"]))
    palpation = op.Palpation(layer, numbers["extent"], (8, 8, 2), **contacts(numbers), element=element)
    return op.solve(palpation, op.Imprint(op.ThicknessMap(numbers["map"], extent=SIZE)), ACCURATE)


def traction_on_a_bonded_layer(numbers: Numbers) -> op.Solution:
    layer = op.Layer(op.ThicknessMap(numbers["L0"], extent=SIZE), op.NeoHooke(numbers["shear"], numbers["bulk"]))
    sample = op.Contact(op.ExponentialOverclosure(2.0, 0.01), numbers["friction"])
    sides = {"x0": "roller", "x1": "free", "y0": "free", "y1": "free"}
    palpation = op.Palpation(layer, SIZE, (4, 4, 2), op.Bonded(), sample, sides=sides)
    return op.solve(palpation, op.Traction(numbers["normal"]), ACCURATE)


def displacement_on_a_spring(numbers: Numbers, settings: op.Newton = ACCURATE) -> op.Solution:
    layer = op.Layer(0.5, op.NeoHooke(numbers["shear"], numbers["bulk"]))
    window = op.Contact(op.HardOverclosure(), numbers["friction"])
    palpation = op.Palpation(layer, SIZE, (4, 4, 2), window, op.Roller(), hold=numbers["hold"], element="full")
    return op.solve(palpation, op.Displacement(-numbers["map"]), settings)


def corrected_and_continued(numbers: Numbers) -> op.Solution:
    """A preload, then another map with the approach taken out, both with rollers that hold the layer."""
    layer = op.Layer(0.5, op.MooneyRivlin(numbers["c10"], 7.03e-4, 0.11612))
    palpation = op.Palpation(layer, SIZE, (4, 4, 2), **contacts(numbers), sides="roller")
    preload = op.Imprint(op.ThicknessMap(0.5 - 0.5 * numbers["map"], extent=SIZE))
    actuation = op.Imprint(op.ThicknessMap(0.5 - numbers["map"], extent=SIZE), correct_approach=True)
    two = op.Newton(rtol=1e-11, increments=2)
    return op.solve(palpation, actuation, two, start=op.solve(palpation, preload, two))


class Case(NamedTuple):
    solve: Callable[[Numbers], op.Solution]
    numbers: Numbers


CONTACT = {"window_friction": 0.15, "sample_friction": 0.05, "p0": 2.0, "c0": 0.01}
FRICTIONAL = {
    "L0": 0.5,
    "c10": 2.2e-3,
    "c01": 7.03e-4,
    "bulk": 0.11612,
    "extent": np.array([1.957, 1.973]),  # keeps nodes off the pixels of the map and pixels off nodes: kinks
    "map": 0.5 - bump(41),
    **CONTACT,
}
CASES = {
    "friction on both sides": Case(frictional_imprint, FRICTIONAL),
    "traction on a bonded layer": Case(
        traction_on_a_bonded_layer,
        {"L0": 0.5 + 0.2 * bump(5), "shear": 5.8e-3, "bulk": 0.116, "friction": 0.2, "normal": 0.05 * bump(5)},
    ),
    "displacement on a spring": Case(
        displacement_on_a_spring, {"shear": 5.8e-3, "bulk": 0.116, "friction": 0.1, "hold": 0.01, "map": bump(5)}
    ),
    "preload, approach taken out": Case(corrected_and_continued, {"c10": 2.2e-3, "map": bump(21), **CONTACT}),
}
CASES["hard contact"] = Case(frictional_imprint, {k: v for k, v in FRICTIONAL.items() if k not in ("p0", "c0")})
CASES["hybrid"] = Case(partial(frictional_imprint, element="hybrid"), FRICTIONAL)
# Without the map: its difference passes a kink at a step of 1e-4 and is 4e-5 off at 1e-5.
CASES["tet10"] = Case(
    lambda numbers: frictional_imprint({**FRICTIONAL, **numbers}, element="tet10"),
    {name: FRICTIONAL[name] for name in ("L0", "c10", "c01", "bulk", "extent")},
)
CASES["no friction"] = Case(frictional_imprint, {**FRICTIONAL, "window_friction": 0.0, "sample_friction": 0.0})


@partial(jax.jit, static_argnums=0, compiler_options=op.compiler_options())
def forward_and_reverse(
    solve: Callable[[Numbers], op.Solution], numbers: Numbers, direction: Numbers
) -> tuple[jax.Array, jax.Array, Numbers]:
    """Value, derivative along a direction, and gradient, of one linearisation."""
    value, along = jax.linearize(lambda n: measure(solve(n)), numbers)
    (gradient,) = jax.linear_transpose(along, numbers)(jnp.ones(()))
    return value, along(direction), gradient


def relative(numbers: Numbers, seed: int) -> Numbers:
    """A random change of every number, of its own size."""
    rng = np.random.default_rng(seed)
    return {name: value * rng.uniform(-1, 1, np.shape(value)) for name, value in numbers.items()}


def difference(solve: Callable[[Numbers], op.Solution], numbers: Numbers, change: Numbers, step: float) -> float:
    """Central difference when numbers change together."""
    ends = [
        float(measure(solve({**numbers, **{name: numbers[name] + sign * step * v for name, v in change.items()}})))
        for sign in (1, -1)
    ]
    return (ends[0] - ends[1]) / (2 * step)


def assert_forward_equals_reverse(forward, gradient: Numbers, direction: Numbers, rtol: float = 1e-8):
    """Linear solves end at 1e-10."""
    terms = [float(jnp.vdot(gradient[number], direction[number])) for number in gradient]
    assert abs(sum(terms) - float(forward)) <= rtol * np.abs(terms).sum()


def assert_is_a_central_difference(derivative, solve, numbers: Numbers, change: Numbers):
    differences = []
    for step in STEPS:
        differences.append(difference(solve, numbers, change, step))
        if differences[-1] == pytest.approx(float(derivative), rel=FINITE_DIFFERENCE, abs=1e-8):
            return
    pytest.fail(f"{', '.join(change)}: derivative {derivative}, central differences {differences}")


def test_derivative_along_a_direction_equals_central_differences_and_forward_equals_reverse():
    """All numbers change together, each by its own size; one at a time below."""
    solve, numbers = CASES["friction on both sides"]
    numbers = jax.tree.map(jnp.asarray, numbers)
    direction = relative(numbers, 1)
    value, forward, gradient = forward_and_reverse(solve, numbers, direction)
    np.testing.assert_allclose(value, measure(solve(numbers)), SOLVER)
    assert_forward_equals_reverse(forward, gradient, direction)
    assert_is_a_central_difference(forward, solve, numbers, direction)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_derivatives_equal_central_differences_and_forward_equals_reverse(name):
    solve, numbers = CASES[name]
    numbers = jax.tree.map(jnp.asarray, numbers)
    direction = relative(numbers, 1)
    value, forward, gradient = forward_and_reverse(solve, numbers, direction)
    np.testing.assert_allclose(value, measure(solve(numbers)), SOLVER)
    # Hard contact carries pressure: the error of a gap, times 100 stiffnesses.
    assert_forward_equals_reverse(forward, gradient, direction, 1e-7 if name == "hard contact" else 1e-8)
    for number, value in numbers.items():
        if name == "no friction" and number.endswith("friction"):
            continue  # friction cannot be negative
        change = relative(numbers, 2)[number] if value.ndim else value
        assert_is_a_central_difference(jnp.vdot(gradient[number], change), solve, numbers, {number: change})


@pytest.mark.slow
def test_taylor_remainders_fall_with_the_order_of_the_derivatives_taken_away():
    """docs/validation.md test 37, second derivatives included: halving the step divides remainders by 2, 4 and 8."""
    solve, numbers = CASES["traction on a bonded layer"]

    @partial(jax.jit, compiler_options=op.compiler_options())
    def derivatives(numbers, direction):
        def along(t):
            return measure(solve({name: value + t * direction[name] for name, value in numbers.items()}))

        def slope(t):
            return jax.jvp(along, (t,), (1.0,))

        (value, first), (_, second) = jax.jvp(slope, (0.0,), (1.0,))
        return value, first, second

    for number, start in numbers.items():
        change = relative(numbers, 3)[number] if np.ndim(start) else start
        direction = {name: np.zeros(np.shape(other)) for name, other in numbers.items()} | {number: change}
        value, first, second = derivatives(numbers, direction)
        remainders = []
        for t in (0.005, 0.0025):
            off = measure(solve({**numbers, number: start + t * change})) - value
            remainders.append([off, off - t * first, off - t * first - 0.5 * t**2 * second])
        slopes = np.log2(np.abs(remainders[0]) / np.abs(remainders[1]))
        assert np.all(slopes > [0.95, 1.95, 2.95]), (number, slopes, remainders)


@pytest.mark.slow
def test_vmap_over_four_materials_equals_the_loop_and_jit_equals_eager():
    numbers = CASES["displacement on a spring"].numbers

    def gradient(shear):
        return jax.grad(lambda s: 1e3 * displacement_on_a_spring({**numbers, "shear": s}).pressure.max())(shear)

    materials = jnp.array([2e-3, 4e-3, 8e-3, 16e-3])
    compiled = jax.jit(gradient, compiler_options=op.compiler_options())
    loop = [compiled(shear) for shear in materials]
    np.testing.assert_allclose(
        jax.jit(jax.vmap(gradient), compiler_options=op.compiler_options())(materials), loop, 1e-6
    )
    np.testing.assert_allclose(gradient(materials[1]), loop[1], 1e-6)


@pytest.mark.slow
def test_a_path_too_long_to_record_has_no_derivative():
    numbers = CASES["displacement on a spring"].numbers

    def mean_pressure(shear):
        solution = displacement_on_a_spring({**numbers, "shear": shear}, op.Newton(increments=3, max_path=2))
        return 1e3 * solution.pressure.mean()

    value, gradient = jax.jit(jax.value_and_grad(mean_pressure), compiler_options=op.compiler_options())(5.8e-3)
    assert np.isfinite(value)
    assert np.isnan(gradient)


@pytest.mark.slow
def test_gradient_of_ogden_equals_that_of_mooney_rivlin():
    def measured(material):
        layer = op.Layer(0.5, material)
        palpation = op.Palpation(layer, SIZE, (4, 4, 2), **contacts(CONTACT))
        return measure(op.solve(palpation, op.Imprint(op.ThicknessMap(0.5 - bump(21), extent=SIZE)), ACCURATE))

    bulk = 0.11612
    value, slope = jax.value_and_grad(lambda c: measured(op.MooneyRivlin(c, 7.03e-4, bulk)))(2.2e-3)
    twin = jax.value_and_grad(lambda c: measured(op.Ogden([2 * c, 2 * 7.03e-4], [2.0, -2.0], bulk)))(2.2e-3)
    np.testing.assert_allclose(twin, (value, slope), SOLVER)
