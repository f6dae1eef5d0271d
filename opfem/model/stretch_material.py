"""Hyperelastic laws in the principal stretches: ψ = Σ w(ε_a) over the modified log stretches, plus U(J).

ε_a = ln(J^(-1/3) λ_a). Stress and tangent are exact where stretches repeat or nearly do: differences over
differences are computed as such, and derivatives of the stress go through its closed-form tangent,
never through eigenvectors. A second derivative of the stress by F is refused.

Source: Ogden, Non-linear Elastic Deformations, ch. 6; the spectral tangent as in Holzapfel,
Nonlinear Solid Mechanics, section 6.6.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import Leaf, check_finite, check_modulus, check_positive, concrete
from .deformation import Kinematics, ProductSum, Tensor, identity_like, product, transpose
from .material import AbstractMaterial, LogStrain, Numbers, on_diagonal

_SWEEPS = 6  # of Jacobi's method on 3×3: it converges quadratically, and five reach rounding

Stretches = Float[Array, "3 *points"]


class AbstractStretchMaterial(AbstractMaterial):
    """A law ψ = Σ w(ε_a) of the modified log stretches ε_a, plus U(J)."""

    def density(self, strain: Stretches) -> Stretches:
        """Compute what each stretch stores, w(ε_a) [MPa]; w(0) = 0."""
        raise NotImplementedError

    def slope(self, strain: Stretches) -> Stretches:
        """Compute w' [MPa] up to a constant, which the deviator removes."""
        raise NotImplementedError

    def curvature(self, strain: Stretches) -> Stretches:
        """Compute w'' [MPa]."""
        raise NotImplementedError

    def divided_difference(self, start: Array, step: Array) -> Array:
        """Compute (w'(start + step) - w'(start)) / step [MPa] without cancellation; w'' at step 0."""
        raise NotImplementedError

    def log_stiffness(self, strain: LogStrain) -> Float[Numbers, "3 3 *points"]:
        """Compute d²ψ/dε_a dε_b [MPa] by principal log strains, at constant volume."""
        xp = np if isinstance(strain, np.ndarray) else jnp
        return on_diagonal(xp.asarray(self.curvature(jnp.asarray(strain))))

    def isochoric_energy(self, k: Kinematics) -> Float[Array, "*points"]:
        """Compute the isochoric part of the energy density [MPa]."""
        return _energy(self, k.C)

    def isochoric_piola(self, k: Kinematics) -> Tensor:
        """Compute the isochoric part of the first Piola–Kirchhoff stress [MPa]."""
        return product(k.F, _second_piola(self, k.C))

    def isochoric_tangent(self, k: Kinematics) -> ProductSum:
        """Compute the derivative of `isochoric_piola` by F [MPa]."""
        squares, N = _spectrum(k.C)
        principal = _principal(self, squares)
        n = product(k.F, N)
        one = jnp.ones_like(squares[0])

        def dyad(a, b):
            return n[:, None, a] * N[None, :, b]

        # Geometric part, then dS: axes (i, a), (J, a), (k, b), (L, b) meet in the principal frame.
        geometric = ProductSum(
            legs=((one, jnp.broadcast_to(identity_like(k.F), k.F.shape), _assemble(principal.stress, N)),)
        )
        dyads = [dyad(a, a) for a in range(3)]
        zero = jnp.zeros_like(k.F)
        normal = [(one, dyads[a], sum((principal.normal[a, b] * dyads[b] for b in range(3)), zero)) for a in range(3)]
        pairs = [(principal.shear[a, b], dyad(a, b) + dyad(b, a)) for a, b in ((0, 1), (0, 2), (1, 2))]
        return geometric + ProductSum(direct=(*normal, *((shear, both, both) for shear, both in pairs)))


