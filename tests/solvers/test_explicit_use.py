"""Explicit dynamics in use: derivatives, checkpoints, continuation, other loads and labelled results."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import MATERIAL, bumpy_map, published_palpation

EXPLICIT_DERIVATIVE = 1e-4
"""A central difference against a derivative through two thousand increments."""


def palpation(c10=MATERIAL.c10, friction=0.15, **options) -> op.Palpation:
    material = op.MooneyRivlin(c10, MATERIAL.c01, MATERIAL.bulk)
    return published_palpation(friction, options.pop("sample", 0.3 * friction), material, **options)


QUICK = op.Explicit(duration=0.05)


def mean_pressure(steps: int):
    def evaluate(c10, friction):
        solver = op.Explicit(duration=steps * 5e-5, increment=5e-5, output_every=steps * 5e-5 / 4)
        return op.solve(palpation(c10, friction), op.Imprint(bumpy_map()), solver, throw=False).pressure.mean()

    return evaluate


@pytest.mark.slow
def test_gradient_through_two_thousand_increments():
    """By C10 and friction; away from switches, differences of one part in 1e5 see none."""
    evaluate = mean_pressure(2000)
    at = (MATERIAL.c10, 0.15)
    gradient = jax.jit(jax.grad(evaluate, (0, 1)), compiler_options=op.compiler_options())(*at)
    value = jax.jit(evaluate)
    for k in range(2):
        move = np.zeros(2)
        move[k] = 1e-5 * at[k]
        difference = (value(*(at + move)) - value(*(at - move))) / (2 * move[k])
        np.testing.assert_allclose(gradient[k], difference, rtol=EXPLICIT_DERIVATIVE)
        forward = jax.jit(lambda direction: jax.jvp(evaluate, at, direction)[1])(tuple(jnp.asarray(move)))
        np.testing.assert_allclose(forward, gradient[k] * move[k], rtol=1e-9)


@pytest.mark.slow
def test_memory_of_the_gradient_grows_like_the_root_of_the_increments():
    def temporary(steps):
        lowered = jax.jit(jax.grad(mean_pressure(steps), (0, 1))).lower(MATERIAL.c10, 0.15)
        return lowered.compile().memory_analysis().temp_size_in_bytes

    few, many = temporary(500), temporary(8000)
    assert many < 1.2 * few * np.sqrt(8000 / 500)


def test_traced_solve_gives_what_the_host_loop_gives():
    solver = op.Explicit(duration=0.02, increment=5e-5, output_every=0.01)
    plain = op.solve(palpation(), op.Imprint(bumpy_map()), solver, throw=False)
    traced = jax.jit(lambda c10: op.solve(palpation(c10), op.Imprint(bumpy_map()), solver, throw=False))(MATERIAL.c10)
    assert int(traced.stats["increments"]) >= int(plain.stats["increments"])
    np.testing.assert_allclose(traced.displacement, plain.displacement, atol=2e-3 * 0.11)


def test_springs_behind_a_traction_are_refused():
    with pytest.raises(ValueError, match=r"Explicit takes dead loads.*Traction\.stiffness \[MPa/mm\]"):
        op.solve(palpation(), op.Traction(1e-3, stiffness=0.1), QUICK)


def test_traced_solve_needs_an_increment():
    with pytest.raises(ValueError, match=r"Explicit\.increment"):
        jax.jit(lambda c10: op.solve(palpation(c10), op.Imprint(bumpy_map()), QUICK).pressure)(MATERIAL.c10)


class KilledError(Exception):
    pass


def test_killed_run_goes_on_with_the_same_bits(tmp_path):
    whole = op.solve(palpation(), op.Imprint(bumpy_map()), QUICK)
    path = tmp_path / "run.npz"

    class Dies(op.Checkpoint):
        def keep(self, inputs, state):
            super().keep(inputs, state)
            if int(state[-1]) == 7:
                raise KilledError

    with pytest.raises(KilledError):
        op.solve(palpation(), op.Imprint(bumpy_map()), dataclasses.replace(QUICK, checkpoint=Dies(path)))
    kept = dataclasses.replace(QUICK, checkpoint=op.Checkpoint(path))
    resumed = op.solve(palpation(), op.Imprint(bumpy_map()), kept)
    for name in ("displacement", "pressure", "slip"):
        assert bool(jnp.all(getattr(resumed, name) == getattr(whole, name)))
    for name, values in whole.stats.items():
        np.testing.assert_array_equal(resumed.stats[name], values)
    with pytest.raises(ValueError, match="other inputs"):
        op.solve(palpation(friction=0.2), op.Imprint(bumpy_map()), kept)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="damaged"):
        op.solve(palpation(), op.Imprint(bumpy_map()), kept)


def test_start_continues_with_history():
    """A preload and an actuation by a micrometre, against the implicit solver on the same two steps."""
    first, second = op.Imprint(bumpy_map()), op.Imprint(bumpy_map(0.081))
    slow = op.Explicit(duration=0.1)
    moves, results = {}, {}
    for name, solver in (("explicit", slow), ("implicit", op.Newton(face_rule="nodes"))):
        preload = op.solve(palpation(), first, solver)
        results[name] = op.solve(palpation(), second, solver, start=preload)
        moves[name] = np.asarray(results[name].displacement - preload.displacement)
    axial = {name: move[2] for name, move in moves.items()}
    error = np.linalg.norm(axial["explicit"] - axial["implicit"]) / np.linalg.norm(axial["implicit"])
    assert error < 0.03
    assert 5e-4 < -axial["explicit"].min() < 2e-3
    with pytest.raises(ValueError, match="comes from Newton"):
        op.solve(palpation(), second, slow, start=results["implicit"])
    with pytest.raises(ValueError, match="comes from Explicit"):
        op.solve(palpation(), second, op.Newton(), start=results["explicit"])


@pytest.mark.parametrize(
    ("load", "options"),
    [
        (op.Traction(2e-3), {}),
        pytest.param(op.Traction(2e-3, lateral=np.zeros((2, 7, 7))), {}, marks=pytest.mark.slow),
        pytest.param(op.Displacement(-0.05, lateral="fixed"), {"sample": op.Bonded()}, marks=pytest.mark.slow),
        pytest.param(
            op.Displacement(-0.05, lateral="free"), {"sample": op.Roller(), "sides": "roller"}, marks=pytest.mark.slow
        ),
    ],
)
def test_other_loads_agree_with_statics(load, options):
    """Damped: nothing else slows what a dead load has set in motion."""
    static = op.solve(palpation(**options), load, op.Newton(face_rule="nodes"))
    moving = op.solve(palpation(**options), load, op.Explicit(duration=0.2, damping=200.0))
    error = np.linalg.norm(moving.displacement - static.displacement) / np.linalg.norm(static.displacement)
    assert error < 0.01
    np.testing.assert_allclose(moving.stats["force_sample"][2], static.stats["force_sample"][2], rtol=0.01)
    assert float(moving.stats["energy_drift"]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("element", ["full", "reduced", "tet4"])
def test_other_elements_agree_with_statics(element):
    static = op.solve(palpation(element=element), op.Imprint(bumpy_map()), op.Newton(face_rule="nodes"))
    moving = op.solve(palpation(element=element), op.Imprint(bumpy_map()), op.Explicit(duration=0.1))
    np.testing.assert_allclose(moving.stats["force_sample"][2], static.stats["force_sample"][2], rtol=0.01)
    error = np.linalg.norm(moving.stress_zz - static.stress_zz) / np.linalg.norm(static.stress_zz)
    assert error < 0.02


def test_variable_mass_scaling_reaches_its_increment():
    """Elements that are thinner get heavier; the layer takes the increment that was asked for."""
    x = np.linspace(0.3, 0.5, 21)
    thickness = op.ThicknessMap(np.broadcast_to(x, (21, 21)).copy(), extent=(2.0, 2.0))
    wedge = palpation(thickness=thickness)
    solver = op.Explicit(duration=0.05, mass_scaling="variable", increment=5e-5)
    loaded = op.ThicknessMap(thickness.values - 0.02, extent=(2.0, 2.0))
    solution = op.solve(wedge, op.Imprint(loaded), solver)
    assert float(solution.stats["energy_drift"]) < 0.01
    assert int(solution.stats["increments"]) == 1000


def test_labelled_results_hold_the_energies():
    data = op.to_xarray(op.solve(palpation(), op.Imprint(bumpy_map()), op.Explicit(duration=0.13)))
    assert data.energy_strain.dims == ("output",)
    assert data.energy_strain.attrs["units"] == "N mm"
    assert data.output_time.values[-1] == pytest.approx(0.13)
    assert data.attrs["status"] == "successful"
    assert {"pressure", "traction", "stress_zz", "thickness"} <= set(data)
