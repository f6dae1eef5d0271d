"""The traction fit on data of its own model: it finds the truth, and knows how well."""

import dataclasses
import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import opfem as op
from opfem.inverse.elastic_foundation import solve_imprints, zero_foundation
from opfem.inverse.forward import Linearised, forward_solve, load_mask
from opfem.inverse.inputs import stacked
from opfem.inverse.measured_surface import _spline_values, interface_heights, project_map
from opfem.inverse.objective import Objective
from opfem.inverse.traction_fit import _status
from opfem.inverse.warm_start import interpolated
from opfem.mechanics.face import tributary_area
from opfem.optimise.gauss_newton import GaussNewton, PreconditionedDescent
from opfem.solvers.derivative import Handed, follow_path
from opfem.solvers.discretise import discretise
from opfem.solvers.stepping import attempt, begin, unfinished

# A fit compiles for minutes on a busy machine.
pytestmark = pytest.mark.timeout(1500)

NOISE, SIDE, ELEMENTS = 2e-3, 1.5, (12, 12, 2)
PRIOR = op.Matern(length=0.6, std=1.5e-3, mean=3e-3)


def palpation(elements=ELEMENTS, window=0.15, sample=0.05):
    return op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(SIDE, SIDE),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
    )


def measured(normal, experiment, seed=0, pixels=101):
    """Simulate a map of the interface under a traction [MPa], with white noise."""
    mesh = experiment.mesh()
    u = op.solve(experiment, op.Traction(normal)).displacement[:, -1]
    basis, _ = _spline_values(jnp.linspace(0.0, ELEMENTS[0], pixels), ELEMENTS[0])
    heights = basis @ interface_heights(mesh, u) @ basis.T
    noise = NOISE * np.random.default_rng(seed).standard_normal(heights.shape)
    return op.ThicknessMap(heights + noise, extent=(SIDE, SIDE), std=NOISE)


def fit_along_z(*args, **settings):
    """Fit data that a traction along z makes: no surface pushes sideways."""
    return op.fit_traction(*args, **{"lateral": "friction", **settings})


@pytest.fixture(scope="module")
def truth():
    """Normal traction [MPa] of up to 7 kPa, drawn from the prior."""
    white = jax.random.normal(jax.random.key(5), (13, 13))
    return 3e-3 + PRIOR.expand(white, palpation().mesh().spacing)


@pytest.fixture(scope="module")
def fit(truth):
    experiment = palpation()
    # The map comes from the same mesh, which then misses nothing.
    return fit_along_z(experiment, measured(truth, experiment), PRIOR, model_std=0.0, draws=12)


@pytest.mark.slow
def test_fit_finds_the_traction(fit, truth):
    error = jnp.linalg.norm(fit.normal - truth) / jnp.linalg.norm(truth - truth.mean())
    assert fit.result == op.FitStatus.successful
    assert fit.stats["inner_iterations"] <= 5 * fit.stats["gauss_newton_steps"]
    assert error < 0.05
    thickness = measured(truth, palpation())
    linear = op.linear_estimate(palpation(), thickness, PRIOR).normal
    assert error < 0.2 * jnp.linalg.norm(linear - truth) / jnp.linalg.norm(truth - truth.mean())


@pytest.mark.slow
def test_fit_goes_on_from_another(truth):
    def close(start=None):
        options = {"model_std": 0.0, "rtol": 1e-2, "start": start, "draws": 1, "progress": False}
        return fit_along_z(palpation(), measured(truth, palpation()), PRIOR, **options)

    first = close()
    again = close(first.normal)
    assert again.stats["forward_solves"] < first.stats["forward_solves"]
    assert jnp.max(jnp.abs(again.normal - first.normal)) < 1e-2 * jnp.std(truth)


@pytest.mark.slow
def test_standard_deviations_include_the_mesh_error(fit, truth):
    own = fit_along_z(palpation(), measured(truth, palpation()), PRIOR, draws=12, progress=False)
    assert own.normal == pytest.approx(np.asarray(fit.normal), abs=1e-9)
    missed = jnp.sqrt(jnp.mean(op.mesh_error(fit.solution) ** 2))
    assert own.stats["mesh_error"] == pytest.approx(float(missed), rel=0.05)
    assert jnp.all(fit.mesh_std == 0.0)
    assert own.pressure_std == pytest.approx(np.hypot(fit.pressure_std, own.mesh_std), rel=1e-6)
    assert own.mesh_std.mean() > 0.1 * fit.pressure_std.mean()


