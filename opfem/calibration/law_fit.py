"""Fit of a material law to stress–strain curves: least squares by optimistix, with covariance and stability.

The residual is the nominal stress of the law minus the measured one. Every curve has a separate offset, in stress or in
strain: the zeros of a load frame are those of its sensors, not of the specimen.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..measurement import MeasurementError
from ..measurement.stress_strain import StressStrain
from ..model.homogeneous import principal_stretches
from ..model.material import AbstractMaterial, MooneyRivlin, NeoHooke, Yeoh
from ..model.stability import stable_stretches
from ..model.stretch_material import Hencky, Ogden
from .covariance import correlated_covariance
from .law_model import LAWS, Curves, LawModel, Unknown, names_of
from .platens import bonded_factor
from .result import Calibration

_MOST_STEPS = 1000
_RTOL = 1e-13  # of the numbers and of the sum of squares: exact data gives the numbers to 1e-8
_SMALLEST = 0.05  # of the largest stress, below which weights "relative" are constant
_EDGE = 1e-9  # relative round-off of a range's ends
_CUT = 1e-10  # relative cut-off of singular values of the scaled Jacobian
# Initial exponents of an Ogden fit, by its number of terms; the best of the fits is returned.
_EXPONENTS = {
    1: [[2.0], [-2.0], [6.0], [-6.0]],
    2: [[2.0, -2.0], [1.3, 5.0], [4.0, -4.0], [-2.0, -8.0]],
    3: [[1.3, 5.0, -2.0], [2.0, -2.0, 6.0], [1.5, 8.0, -4.0]],
}


def calibrate(
    data: StressStrain | Sequence[StressStrain],
    law: str | type[AbstractMaterial] = "mooney_rivlin",
    *,
    bulk: float | int | None = None,
    offset: bool = True,
    toe: Literal["stress", "strain"] = "stress",
    terms: int = 1,
    start: Mapping[str, Any] | None = None,
    weights: Literal["absolute", "relative"] = "absolute",
    range: tuple[float, float] | None = None,
    platens: Literal["lubricated", "bonded"] = "lubricated",
    diameter: float | int | None = None,
    height: float | int | None = None,
) -> Calibration:
    """Fit a material law to stress–strain curves.

    Args:
        data: One curve or several; of one material, in any modes.
        law: "neo_hooke", "mooney_rivlin", "yeoh", "ogden", "hencky", or a class of law.
        bulk: Bulk over shear modulus [-]; None fits, and returns, an incompressible law (`bulk = inf`, which needs
            `element="hybrid"`).
        offset: Whether each curve has a separate offset.
        toe: Kind of offset: in "stress" [MPa], or in "strain" [-] for late contact.
        terms: Terms of "ogden".
        start: Numbers to start from, by name; needed for a class that is not one of the five.
        weights: "absolute": every point counts alike (or by its `std`); "relative": by its stress.
        range: Stretches to fit over (low, high) [-]; None takes all.
        platens: "lubricated": the specimen stays a cylinder. "bonded": it barrels, and its stress is divided by the
            stiffening of a bonded disc at small strain, for which `diameter` and `height` are needed.
        diameter: Of the specimen [mm].
        height: Of the specimen [mm].

    Returns:
        The law, ready to use, with covariance, stable range and advice.

    Raises:
        MeasurementError: If the modulus is not positive or the fitted law is unstable.
        ValueError: For invalid arguments.

    Example:
        >>> import jax, numpy as np
        >>> import opfem as op
        >>> jax.config.update("jax_enable_x64", True)
        >>> stretch = np.linspace(1.0, 0.7, 31)
        >>> curve = op.StressStrain(stretch, 2 * 3e-3 * (stretch - stretch**-2) + 5e-5)
        >>> found = op.calibrate(curve, "neo_hooke")
        >>> round(float(found.material.c10), 9), round(float(found.offset[0]), 9)
        (0.003, 5e-05)
    """
    measured = [data] if isinstance(data, StressStrain) else list(data)
    kind = LAWS.get(law) if isinstance(law, str) else law
    if kind is None:
        raise ValueError(f"calibrate.law must be one of {', '.join(LAWS)}, or a class of law, got {law!r}.")
    _check(measured, bulk, toe, weights, platens, terms)
    factor = 1.0
    if platens == "bonded":
        if not (diameter and height and diameter > 0 and height > 0):
            raise ValueError('calibrate: platens="bonded" needs diameter= and height= of the specimen [mm], positive.')
        factor = bonded_factor(float(diameter), float(height), bulk)
    if range is not None:
        measured = [curve.cropped(*range) for curve in measured]
    curves = _curves(measured, weights, factor)
    model = LawModel(None if bulk is None else jnp.asarray(bulk, float), kind, toe)
    offsets = jnp.zeros(len(measured) if offset else 0)
    starts = [{"numbers": numbers, "offset": offsets} for numbers in _starts(kind, curves, terms, start)]
    return _judged(model, curves, tuple(measured), _best(model, curves, starts), factor)


def _check(measured: list[Any], bulk: Any, toe: str, weights: str, platens: str, terms: int) -> None:
    if jnp.zeros((), float).dtype != jnp.dtype("float64"):
        raise ValueError('calibrate needs float64 numbers: run jax.config.update("jax_enable_x64", True) once, first.')
    if not measured or not all(isinstance(curve, StressStrain) for curve in measured):
        raise ValueError(f"calibrate.data must be one StressStrain or several, got {measured!r}.")
    choices = {"toe": ("stress", "strain"), "weights": ("absolute", "relative"), "platens": ("lubricated", "bonded")}
    for (name, valid), value in zip(choices.items(), (toe, weights, platens), strict=True):
        if value not in valid:
            raise ValueError(f"calibrate.{name} must be one of {', '.join(valid)}, got {value!r}.")
    if bulk is not None and not bulk > 1.0:
        raise ValueError(f"calibrate.bulk [-] is the bulk over the shear modulus and must be above 1, got {bulk!r}.")
    if terms not in _EXPONENTS:
        raise ValueError(f"calibrate.terms must be 1, 2 or 3, got {terms!r}.")


def _curves(measured: list[StressStrain], weights: str, factor: float) -> Curves:
    largest = max(float(jnp.max(jnp.abs(curve.nominal))) for curve in measured)
    if largest == 0:
        raise MeasurementError("calibrate: all stresses are zero.")
    stds = [jnp.broadcast_to(1.0 if curve.std is None else curve.std, curve.nominal.shape) for curve in measured]
    least = min(float(jnp.min(std)) for std in stds)
    if weights == "relative":
        weight = tuple(1.0 / jnp.maximum(jnp.abs(curve.nominal) / largest, _SMALLEST) for curve in measured)
    else:
        weight = tuple(least / std for std in stds)
    return Curves(
        tuple(curve.stretch for curve in measured),
        tuple(curve.nominal / factor for curve in measured),
        weight,
        tuple(curve.mode for curve in measured),
    )


def _starts(kind: type, curves: Curves, terms: int, start: Mapping[str, Any] | None) -> list[dict[str, Array]]:
    """List the law's numbers to start from, by the shear modulus of a neo-Hookean fit."""
    if start is not None:
        return [{name: jnp.asarray(value, float) for name, value in start.items()}]
    unit = LawModel(None, NeoHooke, "stress").measured({"numbers": {"c10": 0.5}, "offset": jnp.zeros(0)}, curves)
    x, y = (np.concatenate([np.asarray(one - one.mean()) for one in parts]) for parts in (unit, curves.nominal))
    shear = jnp.asarray(float(x @ y / (x @ x)))
    if not shear > 0:
        raise MeasurementError(
            f"calibrate: the stress falls as the stretch grows (modulus {3e3 * float(shear):.3g} kPa); is the sign of "
            "one of them wrong? In compression the stretch is below one and the nominal stress negative."
        )
    zero = jnp.zeros(())
    initial: dict[type, list[dict[str, Array]]] = {
        NeoHooke: [{"c10": shear / 2}],
        MooneyRivlin: [{"c10": 0.4 * shear, "c01": 0.1 * shear}],
        Yeoh: [{"c10": shear / 2, "c20": zero, "c30": zero}],
        Hencky: [{"shear": shear}],
        Ogden: [{"mu": jnp.full(terms, shear / terms), "alpha": jnp.asarray(alpha)} for alpha in _EXPONENTS[terms]],
    }
    if kind not in initial:
        raise ValueError(f"calibrate: {kind.__name__} needs start=, its numbers by name.")
    return initial[kind]