class Ogden(AbstractStretchMaterial):
    """Ogden: ψ = Σ_p 2 mu_p/alpha_p² (Σ_a (J^(-1/3) λ_a)^alpha_p - 3) + (bulk/2)(J - 1)².

    Abaqus: *HYPERELASTIC, OGDEN with mu_p, alpha_p, D1 = 2/bulk and the other D zero. Initial shear modulus
    Σ mu_p. Where a source writes ψ = Σ_p m_p/alpha_p (Σ_a λ_a^alpha_p - 3), mu_p = m_p alpha_p / 2.

    Args:
        mu: Moduli of the terms [MPa], `(terms,)`; their sum is positive. Where one is negative the law may be stable up
            to some stretch only: see `MooneyRivlin`.
        alpha: Exponents of the terms [-], `(terms,)`, none zero.
        bulk: Bulk modulus [MPa], positive.

    Raises:
        ValueError: If a number is out of its range, or mu and alpha are not two lists of one length.
    """

    mu: Array = eqx.field(converter=Leaf("Ogden.mu", "MPa"))
    alpha: Array = eqx.field(converter=Leaf("Ogden.alpha", "-"))
    bulk: Array = eqx.field(converter=Leaf("Ogden.bulk", "MPa"))

    def __check_init__(self):
        if self.mu.ndim != 1 or self.mu.shape != self.alpha.shape or self.mu.size == 0:
            raise ValueError(
                f"Ogden.mu [MPa] and Ogden.alpha [-] must be two lists of one length, got shapes {self.mu.shape} and "
                f"{self.alpha.shape}."
            )
        check_finite("Ogden.mu", "MPa", self.mu)
        check_finite("Ogden.alpha", "-", self.alpha)
        alpha = concrete(self.alpha)
        if alpha is not None and (alpha == 0).any():
            raise ValueError(f"Ogden.alpha [-] must not be zero, got {alpha.tolist()}; leave that term out.")
        check_positive("Ogden shear modulus, the sum of mu", "MPa", self.shear)
        check_modulus("Ogden.bulk", "MPa", self.bulk)

    @property
    def shear(self) -> Array:
        """Initial shear modulus [MPa]."""
        return jnp.sum(self.mu)

    def density(self, strain: Stretches) -> Stretches:
        """Compute what each stretch stores [MPa]."""
        return self._sum(lambda mu, alpha: 2.0 * mu / alpha**2 * jnp.expm1(alpha * strain))

    def slope(self, strain: Stretches) -> Stretches:
        """Compute w' [MPa] up to a constant."""
        return self._sum(lambda mu, alpha: 2.0 * mu / alpha * jnp.expm1(alpha * strain))

    def curvature(self, strain: Stretches) -> Stretches:
        """Compute w'' [MPa]."""
        return self._sum(lambda mu, alpha: 2.0 * mu * jnp.exp(alpha * strain))

    def divided_difference(self, start: Array, step: Array) -> Array:
        """Compute (w'(start + step) - w'(start)) / step [MPa]."""
        return self._sum(lambda mu, alpha: 2.0 * mu * jnp.exp(alpha * start) * _relative_growth(alpha * step))

    def _sum(self, term: Callable[[Array, Array], Array]) -> Array:
        terms = [term(self.mu[p], self.alpha[p]) for p in range(self.mu.size)]
        return sum(terms[1:], start=terms[0])


class Hencky(AbstractStretchMaterial):
    """Hencky: ψ = shear |dev ln U|² + (bulk/2)(J - 1)², linear elasticity in logarithmic strain.

    The law to compare with small-strain results: its deviatoric Kirchhoff stress is 2 shear times the
    deviatoric logarithmic strain, its mean Cauchy stress bulk (J - 1). Abaqus has no equal; its *ELASTIC with
    NLGEOM is close (a rate form in the same strain, with bulk ln J for bulk (J - 1)).

    Args:
        shear: Shear modulus [MPa], positive.
        bulk: Bulk modulus [MPa], positive.

    Raises:
        ValueError: If a number is out of its range.
    """

    shear: Array = eqx.field(converter=Leaf("Hencky.shear", "MPa"))  # pyright: ignore[reportIncompatibleVariableOverride]
    bulk: Array = eqx.field(converter=Leaf("Hencky.bulk", "MPa"))

    def __check_init__(self):
        check_positive("Hencky.shear", "MPa", self.shear)
        check_modulus("Hencky.bulk", "MPa", self.bulk)

    def density(self, strain: Stretches) -> Stretches:
        """Compute what each stretch stores [MPa]."""
        return self.shear * strain**2

    def slope(self, strain: Stretches) -> Stretches:
        """Compute w' [MPa]."""
        return 2.0 * self.shear * strain

    def curvature(self, strain: Stretches) -> Stretches:
        """Compute w'' [MPa]."""
        return jnp.broadcast_to(2.0 * self.shear, strain.shape)

    def divided_difference(self, start: Array, step: Array) -> Array:
        """Compute (w'(start + step) - w'(start)) / step [MPa]."""
        return jnp.broadcast_to(2.0 * self.shear, step.shape)


class _Principal(NamedTuple):
    """Second Piola–Kirchhoff stress S and its derivative by E = (C - I)/2 in the principal frame [MPa].

    `normal[a, b]` = dS_a/dE_b; `shear[a, b]` = (S_b - S_a)/(C_b - C_a), half of dS_ab/dE_ab.
    """

    stress: Stretches
    normal: Float[Array, "3 3 *points"]
    shear: Float[Array, "3 3 *points"]


def _modified(squares: Stretches) -> Stretches:
    """Compute modified log stretches from squared stretches."""
    strain = 0.5 * jnp.log(squares)
    return strain - jnp.mean(strain, axis=0)


def _principal_stress(law: AbstractStretchMaterial, squares: Stretches) -> tuple[Stretches, Stretches]:
    """Compute principal Kirchhoff stress and second Piola–Kirchhoff stress [MPa], both without the volume's part."""
    slope = law.slope(_modified(squares))
    kirchhoff = slope - jnp.mean(slope, axis=0)
    return kirchhoff, kirchhoff / squares