@pytest.mark.slow
def test_standard_deviations_cover_the_truth_of_a_finer_mesh():
    fine = palpation((24, 24, 4))
    white = jax.random.normal(jax.random.key(2), (25, 25))
    known = 3e-3 + PRIOR.expand(white, fine.mesh().spacing)
    mesh, u = fine.mesh(), op.solve(fine, op.Traction(known)).displacement[:, -1]
    basis, _ = _spline_values(jnp.linspace(0.0, 24.0, 101), 24)
    noise = NOISE * np.random.default_rng(4).standard_normal((101, 101))
    heights = basis @ interface_heights(mesh, u) @ basis.T + noise
    fit = fit_along_z(palpation(), op.ThicknessMap(heights, extent=(SIDE, SIDE), std=NOISE), PRIOR, progress=False)
    off = jnp.abs(fit.normal - known[::2, ::2])
    # 169 nodes, correlated over several: 0.85 to 1 at 95 %.
    assert jnp.mean(off < 1.96 * fit.normal_std) > 0.85
    assert jnp.mean(off < 1.96 * fit.normal_std) > jnp.mean(off**2 < 1.96**2 * (fit.normal_std**2 - fit.mesh_std**2))


@pytest.mark.slow
def test_lateral_traction_of_a_steep_sample_is_that_of_its_imprint():
    experiment = palpation()
    y, x = np.mgrid[0:1:101j, 0:1:101j]
    # A ridge of 0.1 mm with slopes of 0.4.
    shape = op.ThicknessMap(0.45 - 0.1 * np.exp(-(((x + 0.2 * y - 0.6) / 0.15) ** 2)), extent=(SIDE, SIDE), std=NOISE)
    pressed = op.solve(experiment, op.Imprint(shape))
    basis, _ = _spline_values(jnp.linspace(0.0, ELEMENTS[0], 101), ELEMENTS[0])
    heights = basis @ interface_heights(experiment.mesh(), pressed.displacement[:, -1]) @ basis.T
    noise = NOISE * np.random.default_rng(3).standard_normal(heights.shape)
    seen = op.ThicknessMap(heights + noise, extent=(SIDE, SIDE), std=NOISE)
    prior = op.Matern(0.4, 4e-3, mean=4e-3)
    pushed, along_z = (
        op.fit_traction(experiment, seen, prior, lateral=lateral, model_std=0.0, draws=2, progress=False)
        for lateral in ("imprint", "friction")
    )
    known = -pressed.traction[2]
    assert jnp.linalg.norm(pushed.normal - known) < 0.6 * jnp.linalg.norm(along_z.normal - known)
    size = jnp.linalg.norm(pressed.traction[:2])
    assert size > 0.05 * jnp.linalg.norm(known)
    assert jnp.linalg.norm(pushed.traction[:2] - pressed.traction[:2]) < 0.5 * size


def test_start_comes_from_any_mesh():
    def field(nodes):
        x = np.linspace(0.0, 1.0, nodes)
        return np.cos(np.pi * x)[:, None] * (2.0 + np.cos(np.pi * x))

    np.testing.assert_allclose(interpolated(field(13), 1, 13, 13)[0], field(13), atol=1e-12)
    np.testing.assert_allclose(interpolated(field(7), 1, 13, 13)[0], field(13), atol=2e-3)
    with pytest.raises(ValueError, match=r"fit_traction.start \[MPa\].*such as \(13, 13\); got shape \(2, 7, 7\)"):
        interpolated(np.zeros((2, 7, 7)), 1, 13, 13)


@pytest.mark.slow
def test_fit_knows_how_well_it_did(fit, truth):
    z = (fit.normal - truth) / fit.normal_std
    # About 115 degrees of freedom, and standard deviations from 12 draws.
    assert 0.75 < float(jnp.sqrt(jnp.mean(z**2))) < 1.35
    assert 0.5 < fit.reduced_chi2 < 1.6
    assert 0.5 * fit.observed < fit.effective_dof < fit.observed
    assert fit.stats["misfit_rms"] < 0.5 * NOISE
    assert fit.stats["representation_rms"] == pytest.approx(NOISE, rel=0.05)
    # The residual is that of the traction which is returned.
    heights = interface_heights(palpation().mesh(), fit.solution.displacement[:, -1])
    np.testing.assert_allclose(fit.residual, heights - fit.objective.surfaces.surface[0], atol=0.01 * NOISE)