class _Fitted(eqx.Module):
    """Optimum of a fit: unknowns, residuals [MPa] and their Jacobian by the flat unknowns."""

    unknown: Unknown
    residuals: Float[Array, " n"]
    jacobian: Float[Array, "n k"]


def _best(model: LawModel, curves: Curves, starts: list[Unknown]) -> _Fitted:
    """Fit from every start and return the best optimum."""
    fitted = [_fit(model, curves, start) for start in starts]
    losses = [float(jnp.sum(one.residuals**2)) for one in fitted]
    if not np.isfinite(losses).any():
        raise MeasurementError(
            f"calibrate: the fit of {model.law.__name__} diverged; pass start=, or take fewer terms."
        )
    return fitted[int(np.nanargmin(losses))]


@eqx.filter_jit
def _fit(model: LawModel, curves: Curves, start: Unknown) -> _Fitted:
    """Fit from one start, in unknowns whose Jacobian there is orthonormal."""
    flat, unravel = ravel_pytree(start)
    largest = jnp.max(jnp.concatenate([jnp.abs(stress) for stress in curves.nominal]))
    is_ratio = jax.tree.map(jnp.zeros_like, start)
    is_ratio["numbers"] |= {"alpha": jnp.ones_like(start["numbers"]["alpha"])} if "alpha" in start["numbers"] else {}
    is_ratio["offset"] = jnp.full_like(start["offset"], model.toe == "strain")
    size = jnp.where(ravel_pytree(is_ratio)[0] > 0, 1.0, largest)

    def residuals(y):
        return model.residuals(unravel(y), curves)

    _, singular, V = jnp.linalg.svd(jax.jacfwd(residuals)(flat) * size / largest, full_matrices=False)
    to_flat = size[:, None] * V.T / jnp.maximum(singular, _CUT * singular[0])
    solved = optx.least_squares(
        lambda white, _: residuals(flat + to_flat @ white) / largest,
        optx.LevenbergMarquardt(rtol=_RTOL, atol=_RTOL),
        jnp.zeros_like(flat),
        max_steps=_MOST_STEPS,
        throw=False,
    )
    y = flat + to_flat @ solved.value
    return _Fitted(unravel(y), residuals(y), jax.jacfwd(residuals)(y))


