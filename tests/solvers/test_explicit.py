"""Explicit dynamics: docs/validation.md tests 28 and 32 to 36, and what users of the solver meet."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.inertia import wave_modulus
from opfem.solvers.explicit import prepare
from opfem.solvers.explicit_step import Dynamics, Motion, run
from tests.experiments import MATERIAL, bumpy_map, published_palpation
from tests.tolerances import ROUNDOFF

INVISCID = op.Explicit(mass_scaling=1.0, bulk_viscosity=(0.0, 0.0), duration=1e-9)
FREE = op.Contact(op.HardOverclosure(), 0.0)


def block(elements, size=(1.0, 1.0), thickness=1.0, window=FREE, sample=FREE, **options) -> op.Palpation:
    return op.Palpation(op.Layer(thickness, MATERIAL), size, elements, window=window, sample=sample, **options)


def dynamics(palpation: op.Palpation, load=None, solver: op.Explicit = INVISCID) -> tuple[Dynamics, Motion]:
    return prepare(palpation, op.Traction(0.0, lateral=None) if load is None else load, None, solver, None)


def floating(elements, size=(1.0, 1.0), element="full", solver=INVISCID) -> tuple[Dynamics, Motion]:
    """A layer that nothing holds or touches."""
    made, motion = dynamics(block(elements, size, element=element), solver=solver)
    alone = dataclasses.replace(made.problem, contacts=type(made.problem.contacts)())
    made = dataclasses.replace(made, problem=alone, modes=None)
    return made, dataclasses.replace(motion, window=None, sample=None)


def matrices(made: Dynamics, u=None) -> tuple[np.ndarray, np.ndarray]:
    """The dense stiffness at a displacement, and the masses on its diagonal."""
    X = made.problem.positions
    u = jnp.zeros_like(X) if u is None else u
    return np.asarray(_columns(made.force.body, u)).reshape(X.size, X.size), np.broadcast_to(made.mass, X.shape).ravel()


@eqx.filter_jit
def _columns(body, u):
    product = jax.linearize(lambda u: body.internal_force(u)[0], u)[1]
    return jax.lax.map(product, jnp.eye(u.size).reshape(u.size, *u.shape), batch_size=32)


def frequencies(made: Dynamics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angular frequencies, modes of unit mass as columns, masses."""
    K, mass = matrices(made)
    squares, modes = np.linalg.eigh(K / np.sqrt(np.outer(mass, mass)))
    return np.sqrt(np.maximum(squares, 0.0)), modes / np.sqrt(mass)[:, None], mass


step = jax.jit(lambda made, m, dt: made.step(m, dt, None))
march = jax.jit(run)


def test_28_block_slides_to_its_stop_and_stays():
    """v0 = 1 m/s, friction 0.3, weight by a dead load: stops after v0²/(2 μ g) at v0/(μ g)."""
    friction, gravity, speed, density = 0.3, 9810.0, 1000.0, 1e-6
    stiff = op.Palpation(
        op.Layer(1.0, op.MooneyRivlin(c10=1.0, c01=0.1, bulk=44.0)),
        (2.0, 2.0),
        (2, 2, 1),
        window=op.Contact(op.HardOverclosure(), friction),
        sample=FREE,
    )
    solver = op.Explicit(mass_scaling=1.0, density=density, duration=1e-9)
    made, motion = dynamics(stiff, op.Traction(density * gravity), solver)
    motion = dataclasses.replace(motion, v=motion.v.at[0].set(speed))
    dt = 0.45 * float(made.stable_increment(motion.u))
    stop = speed / (friction * gravity)

    def centre(m):
        return float(jnp.sum(made.mass * m.u[0]) / jnp.sum(made.mass))

    before = march(made, motion, dt, round(0.95 * stop / dt))
    after = march(made, before, dt, round(0.1 * stop / dt))
    assert abs(centre(before) - stop * speed / 2 * (1 - 0.05**2)) < 0.005 * stop * speed / 2
    assert abs(centre(after) - stop * speed / 2) < 0.005 * stop * speed / 2
    later = march(made, after, dt, round(stop / dt))
    assert np.abs(np.asarray(later.u[:2, 0] - after.u[:2, 0])).max() < 1e-6 * stop * speed
    # All of the energy that the motion had went into friction.
    started = 0.5 * float(jnp.sum(made.mass)) * speed**2
    np.testing.assert_allclose(float(made.energies(later)["friction"]), started, rtol=0.01)


