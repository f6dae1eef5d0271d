"""A layer and a deformable sample pressed together: closed forms, balance, and references of CalculiX."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.solvers.derivative import _solve
from opfem.solvers.experiment import discretise_experiment
from tests.tolerances import OTHER_CODE, ROUNDOFF

SOFT = op.MooneyRivlin(c10=0.00223, c01=0.000703, bulk=0.11732)  # MPa, of the references
PENALTY = 2.0  # MPa/mm
L0, SAMPLE = 0.5, 2.0  # mm


def scaled(ratio):
    return op.MooneyRivlin(c10=ratio * SOFT.c10, c01=ratio * SOFT.c01, bulk=ratio * SOFT.bulk)


def stack(ratio=1.0, sides="roller", elements=(3, 3, (2, 3)), friction=0.0, layer=SOFT):
    return op.Experiment(
        op.Layer(L0, layer),
        op.Sample(SAMPLE, scaled(ratio)),
        extent=(1.0, 1.0),
        elements=elements,
        window=op.Roller(),
        interface=op.Contact(op.LinearOverclosure(PENALTY), friction=friction, stick_slope=0.05),
        plate=op.Roller(),
        sides=sides,
    )


FRICTIONAL = stack(2.0, sides="free", elements=(3, 2, (1, 2)), friction=0.1), op.Compression(0.2)


def confined_stress(strain, material):
    """Nominal stress [MPa] of a block that cannot widen, from its energy."""
    along_z = jnp.zeros((3, 3, 1)).at[2, 2].set(1.0)
    return float(jax.grad(lambda s: material.energy(s * along_z)[0])(strain))


@pytest.fixture(scope="module")
def confined():
    return {
        ratio: op.solve(stack(ratio), op.Compression(0.3 * (L0 + SAMPLE)), op.Newton(rtol=1e-10))
        for ratio in (0.1, 1.0, 10.0, 100.0)
    }


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0, 100.0])
def test_confined_stack_is_two_blocks_and_a_spring_in_series(confined, ratio):
    solution = confined[ratio]
    top, bottom = solution.layer.displacement[2, -1], solution.sample.displacement[2, 0]
    in_layer = confined_stress(top[1, 1] / L0, SOFT)
    in_sample = confined_stress(-(0.75 + bottom[1, 1]) / SAMPLE, scaled(ratio))
    in_spring = -PENALTY * (top - bottom)[1, 1]
    force = solution.stats["force_plate"][2]  # on 1 mm²
    np.testing.assert_allclose([in_layer, in_sample, in_spring], force, rtol=1e-4)
    np.testing.assert_allclose(top, top[0, 0], atol=1e-8)


def test_uniform_pressure_passes_matching_faces_unchanged():
    solution = op.solve(stack(1.0, sides="free"), op.Compression(0.25), op.Newton(rtol=1e-8))
    pressure = np.asarray(solution.pressure)
    np.testing.assert_allclose(pressure, pressure.mean(), rtol=1e-6)


def test_action_is_reaction(confined):
    stats = confined[10.0].stats
    total = stats["force_sample"] + stats["force_window"] + stats["force_hold"]
    assert np.abs(total).max() < 1e-6 * np.abs(stats["force_window"]).max()
    np.testing.assert_allclose(stats["force_plate"][2], stats["force_sample"][2], rtol=1e-6)


def test_forces_between_bodies_are_equal_and_opposite_to_rounding():
    problem = discretise_experiment(*FRICTIONAL, None, "gauss2")
    state = problem.initial_state()
    move = np.array([1e-3, 0.0, -2e-3])[:, None, None, None]  # mm
    x = state.unknowns._replace(u=(state.u[0], state.u[1] + move))
    lower, upper = jax.jit(lambda x: problem.forces(x, jnp.ones(()), state).bodies)(x)
    on_layer, on_sample = lower.applied.sample.total, upper.applied.window.total
    assert np.abs(on_layer[0]) > 1e-2 * np.abs(on_layer[2]) > 0
    np.testing.assert_allclose(on_layer, -on_sample, rtol=0, atol=ROUNDOFF * np.abs(on_layer[2]))


def test_bonded_stack_of_one_material_is_one_block():
    bonded = dataclasses.replace(
        stack(1.0, sides="free", elements=(3, 3, (1, 4))), window=op.Bonded(), interface=op.Bonded(), plate=op.Bonded()
    )
    stacked = op.solve(bonded, op.Compression(0.3))
    block = op.Palpation(op.Layer(L0 + SAMPLE, SOFT), (1.0, 1.0), (3, 3, 5), op.Bonded(), op.Bonded())
    whole = op.solve(block, op.Displacement(jnp.full((4, 4), -0.3), lateral="fixed"))
    np.testing.assert_allclose(stacked.layer.displacement, whole.displacement[:, :2], atol=1e-7)
    np.testing.assert_allclose(stacked.sample.displacement, whole.displacement[:, 1:], atol=1e-7)
    stats = {name: stacked.stats[name] for name in ("force_window", "force_sample", "force_plate")}
    expected = np.array([1.0, -1.0, -1.0]) * whole.stats["force_window"][2]
    np.testing.assert_allclose([force[2] for force in stats.values()], expected, rtol=1e-6)
    np.testing.assert_allclose(stacked.stats["strain_energy"], whole.stats["strain_energy"], rtol=1e-6)


@pytest.mark.parametrize("ratio", [0.2, 5.0])
def test_confined_bonded_stack_is_two_blocks_in_series(ratio):
    bonded = dataclasses.replace(stack(ratio, elements=(3, 3, (1, 4))), interface=op.Bonded())
    solution = op.solve(bonded, op.Compression(0.5))
    top = solution.layer.displacement[2, -1, 1, 1]
    in_layer = confined_stress(top / L0, SOFT)
    in_sample = confined_stress(-(0.5 + top) / SAMPLE, scaled(ratio))
    force = solution.stats["force_plate"][2]  # on 1 mm²
    np.testing.assert_allclose([in_layer, in_sample], force, rtol=1e-6)
    np.testing.assert_allclose(solution.interface.traction[2], force, rtol=1e-6)
    np.testing.assert_allclose(solution.thickness.values, L0 + top, rtol=1e-6)


NUMBERS = {
    "layer_c10": 2.23e-3,  # MPa
    "sample_modulus": 2.0,  # of the layer's
    "inclusion_modulus": 5.0,
    "interface_friction": 0.1,
    "end_friction": 0.15,
    "approach": 0.4,  # mm
}


def pressed_inclusion(numbers, elements, exponential):
    def contact(stiffness, friction):
        if exponential:
            return op.Contact(op.ExponentialOverclosure(2.0, 0.01), friction)
        return op.Contact(op.LinearOverclosure(stiffness), friction, stick_slope=0.05)

    end = contact(5.0, numbers["end_friction"])
    box = op.Box(low=(-0.1, -0.1, 0.2), high=(0.5, 0.6, 1.2))
    sample = op.Sample(SAMPLE, scaled(numbers["sample_modulus"]))
    experiment = op.Experiment(
        op.Layer(L0, dataclasses.replace(SOFT, c10=numbers["layer_c10"])),
        sample.with_inclusion(box, scaled(numbers["inclusion_modulus"])),
        extent=(1.0, 1.2),
        elements=elements,
        window=end,
        interface=contact(PENALTY, numbers["interface_friction"]),
        plate=end,
    )
    # Programs that may raise are not kept on disk.
    return op.solve(experiment, op.Compression(numbers["approach"]), op.Newton(rtol=1e-11, increments=4), throw=False)


@partial(jax.jit, static_argnums=(2, 3), compiler_options=op.compiler_options())
def linearised(numbers, direction, elements=(3, 2, (1, 2)), exponential=False):
    """Mean interface pressure [kPa] and thickness along a direction [mm], their derivatives, and both's gradients."""

    def measures(numbers):
        solution = pressed_inclusion(numbers, elements, exponential)
        weights = np.random.default_rng(0).uniform(0.5, 1.5, solution.thickness.shape)
        return jnp.stack([1e3 * jnp.mean(solution.pressure), jnp.sum(weights * solution.thickness.values)])

    values, along = jax.linearize(measures, numbers)
    transpose = jax.linear_transpose(along, numbers)
    return values, along(direction), jax.lax.map(lambda one: transpose(one)[0], jnp.eye(2))


