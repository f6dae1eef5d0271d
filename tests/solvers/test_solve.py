"""`solve` as users meet it: balances, status, continuation, tracing, determinism, errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import SOLVER

MATERIAL = op.MooneyRivlin(c10=2.2e-3, c01=7.03e-4, bulk=0.11612)
HARD, EXPONENTIAL = op.HardOverclosure(), op.ExponentialOverclosure(2.0, 0.01)
SIZE = (2.0, 2.0)


def palpation(window=0.15, sample=0.05, material=MATERIAL, **options) -> op.Palpation:
    options = {"elements": (8, 8, 2), **options}
    return op.Palpation(
        op.Layer(0.5, material),
        SIZE,
        window=window if isinstance(window, op.Bonded) else op.Contact(HARD, window),
        sample=op.Contact(EXPONENTIAL, sample),
        **options,
    )


def bumpy(depth: float = 0.08, tilt: float = 0.0) -> op.ThicknessMap:
    """A loaded map with one bump off centre, and a tilt that pushes the layer sideways."""
    y, x = np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 2, 41), indexing="ij")
    values = 0.5 - depth * np.exp(-(((x - 0.8) / 0.5) ** 2) - ((y - 1.1) / 0.6) ** 2) - 0.03 - tilt * (x - 1.0)
    return op.ThicknessMap(values, extent=SIZE)


def imbalance(solution: op.Solution, what: str = "force") -> float:
    """Largest component of the sum of forces, or moments, over that of the sample's."""
    sample, window, hold = (solution.stats[f"{what}_{name}"] for name in ("sample", "window", "hold"))
    return float(jnp.abs(sample + window + hold).max() / jnp.abs(sample).max())


def energy_gained(solution: op.Solution) -> float:
    """Work done on the layer beyond its strain energy, over the strain energy."""
    stats = solution.stats
    return float((stats["work_sample"] + stats["work_window"]) / stats["strain_energy"] - 1.0)


@pytest.fixture(scope="module")
def frictional() -> op.Solution:
    return op.solve(palpation(), op.Imprint(bumpy()))


def test_26_forces_moments_and_energy_balance(frictional):
    assert imbalance(frictional) < 1e-6
    assert imbalance(frictional, "moment") < 1e-6
    assert abs(energy_gained(frictional)) < 2e-3  # 8 increments; second order, see below
    assert float(frictional.stats["work_window"]) < 0  # friction
    assert float(frictional.stats["min_volume_ratio"]) > 0
    assert bool(frictional.result == op.RESULTS.successful)


@pytest.mark.slow
def test_energy_balance_is_second_order_in_the_increment(frictional):
    """Measured: 1.2e-3 and 3.0e-4."""
    finer = op.solve(palpation(), op.Imprint(bumpy()), op.Newton(increments=16))
    assert energy_gained(frictional) / energy_gained(finer) == pytest.approx(4.0, rel=0.1)


def test_traction_sums_to_the_force(frictional):
    area = np.full((9, 9), 0.25**2)
    area[[0, -1]] *= 0.5
    area[:, [0, -1]] *= 0.5
    force = np.sum(np.asarray(frictional.traction) * area, axis=(1, 2))
    np.testing.assert_allclose(force, frictional.stats["force_sample"], rtol=0, atol=1e-10)


def test_friction_stays_inside_its_cone(frictional):
    traction = np.asarray(frictional.window.traction)
    assert np.all(np.hypot(traction[0], traction[1]) <= 0.15 * traction[2] * (1 + 1e-6) + 1e-9)


def test_deformed_interface_meets_the_imprint(frictional):
    measured = np.asarray(bumpy().values)
    computed = frictional.thickness
    inside = ~np.asarray(computed.mask)
    assert inside.mean() > 0.99
    # 0.25 mm elements are bilinear: they leave about h²/8 of the surface's curvature, 4 µm at its peak.
    rms = np.sqrt(np.mean((np.asarray(computed.values) - measured)[inside] ** 2))
    assert rms < 0.004