def test_32_step_wave_along_a_bar_is_exact_at_the_nodes():
    """100 elements, increment = length/wave speed: the front is where it is, behind it all move as one."""
    n, stress = 100, 1e-15
    bar = block((1, 1, n), (0.1, 0.1), window=op.Roller(), sides="roller", element="full", thickness=1.0)
    made, motion = dynamics(bar, op.Traction(stress))
    speed = float(jnp.sqrt(wave_modulus(made.force.body) / made.density))
    dt = 1.0 / n / speed
    steps = 80
    motion = march(made, motion, jnp.asarray(dt), steps)
    behind = np.arange(n, -1, -1)  # elements from the loaded end, window first
    expected = -stress / (1e-9 * speed) * dt * np.maximum(steps - behind, 0.0)
    np.testing.assert_allclose(motion.u[2, :, 0, 0], expected, rtol=0, atol=ROUNDOFF * np.abs(expected).max())
    assert np.count_nonzero(expected) == steps


@pytest.mark.parametrize("element", ["full", "mean_dilatation"])
def test_33_linear_energy_is_constant(element):
    """½ vᵀ M v half an increment on, plus ½ u_nᵀ K u_(n+1), at strains so small that the layer is linear."""
    made, motion = floating((2, 2, 2), element=element)
    rng = np.random.default_rng(0)
    motion = dataclasses.replace(motion, u=jnp.asarray(1e-14 * rng.standard_normal(motion.u.shape)))
    dt = jnp.asarray(0.5 * float(made.stable_increment(motion.u)))
    K, _ = matrices(made)

    def energy(before, after):
        elastic = 0.5 * np.asarray(before.u).ravel() @ K @ np.asarray(after.u).ravel()
        return elastic + 0.5 * float(jnp.sum(made.mass * after.v**2))

    energies = []
    for _ in range(200):
        after = step(made, motion, dt)
        energies.append(energy(motion, after))
        motion = after
    np.testing.assert_allclose(energies, energies[0], rtol=20 * ROUNDOFF)


def test_34_period_is_that_of_central_differences():
    """A mode started at rest follows cos(n ω_h Δt), ω_h = (2/Δt) asin(ω Δt/2)."""
    made, motion = floating((2, 2, 2))
    omega, modes, _ = frequencies(made)
    for k in (8, len(omega) - 1):
        dt = 0.7 * 2.0 / omega[-1]
        mode = 1e-15 * jnp.asarray(modes[:, k].reshape(motion.u.shape)) / np.abs(modes[:, k]).max()
        steps = 1000
        end = march(made, dataclasses.replace(motion, u=mode), jnp.asarray(dt), steps)
        expected = np.cos(steps * 2.0 * np.arcsin(omega[k] * dt / 2.0)) * np.asarray(mode)
        np.testing.assert_allclose(end.u, expected, rtol=0, atol=1e-8 * np.abs(mode).max())


