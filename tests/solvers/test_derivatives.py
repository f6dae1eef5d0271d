"""Derivatives through a solve: against central differences, forward against reverse, jit, vmap.

Central differences solve to 1e-11. The states lie away from kinks: a step of 1e-5 changes no contact
status, else the difference would not agree to the tolerance.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import FINITE_DIFFERENCE, SOLVER

SIZE = (2.0, 2.0)
ACCURATE = op.Newton(rtol=1e-11, increments=4)
STEP = 1e-5
Numbers = dict[str, Any]


def bump(n: int, depth: float = 0.08) -> np.ndarray:
    """One bump off centre on n × n points."""
    y, x = np.meshgrid(np.linspace(0, 2, n), np.linspace(0, 2, n), indexing="ij")
    return depth * np.exp(-(((x - 0.8) / 0.5) ** 2) - ((y - 1.1) / 0.6) ** 2) + 0.03


def measure(solution: op.Solution) -> jax.Array:
    """Weigh every kind of output into one number of order one; no two nodes count the same."""
    total = jnp.zeros(())
    outputs = {
        "pressure": 1e3 * solution.pressure,
        "window": 1e3 * solution.window.pressure,
        "traction": 1e3 * solution.traction,
        "stress": 1e3 * solution.stress_zz,
        "slip": 10.0 * solution.slip,
        "thickness": 10.0 * jnp.where(solution.thickness.mask, 0.0, solution.thickness.values),
        "energy": 1e3 * solution.stats["strain_energy"],
        "dissipation": 1e3 * solution.stats["friction_dissipation"],
        "approach": 1e3 * solution.stats["approach"],
    }
    for seed, field in enumerate(outputs.values()):
        weights = np.random.default_rng(seed).uniform(0.5, 1.5, field.shape)
        total = total + jnp.mean(weights * field)
    return total


def contacts(numbers: Numbers) -> dict[str, op.Contact]:
    return {
        "window": op.Contact(op.HardOverclosure(), numbers["window_friction"]),
        "sample": op.Contact(op.ExponentialOverclosure(numbers["p0"], numbers["c0"]), numbers["sample_friction"]),
    }


def frictional_imprint(numbers: Numbers, settings: op.Newton = ACCURATE) -> op.Solution:
    layer = op.Layer(numbers["L0"], op.MooneyRivlin(numbers["c10"], numbers["c01"], numbers["bulk"]))
    palpation = op.Palpation(layer, numbers["extent"], (8, 8, 2), **contacts(numbers))
    return op.solve(palpation, op.Imprint(op.ThicknessMap(numbers["map"], extent=SIZE)), settings)


def traction_on_a_bonded_layer(numbers: Numbers) -> op.Solution:
    layer = op.Layer(op.ThicknessMap(numbers["L0"], extent=SIZE), op.NeoHooke(numbers["shear"], numbers["bulk"]))
    sample = op.Contact(op.ExponentialOverclosure(2.0, 0.01), numbers["friction"])
    sides = {"x0": "roller", "x1": "free", "y0": "free", "y1": "free"}
    palpation = op.Palpation(layer, SIZE, (4, 4, 2), op.Bonded(), sample, sides=sides)
    return op.solve(palpation, op.Traction(numbers["normal"]), ACCURATE)


def displacement_on_a_spring(numbers: Numbers) -> op.Solution:
    layer = op.Layer(0.5, op.NeoHooke(numbers["shear"], numbers["bulk"]))
    window = op.Contact(op.HardOverclosure(), numbers["friction"])
    palpation = op.Palpation(layer, SIZE, (4, 4, 2), window, op.Roller(), hold=numbers["hold"], element="full")
    return op.solve(palpation, op.Displacement(-numbers["map"]), ACCURATE)


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
    "extent": np.array([1.93, 1.91]),  # so that no node of the mesh lies on a pixel of the map, where it has kinks
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


def forward_and_reverse(f: Callable, numbers: Numbers, direction: Numbers) -> tuple[Any, Any, Numbers]:
    """Value, derivative along a direction, and gradient, of one linearisation."""
    value, along = jax.linearize(f, numbers)
    (gradient,) = jax.linear_transpose(along, numbers)(jnp.ones(()))
    return value, along(direction), gradient


def relative(numbers: Numbers, seed: int) -> Numbers:
    """A random change of every number, of its own size."""
    rng = np.random.default_rng(seed)
    return {name: value * rng.uniform(-1, 1, np.shape(value)) for name, value in numbers.items()}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_equal_central_differences_and_forward_equals_reverse(name):
    case = CASES[name]
    numbers = jax.tree.map(jnp.asarray, case.numbers)

    def f(numbers):
        return measure(case.solve(numbers))

    direction = relative(numbers, 1)
    value, forward, gradient = jax.jit(lambda n, d: forward_and_reverse(f, n, d))(numbers, direction)
    np.testing.assert_allclose(value, f(numbers), SOLVER)
    terms = [float(jnp.vdot(gradient[name], direction[name])) for name in numbers]
    assert abs(sum(terms) - float(forward)) <= 1e-8 * np.abs(terms).sum()
    for number, value in numbers.items():
        change = relative(numbers, 2)[number] if value.ndim else value
        ends = [float(f({**numbers, number: value + sign * STEP * change})) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * STEP)
        expected = float(jnp.vdot(gradient[number], change))
        assert expected == pytest.approx(difference, rel=FINITE_DIFFERENCE, abs=1e-8), number


def test_gradient_of_a_frictionless_layer():
    numbers = {**FRICTIONAL, "window_friction": 0.0, "sample_friction": 0.0}
    numbers = jax.tree.map(jnp.asarray, numbers)

    def mean_pressure(numbers):
        return 1e3 * frictional_imprint(numbers).pressure.mean()

    gradient = jax.grad(mean_pressure)(numbers)
    for number in ("c10", "bulk", "L0", "map"):
        change = 0.5 - bump(41) if number == "map" else numbers[number]
        ends = [float(mean_pressure({**numbers, number: numbers[number] + s * STEP * change})) for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * STEP)
        assert float(jnp.vdot(gradient[number], change)) == pytest.approx(difference, rel=FINITE_DIFFERENCE)


def test_vmap_over_four_materials_equals_the_loop_and_jit_equals_eager():
    numbers = CASES["preload, approach taken out"].numbers

    def gradient(c10):
        return jax.grad(lambda c: 1e3 * corrected_and_continued({**numbers, "c10": c}).pressure.max())(c10)

    materials = jnp.array([1e-3, 2e-3, 4e-3, 8e-3])
    compiled = jax.jit(gradient)
    loop = [compiled(c10) for c10 in materials]
    np.testing.assert_allclose(jax.jit(jax.vmap(gradient))(materials), loop, 1e-6)
    np.testing.assert_allclose(gradient(materials[1]), loop[1], 1e-6)


def test_a_path_too_long_to_record_has_no_derivative():
    numbers = jax.tree.map(jnp.asarray, FRICTIONAL)

    def mean_pressure(c10):
        solution = frictional_imprint({**numbers, "c10": c10}, op.Newton(increments=3, max_path=2))
        return 1e3 * solution.pressure.mean()

    value, gradient = jax.jit(jax.value_and_grad(mean_pressure))(numbers["c10"])
    assert np.isfinite(value)
    assert np.isnan(gradient)