def test_two_runs_give_identical_bits(frictional):
    again = op.solve(palpation(), op.Imprint(bumpy()))
    assert np.array_equal(np.asarray(again.displacement), np.asarray(frictional.displacement))
    assert np.array_equal(np.asarray(again.pressure), np.asarray(frictional.pressure))


def test_metres_and_pascals_give_the_same_result():
    experiment, load, settings = palpation(), op.Imprint(bumpy()), op.Newton(rtol=1e-12)
    metre, pascal = 1e-3, 1e6  # per mm and MPa; constructors would refuse such numbers

    def lengths(p, imprint):
        return p.layer.thickness, p.extent, p.sample.law.c0, imprint.thickness.values, imprint.thickness.extent

    def stresses(p, _):
        material, law = p.layer.material, p.sample.law
        return material.c10, material.c01, material.bulk, law.p0

    scaled = (experiment, load)
    for where, unit in ((lengths, metre), (stresses, pascal)):
        scaled = eqx.tree_at(lambda both, w=where: w(*both), scaled, replace_fn=lambda leaf, u=unit: u * leaf)
    ours, theirs = op.solve(experiment, load, settings), op.solve(*scaled, settings)
    for field, unit in (("displacement", metre), ("pressure", pascal), ("traction", pascal)):
        expected = np.asarray(getattr(ours, field))
        assert np.linalg.norm(np.asarray(getattr(theirs, field)) / unit - expected) < 1e-10 * np.linalg.norm(expected)


def test_jit_equals_eager(frictional):
    solved = jax.jit(lambda p, m: op.solve(p, op.Imprint(m), throw=False).pressure)(palpation(), bumpy())
    np.testing.assert_allclose(solved, frictional.pressure, rtol=SOLVER, atol=1e-9)


@pytest.mark.slow
def test_ogden_with_exponents_2_and_minus_2_is_mooney_rivlin(frictional):
    ogden = op.Ogden(mu=[2 * 2.2e-3, 2 * 7.03e-4], alpha=[2.0, -2.0], bulk=0.11612)
    solved = op.solve(palpation(material=ogden), op.Imprint(bumpy()))
    np.testing.assert_allclose(solved.pressure, frictional.pressure, rtol=SOLVER, atol=1e-9)


def test_vmap_equals_loop():
    def peak(depth):
        y = jnp.linspace(0, 2, 11)
        values = 0.47 - depth * jnp.exp(-((y - 1.0) ** 2))[:, None] * jnp.ones(11)
        load = op.Imprint(op.ThicknessMap(values, extent=SIZE))
        return op.solve(palpation(elements=(4, 4, 1)), load, throw=False).pressure.max()

    depths = jnp.array([0.0, 0.02, 0.05])
    np.testing.assert_allclose(jax.vmap(peak)(depths), [peak(d) for d in depths], rtol=SOLVER)


def test_failure_returns_status_and_last_state():
    settings = op.Newton(max_steps=2, min_increment=0.05)
    failed = op.solve(palpation(), op.Imprint(bumpy()), settings, throw=False)
    assert bool(failed.result == op.RESULTS.increment_too_small)
    assert np.isnan(np.asarray(failed.pressure)).all()
    assert np.isnan(np.asarray(failed.stats["force_sample"])).all()
    assert np.isfinite(np.asarray(failed.last_converged.displacement)).all()
    assert 0.0 <= float(failed.last_converged.load_fraction) < 1.0
    with pytest.raises(op.ConvergenceError, match=r"stopped at .* of the load.*increment"):
        op.solve(palpation(), op.Imprint(bumpy()), settings)


