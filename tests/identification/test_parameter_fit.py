"""Fits of friction and moduli: their observations, their posterior in closed form, and a whole fit."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.identification.loaded_states import follow
from opfem.identification.state_residuals import axial_increment, bulge
from tests.experiments import SIDE
from tests.tolerances import ROUNDOFF

POINTS = np.stack(
    np.meshgrid(np.linspace(0.4, 1.6, 4), np.linspace(0.5, 1.5, 3), np.linspace(0.05, 0.35, 4)), axis=-1
).reshape(-1, 3)


def moved(solution, step):
    """The state that lies a displacement [mm] beyond another."""
    return eqx.tree_at(lambda s: s.displacement, solution, solution.displacement + step)


def modes(solution):
    """Two displacements [mm]: thinning, and a wave along x that vanishes at the window."""
    X = solution.positions
    zero = jnp.zeros_like(X[0])
    return jnp.stack([zero, zero, -X[2]]), jnp.stack([zero, zero, X[2] * jnp.sin(3.0 * X[0])])


def test_increment_is_that_of_the_scene(solution):
    after = moved(solution, 1e-3 * modes(solution)[0] + 2e-3 * modes(solution)[1])
    expected = op.oct_scene(after, before=solution).increment(*POINTS.T)[2]
    np.testing.assert_allclose(axial_increment(solution, after, jnp.asarray(POINTS)), expected, atol=1e-10)


def test_bulge_is_that_of_the_side(solution):
    depth = np.array([0.1, 0.2])
    for side, axis, end, sign in (("x0", 0, 0, -1.0), ("x1", 0, -1, 1.0), ("y0", 1, 0, -1.0), ("y1", 1, -1, 1.0)):
        u, X = (np.asarray(part) for part in (solution.displacement, solution.positions))
        middle = u.shape[3 - axis - 0] // 2 if axis else u.shape[2] // 2
        line = (
            (slice(None), slice(None), middle, end) if axis == 0 else (slice(None), slice(None), end, u.shape[3] // 2)
        )
        z = X[line][2] + u[line][2]
        expected = np.interp(depth, z, sign * u[line][axis])
        np.testing.assert_allclose(bulge(solution, side, jnp.asarray(depth)), expected, rtol=ROUNDOFF)


@pytest.fixture
def linear(solution):
    """An experiment that is linear in its numbers, what is observed of it, and its Jacobian over the noise."""
    first, second = modes(solution)

    def experiment(numbers):
        step = 1e-3 * numbers["thinning"] * first
        if "wave" in numbers:
            step = step + 1e-3 * numbers["wave"] * second
        return solution, moved(solution, step)

    J = np.stack(
        [axial_increment(solution, moved(solution, 1e-3 * mode), jnp.asarray(POINTS)) for mode in (first, second)],
        axis=1,
    )
    noise = 2e-6 * np.random.default_rng(3).standard_normal(len(POINTS))
    return experiment, op.AxialIncrement(POINTS, J @ [2.0, 0.3] + noise, 2e-6), J / 2e-6


PRIORS = {"thinning": op.Normal(1.0, 1.0), "wave": op.Normal(0.0, 1.0)}


def test_posterior_of_a_linear_experiment(linear):
    experiment, observed, J = linear
    found = op.fit_parameters(experiment, [observed], PRIORS, scale=op.Normal(1.0, 1e-7), rtol=1e-4)
    covariance = np.linalg.inv(J.T @ J + np.eye(2))
    mean = covariance @ (J.T @ np.asarray(observed.values) / 2e-6 + [1.0, 0.0])
    np.testing.assert_allclose([found.numbers["thinning"], found.numbers["wave"]], mean, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[:2, :2], covariance, rtol=1e-3)
    left = np.asarray(observed.values) / 2e-6 - J @ mean
    assert float(found.chi2["phase"]) == pytest.approx(left @ left, rel=1e-4)
    assert found.converged


def test_scale_is_fitted_with_its_prior(linear):
    """The scale of all increments is one with the thinning where nothing else tells the thinning."""
    experiment, observed, _ = linear
    found = op.fit_parameters(experiment, [observed], PRIORS)
    assert float(found.std["scale"]) == pytest.approx(0.01, rel=0.01)
    assert float(found.std["thinning"] / found.numbers["thinning"]) == pytest.approx(0.01, rel=0.02)
    assert any("identified only in combination" in said for said in found.advice())
    assert not any("scale is prior-dominated" in said for said in found.advice())


def test_prior_of_the_scale_is_that_of_the_increments(linear):
    experiment, observed, _ = linear
    sharper = eqx.tree_at(lambda o: o.scale_std, observed, 1e-3)
    found = op.fit_parameters(experiment, [sharper], PRIORS)
    assert float(found.std["scale"]) == pytest.approx(1e-3, rel=0.01)


def test_a_number_that_nothing_depends_on_is_its_prior(linear):
    experiment, observed, _ = linear
    found = op.fit_parameters(experiment, [observed], {**PRIORS, "idle": op.LogNormal(0.1, 0.5)})
    assert found.insensitive == ("idle",)
    assert float(found.prior_share["idle"]) == pytest.approx(1.0)
    assert any(said.startswith("idle is prior-dominated") for said in found.advice())


def test_a_wrong_model_shows_in_chi2(linear):
    experiment, observed, _ = linear
    found = op.fit_parameters(experiment, [observed], {"thinning": PRIORS["thinning"]}, scale=op.Normal(1.0, 1e-4))
    assert any("χ² of phase" in said for said in found.advice())
    allowed = op.fit_parameters(
        experiment, [observed], {"thinning": PRIORS["thinning"]}, scale=op.Normal(1.0, 1e-4), model_std=1e-3
    )
    assert not any("χ² of phase" in said for said in allowed.advice())
    assert float(allowed.std["thinning"]) > 10 * float(found.std["thinning"])


def test_one_force_that_is_far_off_shows_in_chi2(linear, solution):
    experiment, observed, _ = linear
    force = -float(solution.stats["force_sample"][2])
    for off, said in ((2.0, False), (5.0, True)):
        found = op.fit_parameters(experiment, [observed, (0, op.ForceReading(force + off * 1e-3, 1e-3))], PRIORS)
        assert any("χ² of force" in one for one in found.advice()) == said


def test_starts_again_where_the_first_optimum_explains_nothing(solution):
    """Steps from the median end in the local minimum of t³ - 3t at 1, above the observed -8.1 at -2.5."""

    def experiment(numbers):
        t = numbers["t"]
        return solution, moved(solution, 1e-3 * (t**3 - 3.0 * t) * modes(solution)[0])

    first, second = experiment({"t": -2.5})
    observed = op.AxialIncrement(POINTS, axial_increment(first, second, jnp.asarray(POINTS)), 1e-4)
    found = op.fit_parameters(experiment, [observed], {"t": op.Normal(0.5, 1.5)}, scale=op.Normal(1.0, 1e-4))
    assert float(found.numbers["t"]) == pytest.approx(-2.5, abs=1e-2)
    assert found.steps > 5


def test_maps_and_forces_and_bulges_are_observed(linear, solution):
    """What a state itself shows leaves no residual."""
    experiment, _, _ = linear
    force = -float(solution.stats["force_sample"][2])
    depth = np.array([0.1, 0.3])
    found = op.fit_parameters(
        experiment,
        [
            (0, op.ForceReading(force, 1e-3)),
            (0, op.SideBulge("x1", depth, bulge(solution, "x1", jnp.asarray(depth)), 1e-3)),
            (0, op.measured_thickness(solution, 0.1, std=2e-3)),
        ],
        PRIORS,
    )
    assert set(found.residuals) == {"force", "bulge", "thickness"}
    assert float(found.chi2["force"]) == pytest.approx(0.0, abs=1e-12)
    assert float(found.chi2["bulge"]) == pytest.approx(0.0, abs=1e-12)
    assert found.insensitive == ("thinning", "wave")


def test_what_is_refused(linear, solution):
    experiment, observed, _ = linear
    for wrong, message in (
        ([], "must contain an observation"),
        ([op.ForceReading(1.0, 0.1)], "number of the observed state"),
        ([3], "must be AxialIncrement"),
        ([(2, op.ForceReading(1.0, 0.1))], "is of state 2; there are 2"),
    ):
        with pytest.raises(ValueError, match=message):
            op.fit_parameters(experiment, wrong, PRIORS)
    with pytest.raises(ValueError, match="identical"):
        op.fit_parameters(lambda numbers: (solution, solution), [observed], PRIORS)
    with pytest.raises(ValueError, match="got 1 twice"):
        op.AxialIncrement(POINTS, np.zeros(len(POINTS)), 1e-6, before=1, after=1)
    with pytest.raises(op.FitError, match="did not converge within"):
        op.fit_parameters(experiment, [observed], PRIORS, max_steps=1)
    with pytest.raises(ValueError, match="two lists of one length"):
        op.SideBulge("x0", [0.1, 0.2], [0.0], 1e-3)
    with pytest.raises(ValueError, match="fit_parameters: parameters name numbers"):
        op.fit_parameters((solution.palpation, [solution.load]), [observed], {"window.grip": op.Normal(1.0, 1.0)})


def plates(window, sample, **changes):
    """A layer between two flat plates."""
    layer = op.Layer(0.5, op.MooneyRivlin(2.23e-3, 7.03e-4, bulk=changes.pop("bulk", 0.11732)))
    # A penalty: multipliers take one increment more or less, and move the layer by nanometres, as numbers change.
    hard = op.HardOverclosure(exact=False)
    given = {"extent": (SIDE, SIDE), "elements": (8, 8, 2), **changes}
    return op.Palpation(layer, window=op.Contact(hard, window), sample=op.Contact(hard, sample), **given)


def pressed(thickness):
    return op.Imprint(op.ThicknessMap(np.full((5, 5), thickness), extent=(SIDE, SIDE)))


LOADS = [pressed(0.45), pressed(0.449)]


def test_changes_of_states_against_differences():
    """Of two states, the second from the first, by friction, modulus and thickness: nodes and force."""
    # At 20 shear moduli, the published bulk modulus, the penalty's stiffness has a kink.
    palpation, solver = plates(0.15, 0.05, elements=(4, 4, 2), bulk=0.2), op.Newton(rtol=1e-10)
    numbers = {name: jnp.asarray(value) for name, value in
               {"window.friction": 0.15, "layer.material.c10": 2.23e-3, "l0_offset": 0.0}.items()}  # fmt: skip
    direction = {"window.friction": 0.1, "layer.material.c10": 1e-3, "l0_offset": 0.05}
    h = 1e-4

    def states(factor):
        moved = {name: value + factor * h * direction[name] for name, value in numbers.items()}
        return follow(palpation, LOADS, moved, solver).states()

    path = follow(palpation, LOADS, numbers, solver)
    changes = path.changes([{name: jnp.asarray(value) for name, value in direction.items()}])
    for change, high, low in zip(changes, states(1.0), states(-1.0), strict=True):
        for name in ("positions", "displacement", "force"):
            expected = (getattr(high, name) - getattr(low, name)) / (2 * h)
            scale = float(jnp.abs(expected).max())
            np.testing.assert_allclose(getattr(change, name)[0], expected, atol=1e-4 * scale)


@pytest.fixture
def _room_for_programs():
    """Each step of a fit loads its linearised solves again; with what others left, mapped regions would not suffice."""
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.usefixtures("_room_for_programs")
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("frictions", [(0.2, 0.08), (0.1, 0.1)])
def test_frictions_from_phase_and_force(frictions):
    """Own mesh, 2 nm a block, a scale 0.5 % off: both frictions, bulk modulus and scale; equal frictions too."""
    truth = plates(*frictions)
    first = op.solve(truth, LOADS[0])
    second = op.solve(truth, LOADS[1], start=first)
    rng = np.random.default_rng(0)
    values = 1.005 * np.asarray(axial_increment(first, second, jnp.asarray(POINTS)))
    force = -float(first.stats["force_sample"][2])
    observations = [
        op.AxialIncrement(POINTS, values + 2e-6 * rng.standard_normal(len(POINTS)), 2e-6),
        (0, op.ForceReading(force, 0.02 * force)),
    ]
    found = op.fit_parameters(
        (plates(0.15, 0.05), LOADS),
        observations,
        {
            "window.friction": op.LogNormal(0.15, 0.5),
            "sample.friction": op.LogNormal(0.05, 0.7),
            "layer.material.bulk": op.LogNormal(0.15, 0.5),
        },
        model_std=0.0,  # the increments are of this mesh
    )
    expected = {"window.friction": frictions[0], "sample.friction": frictions[1], "layer.material.bulk": 0.11732}
    for name, value in (expected | {"scale": 1.005}).items():
        assert abs(float(found.numbers[name]) - value) < 3.0 * float(found.std[name])
    assert float(found.chi2["phase"]) == pytest.approx(len(POINTS), rel=0.5)


@pytest.mark.slow
@pytest.mark.usefixtures("_room_for_programs")
@pytest.mark.timeout(1500)
def test_mesh_error_is_followed_into_the_numbers():
    """Intervals hold a truth of a finer mesh, and states and residuals are of the fit's own."""
    truth = plates(0.2, 0.08, elements=(14, 14, 4))
    first = op.solve(truth, LOADS[0])
    second = op.solve(truth, LOADS[1], start=first)
    values = axial_increment(first, second, jnp.asarray(POINTS))
    force = -float(first.stats["force_sample"][2])
    found = op.fit_parameters(
        (plates(0.15, 0.05, elements=(8, 8, 4)), LOADS),
        [op.AxialIncrement(POINTS, values, 2e-6, scale_std=1e-3), (0, op.ForceReading(force, 0.02 * force))],
        {"window.friction": op.LogNormal(0.15, 0.5), "sample.friction": op.LogNormal(0.05, 0.7)},
    )
    for name, value in {"window.friction": 0.2, "sample.friction": 0.08}.items():
        low, high = found.intervals()[name]
        assert low < value < high
        assert float(found.mesh_std[name]) > 0.2 * float(found.std[name])
    assert [one.palpation.elements for one in found.solutions] == [(8, 8, 4)] * 2
    computed = float(found.numbers["scale"]) * axial_increment(*found.solutions, jnp.asarray(POINTS))
    left = np.asarray(computed - values) / 2e-6
    np.testing.assert_allclose(found.residuals["phase"] / left, np.median(found.residuals["phase"] / left), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("_room_for_programs")
@pytest.mark.timeout(1500)
def test_derivatives_of_increments_against_differences():
    """Through two solves in a row, the second from the first."""
    tight = op.Newton(rtol=1e-10)

    def increments(x):
        palpation = dataclasses.replace(plates(x[0], x[1]))
        first = op.solve(palpation, LOADS[0], tight, progress=False)
        second = op.solve(palpation, LOADS[1], tight, start=first, progress=False)
        return axial_increment(first, second, jnp.asarray(POINTS))

    x, direction = jnp.array([0.15, 0.05]), jnp.array([1.0, 0.5])
    _, derivative = jax.jvp(increments, (x,), (direction,))
    h = 1e-4
    difference = (increments(x + h * direction) - increments(x - h * direction)) / (2 * h)
    np.testing.assert_allclose(derivative, difference, atol=1e-4 * float(jnp.abs(difference).max()))


def test_intervals_are_those_of_the_posterior(linear):
    experiment, observed, _ = linear
    priors = {"thinning": op.Normal(1.0, 1.0), "wave": op.LogNormal(0.2, 0.5)}
    found = op.fit_parameters(experiment, [observed], priors, scale=op.Normal(1.0, 1e-7))
    low, high = found.intervals()["thinning"]
    assert high - low == pytest.approx(2 * 1.959964 * float(found.std["thinning"]), rel=1e-5)
    low, high = found.intervals(0.9)["wave"]
    assert low * high == pytest.approx(float(found.numbers["wave"]) ** 2, rel=1e-9)  # symmetric in the logarithm
    assert np.log(high / low) == pytest.approx(2 * 1.644854 * 0.5 * float(found.prior_share["wave"]), rel=1e-5)


def test_picture_shows_every_number_and_pair(linear):
    experiment, observed, _ = linear
    found = op.fit_parameters(experiment, [observed], PRIORS)
    axes = op.plot_parameters(found)
    assert axes.shape == (3, 3)
    assert [ax.get_xlabel() for ax in axes[-1]] == ["thinning [-]", "wave [-]", "scale [-]"]
    low, high = (float(end) for end in axes[2, 2].get_title().split(" to "))
    assert 0.9 * (high - low) < 2 * 1.959964 * float(found.std["scale"]) < 1.1 * (high - low)
    assert [[ax.get_visible() for ax in row] for row in axes.tolist()] == np.tri(3, dtype=bool).tolist()


def test_curves_of_the_picture_include_the_mesh_error(linear):
    experiment, observed, _ = linear
    found = op.fit_parameters(experiment, [observed], {"thinning": op.Normal(1.0, 1.0)})
    found = eqx.tree_at(lambda fit: fit.white_mesh_covariance, found, 8.0 * found.white_covariance)
    curve = op.plot_parameters(found)[0, 0].get_lines()[0].get_xdata()
    std = float(found.std["thinning"])
    assert std == pytest.approx(3.0 * float(found.prior_share["thinning"]), rel=1e-5)
    np.testing.assert_allclose(np.ptp(curve), 8.0 * std, rtol=1e-5)