@pytest.mark.slow
def test_another_map_and_prior_compile_nothing_anew(small):
    experiment, settings, prior, _ = small
    fit_along_z(experiment, small_map(small), prior, solver=settings, draws=1, progress=False).unobserved()
    other, rubbing = op.Matern(length=0.5, std=1.2e-3, mean=2.5e-3), palpation((6, 6, 2), window=0.2)
    thickness = small_map(small, seed=1, load=0.8)
    compiled = []

    def listen(event, _, **__):
        compiled.extend([event] if event == "/jax/core/compile/backend_compile_duration" else [])

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        fit_along_z(rubbing, thickness, other, solver=settings, draws=1, progress=False).unobserved()
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled


@pytest.mark.slow
def test_covariance_agrees_with_draws(fit):
    weights = jnp.zeros((13, 13)).at[3:8, 4:9].set(1.0 / 25)
    variance = float(jnp.sum(weights * fit.covariance(weights)))
    samples = jnp.sum(weights * fit.deviations, axis=(1, 2))
    n = samples.size
    assert jnp.mean(samples**2) == pytest.approx(variance, rel=4 * np.sqrt(2 / n))


def dead_load(field):
    return op.Traction(3e-3 + 1e-3 * field)


def on_foundation(field):
    return op.Traction(0.02 + 1e-3 * field, stiffness=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("load", [dead_load, on_foundation])
def test_jacobian_of_the_fit_against_exact_derivatives(load):
    """Kept tangents give products to 1e-3 of those through `follow_path`, forward and transposed."""
    experiment, settings = palpation((6, 6, 2)), op.Newton(max_path=12).as_leaves()
    field = jax.random.normal(jax.random.key(0), (7, 7))
    change = jax.random.normal(jax.random.key(1), (7, 7))

    def exact(field):
        problem = discretise(experiment, load(field), None, settings.face_rule)
        frozen = jax.lax.stop_gradient(problem)
        end = jax.lax.while_loop(
            unfinished, lambda s: attempt(frozen, s, settings), begin(frozen.initial_state(), settings, True)
        )
        return follow_path(problem, problem.initial_state(), end.path.solves, end.path.kept, settings)[1].u[:, -1]

    path = forward_solve(experiment, load(field), settings)
    line = Linearised.along(path, settings)

    def problem(field):
        laid = discretise(experiment, load(field), None, settings.face_rule)
        return eqx.filter(laid, load_mask(laid))

    solution = op.solve(experiment, load(field), settings)
    assert jnp.all(path.end.state.u == solution.displacement)
    u, expected = jax.jit(lambda p: jax.jvp(exact, (p,), (change,)))(field)
    start = Handed(path.problem.initial_state().unknowns, path.problem.initial_state().histories)
    still = jax.tree.map(jnp.zeros_like, start)
    slope = line.push(jax.jvp(problem, (field,), (change,))[1], still)[:, -1]
    assert jnp.linalg.norm(slope - expected) < 3e-3 * jnp.linalg.norm(expected)
    weights = jax.random.normal(jax.random.key(2), u.shape)
    pulled = jax.vjp(problem, field)[1](line.pull(jnp.zeros_like(path.end.state.u).at[:, -1].set(weights)))[0]
    reference = jax.jit(lambda p: jax.vjp(exact, p)[1](weights)[0])(field)
    assert jnp.linalg.norm(pulled - reference) < 3e-3 * jnp.linalg.norm(reference)


def test_errors_say_what_to_do():
    thickness = op.ThicknessMap(np.full((11, 11), 0.45), extent=(SIDE, SIDE))
    with pytest.raises(ValueError, match="standard deviation"):
        fit_along_z(palpation(), thickness, PRIOR)
    bonded = op.Palpation(palpation().layer, (SIDE, SIDE), ELEMENTS, palpation().window, op.Bonded())
    with pytest.raises(ValueError, match=r"sample=Contact\(law, friction\), got sample=Bonded"):
        fit_along_z(bonded, thickness, PRIOR)
    noisy = eqx.tree_at(lambda m: m.std, thickness, jnp.asarray(NOISE), is_leaf=lambda leaf: leaf is None)

    def refused(message, thickness=noisy, experiment=palpation(), prior=PRIOR, **options):
        with pytest.raises(ValueError, match=message):
            fit_along_z(experiment, thickness, prior, **options)

    refused(r"Matern\.length \[mm\].*element", prior=op.Matern(0.05, 1e-3))
    refused("at least 4 elements", experiment=palpation((3, 12, 2)))
    refused(r"lateral \[MPa\].*\(2, 13, 13\).*got shape \(13, 13\)", lateral=np.zeros((13, 13)))
    refused("hexahedra", experiment=dataclasses.replace(palpation(), element="tet10"))
    refused(r"parameters name numbers .* got 'c10'", parameters={"c10": op.Normal(1.0, 0.1)})
    refused("forces needs one for each of 1 maps, got 2", forces=[op.ForceReading(1.0, 0.1)] * 2)
    inside = op.AxialDisplacement(np.zeros((3, 12, 13)), 1e-4)
    refused(r"inside \[mm\].*\(nz\+1, ny\+1, nx\+1\) = \(3, 13, 13\).*got shape \(3, 12, 13\)", inside=inside)
    jaxtyping.config.update("jaxtyping_disable", True)  # as users run it
    refused(r"inside \[mm\].*got ndarray", inside=[np.zeros((3, 13, 13))])
    jaxtyping.config.update("jaxtyping_disable", False)
    fits = op.AxialDisplacement(np.zeros((3, 13, 13)), 1e-4)
    refused("inside needs one for each of 1 maps, got 2", inside=[fits, fits])
    beside = op.ThicknessMap(np.full((11, 11), 0.45), extent=(SIDE, SIDE), std=NOISE, origin=(5.0, 0.0))
    refused("map 0 has no pixel with data on the layer", thickness=beside)
    other = op.ThicknessMap(np.full((9, 11), 0.45), extent=(SIDE, SIDE), std=NOISE)
    refused("one grid of pixels", thickness=[noisy, other])


@pytest.mark.parametrize("std", [0.0, -1e-3])
def test_noise_must_be_positive(std):
    with pytest.raises(ValueError, match=r"std.*positive|positive.*std"):
        fit_along_z(
            palpation(), op.ThicknessMap(np.full((11, 11), 0.45), extent=(SIDE, SIDE), std=std), PRIOR, progress=False
        )


@pytest.fixture(scope="module")
def small():
    """A quick problem: 6 × 6 × 2 elements, two increments; its truth, map and prior."""
    experiment, settings = palpation((6, 6, 2)), op.Newton(increments=2, max_path=8, rtol=1e-9)
    prior = op.Matern(length=0.6, std=1e-3, mean=3e-3)
    known = 3e-3 + prior.expand(jax.random.normal(jax.random.key(3), (7, 7)), experiment.mesh().spacing)
    return experiment, settings, prior, known


def small_map(small, seed=0, load=1.0, mask=None):
    experiment, settings, _, known = small
    # A foundation without stiffness: the program of the fit solves it.
    u = op.solve(experiment, op.Traction(load * known, stiffness=0.0), settings).displacement[:, -1]
    basis, _ = _spline_values(jnp.linspace(0.0, 6.0, 31), 6)
    heights = basis @ interface_heights(experiment.mesh(), u) @ basis.T
    noise = NOISE * np.random.default_rng(seed).standard_normal(heights.shape)
    return op.ThicknessMap(heights + noise, extent=(SIDE, SIDE), std=NOISE, mask=mask)


def test_small_fit_finds_the_traction_and_knows_how_well(small):
    experiment, settings, prior, known = small
    fit = fit_along_z(experiment, small_map(small), prior, solver=settings, draws=8, progress=False)
    assert fit.result == op.FitStatus.successful
    assert jnp.linalg.norm(fit.normal - known) < 0.1 * jnp.linalg.norm(known - known.mean())
    # About 40 degrees of freedom, and standard deviations from 8 draws.
    z = (fit.normal - known) / fit.normal_std
    assert 0.6 < float(jnp.sqrt(jnp.mean(z**2))) < 1.6
    left = fit.observed - fit.effective_dof
    assert abs(fit.chi2 - left) < 3.0 * jnp.sqrt(2.0 * left)
    assert jnp.all(fit.pressure_std > 0.2 * fit.normal_std)
    assert jnp.all(fit.resolution_width > 0.25)
    assert not fit.unobserved()
    assert fit.stats["inner_iterations"] <= 6 * fit.stats["gauss_newton_steps"]


@pytest.mark.slow
def test_derivative_of_the_fitted_traction_through_the_optimum(small):
    experiment, settings, prior, _ = small
    thickness = small_map(small)
    fit = fit_along_z(experiment, thickness, prior, solver=settings, draws=1)
    change = jax.random.normal(jax.random.key(1), thickness.shape)

    def variation(normal):
        return 1e6 * jnp.sum((normal - 3e-3) ** 2)  # kPa²

    # One program, for values too: each takes minutes to compile.
    @functools.partial(jax.jit, compiler_options=op.compiler_options())
    @functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
    def functional(values, length, std):
        moved = eqx.tree_at(lambda m: m.values, thickness, values)
        return variation(op.refitted(fit, moved, op.Matern(length, std, mean=3e-3)))

    at = (thickness.values, 0.6, 1e-3)
    value, slopes = functional(*at)
    assert value == pytest.approx(float(variation(fit.normal)), rel=2e-3)
    for slope, direction, h in (
        (jnp.sum(slopes[0] * change), (change, 0.0, 0.0), 1e-4),
        (slopes[1], (0.0, 1.0, 0.0), 1e-3),
        (slopes[2], (0.0, 0.0, 1.0), 1e-5),
    ):
        ahead, behind = (
            functional(*(a + s * h * d for a, d in zip(at, direction, strict=True)))[0] for s in (1.0, -1.0)
        )
        assert slope == pytest.approx(float(ahead - behind) / (2.0 * h), rel=2e-4)


def test_imprint_where_a_corner_is_masked():
    """Splines oscillate there; the imprint that the foundation is at rest with must not."""
    experiment, mask = palpation((6, 6, 2)), np.zeros((31, 31), bool)
    mask[:17, :17] = True
    y, x = np.mgrid[0:1:31j, 0:1:31j]
    pressed = 0.5 - 0.9 * np.maximum(0.55 - np.maximum(x, y) / 1.2, 0.0)
    thickness = op.ThicknessMap(pressed, extent=(SIDE, SIDE), std=NOISE, mask=mask)
    surfaces = jax.tree.map(lambda leaf: leaf[None], project_map(experiment.mesh(), thickness, NOISE))
    assert surfaces.surface.min() < -1.0
    imprinted = solve_imprints(experiment, surfaces, op.Newton())
    assert imprinted is not None
    assert jnp.all(imprinted.uz > -0.3)


@pytest.mark.slow
def test_foundation_does_not_change_the_optimum(small):
    # Without friction nothing depends on the load path, and both fits have one optimum.
    experiment, (_, settings, prior, known) = palpation((6, 6, 2), window=0.0, sample=0.0), small
    thickness = small_map((experiment, settings, prior, known))

    def fit_closely(stiffness):
        closely = op.FitSettings(rtol=1e-3, cg_negligible=3e-3, draws=2, foundation_stiffness=stiffness, progress=False)
        fit = fit_along_z(experiment, thickness, prior, settings=closely, solver=settings)
        return eqx.tree_at(lambda f: f.posterior.rtol, fit, 3e-3)

    founded, dead = fit_closely(20.0), fit_closely(0.0)
    assert dead.objective.foundation.stiffness == 0.0
    assert founded.objective.foundation.stiffness > 0.0
    scale = float(jnp.max(dead.normal_std))
    assert founded.normal == pytest.approx(np.asarray(dead.normal), abs=0.02 * scale)
    assert jnp.linalg.norm(founded.normal - dead.normal) < 0.02 * jnp.linalg.norm(dead.normal_std)
    assert founded.chi2 == pytest.approx(float(dead.chi2), rel=0.01)
    assert founded.resolution_width == pytest.approx(np.asarray(dead.resolution_width), rel=0.05)
    assert jnp.linalg.norm(founded.normal_std) == pytest.approx(float(jnp.linalg.norm(dead.normal_std)), rel=0.03)
    deviations, others = (fit.draws(jax.random.key(0), 4) - fit.normal for fit in (founded, dead))
    assert deviations == pytest.approx(np.asarray(others), abs=0.05 * scale)
    weights = jnp.zeros((7, 7)).at[2:4, 1:4].set(1.0 / 6)
    covariance, other = (fit.covariance(weights) for fit in (founded, dead))
    assert covariance == pytest.approx(np.asarray(other), abs=0.05 * float(jnp.max(jnp.abs(other))))
    assert jnp.sum(weights * covariance) == pytest.approx(float(jnp.sum(weights * other)), rel=0.02)


@pytest.mark.slow
def test_lateral_traction_rests_on_its_prior(small):
    experiment, settings, prior, known = small
    rubbed = op.solve(experiment, op.Traction(known), settings).traction[:2]
    lateral = op.Matern(0.6, 2e-4, mean=rubbed)
    fit = fit_along_z(experiment, small_map(small), prior, lateral=lateral, solver=settings, draws=4, progress=False)
    assert jnp.linalg.norm(fit.normal - known) < 0.2 * jnp.linalg.norm(known - known.mean())
    assert fit.stats["lateral_informed"] < 0.3
    assert jnp.sqrt(jnp.mean((fit.traction[:2] - rubbed) ** 2)) < 2e-4
    told = fit_along_z(experiment, small_map(small), prior, lateral=rubbed, solver=settings, draws=1, progress=False)
    assert jnp.linalg.norm(told.normal - known) < 0.2 * jnp.linalg.norm(known - known.mean())
    assert told.traction[:2] == pytest.approx(np.asarray(rubbed), abs=1e-12)
    with pytest.raises(ValueError, match=r"Matern.mean \[MPa\].*\(2, ny\+1, nx\+1\) = \(2, 7, 7\), got \(7, 7\)"):
        fit_along_z(experiment, small_map(small), prior, lateral=op.Matern(0.6, 2e-4, mean=known), solver=settings)


@pytest.mark.slow
def test_friction_and_modulus_from_three_maps_and_forces(small):
    experiment, settings, prior, known = small
    loads = (0.5, 1.0, 1.5)
    maps = [small_map(small, seed, load) for seed, load in enumerate(loads)]
    area = tributary_area(experiment.mesh().positions()[:, -1])
    readings = [op.ForceReading(f, 0.01 * f) for f in (float(jnp.sum(load * known * area)) for load in loads)]
    truth = {"window.friction": 0.15, "layer.material.c10": 2.23e-3}
    parameters = {name: op.LogNormal(0.8 * value, 0.5) for name, value in truth.items()}
    wide = op.Matern(prior.length, 2e-3, mean=3e-3)
    fit = fit_along_z(
        experiment, maps, wide, parameters=parameters, forces=readings, solver=settings, draws=2, progress=False
    )
    assert fit.pressure.shape == (3, 7, 7)
    assert fit.draws(jax.random.key(0), 2).shape == (2, 3, 7, 7)
    for name, (low, high) in fit.number_intervals(0.99).items():
        assert low < truth[name] < high
        # The data tell: the interval is well inside the prior's.
        assert np.log(high / low) < 0.6 * 2 * 2.58 * 0.5
    low, high = fit.number_intervals()["window.friction"]
    assert fit.not_identified(0.1) == {
        "window.friction": pytest.approx(0.5 * (high - low) / fit.numbers["window.friction"])
    }
    total = jnp.sum(fit.normal * area, axis=(1, 2))
    assert total == pytest.approx(np.array([float(r.force) for r in readings]), rel=0.02)


@pytest.mark.slow
def test_two_constants_are_not_told_apart_at_small_strain(small):
    experiment, settings, prior, known = small
    force = 0.1 * float(jnp.sum(known * tributary_area(experiment.mesh().positions()[:, -1])))
    fit = fit_along_z(
        experiment,
        small_map(small, load=0.1),
        op.Matern(prior.length, 1e-4, mean=3e-4),
        parameters={"layer.material.c10": op.LogNormal(2.23e-3, 0.5), "layer.material.c01": op.LogNormal(7.03e-4, 0.5)},
        forces=op.ForceReading(force, 0.01 * force),
        solver=settings,
        draws=2,
        progress=False,
    )
    # Their sum is half of the shear modulus: 0.76 and 0.24 of a relative change of it.
    (name,) = (name for name in fit.unobserved() if "c01" in name)
    assert re.fullmatch(r"layer\.material\.c01 - 0\.[23]\d? layer\.material\.c10", name)
    after, before = fit.unobserved()[name]
    assert 0.9 < after <= before * 1.001
    assert fit.not_identified().keys() == fit.numbers.keys()
    covariance = fit.number_covariance
    assert covariance[0, 1] / jnp.sqrt(covariance[0, 0] * covariance[1, 1]) < -0.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:χ²")  # of priors that are too strong
@pytest.mark.parametrize("how", ["discrepancy", "evidence"])
def test_chosen_prior_is_at_most_twice_as_far_from_the_truth_as_the_best(small, how):
    """docs/validation.md test 40, from a prior eight times too wide."""
    experiment, settings, prior, known = small
    thickness = small_map(small)

    def fit(factor, **choice):
        believed = op.Matern(prior.length, factor * prior.std, mean=prior.mean)
        return fit_along_z(experiment, thickness, believed, solver=settings, draws=4, progress=False, **choice)

    def error(fit):
        return jnp.linalg.norm(fit.normal - known)

    chosen = fit(8.0, hyperparameters=how)
    assert chosen.prior.std < 4.0 * prior.std
    assert error(chosen) < 2.0 * min(error(fit(factor)) for factor in (0.25, 0.5, 1.0, 2.0, 4.0))
    if how == "discrepancy":
        assert chosen.chi2 / chosen.observed == pytest.approx(1.0, abs=0.1)


def test_displacements_inside_count_by_their_noise_where_they_were_measured(small):
    experiment, settings, prior, _ = small
    rng = np.random.default_rng(0)
    u, values = rng.standard_normal((1, 3, 3, 7, 7)), rng.standard_normal((3, 7, 7))
    std, mask = rng.uniform(0.5, 2.0, (3, 7, 7)), rng.random((3, 7, 7)) < 0.3
    flat = op.ThicknessMap(np.full((31, 31), 0.48), extent=(SIDE, SIDE), std=NOISE)
    observations = jax.tree.map(lambda leaf: leaf[None], project_map(experiment.mesh(), flat, NOISE))

    def inside(*args):
        misfit = Objective(
            experiment, observations, prior, None, None, {}, None, stacked("inside", op.AxialDisplacement(*args), 1),
            None, zero_foundation(experiment, observations, prior), settings.as_leaves(),
        )  # fmt: skip
        white = misfit.white(observations.surface)
        return misfit.residuals(white, jnp.asarray(u), jnp.ones(1))[0]["inside"][0]

    np.testing.assert_allclose(inside(values, std, mask), np.where(mask, 0.0, (u[0, 2] - values) / std), 1e-12)
    np.testing.assert_allclose(inside(values, 0.5), 2.0 * (u[0, 2] - values), 1e-12)


@pytest.mark.slow
def test_displacements_inside_tell_what_a_masked_map_does_not(small):
    """Half of the map is missing; the layer's motion, to 0.2 µm, says what presses there."""
    experiment, settings, prior, known = small
    mask = np.zeros((31, 31), bool)
    mask[:, :16] = True
    u = op.solve(experiment, op.Traction(known, stiffness=0.0), settings).displacement
    std = 2e-4
    measured = u[2] + std * np.random.default_rng(4).standard_normal(u[2].shape)
    fits = [
        fit_along_z(
            experiment, small_map(small, mask=mask), prior, solver=settings, draws=4, progress=False, inside=inside
        )
        for inside in (None, op.AxialDisplacement(measured, std))
    ]
    without, told = (float(jnp.sqrt(jnp.mean((fit.normal - known)[:, :3] ** 2))) for fit in fits)
    assert told < 0.3 * without
    assert jnp.mean(fits[1].normal_std[:, :3]) < 0.5 * jnp.mean(fits[0].normal_std[:, :3])


@pytest.mark.slow
def test_mean_pressure_under_a_bonded_nearly_incompressible_layer_is_named(small):
    """docs/validation.md test 40: it hardly moves the interface, and rests on the prior."""
    _, settings, prior, known = small
    sides = dict.fromkeys(("x0", "x1", "y0", "y1"), "roller")
    named = []
    for bulk in (0.11732, 20.0):
        layer = op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=bulk))
        free = palpation((6, 6, 2))
        held = op.Palpation(layer, free.extent, free.elements, op.Bonded(), free.sample, sides)
        thickness = small_map((held, settings, prior, known))
        fit = fit_along_z(held, thickness, prior, solver=settings, draws=1, progress=False)
        named.append(fit.unobserved())
    assert "mean pressure" not in named[0]
    after, before = named[1]["mean pressure"]
    assert 0.5 < after / before < 1.0