class TestStableIncrement:
    """35: the limits of docs/validation.md for a cube of ν = 0.4754, in L/c."""

    @staticmethod
    def unit(made: Dynamics, n: int) -> float:
        return 1.0 / n / float(jnp.sqrt(wave_modulus(made.force.body) / made.density))

    @pytest.mark.parametrize(
        ("n", "element", "limit"), [(1, "full", 0.596), (6, "full", 0.846), (6, "mean_dilatation", 0.871)]
    )
    def test_35_limits_of_free_cubes(self, n, element, limit):
        made, motion = floating((n, n, n), element=element)
        unit = self.unit(made, n)
        exact = 2.0 / frequencies(made)[0][-1] / unit
        assert abs(exact - limit) < 0.0006
        estimate = float(made.stable_increment(motion.u)) / unit
        np.testing.assert_allclose(estimate, 1.0 / np.sqrt(3.0), rtol=1e-10)
        assert estimate < exact

    @pytest.mark.parametrize("element", ["full", "mean_dilatation", "reduced", "tet4"])
    @pytest.mark.parametrize("size", [(1.0, 1.0), (3.0, 0.5)])
    def test_35_estimate_is_safe(self, element, size):
        made, motion = floating((3, 3, 3), size, element=element)
        assert float(made.stable_increment(motion.u)) < 2.0 / frequencies(made)[0][-1]

    @pytest.mark.parametrize("strain", [-0.4, 0.5])
    def test_35_estimate_is_safe_when_pressed(self, strain):
        """At its current shape and stiffness: frequencies of the pressed block."""
        made, _ = floating((2, 2, 2))
        X = made.problem.positions
        u = strain * X.at[:2].set(0.0) - 0.3 * strain * X.at[2].set(0.0)
        K, mass = matrices(made, u)
        largest = np.linalg.eigvalsh(K / np.sqrt(np.outer(mass, mass)))[-1]
        limit = 2.0 / np.sqrt(largest)
        own = float(made.stable_increment(u))
        assert 0.5 * limit < own < limit

    @pytest.mark.parametrize(("share", "grows"), [(0.99, False), (1.01, True)])
    def test_35_limit_is_where_motion_grows(self, share, grows):
        made, motion = floating((3, 3, 3))
        rng = np.random.default_rng(1)
        motion = dataclasses.replace(motion, u=jnp.asarray(1e-14 * rng.standard_normal(motion.u.shape)))
        dt = share * 2.0 / frequencies(made)[0][-1]
        end = march(made, motion, jnp.asarray(dt), 400)
        growth = float(jnp.abs(end.u).max() / jnp.abs(motion.u).max())
        # NaN: it grew beyond what a number holds.
        assert not growth < 1e3 if grows else growth < 10.0

    def test_35_bulk_viscosity_shortens_it(self):
        """A volume wave at the limit: stable below sqrt(1 + b1²) - b1 = 0.9418 of it, not above."""
        b1 = 0.06
        share = np.sqrt(1 + b1**2) - b1
        np.testing.assert_allclose(share, 0.9418, atol=5e-5)
        growth = []
        for factor in (0.99, 1.03):
            solver = dataclasses.replace(INVISCID, bulk_viscosity=(b1, 0.0))
            bar = block((1, 1, 20), (0.05, 0.05), window=op.Roller(), sides="roller", element="full")
            made, motion = dynamics(bar, op.Traction(1e-15), solver)
            dt = factor * share * 0.05 / float(jnp.sqrt(wave_modulus(made.force.body) / made.density))
            early = march(made, motion, jnp.asarray(dt), 200)
            late = march(made, early, jnp.asarray(dt), 600)
            growth.append(float(jnp.abs(late.v).max() / jnp.abs(early.v).max()))
        assert growth[0] < 1.5
        assert not growth[1] < 1e3  # NaN: it grew beyond what a number holds


QUICK = op.Explicit(duration=0.13)


@pytest.fixture(scope="module")
def solved() -> op.Solution:
    return op.solve(published_palpation(), op.Imprint(bumpy_map()), QUICK)


def relative(values, reference) -> float:
    return float(np.linalg.norm(np.asarray(values) - np.asarray(reference)) / np.linalg.norm(reference))


