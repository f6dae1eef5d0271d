"""Materials against NumPy formulas, against `energy` differentiated, and against table A of docs/validation.md."""

from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq

import opfem as op
from opfem.model.deformation import kinematics
from tests.oracles import cauchy_stress, first_piola, random_rotation
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
C20, C30 = -3e-4, 2e-4
MU, ALPHA = np.array([4e-3, -5e-4, 1e-3]), np.array([1.3, -3.0, 5.0])
SHEAR = 5.8e-3
MR20 = op.MooneyRivlin(C10, C01, BULK)
NEO = op.NeoHooke(C10, BULK)


# Isochoric energy of each law by its docstring, of modified stretches y (λ_a J^(-1/3)).
def yeoh(y):
    x = (y**2).sum() - 3
    return C10 * x + C20 * x**2 + C30 * x**3


def ogden(y):
    return sum(2 * m / a**2 * ((y**a).sum() - 3) for m, a in zip(MU, ALPHA, strict=True))


LAWS = {
    "mooney-rivlin": (MR20, lambda y: C10 * ((y**2).sum() - 3) + C01 * ((y**-2.0).sum() - 3)),
    "neo-hooke": (NEO, lambda y: C10 * ((y**2).sum() - 3)),
    "yeoh": (op.Yeoh(C10, C20, C30, BULK), yeoh),
    "ogden": (op.Ogden(MU, ALPHA, BULK), ogden),
    "hencky": (op.Hencky(SHEAR, BULK), lambda y: SHEAR * (np.log(y) ** 2).sum()),
}
MATERIALS = pytest.mark.parametrize(("material", "isochoric"), LAWS.values(), ids=LAWS)
EYE = np.eye(3)