def test_cut_back_restores_the_state_and_equals_asking_for_the_smaller_increment():
    from opfem.solvers.solve import _attempt, _prepare

    settings = op.Newton().as_leaves()
    problem, start = _prepare(palpation(), op.Imprint(bumpy()), None, settings, None, False)
    first = _attempt(problem, start, settings)
    whole = first._replace(increment=jnp.asarray(0.25))
    failed = _attempt(problem, whole, op.Newton(max_steps=1).as_leaves())
    assert int(failed.increments) == int(first.increments)
    assert int(failed.attempts) == int(first.attempts) + 1
    for kept, before in zip(jax.tree.leaves(failed.state), jax.tree.leaves(first.state), strict=True):
        assert np.array_equal(kept, before)
    assert float(failed.increment) == 0.125
    after_cut = _attempt(problem, failed, settings)
    asked = _attempt(problem, first._replace(increment=jnp.asarray(0.125)), settings)
    np.testing.assert_array_equal(after_cut.state.u, asked.state.u)
    np.testing.assert_array_equal(after_cut.state.histories.window.elastic, asked.state.histories.window.elastic)


def test_a_snap_ends_in_equilibrium_and_no_state_on_its_way_is_accepted():
    """Without friction the path does not count, so the viscous medium must lead to the state of a direct solve."""
    from opfem.solvers.solve import _attempt, _prepare

    settings = op.Newton(increments=4).as_leaves()
    problem, start = _prepare(palpation(0.0, 0.0), op.Imprint(bumpy()), None, settings, None, False)
    direct = _attempt(problem, start, settings)
    snap = start._replace(viscosity=jnp.asarray(1.5))
    on_the_way = 0
    while not int(snap.increments):
        snap = _attempt(problem, snap, settings)
        if not int(snap.increments):
            on_the_way += 1
            assert float(snap.state.fraction) == 0.0
            assert float(snap.origin.fraction) == 0.25
            np.testing.assert_array_equal(snap.state.u, start.state.u)
    assert 1 < on_the_way < 40
    assert float(snap.viscosity) == 0.0
    assert float(snap.residual) <= 1e-7
    np.testing.assert_allclose(snap.state.u, direct.state.u, atol=SOLVER)


@pytest.mark.parametrize("rubs", [True, False])
def test_a_bed_of_springs_carries_the_layer_as_a_dead_load_does(rubs):
    y, x = np.meshgrid(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 9), indexing="ij")
    normal = 4e-3 + 3e-3 * np.cos(np.pi * x) * np.cos(2.0 * np.pi * y)
    lateral = None if rubs else np.stack([2e-4 * y, -1e-4 * x])
    experiment = palpation(window=op.Bonded())
    dead = op.solve(experiment, op.Traction(normal, lateral))
    behind = normal - 0.3 * dead.displacement[2, -1]
    held = op.solve(experiment, op.Traction(behind, lateral, stiffness=0.3))
    apart = jnp.abs(held.displacement - dead.displacement).max() / jnp.abs(dead.displacement).max()
    # Friction depends on the way there, and the bed's pressure rises in another way.
    assert apart < (1e-2 if rubs else 1e-5)
    assert jnp.abs(held.traction[2] + normal).max() < (1e-2 if rubs else 1e-5) * normal.max()
    assert imbalance(held) < 1e-6
    # Without the springs it stays where it is.
    let_go = op.solve(experiment, op.Traction(-held.traction[2], lateral), start=held)
    assert jnp.abs(let_go.displacement - held.displacement).max() < 1e-4 * jnp.abs(held.displacement).max()


def test_start_of_another_kind_is_told():
    shoved = op.solve(palpation(), op.Traction(1e-3, jnp.zeros((2, *palpation().mesh().thickness.shape))))
    with pytest.raises(ValueError, match="other contact, friction or mean stress"):
        op.solve(palpation(), op.Traction(1e-3), start=shoved)


