"""Drucker's criterion against closed forms, and what a solve says that leaves the stable range."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import opfem as op
from opfem.model import extreme_stretches, unstable_stretch
from opfem.model.deformation import kinematics
from opfem.solvers import CONVERGED
from tests.experiments import published_palpation
from tests.oracles import random_rotation
from tests.tolerances import ROUNDOFF

BULK = 0.1
# The criterion is looked at on a grid of stretches; this is its spacing, in log strain, over the ranges below.
GRID = 0.025
MODES = {
    "uniaxial": lambda s: np.array([s, s**-0.5, s**-0.5]),
    "equibiaxial": lambda s: np.array([s, s, s**-2.0]),
    "planar": lambda s: np.array([s, 1.0, 1.0 / s]),
}


def mooney(c10, c01):
    return lambda y: c10 * ((y**2).sum() - 3) + c01 * ((y**-2.0).sum() - 3)


def yeoh(c10, c20, c30):
    return lambda y: sum(c * ((y**2).sum() - 3) ** p for p, c in enumerate((c10, c20, c30), 1))


def ogden(mu, alpha):
    return lambda y: sum(2 * m / a**2 * ((y**a).sum() - 3) for m, a in zip(mu, alpha, strict=True))


LAWS = {
    "mooney-rivlin, c01 < 0": (op.MooneyRivlin(4e-3, -1.5e-3, BULK), mooney(4e-3, -1.5e-3)),
    "mooney-rivlin, c10 < 0": (op.MooneyRivlin(-1e-3, 3.9e-3, BULK), mooney(-1e-3, 3.9e-3)),
    "yeoh, c20 < 0": (op.Yeoh(3e-3, -1.2e-3, 1e-4, BULK), yeoh(3e-3, -1.2e-3, 1e-4)),
    "yeoh, c30 < 0": (op.Yeoh(3e-3, 0.0, -2e-4, BULK), yeoh(3e-3, 0.0, -2e-4)),
    "ogden, one term < 0": (op.Ogden([8e-3, -3e-3], [2.0, -2.0], BULK), ogden([8e-3, -3e-3], [2.0, -2.0])),
    "ogden, wrong sign": (op.Ogden([8e-3, -2e-3], [1.5, 4.0], BULK), ogden([8e-3, -2e-3], [1.5, 4.0])),
}
STABLE = {
    "mooney-rivlin": op.MooneyRivlin(2.23e-3, 7.03e-4, BULK),
    "neo-hooke": op.NeoHooke(2e-3, BULK),
    "yeoh": op.Yeoh(2e-3, 1e-4, 1e-5, BULK),
    "ogden": op.Ogden([4e-3, 5e-4, 1e-3], [1.3, -3.0, 5.0], BULK),
    "hencky": op.Hencky(5e-3, BULK),
}


def work_of_change(energy, stretches):
    """Least eigenvalue of d²ψ/dε² at constant volume, by central differences of the energy."""
    step, base = 1e-4, np.log(stretches)
    directions = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])

    def at(a, b):
        return energy(np.exp(base + a * directions[0] + b * directions[1]))

    D11 = (at(step, 0) - 2 * at(0, 0) + at(-step, 0)) / step**2
    D22 = (at(0, step) - 2 * at(0, 0) + at(0, -step)) / step**2
    D12 = (at(step, step) - at(step, -step) - at(-step, step) + at(-step, -step)) / (4 * step**2)
    return np.linalg.eigvalsh([[D11, D12], [D12, D22]])[0]


def limits(energy, low, high):
    """Stretches along every mode, both ways from rest, at which the work of a small change vanishes."""
    found = []
    for mode in MODES.values():
        for end in (low, high):
            path = np.geomspace(1.0, end, 400)
            work = np.array([work_of_change(energy, mode(s)) for s in path])
            if (work <= 0).any():
                k = int(np.argmax(work <= 0))
                s = brentq(lambda s, mode=mode: work_of_change(energy, mode(s)), path[k - 1], path[k])
                found.append(mode(s))
    return [stretches[np.argmax(np.abs(np.log(stretches)))] for stretches in found]


@pytest.mark.parametrize(("law", "energy"), LAWS.values(), ids=LAWS)
def test_limit_is_where_the_work_of_a_small_change_vanishes(law, energy):
    low, high = 0.3, 3.0
    expected = min(limits(energy, low, high), key=lambda s: abs(np.log(s)))
    # The same state is a stretch of s along one axis, or one of s^(-1/2) along two.
    assert abs(np.log(unstable_stretch(law, low, high))) == pytest.approx(abs(np.log(expected)), abs=GRID)
    # Not from before the limit.
    near = np.exp(0.9 * abs(np.log(expected)))
    assert unstable_stretch(law, 1 / near, near) == 0


def test_limit_in_closed_form():
    """Mooney–Rivlin squeezed to s: 2 (c10 s² + c01/s²) + c10/s + c01 s vanishes (module of the trial: 0.5 to 0.6)."""
    c10, c01 = 4e-3, -1.5e-3
    limit = brentq(lambda s: 2 * (c10 * s**2 + c01 / s**2) + c10 / s + c01 * s, 0.3, 0.9)
    law = op.MooneyRivlin(c10, c01, BULK)
    assert float(unstable_stretch(law, 0.45, 0.45**-0.5)) == pytest.approx(limit, rel=GRID)
    assert 0.45 < limit < 0.7
    assert unstable_stretch(law, 0.7, 0.7**-0.5) == 0


@pytest.mark.parametrize("law", STABLE.values(), ids=STABLE)
def test_laws_in_use_are_stable_from_a_tenth_to_tenfold(law):
    assert unstable_stretch(law, 0.1, 10.0) == 0


@pytest.mark.parametrize(("low", "high"), [(np.nan, np.nan), (0.0, 1e200), (1.0, 1.0), (0.5, np.inf)])
def test_stretches_of_a_failed_solve_raise_no_alarm(low, high):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for law in STABLE.values():
            assert unstable_stretch(law, low, high).shape == ()


@pytest.mark.parametrize("law", [law for law, _ in LAWS.values()], ids=LAWS)
def test_traced_numbers_give_the_same_limit(law):
    expected = unstable_stretch(law, 0.3, 3.0)
    got = jax.jit(unstable_stretch)(law, 0.3, 3.0)
    np.testing.assert_allclose(got, expected, ROUNDOFF)
    many = jax.vmap(unstable_stretch)(
        jax.tree.map(lambda v: jnp.stack([v, v]), law), jnp.array([0.3, 0.99]), 3.0 * jnp.ones(2)
    )
    np.testing.assert_allclose(many[0], expected, ROUNDOFF)


def test_extreme_stretches_are_those_of_the_singular_values():
    rng = np.random.default_rng(0)
    F = [random_rotation(rng) @ np.diag(s) @ random_rotation(rng) for s in rng.uniform(0.4, 2.0, (200, 3))]
    F += [np.eye(3), random_rotation(rng), 1.2 * np.eye(3)]
    stretches = np.array([np.linalg.svd(f, compute_uv=False) / np.linalg.det(f) ** (1 / 3) for f in F])
    for one, expected in zip([F, F[200:], F[:1]], [stretches, stretches[200:], stretches[:1]], strict=True):
        H = jnp.array(np.moveaxis(np.array(one) - np.eye(3), 0, -1))
        # Near equal stretches the root of a difference leaves half of the digits.
        np.testing.assert_allclose(extreme_stretches(kinematics(H)), [expected.min(), expected.max()], rtol=1e-7)


@pytest.mark.parametrize(
    "make",
    [
        lambda: op.MooneyRivlin(-1e-3, 9e-4, BULK),
        lambda: op.MooneyRivlin(1e-3, -1e-3, BULK),
        lambda: op.NeoHooke(-1e-3, BULK),
        lambda: op.Yeoh(-1e-3, 1.0, 1.0, BULK),
        lambda: op.Ogden([1e-3, -2e-3], [2.0, 1.0], BULK),
        lambda: op.Hencky(-1e-3, BULK),
    ],
)
def test_what_is_unstable_at_rest_is_refused(make):
    with pytest.raises(ValueError, match="must be positive"):
        make()


SMOOTH = op.Contact(op.HardOverclosure(exact=True), friction=0.0)


def squeezed(law, stretch, **options):
    """A smooth block between smooth plates, as in uniaxial compression."""
    palpation = published_palpation(SMOOTH, SMOOTH, law, extent=(1.0, 1.0), elements=(2, 2, 2))
    return op.solve(palpation, op.Displacement(uz=-(1 - stretch) * 0.5), **options)


@pytest.fixture(scope="module")
def unstable():
    return squeezed(op.MooneyRivlin(4e-3, -1.5e-3, BULK), 0.45)


def test_a_solve_beyond_the_limit_says_so_and_names_the_stretch(unstable):
    assert unstable.result == op.RESULTS.material_unstable
    assert "material_unstable" in CONVERGED
    assert float(unstable.stats["unstable_stretch"]) == pytest.approx(0.56, abs=0.04)
    dataset = op.to_xarray(unstable)
    assert dataset.attrs["status"] == "material_unstable"
    assert "Stretches reach from 0.4" in dataset.attrs["status_message"]
    assert np.isfinite(dataset.pressure).all()
    assert op.summary(unstable)["status"] == "material_unstable"


def test_a_solve_within_the_limit_does_not():
    solved = squeezed(op.MooneyRivlin(4e-3, -1.5e-3, BULK), 0.7)
    assert solved.result == op.RESULTS.successful
    assert solved.stats["unstable_stretch"] == 0
    # Free sides: the lateral stretch of the closed form, and its modified value.
    u = solved.displacement[0, 0]
    lateral = 1 + float(u[0, -1] - u[0, 0])
    J = 0.7 * lateral**2
    np.testing.assert_allclose(solved.stats["min_stretch"], 0.7 * J ** (-1 / 3), rtol=1e-5)
    np.testing.assert_allclose(solved.stats["max_stretch"], lateral * J ** (-1 / 3), rtol=1e-5)


def test_a_sweep_marks_its_unstable_points():
    def pressed(c01):
        return squeezed(op.MooneyRivlin(4e-3, c01, BULK), 0.45, throw=False, progress=False)

    data = op.sweep(pressed, {"c01": [-1.5e-3, 1e-3]}, keep=("max_pressure", "unstable_stretch"))
    assert data.status.values.tolist() == ["material_unstable", "successful"]
    assert (data.unstable_stretch > 0).values.tolist() == [True, False]
    assert np.isfinite(data.max_pressure).all()