def assert_derivatives_agree(name, **case):
    """Forward and reverse to ten times their linear solves, central differences to 1e-4."""
    numbers = {key: jnp.asarray(value) for key, value in NUMBERS.items()}
    direction = {key: value * (key == name) for key, value in numbers.items()}
    _, forward, gradients = linearised(numbers, direction, **case)
    np.testing.assert_allclose(numbers[name] * gradients[name], forward, rtol=1e-8)
    ends = [linearised({**numbers, name: (1.0 + h) * numbers[name]}, direction, **case)[0] for h in (1e-4, -1e-4)]
    np.testing.assert_allclose((ends[0] - ends[1]) / 2e-4, forward, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.timeout(1500)  # its program compiles for minutes
@pytest.mark.parametrize("name", NUMBERS)
def test_derivatives_equal_central_differences_and_forward_equals_reverse(name):
    assert_derivatives_agree(name)


@pytest.mark.slow
@pytest.mark.timeout(1500)  # its program compiles for minutes
@pytest.mark.parametrize("name", NUMBERS)
def test_derivatives_of_a_finer_experiment_with_the_exponential_law(name):
    assert_derivatives_agree(name, elements=(8, 8, (2, 4)), exponential=True)


@jax.jit
def forward_and_transposed(problem, x, held, b, c):
    """Solve the linear systems of a derivative, forward with b and transposed with c."""
    state, full = problem.initial_state(), jnp.ones(())
    settings = dataclasses.replace(op.Newton().as_leaves(), krylov_rtol=jnp.asarray(1e-5))

    def balance(x):
        return problem.balance(x, full, state, held)

    def solved(transposed, product, right):
        tangent = problem.tangent(x, full, state, None, transposed)
        return _solve(problem, tangent, False, held, product, right, jnp.asarray(True), settings)

    across = jax.vjp(balance, x)[1]
    return solved(False, lambda v: jax.jvp(balance, (x,), (v,))[1], b), solved(True, lambda v: across(v)[0], c)


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_linear_systems_of_a_stack_that_nothing_rigid_holds_are_solved_forward_and_transposed(friction):
    """Between frictionless ends, by the hold of both bodies, and of the lower one once the other rubs on it."""
    experiment = stack(2.0, sides="free", elements=(3, 2, (1, 2)), friction=friction)
    problem = discretise_experiment(experiment, op.Compression(0.2), None, "gauss2")
    start = problem.initial_state().unknowns
    moves = (np.array([0.0, 0.0, 0.0]), np.array([1e-3, 0.0, -2e-3]))  # mm: a pressure of 4 kPa, sticking and sliding
    x = start._replace(u=tuple(u + move[:, None, None, None] for u, move in zip(start.u, moves, strict=True)))
    rng = np.random.default_rng(0)
    b, c = (jax.tree.map(lambda v: jnp.asarray(rng.standard_normal(v.shape)), x) for _ in range(2))
    forward, transposed = forward_and_transposed(problem, x, jnp.asarray(friction == 0.0), b, c)
    products = [jax.tree.map(jnp.vdot, *pair) for pair in ((c, forward), (b, transposed))]
    ours, theirs = (sum(jax.tree.leaves(product)) for product in products)
    np.testing.assert_allclose(ours, theirs, rtol=1e-8)


def law(numbers):
    return op.MooneyRivlin(c10=numbers["C10"], c01=numbers["C01"], bulk=numbers["bulk"])


def side(stated):
    if isinstance(stated, str):
        return {"roller": op.Roller(), "bonded": op.Bonded(), "tied": op.Bonded()}[stated]
    return op.Contact(op.LinearOverclosure(stated["k"]), stated["mu"], stick_slope=stated["lam"])


def referenced(case):
    """Build the experiment of a reference, on its mesh."""
    geometry, counts = case["geometry"], case["mesh"]
    (x0, x1), (y0, y1) = geometry["x"], geometry["y"]
    sides = dict.fromkeys(("y0", "y1"), "roller") if case["plane_strain_slice"] else {}
    sides |= {"x0" if x == x0 else "x1": "roller" for x in case["ux_zero_at_x"]}
    sides |= {"y0" if y == y0 else "y1": "roller" for y in case["uy_zero_at_y"]}
    nx, ny, nz = counts["layer"]
    thickness = geometry.get("H_sample", SAMPLE)
    if "cos" in geometry["surface"]:  # the crests start 0.2 µm inside the layer
        x = np.linspace(x0, x1, nx + 1)
        ridges = geometry["z_plate"] - L0 - 0.125 * (1.0 - np.cos(1.8 * np.pi * x)) + 2e-4
        thickness = op.ThicknessMap(np.stack([ridges, ridges]), extent=(x1 - x0, y1 - y0))
    sample = op.Sample(thickness, law(case["materials"][0]))
    if "x>2.5" in case["material_of"]:
        sample = sample.with_inclusion(op.HalfSpace((2.5, 0.0, 0.0), (1.0, 0.0, 0.0)), law(case["materials"][1]))
    elif "x<0.5" in case["material_of"]:
        box = op.Box(low=(-0.5, -0.5, 0.25), high=(0.5, 0.5, 1.25))
        sample = sample.with_inclusion(box, law(case["materials"][1]))
    return op.Experiment(
        op.Layer(geometry["H_layer"], law(case["materials"][0])),
        sample,
        extent=(x1 - x0, y1 - y0),
        elements=(nx, ny, (nz, counts["sample"][2])),
        window=side(case["window"]),
        interface=side(case["interface"]),
        plate=side(case["plate"]),
        sides=sides,
        element="full",
    )


@pytest.mark.parametrize(
    "name",
    [
        "ridge_slice_C3D8_n20_roller_mu0",
        "incl_box_bonded_tied_C3D8_n10",
        pytest.param("col_slice_C3D8_n40_k2", marks=pytest.mark.slow),
        pytest.param("incl_box_bonded_tied_C3D8_n20", marks=pytest.mark.slow),
        pytest.param("incl_box_roller_contact_C3D8_n10", marks=pytest.mark.slow),
        pytest.param("incl_box_roller_tied_C3D8_n20", marks=pytest.mark.slow),
        pytest.param("ridge_slice_C3D8_n20_bonded_mu0.1", marks=pytest.mark.slow),
        pytest.param("ridge_slice_C3D8_n40_roller_mu0", marks=pytest.mark.slow),
    ],
)
def test_calculix_gives_the_same_force_on_the_same_mesh(shared, name):
    """Its C3D8 is plain full integration; its faces are flat between nodes where opfem's are smooth: 1 %; tied 1e-4."""
    case = json.loads((shared / "reference" / "pairs" / f"{name}.json").read_text())
    forces = case["results"]["forces_N"]
    (expected,) = (force[2] for key, force in forces.items() if key.startswith("window_reaction"))
    solution = op.solve(referenced(case), op.Compression(case["delta"]))
    tolerance = 1e-4 if "tied" in name else OTHER_CODE
    np.testing.assert_allclose(solution.stats["force_window"][2], expected, rtol=tolerance)