@pytest.mark.slow
def test_a_map_that_contradicts_the_model_is_told(small):
    experiment, settings, prior, _ = small
    # As short as the layer is thick: the prior allows no traction that makes such waves.
    waves = 0.03 * jnp.cos(2.0 * jnp.pi * jnp.linspace(0.0, SIDE, 31) / 0.5)
    wavy = eqx.tree_at(lambda m: m.values, thickness := small_map(small), thickness.values + waves)
    with pytest.warns(UserWarning, match="cannot explain the map"):
        # By the map's noise alone: waves of two elements would count as what the mesh cannot follow.
        fit = fit_along_z(experiment, wavy, prior, model_std=0.0, solver=settings, draws=1, progress=False)
    assert fit.result == op.FitStatus.successful
    assert fit.reduced_chi2 > 5


@pytest.mark.slow
def test_path_that_is_too_short_is_named(small):
    experiment, _, prior, _ = small
    with pytest.raises(op.FitError, match="Raise max_path"):
        fit_along_z(experiment, small_map(small), prior, solver=op.Newton(increments=3, max_path=2), progress=False)


def line_searched(misfit):
    """Evaluate six trial points from zero at most, until the fit stalls."""

    def evaluated(y, _):
        return misfit(y), {"within_max_path": jnp.ones((), bool), "in_equilibrium": jnp.ones((), bool)}

    rtol, number = jnp.asarray(1e-2), jnp.asarray
    descent = PreconditionedDescent(lambda J: lambda g: g, rtol, number(60), number(0.03), number(jnp.inf))
    solver = GaussNewton(rtol, descent)
    state = solver.init(evaluated, y := jnp.zeros(3), None, {}, *jax.eval_shape(evaluated, y, None), frozenset())
    for _ in range(6):
        y, state, _ = solver.step(evaluated, y, None, {}, state, frozenset())
        done, _ = solver.terminate(evaluated, y, None, {}, state, frozenset())
        status = _status(state, done, op.FitSettings().stall)
        if status != op.FitStatus.max_steps_reached:
            break
    return y, status


