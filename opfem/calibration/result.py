"""Result of a calibration: the law, the covariance of its numbers, its stable range, and advice."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import wadler_lindig as wl
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._types import Scalar
from ..measurement.stress_strain import Mode, StressStrain
from ..model.material import AbstractMaterial
from .law_model import Curves, LawModel, Unknown

# A number is poorly identified above this relative standard deviation; specimens that differ by more are not one.
_UNCERTAIN, _SAME_SPECIMEN = 0.2, 0.05
# Difference of Young's modulus between nominal and true stress above which advice names it.
_READING = 0.1
# Offset over the largest stress above which advice names it: neglecting 2 % changes E0 by 7 %.
_OFFSET = 0.01
_SIGNIFICANT = 2.0  # standard deviations


class Calibration(eqx.Module):
    """A law fitted to stress–strain curves.

    1.96 standard deviations are a 95 % interval, correlation of the residuals included.

    Attributes:
        material: The law, with the stretches that it was fitted over.
        names: Names of the unknowns; static.
        unknown: Their values: `numbers` of the law and `offset` of every curve.
        covariance: Covariance of the unknowns, in the order of `names`.
        model: The fitted model.
        curves: The data as the fit takes them.
        data: The measured curves.
        residuals: Computed minus measured stress of every curve [MPa], weighted.
        autocorrelation: Correlation of neighbouring residuals [-].
        effective: Number of independent points of equal information.
        aic: Akaike's criterion, to compare laws on the same curves: lower is better.
        std_residual: Standard deviation of one residual [MPa].
        stability: Least and largest stable stretch (Drucker) of every mode, within 0.3 to 3; static.
        range: Least and largest stretch of the curves along the load [-].
        platen_factor: Divisor of the stresses for bonded platens [-].
        reading: Coefficients of Mooney–Rivlin and Young's modulus [MPa] where stress counts as nominal, and where the
            same numbers count as the other kind.
    """

    material: AbstractMaterial
    names: tuple[str, ...] = eqx.field(static=True)
    unknown: Unknown
    covariance: Float[Array, "k k"]
    model: LawModel
    curves: Curves
    data: tuple[StressStrain, ...]
    residuals: tuple[Float[Array, " _"], ...]
    autocorrelation: Scalar
    effective: Scalar
    aic: Scalar
    std_residual: Scalar
    stability: dict[str, tuple[float, float]] = eqx.field(static=True)
    range: tuple[float, float] = eqx.field(static=True)
    platen_factor: float = eqx.field(static=True)
    reading: Float[Array, "2 3"]

    @property
    def numbers(self) -> dict[str, Array]:
        """Values of the unknowns by name [MPa, -]."""
        return dict(zip(self.names, ravel_pytree(self.unknown)[0], strict=True))

    @property
    def std(self) -> dict[str, Array]:
        """Standard deviations by name."""
        return dict(zip(self.names, jnp.sqrt(jnp.diag(self.covariance)), strict=True))

    @property
    def correlation(self) -> Float[Array, "k k"]:
        """Correlation of the unknowns [-]."""
        std = jnp.sqrt(jnp.diag(self.covariance))
        return self.covariance / jnp.where(std > 0, std, 1.0) / jnp.where(std > 0, std, 1.0)[:, None]

    @property
    def offset(self) -> Float[Array, " _"]:
        """Offset of every curve: in stress [MPa] or in strain [-]; empty without."""
        return self.unknown["offset"]

    @property
    def modulus(self) -> Scalar:
        """Young's modulus at rest [MPa]."""
        return self.model.modulus(self.unknown)

    @property
    def modulus_std(self) -> Scalar:
        """Its standard deviation [MPa]."""
        return self._std_of(lambda unknown: self.model.modulus(unknown)[None])[0]

    @property
    def chi2(self) -> Scalar:
        """Sum of squared residuals, over the curve's `std` where it is known, else over the least square noise."""
        stated = [curve.std for curve in self.data]
        if any(std is None for std in stated):
            return (
                jnp.sum(jnp.concatenate(self.residuals) ** 2)
                / jnp.where(self.std_residual > 0, self.std_residual, 1.0) ** 2
            )
        least = min(float(jnp.min(std)) for std in stated if std is not None)
        return jnp.sum(jnp.concatenate(self.residuals) ** 2) / least**2

    @property
    def rms(self) -> Scalar:
        """Root mean square of the residuals [MPa]."""
        return jnp.sqrt(jnp.mean(jnp.concatenate(self.residuals) ** 2))

    def stress(self, stretch: Any, mode: Mode = "uniaxial") -> Array:
        """Compute the law's nominal stress [MPa]."""
        return self.model.nominal(self.unknown, jnp.asarray(stretch, float), mode)

    def stress_std(self, stretch: Any, mode: Mode = "uniaxial") -> Array:
        """Compute the standard deviation of the law's nominal stress [MPa], that of the numbers."""
        at = jnp.asarray(stretch, float)
        return self._std_of(lambda unknown: self.model.nominal(unknown, at, mode))

    def tangent(self, stretch: Any, mode: Mode = "uniaxial") -> Array:
        """Compute the slope of the law's nominal stress by the stretch [MPa]."""
        at = jnp.asarray(stretch, float)
        return jax.jvp(lambda s: self.model.nominal(self.unknown, s, mode), (at,), (jnp.ones_like(at),))[1]

    def advice(self) -> list[str]:
        """Name poorly identified numbers and other limits of the calibration, with a remedy for each."""
        said = [*self._poorly_known(), *self._of_reading(), *self._of_specimens()]
        low, high = self.range
        said.append(
            f"The curves reach stretches of {low:.3g} to {high:.3g}; "
            'stats["beyond_calibration"] reports a solve outside of them.'
        )
        for mode, (least, largest) in self.stability.items():
            if least > 0.301 or largest < 2.99:
                said.append(f"The law is stable in {mode} tests from {least:.3g} to {largest:.3g} only (Drucker).")
        if self.platen_factor > 1.0:
            said.append(
                f"Stresses were divided by {self.platen_factor:.3g} for bonded platens, valid at small strain; "
                "lubricated platens need no such factor."
            )
        if self.model.ratio is None:
            said.append(
                'The law is incompressible: solve with element="hybrid", or pass bulk= for a finite bulk modulus.'
            )
        return said

    def _poorly_known(self) -> list[str]:
        offsets = self.offset.size
        numbers, std = self.numbers, self.std
        poor = [
            name
            for name in self.names[: len(self.names) - offsets]
            if float(std[name]) > _UNCERTAIN * abs(float(numbers[name]))
        ]
        if not poor:
            return []
        listed = ", ".join(f"{name} ± {float(std[name]) / max(abs(float(numbers[name])), 1e-300):.0%}" for name in poor)
        E = f"E0 is known to ±{float(self.modulus_std / self.modulus):.1%}"
        return [
            f"These numbers are poorly identified: {listed}; {E}. A law with fewer numbers, such as neo_hooke, fits "
            "over the range of the curves."
        ]

    def _of_reading(self) -> list[str]:
        (c10, c01, E), (other10, other01, other_E) = np.asarray(self.reading).tolist()
        if min(c10, c01) < 0 <= min(other10, other01):
            return [
                f"Read as stated the stress gives a Mooney–Rivlin law with a negative coefficient ({1e3 * c10:.3g}, "
                f"{1e3 * c01:.3g} kPa), read as the other kind it does not: is it nominal where true was stated, or "
                "true where nominal was? Pass kind= to read_stress_strain."
            ]
        if abs(other_E / E - 1.0) > _READING:
            return [
                f"Whether the stress is nominal or true changes E0 by {other_E / E - 1.0:+.0%}: make sure which it is."
            ]
        return []

    def _of_specimens(self) -> list[str]:
        said = []
        for name, unit in (("area", "mm²"), ("height", "mm")):
            sizes = [float(size) for curve in self.data if (size := getattr(curve, name)) is not None]
            if len(sizes) > 1 and max(sizes) / min(sizes) > 1.0 + _SAME_SPECIMEN:
                listed = ", ".join(f"{size:.4g}" for size in sizes)
                said.append(
                    f"By their own force and position the files' specimens differ in {name}: {listed} {unit}. Is the "
                    "stress of each over its own area?"
                )
        largest = max(float(jnp.max(jnp.abs(stress))) for stress in self.curves.nominal)
        if self.model.toe == "stress" and self.offset.size:
            offset = float(jnp.max(jnp.abs(self.offset)))
            if offset > _OFFSET * largest:
                said.append(
                    f"The stress is off by {1e3 * offset:.3g} kPa at rest, {offset / largest:.1%} of the largest: "
                    "contact or preload. It was fitted and taken out."
                )
        return said

    def _std_of(self, function: Any) -> Array:
        flat, unravel = ravel_pytree(self.unknown)
        J = jax.jacfwd(lambda y: function(unravel(y)))(flat)
        return jnp.sqrt(jnp.maximum(jnp.sum((J @ self.covariance) * J, axis=-1), 0.0))

    def __pdoc__(self, **options: Any) -> Any:
        std, numbers = self.std, self.numbers
        listed = ", ".join(f"{name}={float(numbers[name]):.5g} ± {float(std[name]):.2g}" for name in self.names)
        E = f"E0={1e3 * float(self.modulus):.4g} ± {1e3 * float(self.modulus_std):.2g} kPa"
        return wl.TextDoc(f"Calibration({self.model.law.__name__}: {listed}, {E})")