def _judged(
    model: LawModel, curves: Curves, measured: tuple[StressStrain, ...], fitted: _Fitted, factor: float
) -> Calibration:
    """Assemble the result; raise MeasurementError where it is no material."""
    try:
        law = model.material(fitted.unknown)
    except ValueError as cause:
        raise MeasurementError(
            f"calibrate: the best fit is no material: {cause} Are sign, unit and kind (nominal or true) of the stress "
            "right? A law with fewer numbers may do."
        ) from cause
    ends = np.cumsum([0, *(curve.stretch.size for curve in measured)]).tolist()
    rows = [slice(first, last) for first, last in pairwise(ends)]
    residuals = np.asarray(fitted.residuals)
    scale = max(float(jnp.max(jnp.abs(stress))) for stress in curves.nominal)
    noise = correlated_covariance(residuals, np.asarray(fitted.jacobian), rows, scale)
    reached = [principal_stretches(curve.stretch, curve.mode) for curve in measured]
    calibrated = min(float(jnp.min(one)) for one in reached), max(float(jnp.max(one)) for one in reached)
    material = type(law)(**fitted.unknown["numbers"], bulk=law.bulk, calibrated=calibrated)
    stretches = np.concatenate([np.asarray(curve.stretch) for curve in measured])
    found = Calibration(
        material=material,
        names=names_of(fitted.unknown),
        unknown=fitted.unknown,
        covariance=jnp.asarray(noise.matrix),
        model=model,
        curves=curves,
        data=measured,
        residuals=tuple(jnp.asarray(residuals[row]) for row in rows),
        autocorrelation=jnp.asarray(noise.correlation),
        effective=jnp.asarray(noise.effective),
        aic=jnp.asarray(noise.deviance + 2.0 * (len(noise.matrix) + 2)),
        std_residual=jnp.asarray(np.sqrt(noise.variance)),
        stability=stable_stretches(material, min(0.3, *stretches), max(3.0, *stretches)),
        range=(float(stretches.min()), float(stretches.max())),
        platen_factor=factor,
        reading=jnp.asarray([_mooney(curves, 0.0), _mooney(curves, 1.0 if measured[0].kind == "true" else -1.0)]),
    )
    _check_stable(found)
    return found


def _mooney(curves: Curves, power: float) -> list[float]:
    """Fit Mooney–Rivlin and offsets to the stress times stretch^power [MPa]: c10, c01 and Young's modulus."""
    model, zero = LawModel(None, MooneyRivlin, "stress"), jnp.zeros(0)
    unit = [
        model.measured({"numbers": {"c10": jnp.asarray(a), "c01": jnp.asarray(1.0 - a)}, "offset": zero}, curves)
        for a in (1.0, 0.0)
    ]
    # An offset fits the mean of each curve exactly.
    basis = [np.concatenate([np.asarray(one - one.mean()) for one in parts]) for parts in unit]
    stresses = [s * stretch**power for s, stretch in zip(curves.nominal, curves.stretch, strict=True)]
    y = np.concatenate([np.asarray(one - one.mean()) for one in stresses])
    c10, c01 = np.linalg.lstsq(np.stack(basis, axis=1), y, rcond=None)[0].tolist()
    return [c10, c01, 6.0 * (c10 + c01)]


def _check_stable(found: Calibration) -> None:
    """Raise MeasurementError for a law that is unstable within a curve."""
    for curve in found.data:
        low, high = found.stability[curve.mode]
        least, largest = float(jnp.min(curve.stretch)), float(jnp.max(curve.stretch))
        if least < low * (1.0 - _EDGE) or largest > high * (1.0 + _EDGE):
            raise MeasurementError(
                f"calibrate: the best fit of {found.model.law.__name__} is unstable within the {curve.mode} curve "
                f"({least:.3g} to {largest:.3g}): it is stable from {low:.3g} to {high:.3g} only (Drucker). Take a law "
                "with fewer numbers, or a smaller range=."
            )