def test_fit_stalls_where_no_step_along_its_direction_helps():
    y, status = line_searched(lambda y: y - 10.0 + jnp.where(y > 1e-3, 1e3, 0.0))
    assert status == op.FitStatus.stalled
    assert jnp.all(y == 0.0)


def test_fit_goes_on_where_its_misfit_jumps_a_little():
    """As where a solve cuts an increment back: at zero lower than all around, by 0.3 % of the sum of squares, 300."""
    y, _ = line_searched(lambda y: jnp.append(y - 10.0 + jnp.where(y > 0.5, 1e3, 0.0), jnp.where(y[0] > 0.0, 1.0, 0.0)))
    assert jnp.all(y > 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*thicker than L0")
def test_missing_pixels_and_a_sample_that_does_not_touch(small):
    experiment, settings, prior, known = small
    missing = np.random.default_rng(0).random((31, 31)) < 0.3
    fit = fit_along_z(experiment, small_map(small, mask=missing), prior, solver=settings, draws=4, progress=False)
    assert fit.result == op.FitStatus.successful
    assert jnp.linalg.norm(fit.normal - known) < 0.2 * jnp.linalg.norm(known - known.mean())
    left = fit.observed - fit.effective_dof  # about 20
    assert abs(fit.chi2 - left) < 3.0 * jnp.sqrt(2.0 * left)

    free = op.ThicknessMap(np.full((31, 31), 0.52), extent=(SIDE, SIDE), std=NOISE)
    with pytest.raises(op.FitError, match="nonnegative=True"):
        fit_along_z(experiment, free, op.Matern(0.6, 1e-3), solver=settings, draws=1, progress=False)
    with pytest.warns(UserWarning, match="cannot explain the map"):
        kept = fit_along_z(
            experiment, free, op.Matern(0.6, 1e-3), nonnegative=True, solver=settings, draws=1, progress=False
        )
    assert kept.normal.min() >= 0
    assert kept.reduced_chi2 > 10
