"""Pressure–overclosure laws: contact pressure as a function of clearance.

Clearance g > 0 is open; pressure is positive in compression and acts on the current area.
Every law is finite, with a finite slope, for any clearance.
"""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import Leaf, as_leaf, check_finite, check_positive, concrete
from .._repr import with_units
from .plausible import check_clearance_unit, check_modulus_unit

# Overclosure, in units of c0, beyond which the exponential law continues along its tangent;
# the same threshold as Abaqus (Theory Guide 5.2.1). At p0 = 2 MPa it is 1.3 GPa.
_LINEAR_BEYOND = 6.0
# Newton steps from an initial value within a factor of two; they converge to round-off.
_INVERSE_STEPS = 8
# Penalty over element stiffness, with the method of multipliers and without. Ratios 3, 5, 10, 15, 20 and
# 30: a layer with two lifted corners (50×50×4 elements) takes 11, 13, 13, 15, 15 and 38 increments, and fails at 1000;
# the coin on 40×40×4 elements takes 84, 79, 74, 74, 74 and 74 Newton steps. Of 200 random problems 199
# converge at 3 and 5, and 198 at 10 (`benchmarks/robustness.py`).
_EXACT_RATIO, _PENALTY_RATIO = 5.0, 1000.0


class AbstractOverclosure(eqx.Module):
    """A law p(g) with its slope; `scale` is the stiffness of the layer per area [MPa/mm].

    Attributes:
        exact: Whether the law is a penalty whose penetration the method of multipliers removes.
    """

    exact: ClassVar[bool] = False

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        raise NotImplementedError

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure: the inverse of `pressure_at`."""
        raise NotImplementedError

    def multiplier_shift(self, pressure: Array, scale: Array) -> Array:
        """Compute the shift of the clearance [mm] at which zero penetration has this pressure; 0 unless exact."""
        return self.clearance_at(pressure, scale) if self.exact else jnp.zeros_like(pressure)

    @property
    def zero_pressure_clearance(self) -> Array:
        """Clearance at which pressure starts [mm]."""
        raise NotImplementedError


def _overclosure(clearance: Array) -> Array:
    # Slope 1 at zero clearance: a layer that just touches the window is supported by it.
    return jnp.where(clearance <= 0.0, -clearance, 0.0)


class HardOverclosure(AbstractOverclosure):
    """Hard contact: no pressure when open, no penetration when closed.

    Augmented Lagrangian: a penalty of `stiffness_ratio` times the stiffness of one element of the layer, and the method
    of multipliers. Each increment has the pressure of the last one as multiplier; at full load, increments repeat until
    the update is small. The remaining penetration, `stats["max_penetration"]`, is usually below 0.01 µm. The penalty
    can then be moderate. A stiff one makes receding contact fail, as where corners of a sample lift off. It affects a
    solution only through the path of friction. Contact with the sample, which may be curved, is integrated at the nodes
    of the layer: more contact points than nodes would over-constrain it.

    `exact=False` is the penalty alone, for a tenth less work. Penetration is then about 1/stiffness_ratio of the
    shortening of an element under the same pressure: about 0.05 µm at 10 kPa. Take it with `Newton(krylov_rtol=1e-3)`:
    the residual of a linear solve counts mostly forces of the penalty. At the default 3e-2 errors of the first step
    open half of a plate on 15×15×6 elements, which then takes 39 increments with snap-through instead of 8.

    An element's stiffness is the confined modulus, with at most 20 shear moduli for the bulk modulus, over the
    element's height; and times (height/width)² where it is wider than high: a flat layer bends, and stiffer contact
    cycles between open and closed.

    Source:
        Nocedal and Wright, Numerical Optimization, chapter 17 (method of multipliers).

    Args:
        stiffness_ratio: Penalty stiffness over element stiffness [-]; None is 5, and 1000 where not exact.
        exact: Whether the method of multipliers removes penetration.

    Raises:
        ValueError: If stiffness_ratio is not positive.
    """

    stiffness_ratio: Array
    exact: bool = eqx.field(static=True)

    def __init__(self, stiffness_ratio=None, exact: bool = True):
        if stiffness_ratio is None:
            stiffness_ratio = _EXACT_RATIO if exact else _PENALTY_RATIO
        self.stiffness_ratio = as_leaf(stiffness_ratio, "HardOverclosure.stiffness_ratio")
        self.exact = exact

    def __check_init__(self):
        check_positive("HardOverclosure.stiffness_ratio", "-", self.stiffness_ratio)

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        return self.stiffness_ratio * scale * _overclosure(clearance)

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure."""
        return -pressure / (self.stiffness_ratio * scale)

    @property
    def zero_pressure_clearance(self) -> Array:
        """Clearance at which pressure starts [mm]."""
        return jnp.zeros_like(self.stiffness_ratio)