def test_start_continues_with_history():
    whole = op.solve(palpation(), op.Imprint(bumpy()), op.Newton(increments=4))
    half_map = op.ThicknessMap(0.5 * (0.5 + bumpy().values), extent=SIZE)
    two = op.Newton(increments=2)
    half = op.solve(palpation(), op.Imprint(half_map), two)
    rest = op.solve(palpation(), op.Imprint(bumpy()), two, start=half)
    np.testing.assert_allclose(rest.stats["force_sample"][2], whole.stats["force_sample"][2], rtol=2e-3)
    unloaded = op.solve(palpation(), op.Imprint(half_map), two, start=rest)
    # Friction turned round: at the same thickness, unloading needs another force than loading.
    difference = float(unloaded.stats["force_sample"][2] / half.stats["force_sample"][2]) - 1.0
    assert abs(difference) > 0.02


def test_frictionless_tilt_slides_off_and_says_so():
    tilted = op.solve(palpation(0.0, 0.0), op.Imprint(bumpy(0.05, tilt=0.02)))
    assert bool(tilted.result == op.RESULTS.slides_off)
    lateral = np.abs(np.asarray(tilted.stats["force_hold"])).max()
    assert lateral > 1e-3 * abs(float(tilted.stats["force_sample"][2]))
    assert imbalance(tilted) < 1e-6


def test_friction_carries_the_tilt_without_the_hold():
    held = op.solve(palpation(0.3, 0.3), op.Imprint(bumpy(0.05, tilt=0.02)))
    assert bool(held.result == op.RESULTS.successful)
    assert np.all(np.asarray(held.stats["force_hold"]) == 0)


def test_spring_hold_replaces_the_constraint():
    load = op.Imprint(bumpy(0.05, tilt=0.02))
    sprung = op.solve(palpation(0.0, 0.0, hold=10.0), load)
    held = op.solve(palpation(0.0, 0.0), load)
    assert imbalance(sprung) < 1e-6
    # A spring under every node also resists spreading.
    assert float(sprung.stats["force_sample"][2]) < float(held.stats["force_sample"][2])


def test_lift_off_everywhere_is_a_solution_without_force():
    above = op.ThicknessMap(np.full((5, 5), 0.52), extent=SIZE)
    free = op.solve(palpation(), op.Imprint(above))
    assert float(jnp.max(jnp.abs(free.pressure))) == 0.0
    assert np.all(np.asarray(free.contact_status) == 0)


@pytest.mark.parametrize(("p0", "c0"), [(1.0, 0.002), (5.0, 0.02), (1.0, 0.02)])
def test_24_corrected_approach_does_not_depend_on_the_law(p0, c0):
    flat = op.ThicknessMap(np.full((5, 5), 0.4), extent=SIZE)

    def mean_pressure(p0, c0):
        sample = op.Contact(op.ExponentialOverclosure(p0, c0), 0.0)
        experiment = op.Palpation(op.Layer(0.5, MATERIAL), SIZE, (4, 4, 2), op.Contact(HARD, 0.0), sample)
        return float(op.solve(experiment, op.Imprint(flat, correct_approach=True)).pressure.mean())

    assert mean_pressure(p0, c0) == pytest.approx(mean_pressure(2.0, 0.01), rel=0.005)


def test_float32_is_refused_with_advice():
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), palpation())
    with pytest.raises(ValueError, match=r"float64.*float32.*jax_enable_x64"):
        op.solve(narrow, op.Imprint(bumpy()))


def test_contradicting_load_and_sample_are_refused():
    bonded = op.Palpation(op.Layer(0.5, MATERIAL), SIZE, (4, 4, 1), op.Roller(), op.Bonded())
    with pytest.raises(ValueError, match=r"Imprint needs sample=Contact"):
        op.solve(bonded, op.Imprint(bumpy()))
    with pytest.raises(ValueError, match=r"lets the interface slide, but the sample is Bonded"):
        op.solve(bonded, op.Displacement(-0.05))
    with pytest.raises(ValueError, match=r"leaves the interface without friction"):
        op.solve(palpation(), op.Displacement(-0.05))
    with pytest.raises(ValueError, match=r"Displacement\.uz \[mm\] must be .*\(9, 9\), got \(3, 3\)"):
        op.solve(palpation(0.1, 0.0), op.Displacement(np.full((3, 3), -0.05)))
