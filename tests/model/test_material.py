"""Materials against NumPy formulas, against `energy` differentiated, and against table A of VALIDATION.md."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import opfem as op
from opfem.model.material import kinematics
from tests.oracles import cauchy_stress, first_piola, random_rotation
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
MR20 = op.MooneyRivlin(C10, C01, BULK)
NEO = op.NeoHooke(C10, BULK)
MATERIALS = pytest.mark.parametrize(("material", "c01"), [(MR20, C01), (NEO, 0.0)], ids=["mooney-rivlin", "neo-hooke"])
EYE = np.eye(3)


@pytest.fixture(scope="module")
def samples():
    """200 deformation gradients `(200, 3, 3)`, rotated and far from the identity, with J from 0.3 to 3."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < 200:
        F = random_rotation(rng) @ (EYE + 0.3 * rng.standard_normal((3, 3)))
        if 0.3 < np.linalg.det(F) < 3.0:
            found.append(F)
    return np.array(found)


def as_field(F):
    """From one tensor per row to the layout of opfem, H = F - I with points last."""
    return jnp.array(np.moveaxis(F - EYE, 0, -1))


def stress(material, H):
    k = kinematics(H)
    return material.first_piola(k, material.volumetric_stress(k.volume_change))


def cauchy(material, F):
    """Cauchy stress [MPa] of one F."""
    return np.asarray(stress(material, jnp.array(F - EYE))) @ F.T / np.linalg.det(F)


def assert_close(got, expected, rtol=ROUNDOFF):
    """Compare whole tensors: small entries are as exact as the largest of their point."""
    got, expected = np.asarray(got), np.asarray(expected)
    np.testing.assert_allclose(got, expected, rtol, rtol * np.abs(expected).max())


@MATERIALS
def test_stress_equals_the_spatial_formula(material, c01, samples):
    expected = [first_piola(F, C10, c01, BULK) for F in samples]
    assert_close(np.moveaxis(stress(material, as_field(samples)), -1, 0), expected)


@MATERIALS
def test_energy_equals_its_definition(material, c01, samples):
    expected = []
    for F in samples:
        stretches = np.linalg.svd(F, compute_uv=False)
        J = stretches.prod()
        modified = stretches**2 * J ** (-2 / 3)
        expected.append(C10 * (modified.sum() - 3) + c01 * ((1 / modified).sum() - 3) + BULK / 2 * (J - 1) ** 2)
    assert_close(material.energy(as_field(samples)), expected)


@MATERIALS
def test_stress_is_the_derivative_of_energy(material, c01, samples):
    H = as_field(samples)
    derivative = jax.vmap(jax.grad(material.energy), -1, -1)(H)
    assert_close(stress(material, H), derivative)


@MATERIALS
def test_tangent_is_the_derivative_of_stress_at_constant_mean_stress(material, c01, samples):
    H = as_field(samples)
    mean = 0.3 * material.bulk

    def derivative(h):
        return jax.jacfwd(lambda v: material.first_piola(kinematics(v), mean))(h)

    assert_close(material.tangent(kinematics(H), mean), jax.vmap(derivative, -1, -1)(H))


@MATERIALS
def test_tangent_and_bulk_part_are_the_second_derivative_of_energy(material, c01, samples):
    H = as_field(samples)
    k = kinematics(H)
    cofactors = np.array([np.linalg.det(F) * np.linalg.inv(F).T for F in samples])
    bulk = BULK * np.einsum("pij,pkl->ijklp", cofactors, cofactors)
    got = material.tangent(k, material.volumetric_stress(k.volume_change)) + bulk
    assert_close(got, jax.vmap(jax.hessian(material.energy), -1, -1)(H))


