"""`solve` as users meet it: balances, status, continuation, tracing, determinism, errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import ELEMENTS, EXTENT, L0, MATERIAL, bumpy_map, flat_map, published_palpation
from tests.tolerances import ROUNDOFF, SOLVER

INTERFACE = (ELEMENTS[1] + 1, ELEMENTS[0] + 1)  # nodes


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
    return op.solve(published_palpation(), op.Imprint(bumpy_map()))


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
    finer = op.solve(published_palpation(), op.Imprint(bumpy_map()), op.Newton(increments=16))
    assert energy_gained(frictional) / energy_gained(finer) == pytest.approx(4.0, rel=0.1)


def test_traction_sums_to_the_force(frictional):
    area = np.full(INTERFACE, np.prod(EXTENT) / np.prod(ELEMENTS[:2]))
    area[[0, -1]] *= 0.5
    area[:, [0, -1]] *= 0.5
    force = np.sum(np.asarray(frictional.traction) * area, axis=(1, 2))
    np.testing.assert_allclose(force, frictional.stats["force_sample"], rtol=0, atol=1e-10)


def test_friction_stays_inside_its_cone(frictional):
    traction = np.asarray(frictional.window.traction)
    assert np.all(np.hypot(traction[0], traction[1]) <= 0.15 * traction[2] * (1 + 1e-6) + 1e-9)


def test_deformed_interface_meets_the_imprint(frictional):
    measured = np.asarray(bumpy_map().values)
    computed = frictional.thickness
    inside = ~np.asarray(computed.mask)
    assert inside.mean() > 0.99
    # 0.33 mm elements are bilinear: they leave about h²/8 of the surface's curvature, 8 µm at its peak.
    rms = np.sqrt(np.mean((np.asarray(computed.values) - measured)[inside] ** 2))
    assert rms < 0.004


def test_two_runs_give_identical_bits(frictional):
    again = op.solve(published_palpation(), op.Imprint(bumpy_map()))
    assert np.array_equal(np.asarray(again.displacement), np.asarray(frictional.displacement))
    assert np.array_equal(np.asarray(again.pressure), np.asarray(frictional.pressure))


def test_metres_and_pascals_give_the_same_result():
    experiment, load, settings = published_palpation(), op.Imprint(bumpy_map()), op.Newton(rtol=1e-12)
    metre, pascal = 1e-3, 1e6  # per mm and MPa; constructors would refuse such numbers

    def lengths(p, imprint):
        return p.layer.thickness, p.extent, p.sample.law.clearance, imprint.thickness.values, imprint.thickness.extent

    def stresses(p, _):
        material, law = p.layer.material, p.sample.law
        return material.c10, material.c01, material.bulk, law.pressure

    scaled = (experiment, load)
    for where, unit in ((lengths, metre), (stresses, pascal)):
        scaled = eqx.tree_at(lambda both, w=where: w(*both), scaled, replace_fn=lambda leaf, u=unit: u * leaf)
    ours, theirs = op.solve(experiment, load, settings), op.solve(*scaled, settings)
    for field, unit in (("displacement", metre), ("pressure", pascal), ("traction", pascal)):
        expected = np.asarray(getattr(ours, field))
        assert np.linalg.norm(np.asarray(getattr(theirs, field)) / unit - expected) < 1e-10 * np.linalg.norm(expected)


@pytest.mark.slow
def test_ogden_with_exponents_2_and_minus_2_is_mooney_rivlin():
    ogden = op.Ogden(mu=[2 * MATERIAL.c10, 2 * MATERIAL.c01], alpha=[2.0, -2.0], bulk=MATERIAL.bulk)
    accurate = op.Newton(rtol=1e-8)
    solved, expected = (
        op.solve(published_palpation(material=law), op.Imprint(bumpy_map()), accurate).pressure
        for law in (ogden, MATERIAL)
    )
    np.testing.assert_allclose(solved, expected, rtol=SOLVER, atol=1e-9)


def test_jit_and_vmap_equal_the_eager_loop():
    def pressure(depth):
        base = bumpy_map()
        load = op.Imprint(op.ThicknessMap(L0 - depth * (L0 - base.values), extent=EXTENT))
        return op.solve(published_palpation(), load, op.Newton(rtol=1e-8), throw=False).pressure

    depths = jnp.array([0.0, 0.5, 1.0])
    expected = np.stack([pressure(depth) for depth in depths])
    np.testing.assert_allclose(jax.jit(jax.vmap(pressure))(depths), expected, rtol=SOLVER, atol=1e-9)


def test_failure_returns_status_and_last_state():
    settings = op.Newton(max_steps=2, min_increment=0.05)
    failed = op.solve(published_palpation(), op.Imprint(bumpy_map()), settings, throw=False)
    assert bool(failed.result == op.RESULTS.increment_too_small)
    assert np.isnan(np.asarray(failed.pressure)).all()
    assert np.isnan(np.asarray(failed.stats["force_sample"])).all()
    assert np.isfinite(np.asarray(failed.last_converged.displacement)).all()
    assert 0.0 <= float(failed.last_converged.load_fraction) < 1.0
    with pytest.raises(op.ConvergenceError, match=r"stopped at .* of the load.*increment"):
        op.solve(published_palpation(), op.Imprint(bumpy_map()), settings)


def test_cut_back_restores_the_state_and_equals_asking_for_the_smaller_increment():
    from opfem.solvers.solve import compiled_attempt, prepare

    settings = op.Newton().as_leaves()
    problem, start = prepare(published_palpation(), op.Imprint(bumpy_map()), None, settings, None, False)
    first = compiled_attempt(problem, start, settings)

    def with_increment(size):
        return first._replace(increments=first.increments._replace(size=jnp.asarray(size, float)))

    failed = compiled_attempt(problem, with_increment(0.25), op.Newton(max_steps=1).as_leaves())
    assert int(failed.increments.accepted) == int(first.increments.accepted)
    assert int(failed.increments.attempts) == int(first.increments.attempts) + 1
    for kept, before in zip(jax.tree.leaves(failed.state), jax.tree.leaves(first.state), strict=True):
        assert np.array_equal(kept, before)
    assert float(failed.increments.size) == 0.125
    after_cut = compiled_attempt(problem, failed, settings)
    asked = compiled_attempt(problem, with_increment(0.125), settings)
    np.testing.assert_array_equal(after_cut.state.u, asked.state.u)
    np.testing.assert_array_equal(after_cut.state.histories.window.elastic, asked.state.histories.window.elastic)


def test_a_snap_ends_in_equilibrium_and_no_state_on_its_way_is_accepted():
    """Without friction and multipliers the path does not count: viscosity must lead to the state of a direct solve."""
    from opfem.solvers.solve import compiled_attempt, prepare

    settings = op.Newton(increments=4, rtol=1e-8).as_leaves()
    window = op.Contact(op.HardOverclosure(exact=False), 0.0)
    problem, start = prepare(published_palpation(window, 0.0), op.Imprint(bumpy_map()), None, settings, None, False)
    direct = compiled_attempt(problem, start, settings)
    snap = start._replace(snap=start.snap._replace(viscosity=jnp.asarray(1.5, float)))
    on_the_way = 0
    while not int(snap.increments.accepted):
        snap = compiled_attempt(problem, snap, settings)
        if not int(snap.increments.accepted):
            on_the_way += 1
            assert float(snap.state.fraction) == 0.0
            assert float(snap.origin.fraction) == 0.25
            np.testing.assert_array_equal(snap.state.u, start.state.u)
    assert 1 < on_the_way < 40
    assert float(snap.snap.viscosity) == 0.0
    assert float(snap.residual) <= 1e-8
    np.testing.assert_allclose(snap.state.u, direct.state.u, atol=SOLVER)


@pytest.mark.parametrize("rubs", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_bed_of_springs_carries_the_layer_as_a_dead_load_does(rubs):
    y, x = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in INTERFACE), indexing="ij")
    normal = 4e-3 + 3e-3 * np.cos(np.pi * x) * np.cos(2.0 * np.pi * y)
    lateral = None if rubs else np.stack([2e-4 * y, -1e-4 * x])
    experiment = published_palpation(window=op.Bonded())
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
    bonded = op.solve(published_palpation(op.Bonded()), op.Traction(1e-3))
    with pytest.raises(ValueError, match="other contact, friction or mean stress"):
        op.solve(published_palpation(), op.Traction(1e-3), start=bonded)


def test_start_continues_with_history():
    whole = op.solve(published_palpation(), op.Imprint(bumpy_map()), op.Newton(increments=4))
    half_map = op.ThicknessMap(0.5 * (0.5 + bumpy_map().values), extent=EXTENT)
    two = op.Newton(increments=2)
    half = op.solve(published_palpation(), op.Imprint(half_map), two)
    rest = op.solve(published_palpation(), op.Imprint(bumpy_map()), two, start=half)
    np.testing.assert_allclose(rest.stats["force_sample"][2], whole.stats["force_sample"][2], rtol=2e-3)
    unloaded = op.solve(published_palpation(), op.Imprint(half_map), two, start=rest)
    # Friction turned round: at the same thickness, unloading needs another force than loading.
    difference = float(unloaded.stats["force_sample"][2] / half.stats["force_sample"][2]) - 1.0
    assert abs(difference) > 0.02


def test_frictionless_tilt_slides_off_and_says_so():
    tilted = op.solve(published_palpation(0.0, 0.0), op.Imprint(bumpy_map(0.05, tilt=0.02)))
    assert bool(tilted.result == op.RESULTS.slides_off)
    lateral = np.abs(np.asarray(tilted.stats["force_hold"])).max()
    assert lateral > 1e-3 * abs(float(tilted.stats["force_sample"][2]))
    assert imbalance(tilted) < 1e-6


def test_friction_carries_the_tilt_without_the_hold():
    held = op.solve(published_palpation(0.3, 0.3), op.Imprint(bumpy_map(0.05, tilt=0.02)))
    assert bool(held.result == op.RESULTS.successful)
    assert np.all(np.asarray(held.stats["force_hold"]) == 0)


def test_spring_hold_replaces_the_constraint():
    load = op.Imprint(bumpy_map(0.05, tilt=0.02))
    sprung = op.solve(published_palpation(0.0, 0.0, hold=10.0), load, op.Newton(rtol=1e-8))
    held = op.solve(published_palpation(0.0, 0.0), load)
    assert imbalance(sprung) < 1e-6
    # A spring under every node also resists spreading.
    assert float(sprung.stats["force_sample"][2]) < float(held.stats["force_sample"][2])


def test_lift_off_everywhere_is_a_solution_without_force():
    with pytest.warns(UserWarning, match="the map is thicker than L0 everywhere"):
        free = op.solve(published_palpation(), op.Imprint(flat_map(0.52)))
    assert float(jnp.max(jnp.abs(free.pressure))) == 0.0
    assert np.all(np.asarray(free.contact_status) == 0)


@pytest.mark.parametrize(("p0", "c0"), [(1.0, 0.002), (5.0, 0.02), (1.0, 0.02)])
def test_24_corrected_approach_does_not_depend_on_the_law(p0, c0):
    def mean_pressure(p0, c0):
        experiment = published_palpation(0.0, op.Contact(op.ExponentialOverclosure(p0, c0), 0.0))
        return float(op.solve(experiment, op.Imprint(flat_map(0.4), correct_approach=True)).pressure.mean())

    assert mean_pressure(p0, c0) == pytest.approx(mean_pressure(2.0, 0.01), rel=0.005)


def test_float32_is_refused_with_advice():
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), published_palpation())
    with pytest.raises(ValueError, match=r"float64.*float32.*jax_enable_x64"):
        op.solve(narrow, op.Imprint(bumpy_map()))


def test_contradicting_load_and_sample_are_refused():
    bonded = published_palpation(op.Roller(), op.Bonded())
    with pytest.raises(ValueError, match=r"Imprint needs sample=Contact"):
        op.solve(bonded, op.Imprint(bumpy_map()))
    with pytest.raises(ValueError, match=r"lets the interface slide, but the sample is Bonded"):
        op.solve(bonded, op.Displacement(-0.05))
    with pytest.raises(ValueError, match=r"leaves the interface without friction"):
        op.solve(published_palpation(), op.Displacement(-0.05))
    with pytest.raises(ValueError, match=r"Displacement\.uz \[mm\] must be .*\(7, 7\), got \(3, 3\)"):
        op.solve(published_palpation(0.1, 0.0), op.Displacement(np.full((3, 3), -0.05)))


def test_sides_that_touch_nothing_reach_into_the_body_they_fold_onto():
    from opfem.solvers.discretise import discretise
    from opfem.solvers.recover import side_overlap

    load = op.Imprint(flat_map(0.9 * L0))
    touching, passing = (
        discretise(published_palpation(side_contact=touch), load, None, "gauss2") for touch in (True, False)
    )
    assert touching.contacts.window.sides is not None
    assert passing.contacts.window.sides is None
    assert passing.contacts.sample.sides is None
    state = passing.initial_state()
    assert float(side_overlap(passing, state)) == 0.0
    below = state.u.at[2, 1, 0].set(-0.5 * L0 - 0.01)  # the middle of the southern side, 0.01 mm under the window
    folded = eqx.tree_at(lambda s: s.u, state, below)
    upper_point = 0.5 + 0.5 / np.sqrt(3.0)  # of 2 × 2 Gauss points between the window's edge and there
    assert float(side_overlap(passing, folded)) == pytest.approx(0.01 * upper_point, rel=ROUNDOFF)