def _principal(law: AbstractStretchMaterial, squares: Stretches) -> _Principal:
    strain = _modified(squares)
    kirchhoff, stress = _principal_stress(law, squares)
    w2 = law.curvature(strain)
    pairs = w2[:, None] + w2[None]
    by_strain = identity_like(pairs) * (w2 - 2.0 * kirchhoff) - pairs / 3.0 + jnp.sum(w2, axis=0) / 9.0
    normal = by_strain / (squares[:, None] * squares[None])
    ratio = (squares[None] - squares[:, None]) / squares[:, None]  # [a, b]: (C_b - C_a)/C_a
    step = 0.5 * jnp.log1p(ratio)
    by_square = law.divided_difference(strain[:, None], step) * _relative_log(ratio) * 0.5 / squares[:, None]
    shear = (by_square - stress[:, None]) / squares[None]
    return _Principal(stress, normal, shear)


def _relative_growth(x: Array) -> Array:
    """Compute (eˣ - 1)/x, 1 at 0."""
    some = jnp.where(x == 0.0, 1.0, x)
    return jnp.where(x == 0.0, 1.0, jnp.expm1(some) / some)


def _relative_log(x: Array) -> Array:
    """Compute ln(1 + x)/x, 1 at 0."""
    some = jnp.where(x == 0.0, 1.0, x)
    return jnp.where(x == 0.0, 1.0, jnp.log1p(some) / some)


def _assemble(values: Stretches, N: Tensor) -> Tensor:
    """Form Σ_a values[a] N_a ⊗ N_a."""
    return product(values[None] * N, transpose(N))


@jax.custom_jvp
def _energy(law: AbstractStretchMaterial, C: Tensor) -> Float[Array, "*points"]:
    squares, _ = _spectrum(C)
    return jnp.sum(law.density(_modified(squares)), axis=0)


@_energy.defjvp
def _energy_jvp(primals, tangents):
    (law, C), (law_dot, C_dot) = primals, tangents
    squares, N = _spectrum(C)
    energy, by_law = jax.jvp(lambda m: jnp.sum(m.density(_modified(squares)), axis=0), (law,), (law_dot,))
    _, stress = _principal_stress(law, squares)
    return energy, by_law + 0.5 * jnp.sum(_assemble(stress, N) * C_dot, axis=(0, 1))


@jax.custom_jvp
def _second_piola(law: AbstractStretchMaterial, C: Tensor) -> Tensor:
    squares, N = _spectrum(C)
    return _assemble(_principal_stress(law, squares)[1], N)


@_second_piola.defjvp
def _second_piola_jvp(primals, tangents):
    (law, C), (law_dot, C_dot) = primals, tangents
    squares, N = _spectrum(C)
    S, by_law = jax.jvp(lambda m: _assemble(_principal_stress(m, squares)[1], N), (law,), (law_dot,))
    principal = _principal(law, squares)
    strain = 0.5 * product(product(transpose(N), C_dot), N)
    eye = identity_like(C)
    stress = 2.0 * principal.shear * (1.0 - eye) * strain
    diagonal = jnp.stack([strain[b, b] for b in range(3)])
    stress = stress + eye * jnp.sum(principal.normal * diagonal[None], axis=1)
    return S, by_law + product(product(N, stress), transpose(N))


@jax.custom_jvp
def _spectrum(C: Tensor) -> tuple[Stretches, Tensor]:
    """Compute eigenvalues and eigenvectors (second axis) of symmetric 3×3 matrices, by Jacobi's rotations.

    Point by point in plain arithmetic: batched LAPACK is slower, and can hang on two threads.
    """

    def rotated(A: Tensor, N: Tensor, p: int, q: int) -> tuple[Tensor, Tensor]:
        gap, off = A[q, q] - A[p, p], A[p, q]
        size = jnp.abs(gap) + jnp.sqrt(gap**2 + 4.0 * off**2)
        tangent = jnp.where(gap < 0.0, -2.0, 2.0) * off / jnp.where(size == 0.0, 1.0, size)
        cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
        sine = tangent * cosine
        A = turned(turned(A, p, q, cosine, sine).swapaxes(0, 1), p, q, cosine, sine)
        return A, turned(N, p, q, cosine, sine)

    def turned(A: Tensor, p: int, q: int, cosine: Array, sine: Array) -> Tensor:
        """Turn columns p and q."""
        columns = [A[:, 0], A[:, 1], A[:, 2]]
        columns[p], columns[q] = cosine * A[:, p] - sine * A[:, q], sine * A[:, p] + cosine * A[:, q]
        return jnp.stack(columns, axis=1)

    def sweep(_, state):
        A, N = state
        for p, q in ((0, 1), (0, 2), (1, 2)):
            A, N = rotated(A, N, p, q)
        return A, N

    A, N = jax.lax.fori_loop(0, _SWEEPS, sweep, (C, jnp.broadcast_to(identity_like(C), C.shape).astype(C.dtype)))
    return jnp.stack([A[0, 0], A[1, 1], A[2, 2]]), N


@_spectrum.defjvp
def _spectrum_jvp(primals, tangents):
    raise NotImplementedError(
        "Ogden and Hencky have no second derivative of the stress: eigenvectors have no derivative at equal stretches. "
        "Use first derivatives, or a law in the invariants (MooneyRivlin, NeoHooke, Yeoh)."
    )