@MATERIALS
def test_tangent_equals_a_central_difference_of_the_spatial_formula(material, c01, samples):
    step = 1e-6
    for F in samples[:10]:
        k = kinematics(jnp.array(F - EYE))
        cofactor = np.linalg.det(F) * np.linalg.inv(F).T
        A = material.tangent(k, material.volumetric_stress(k.volume_change)) + BULK * np.multiply.outer(cofactor, cofactor)
        for m in range(9):
            change = step * np.eye(9)[m].reshape(3, 3)
            difference = first_piola(F + change, C10, c01, BULK) - first_piola(F - change, C10, c01, BULK)
            assert_close(A[:, :, m // 3, m % 3], difference / (2 * step), FINITE_DIFFERENCE)


@MATERIALS
def test_tangent_is_symmetric(material, c01, samples):
    A = np.asarray(material.tangent(kinematics(as_field(samples)), 0.1 * material.bulk))
    assert_close(A, np.transpose(A, (2, 3, 0, 1, 4)))


@MATERIALS
def test_objectivity_and_isotropy(material, c01, samples):
    rng = np.random.default_rng(1)
    for F in samples[:20]:
        Q = random_rotation(rng)
        P = np.asarray(stress(material, jnp.array(F - EYE)))
        energy = material.energy(jnp.array(F - EYE))
        for turned, expected in ((Q @ F, Q @ P), (F @ Q, P @ Q)):
            H = jnp.array(turned - EYE)
            assert_close(stress(material, H), expected)
            assert_close(material.energy(H), energy)


def test_a_rotation_alone_causes_no_stress():
    Q = random_rotation(np.random.default_rng(2))
    np.testing.assert_allclose(stress(MR20, jnp.array(Q - EYE)), 0.0, atol=ROUNDOFF * BULK)


@MATERIALS
def test_cauchy_stress_is_symmetric(material, c01, samples):
    for F in samples[:20]:
        sigma = cauchy(material, F)
        assert_close(sigma, sigma.T)


# Stretch, lateral stretch, -σ and -nominal stress [kPa] with free sides, -σzz and -σxx [kPa] with fixed sides.
TABLE_A = [
    (0.95, 1.0246953, 0.870745, 0.914283, 6.220535, 5.598733),
    (0.90, 1.0514025, 1.775797, 1.963050, 12.504048, 11.165976),
    (0.80, 1.1120221, 3.736311, 4.620297, 25.323687, 22.174156),
    (0.70, 1.1848590, 6.018396, 8.449172, 38.645584, 32.931208),
    (0.60, 1.2744468, 8.873126, 14.411863, 52.822046, 43.260977),
    (0.50, 1.3879736, 12.807315, 24.672919, 68.587463, 52.796269),
]
# Tables are printed to six decimals of kPa, lateral stretches to seven.
PRINTED_KPA, PRINTED_STRETCH = 0.6e-6, 0.6e-7


def free_stretch(direction, stretches):
    """Stretch along `direction` that leaves it without stress, others given, by the spatial formula."""

    def sigma(value):
        full = np.array(stretches)
        full[list(direction)] = value
        return cauchy_stress(np.diag(full), C10, C01, BULK)[direction[0], direction[0]]

    return brentq(sigma, 0.3, 3.0, xtol=1e-15, rtol=1e-14)


@pytest.mark.parametrize(("stretch", "lateral", "sigma", "nominal", "zz", "xx"), TABLE_A)
def test_table_a(stretch, lateral, sigma, nominal, zz, xx):
    found = free_stretch((0, 1), [1.0, 1.0, stretch])
    assert abs(found - lateral) < PRINTED_STRETCH
    free = np.diag([found, found, stretch])
    kpa = 1e3 * cauchy(MR20, free)
    np.testing.assert_allclose(np.diag(kpa), [0.0, 0.0, -sigma], rtol=0, atol=PRINTED_KPA)
    piola = 1e3 * np.asarray(stress(MR20, jnp.array(free - EYE)))
    assert abs(piola[2, 2] + nominal) < PRINTED_KPA
    confined = 1e3 * cauchy(MR20, np.diag([1.0, 1.0, stretch]))
    np.testing.assert_allclose(np.diag(confined), [-xx, -xx, -zz], rtol=0, atol=PRINTED_KPA)


def test_plane_strain():
    lateral = free_stretch((0,), [1.0, 1.0, 0.8])
    assert abs(lateral - 1.2217208) < PRINTED_STRETCH
    kpa = 1e3 * cauchy(MR20, np.diag([lateral, 1.0, 0.8]))
    np.testing.assert_allclose(np.diag(kpa), [0.0, -2.719281, -5.161790], rtol=0, atol=PRINTED_KPA)


def test_equibiaxial_stretch():
    through = free_stretch((2,), [1.5, 1.5, 1.0])
    assert abs(through - 0.4782747) < PRINTED_STRETCH
    kpa = 1e3 * cauchy(MR20, np.diag([1.5, 1.5, through]))
    np.testing.assert_allclose(np.diag(kpa), [13.258242, 13.258242, 0.0], rtol=0, atol=PRINTED_KPA)


def test_simple_shear():
    F = EYE + 0.5 * np.outer(EYE[0], EYE[1])
    kpa = 1e3 * cauchy(MR20, F)
    expected = [[0.8505, 2.903, 0.0], [2.903, -0.601, 0.0], [0.0, 0.0, -0.2495]]
    np.testing.assert_allclose(kpa, expected, rtol=ROUNDOFF, atol=1e3 * ROUNDOFF * BULK)


def test_initial_moduli():
    shear = 2 * (C10 + C01)
    np.testing.assert_allclose(MR20.shear, shear, ROUNDOFF)
    np.testing.assert_allclose(NEO.shear, 2 * C10, ROUNDOFF)
    A = MR20.tangent(kinematics(jnp.zeros((3, 3))), jnp.zeros(())) + BULK * np.multiply.outer(EYE, EYE)
    np.testing.assert_allclose(A[2, 2, 2, 2], BULK + 4 / 3 * shear, ROUNDOFF)
    np.testing.assert_allclose([A[0, 1, 0, 1], A[0, 1, 1, 0]], [shear, shear], ROUNDOFF)


@pytest.mark.parametrize("size", [1e-3, 1e-7, 1e-11])
def test_volume_change_of_small_strain_keeps_its_digits(size):
    for H in size * np.random.default_rng(3).standard_normal((20, 3, 3)):
        F = [[Fraction(H[i, j]) + (i == j) for j in range(3)] for i in range(3)]
        determinant = sum(
            F[0][k] * (F[1][(k + 1) % 3] * F[2][(k + 2) % 3] - F[1][(k + 2) % 3] * F[2][(k + 1) % 3]) for k in range(3)
        )
        change = kinematics(jnp.array(H)).volume_change
        np.testing.assert_allclose(change, float(determinant - 1), rtol=ROUNDOFF, atol=ROUNDOFF * size)
        mean = MR20.volumetric_stress(change)
        np.testing.assert_allclose(mean, BULK * float(determinant - 1), rtol=ROUNDOFF, atol=ROUNDOFF * size)


def test_volume_change_of_an_isochoric_shear_is_exactly_zero():
    assert kinematics(jnp.array(1e-5 * np.outer(EYE[0], EYE[1]))).volume_change == 0.0


def test_derivative_by_the_coefficients_equals_a_central_difference(samples):
    H = jnp.array(samples[0] - EYE)
    weights = jnp.array(np.random.default_rng(4).standard_normal((3, 3)))

    def measure(coefficients):
        return jnp.sum(weights * stress(op.MooneyRivlin(*coefficients), H))

    gradient = jax.grad(measure)(jnp.array([C10, C01, BULK]))
    for k, value in enumerate((C10, C01, BULK)):
        step = np.zeros(3)
        step[k] = 1e-4 * value
        ends = [measure(jnp.array([C10, C01, BULK] + sign * step)) for sign in (1, -1)]
        np.testing.assert_allclose(gradient[k], (ends[0] - ends[1]) / (2 * step[k]), FINITE_DIFFERENCE)


def test_jit_equals_eager_and_vmap_a_loop(samples):
    H = as_field(samples[:5])
    eager = stress(MR20, H)
    np.testing.assert_allclose(jax.jit(stress)(MR20, H), eager, ROUNDOFF, ROUNDOFF * BULK)
    np.testing.assert_allclose(jax.vmap(lambda h: stress(MR20, h), -1, -1)(H), eager, ROUNDOFF, ROUNDOFF * BULK)
    layers = H.reshape(3, 3, 5, 1, 1)
    np.testing.assert_allclose(stress(MR20, layers).reshape(eager.shape), eager, ROUNDOFF, ROUNDOFF * BULK)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.MooneyRivlin(2e-3, 1e-3, 0.0), r"MooneyRivlin\.bulk \[MPa\] must be positive, got 0\.0\."),
        (lambda: op.MooneyRivlin(2e-3, 1e-3, np.inf), r"MooneyRivlin\.bulk \[MPa\] must be positive, got inf\."),
        (lambda: op.MooneyRivlin(np.nan, 1e-3, 0.1), r"MooneyRivlin\.c10 \[MPa\] must be finite, got nan\."),
        (lambda: op.MooneyRivlin(2e-3, np.nan, 0.1), r"MooneyRivlin\.c01 \[MPa\] must be finite, got nan\."),
        (lambda: op.MooneyRivlin(1e-3, -2e-3, 0.1), r"2 \(c10 \+ c01\) \[MPa\] must be positive, got -0\.002\."),
        (lambda: op.NeoHooke(-1e-3, 0.1), r"NeoHooke\.c10 \[MPa\] must be positive, got -0\.001\."),
        (lambda: op.NeoHooke(1e-3, -0.1), r"NeoHooke\.bulk \[MPa\] must be positive, got -0\.1\."),
    ],
)
def test_constructor_names_field_unit_and_value(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("make", [lambda: op.MooneyRivlin(2e-3, -1e-3, 0.1), lambda: op.NeoHooke(1e-3, 0.1)])
def test_constructor_takes_what_its_docstring_allows(make):
    """A negative c01 with positive shear modulus is in use for silicones, so it is no error."""
    assert make().shear > 0