@pytest.fixture(scope="module")
def samples():
    """1000 deformation gradients `(1000, 3, 3)`, rotated and far from the identity, with J from 0.3 to 3."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < 1000:
        F = random_rotation(rng) @ (EYE + 0.3 * rng.standard_normal((3, 3)))
        if 0.3 < np.linalg.det(F) < 3.0:
            found.append(F)
    return np.array(found)


def as_field(F):
    """From one tensor per row to the layout of opfem, H = F - I with points last."""
    return jnp.array(np.moveaxis(np.asarray(F) - EYE, 0, -1))


def stress(material, H):
    k = kinematics(H)
    return material.first_piola(k, material.volumetric_stress(k.volume_change))


def tangent_at(material, H, mean_stress):
    return material.tangent(kinematics(H), mean_stress).entries()


_stress, _tangent, _energy = (
    eqx.filter_jit(stress),
    eqx.filter_jit(tangent_at),
    eqx.filter_jit(lambda m, H: m.energy(H)),
)


def piola(material, F):
    """First Piola–Kirchhoff stress [MPa] of each F `(points, 3, 3)`."""
    return np.moveaxis(_stress(material, as_field(F)), -1, 0)


def cauchy(material, F):
    """Cauchy stress [MPa] of each F."""
    return np.stack([P @ f.T / np.linalg.det(f) for P, f in zip(piola(material, F), F, strict=True)])


def assert_close(got, expected, rtol=ROUNDOFF):
    """Compare whole tensors: small entries are as exact as the largest."""
    got, expected = np.asarray(got), np.asarray(expected)
    np.testing.assert_allclose(got, expected, rtol, rtol * np.abs(expected).max())


def by_stretches(F, isochoric):
    """First Piola–Kirchhoff stress of one F, Σ ∂ψ/∂λ_a n_a ⊗ N_a, with ∂ψ/∂λ_a by a complex step."""
    n, stretches, N = np.linalg.svd(F)
    J = stretches.prod()
    slopes = np.empty(3)
    for a in range(3):
        moved = stretches + 1e-30j * EYE[a]
        slopes[a] = (isochoric(moved * moved.prod() ** (-1 / 3))).imag / 1e-30
    return (n * (slopes + BULK * (J - 1) * J / stretches)) @ N


@MATERIALS
def test_06_stress_is_the_derivative_of_the_energy_by_stretches(material, isochoric, samples):
    assert_close(piola(material, samples), [by_stretches(F, isochoric) for F in samples], 10 * ROUNDOFF)


@pytest.mark.parametrize(("material", "c01"), [(MR20, C01), (NEO, 0.0)], ids=["mooney-rivlin", "neo-hooke"])
def test_stress_equals_the_spatial_formula(material, c01, samples):
    assert_close(piola(material, samples), [first_piola(F, C10, c01, BULK) for F in samples])


@MATERIALS
def test_energy_equals_its_definition(material, isochoric, samples):
    expected = []
    for F in samples:
        stretches = np.linalg.svd(F, compute_uv=False)
        J = stretches.prod()
        expected.append(isochoric(stretches * J ** (-1 / 3)) + BULK / 2 * (J - 1) ** 2)
    assert_close(_energy(material, as_field(samples)), expected)


@MATERIALS
def test_stress_is_the_derivative_of_energy(material, isochoric, samples):
    derivative = eqx.filter_jit(lambda m, H: jax.vmap(jax.grad(m.energy), -1, -1)(H))
    assert_close(_stress(material, as_field(samples)), derivative(material, as_field(samples)))


@MATERIALS
def test_05_tangent_is_the_derivative_of_stress_at_constant_mean_stress(material, isochoric, samples):
    mean = 0.3 * material.bulk

    def derivative(m, H):
        return jax.vmap(jax.jacfwd(lambda h: m.first_piola(kinematics(h), mean)), -1, -1)(H)

    A = _tangent(material, as_field(samples), mean)
    assert_close(A, eqx.filter_jit(derivative)(material, as_field(samples)))
    assert_close(A, np.transpose(A, (2, 3, 0, 1, 4)))


@MATERIALS
def test_tangent_and_bulk_part_equal_a_central_difference(material, isochoric, samples):
    mean = np.array([BULK * (np.linalg.det(F) - 1) for F in samples])
    A = np.moveaxis(_tangent(material, as_field(samples), jnp.array(mean)), -1, 0)
    step = 1e-6
    for F, tangent in zip(samples[:20], A, strict=False):
        cofactor = np.linalg.det(F) * np.linalg.inv(F).T
        whole = tangent + BULK * np.multiply.outer(cofactor, cofactor)
        for m in range(9):
            change = step * np.eye(9)[m].reshape(3, 3)
            difference = by_stretches(F + change, isochoric) - by_stretches(F - change, isochoric)
            assert_close(whole[:, :, m // 3, m % 3], difference / (2 * step), FINITE_DIFFERENCE)


@MATERIALS
def test_01_objectivity_and_isotropy(material, isochoric, samples):
    rng = np.random.default_rng(1)
    Q = np.array([random_rotation(rng) for _ in samples])
    P, energy = piola(material, samples), _energy(material, as_field(samples))
    for turned, expected in ((Q @ samples, Q @ P), (samples @ Q, P @ Q)):
        assert_close(piola(material, turned), expected)
        assert_close(_energy(material, as_field(turned)), energy)


@MATERIALS
def test_a_rotation_alone_causes_no_stress(material, isochoric):
    rng = np.random.default_rng(2)
    rotations = [random_rotation(rng) for _ in range(200)]
    np.testing.assert_allclose(piola(material, rotations), 0.0, atol=ROUNDOFF * BULK)


@pytest.mark.parametrize("equal", [2, 3])
def test_06_repeated_stretches(equal):
    """Ogden with exponents 2 and -2 is Mooney–Rivlin, whose formulas know no stretches: stress, tangent, derivative."""
    rng = np.random.default_rng(5)
    twin = op.Ogden(2 * np.array([C10, C01]), [2.0, -2.0], BULK)
    F = []
    for apart in (0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3):
        for _ in range(20):
            stretches = rng.uniform(0.5, 1.8) * (1 + apart * rng.uniform(-1, 1, 3))
            if equal == 2:
                stretches[rng.integers(3)] *= 1.3
            F.append(random_rotation(rng) * stretches @ random_rotation(rng))
        F += [(1.2 + apart) * EYE, np.diag([0.7, 1.1, 1.1 + apart])]
    H, mean = as_field(F), jnp.asarray(0.01)
    assert_close(piola(twin, F), piola(MR20, F), 10 * ROUNDOFF)
    expected = _tangent(MR20, H, mean)
    assert_close(_tangent(twin, H, mean), expected, 10 * ROUNDOFF)
    derivative = jax.jit(jax.vmap(jax.jacfwd(lambda h: twin.first_piola(kinematics(h), mean)), -1, -1))(H)
    assert_close(derivative, expected, 10 * ROUNDOFF)


def test_second_derivative_of_the_stress_is_refused_where_it_has_none():
    with pytest.raises(NotImplementedError, match="a law in the invariants"):
        jax.hessian(lambda h: stress(op.Hencky(SHEAR, BULK), h).sum())(jnp.zeros((3, 3)))


@MATERIALS
def test_cauchy_stress_is_symmetric(material, isochoric, samples):
    sigma = cauchy(material, samples)
    assert_close(sigma, np.swapaxes(sigma, 1, 2))


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
def test_07_08_table_a(stretch, lateral, sigma, nominal, zz, xx):
    found = free_stretch((0, 1), [1.0, 1.0, stretch])
    assert abs(found - lateral) < PRINTED_STRETCH
    paths = [np.diag([found, found, stretch]), np.diag([1.0, 1.0, stretch])]
    free, confined = 1e3 * cauchy(MR20, paths)
    np.testing.assert_allclose(free, np.diag([0.0, 0.0, -sigma]), rtol=0, atol=PRINTED_KPA)
    np.testing.assert_allclose(confined, np.diag([-xx, -xx, -zz]), rtol=0, atol=PRINTED_KPA)
    assert abs(1e3 * piola(MR20, paths)[0, 2, 2] + nominal) < PRINTED_KPA


def test_09_plane_strain_and_equibiaxial_stretch():
    lateral = free_stretch((0,), [1.0, 1.0, 0.8])
    through = free_stretch((2,), [1.5, 1.5, 1.0])
    np.testing.assert_allclose([lateral, through], [1.2217208, 0.4782747], rtol=0, atol=PRINTED_STRETCH)
    plane, biaxial = 1e3 * cauchy(MR20, [np.diag([lateral, 1.0, 0.8]), np.diag([1.5, 1.5, through])])
    np.testing.assert_allclose(plane, np.diag([0.0, -2.719281, -5.161790]), rtol=0, atol=PRINTED_KPA)
    np.testing.assert_allclose(biaxial, np.diag([13.258242, 13.258242, 0.0]), rtol=0, atol=PRINTED_KPA)


def test_09_simple_shear():
    shears = [EYE + gamma * np.outer(EYE[0], EYE[1]) for gamma in (0.5, 1.0)]
    half, whole = 1e3 * cauchy(MR20, shears)
    atol = 1e3 * ROUNDOFF * BULK
    np.testing.assert_allclose(half, [[0.8505, 2.903, 0], [2.903, -0.601, 0], [0, 0, -0.2495]], ROUNDOFF, atol)
    np.testing.assert_allclose(whole, [[3.402, 5.806, 0], [5.806, -2.404, 0], [0, 0, -0.998]], ROUNDOFF, atol)


def test_initial_moduli():
    shear = 2 * (C10 + C01)
    np.testing.assert_allclose(MR20.shear, shear, ROUNDOFF)
    np.testing.assert_allclose(NEO.shear, 2 * C10, ROUNDOFF)


@MATERIALS
def test_tangent_at_rest_is_isotropic_elasticity(material, isochoric):
    shear = material.shear
    A = tangent_at(material, jnp.zeros((3, 3)), jnp.zeros(())) + BULK * np.multiply.outer(EYE, EYE)
    np.testing.assert_allclose(A[2, 2, 2, 2], BULK + 4 / 3 * shear, ROUNDOFF)
    np.testing.assert_allclose([A[0, 1, 0, 1], A[0, 1, 1, 0]], [shear, shear], ROUNDOFF)


@pytest.mark.parametrize("size", [1e-3, 1e-7, 1e-11])
def test_volume_change_of_small_strain_keeps_its_digits(size):
    """Against exact rational arithmetic; 1e-11 of strain has no digit left in det(F) - 1."""
    samples = size * np.random.default_rng(3).standard_normal((20, 3, 3))
    expected = []
    for H in samples:
        F = [[Fraction(H[i, j]) + (i == j) for j in range(3)] for i in range(3)]
        minors = [F[1][(k + 1) % 3] * F[2][(k + 2) % 3] - F[1][(k + 2) % 3] * F[2][(k + 1) % 3] for k in range(3)]
        expected.append(float(sum(F[0][k] * minors[k] for k in range(3)) - 1))
    change = kinematics(jnp.array(np.moveaxis(samples, 0, -1))).volume_change
    np.testing.assert_allclose(change, expected, rtol=ROUNDOFF, atol=0.1 * ROUNDOFF * size)
    np.testing.assert_allclose(
        MR20.volumetric_stress(change), BULK * np.array(expected), ROUNDOFF, ROUNDOFF * size * BULK
    )


def test_volume_change_of_an_isochoric_shear_is_exactly_zero():
    assert kinematics(jnp.array(1e-5 * np.outer(EYE[0], EYE[1]))).volume_change == 0.0


@MATERIALS
def test_derivative_by_the_coefficients_equals_a_central_difference(material, isochoric, samples):
    H = as_field(samples)
    weights = jnp.array(np.random.default_rng(4).standard_normal((3, 3, 1)))
    coefficients, build = ravel_pytree(material)

    @jax.jit
    def measure(coefficients):
        law = build(coefficients)
        return jnp.sum(weights * stress(law, H)) + jnp.sum(law.energy(H))

    gradient = jax.jit(jax.grad(measure))(coefficients)
    for k, value in enumerate(coefficients):
        step = np.zeros(coefficients.size)
        step[k] = 1e-4 * value
        ends = [measure(coefficients + sign * step) for sign in (1, -1)]
        np.testing.assert_allclose(gradient[k], (ends[0] - ends[1]) / (2 * step[k]), FINITE_DIFFERENCE)


def test_jit_equals_eager_and_vmap_a_loop(samples):
    H = as_field(samples)
    eager = stress(MR20, H)
    atol = ROUNDOFF * np.abs(eager).max()
    np.testing.assert_allclose(_stress(MR20, H), eager, ROUNDOFF, atol)
    by_point = jax.jit(jax.vmap(lambda h: stress(MR20, h), -1, -1))(H)
    np.testing.assert_allclose(by_point, eager, ROUNDOFF, atol)
    np.testing.assert_allclose(_stress(MR20, H.reshape(3, 3, 20, 5, 10)).reshape(eager.shape), eager, ROUNDOFF, atol)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: op.MooneyRivlin(2e-3, 1e-3, 0.0),
            r"MooneyRivlin\.bulk \[MPa\] must be positive, or jnp\.inf .*, got 0\.0\.",
        ),
        (
            lambda: op.MooneyRivlin(2e-3, 1e-3, np.nan),
            r"MooneyRivlin\.bulk \[MPa\] must be positive, or jnp\.inf .*, got nan\.",
        ),
        (lambda: op.MooneyRivlin(np.nan, 1e-3, 0.1), r"MooneyRivlin\.c10 \[MPa\] must be finite, got nan\."),
        (lambda: op.MooneyRivlin(2e-3, np.nan, 0.1), r"MooneyRivlin\.c01 \[MPa\] must be finite, got nan\."),
        (lambda: op.MooneyRivlin(1e-3, -2e-3, 0.1), r"2 \(c10 \+ c01\) \[MPa\] must be positive, got -0\.002\."),
        (lambda: op.NeoHooke(-1e-3, 0.1), r"NeoHooke\.c10 \[MPa\] must be positive, got -0\.001\."),
        (lambda: op.Yeoh(0.0, 1e-4, 1e-4, 0.1), r"Yeoh\.c10 \[MPa\] must be positive, got 0\.0\."),
        (lambda: op.Yeoh(1e-3, np.nan, 1e-4, 0.1), r"Yeoh\.c20 \[MPa\] must be finite, got nan\."),
        (lambda: op.Ogden([1e-3], [0.0], 0.1), r"Ogden\.alpha \[-\] must not be zero, got \[0\.0\]; leave"),
        (lambda: op.Ogden([1e-3, 1e-3], [2.0], 0.1), r"Ogden\.mu \[MPa\] and Ogden\.alpha .* shapes \(2,\) and \(1,\)"),
        (lambda: op.Ogden([1e-3, -2e-3], [2.0, 1.0], 0.1), r"the sum of mu \[MPa\] must be positive, got -0\.001\."),
        (lambda: op.Hencky(1e-3, 0.0), r"Hencky\.bulk \[MPa\] must be positive, or jnp\.inf .*, got 0\.0\."),
        (lambda: op.NeoHooke(1e-3, -0.1), r"NeoHooke\.bulk \[MPa\] must be positive, or jnp\.inf .*, got -0\.1\."),
    ],
)
def test_constructor_names_field_unit_and_value(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("make", [lambda: op.MooneyRivlin(2e-3, -1e-3, 0.1), lambda: op.NeoHooke(1e-3, 0.1)])
def test_constructor_takes_what_its_docstring_allows(make):
    """A negative c01 with positive shear modulus is in use for silicones, so it is no error."""
    assert make().shear > 0