class LinearOverclosure(AbstractOverclosure):
    """Linear contact: p = stiffness × overclosure.

    Args:
        stiffness: Pressure per overclosure [MPa/mm].

    Raises:
        ValueError: If the stiffness is not positive.
    """

    stiffness: Array = eqx.field(converter=Leaf("LinearOverclosure.stiffness", "MPa/mm"))

    def __check_init__(self):
        check_positive("LinearOverclosure.stiffness", "MPa/mm", self.stiffness)

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        return self.stiffness * _overclosure(clearance)

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure."""
        return -pressure / self.stiffness

    @property
    def zero_pressure_clearance(self) -> Array:
        """Clearance at which pressure starts [mm]."""
        return jnp.zeros_like(self.stiffness)


class ExponentialOverclosure(AbstractOverclosure):
    """Exponential contact as Abaqus has it: p = p0/(e-1) s (eˢ - 1), s = 1 - g/c0, for s > 0.

    Beyond an overclosure of 6 c0 the law continues along its tangent.

    Args:
        pressure: p0, pressure at zero clearance [MPa].
        clearance: c0, clearance where contact starts [mm].

    Raises:
        ValueError: If a number is not positive.

    Source:
        Abaqus Theory Guide 5.2.1; values in docs/validation.md, table E.
    """

    pressure: Array = eqx.field(converter=Leaf("ExponentialOverclosure.pressure (p0)", "MPa"))
    clearance: Array = eqx.field(converter=Leaf("ExponentialOverclosure.clearance (c0)", "mm"))

    def __check_init__(self):
        check_positive("ExponentialOverclosure.pressure (p0)", "MPa", self.pressure)
        check_positive("ExponentialOverclosure.clearance (c0)", "mm", self.clearance)
        check_modulus_unit("ExponentialOverclosure.pressure (p0)", self.pressure)
        check_clearance_unit("ExponentialOverclosure.clearance (c0)", self.clearance)

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        s = 1.0 - clearance / self.clearance
        top = 1.0 + _LINEAR_BEYOND
        inside = jnp.clip(s, 0.0, top)
        exponential = jnp.exp(inside)
        slope = (1.0 + top) * math.exp(top) - 1.0
        return self.pressure / (np.e - 1.0) * (inside * (exponential - 1.0) + slope * jnp.maximum(s - top, 0.0))

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure, by Newton's method on s (eˢ - 1)."""
        ratio = pressure * (np.e - 1.0) / self.pressure
        top = 1.0 + _LINEAR_BEYOND
        at_top, slope = top * (math.exp(top) - 1.0), (1.0 + top) * math.exp(top) - 1.0
        inside = jnp.minimum(ratio, at_top)
        s = jnp.where(inside < 1.0, jnp.sqrt(inside), jnp.maximum(jnp.log1p(inside), 0.5))
        for _ in range(_INVERSE_STEPS):
            rise = jnp.expm1(s)
            slope_here = rise + s * (1.0 + rise)
            s = s - jnp.where(s > 0, (s * rise - inside) / jnp.where(s > 0, slope_here, 1.0), 0.0)
        return self.clearance * (1.0 - s - jnp.maximum(ratio - at_top, 0.0) / slope)

    @property
    def zero_pressure_clearance(self) -> Array:
        """Clearance at which pressure starts [mm]."""
        return self.clearance


class TabularOverclosure(AbstractOverclosure):
    """Contact by a table, linear between its rows; beyond the last row it continues along the last segment.

    Abaqus: *SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=TABULAR, whose second column is minus the clearance.

    Args:
        pressure: Pressures [MPa], `(rows,)`, rising from 0.
        clearance: Clearances [mm] of the same rows, falling.

    Raises:
        ValueError: If the table has fewer than two rows, or does not rise and fall.
    """

    pressure: Array = eqx.field(converter=Leaf("TabularOverclosure.pressure", "MPa"))
    clearance: Array = eqx.field(converter=Leaf("TabularOverclosure.clearance", "mm"))

    def __check_init__(self):
        if self.pressure.ndim != 1 or self.pressure.shape != self.clearance.shape or self.pressure.size < 2:
            raise ValueError(
                "TabularOverclosure.pressure [MPa] and .clearance [mm] must be two lists of one length, at least 2, "
                f"got shapes {self.pressure.shape} and {self.clearance.shape}."
            )
        check_finite("TabularOverclosure.pressure", "MPa", self.pressure)
        check_finite("TabularOverclosure.clearance", "mm", self.clearance)
        pressures, clearances = concrete(self.pressure), concrete(self.clearance)
        if pressures is not None and (pressures[0] != 0.0 or (np.diff(pressures) <= 0).any()):
            raise ValueError(f"TabularOverclosure.pressure [MPa] must rise from 0, got {pressures.tolist()}.")
        if clearances is not None and (np.diff(clearances) >= 0).any():
            raise ValueError(
                f"TabularOverclosure.clearance [mm] must fall from row to row, got {clearances.tolist()}. "
                "Overclosure is minus the clearance."
            )
        check_modulus_unit("TabularOverclosure.pressure", self.pressure)
        check_clearance_unit("TabularOverclosure.clearance", self.clearance)

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        return _along(-clearance, -self.clearance, self.pressure)

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure."""
        return self.clearance[0] - _along(pressure, self.pressure, self.clearance[0] - self.clearance)

    @property
    def zero_pressure_clearance(self) -> Array:
        """Clearance at which pressure starts [mm]."""
        return self.clearance[0]


def _along(x: Array, rows: Array, values: Array) -> Array:
    """Interpolate rising `values` over rising `rows`: 0 before the first row, straight on after the last."""
    total = jnp.zeros_like(x)
    for k in range(rows.size - 1):
        inside = x - rows[k]
        if k < rows.size - 2:
            inside = jnp.where(x < rows[k + 1], inside, rows[k + 1] - rows[k])
        slope = (values[k + 1] - values[k]) / (rows[k + 1] - rows[k])
        # As for hard contact: a point that just touches is supported.
        total = total + jnp.where(x >= rows[k], slope * inside, 0.0)
    return total