def test_33_energies_balance_with_contact_and_friction(solved):
    names = ("strain", "friction", "external", "total")
    energies = {name: np.asarray(solved.stats[f"energy_{name}"]) for name in names}
    assert float(solved.stats["energy_drift"]) < 0.01
    assert np.abs(energies["total"]).max() < 0.01 * energies["external"].max()
    assert energies["friction"][-1] > 0.02 * energies["external"][-1]
    np.testing.assert_allclose(energies["strain"][-1], solved.stats["strain_energy"], rtol=1e-3)


@pytest.mark.parametrize(("window", "sample"), [(0.15, 0.05), (0.0, 0.0)])
def test_36_agrees_with_statics(window, sample, solved):
    """Traction and force within 1% of the implicit solution, kinetic energy below 1% after the first tenth.

    Nodes on the edge are left out of the map: the implicit layer's sides touch the bodies too and take a share.
    """
    static = op.solve(published_palpation(window, sample), op.Imprint(bumpy_map()), op.Newton(face_rule="nodes"))
    moving = solved if window else op.solve(published_palpation(window, sample), op.Imprint(bumpy_map()), QUICK)
    inner = (slice(None), slice(1, -1), slice(1, -1))
    assert relative(moving.traction[inner], static.traction[inner]) < 0.01
    assert relative(moving.stress_zz, static.stress_zz) < 0.01
    np.testing.assert_allclose(moving.stats["force_sample"][2], static.stats["force_sample"][2], rtol=0.01)
    np.testing.assert_allclose(moving.stats["force_hold"], static.stats["force_hold"], atol=1e-3 * 0.007)
    assert float(moving.stats["kinetic_ratio"]) < 0.01
    assert float(moving.stats["max_penetration"]) < 1e-9


def test_36_twice_the_duration_changes_little(solved):
    slower = op.solve(
        published_palpation(), op.Imprint(bumpy_map()), dataclasses.replace(QUICK, duration=2 * QUICK.duration)
    )
    assert relative(slower.pressure, solved.pressure) < 0.005


def test_forces_on_the_layer_balance(solved):
    total = sum(np.asarray(solved.stats[f"force_{name}"]) for name in ("sample", "window", "hold"))
    assert np.abs(total).max() < 1e-3 * abs(float(solved.stats["force_sample"][2]))


def test_float32_gives_the_same_map(solved):
    single = op.solve(published_palpation(), op.Imprint(bumpy_map()), dataclasses.replace(QUICK, precision="float32"))
    assert relative(single.pressure, solved.pressure) < 0.005


def test_same_bits_twice(solved):
    again = op.solve(published_palpation(), op.Imprint(bumpy_map()), QUICK)
    assert bool(jnp.all(again.pressure == solved.pressure))


def test_fast_motion_is_reported():
    fast = op.solve(published_palpation(), op.Imprint(bumpy_map()), dataclasses.replace(QUICK, duration=0.005))
    assert bool(fast.result == op.RESULTS.kinetic_energy_high)
    assert float(fast.stats["kinetic_ratio"]) > 0.01


def test_too_long_an_increment_stops_with_a_status():
    long = dataclasses.replace(QUICK, increment=3.0 * 4e-5)
    with pytest.raises(op.ConvergenceError, match="stopped at"):
        op.solve(published_palpation(), op.Imprint(bumpy_map()), long)
    failed = op.solve(published_palpation(), op.Imprint(bumpy_map()), long, throw=False)
    assert bool((failed.result == op.RESULTS.energy_drifts) | (failed.result == op.RESULTS.element_inverted))
    assert np.isnan(np.asarray(failed.pressure)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration": 0.0}, "Explicit.duration"),
        ({"mass_scaling": -1.0}, "Explicit.mass_scaling"),
        ({"mass_scaling": "some"}, "Explicit.mass_scaling"),
        ({"mass_scaling": "variable"}, "needs the increment"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        op.Explicit(**changes)


def test_hybrid_is_refused():
    with pytest.raises(ValueError, match="mean_dilatation"):
        op.solve(published_palpation(element="hybrid"), op.Imprint(bumpy_map()), QUICK)
