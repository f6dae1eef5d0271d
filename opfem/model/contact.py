"""Boundary conditions of a face of the layer: bonded, roller, or contact with Coulomb friction."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._checks import Leaf, check_non_negative, check_positive
from .._repr import with_units
from .overclosure import AbstractOverclosure

# Abaqus's default slip tolerance: elastic slip over element size.
SLIP_TOLERANCE = 0.005


class Bonded(eqx.Module):
    """Displacement zero in every direction."""


class Roller(eqx.Module):
    """Normal displacement zero both ways, free to slide."""


class Contact(eqx.Module):
    """Unilateral contact with Coulomb friction.

    Friction sticks with a small elastic slip, then slides at friction × pressure; the slip history of
    every point is stored over the increments.

    Args:
        law: Pressure–overclosure law.
        friction: Friction coefficient [-]; 0 is exactly frictionless.
        elastic_slip: Slip [mm] at which a point starts to slide: the sticking stiffness is
            friction × pressure / elastic_slip. Default: 0.005 of the element size.
        stick_slope: Constant sticking stiffness [MPa/mm] instead, as CalculiX has it.

    Raises:
        ValueError: If a number is out of range, or elastic_slip and stick_slope are both given.
    """

    law: AbstractOverclosure
    friction: Array = eqx.field(converter=Leaf("Contact.friction", "-"))
    elastic_slip: Array | None = eqx.field(converter=Leaf("Contact.elastic_slip", "mm", optional=True), default=None)
    stick_slope: Array | None = eqx.field(converter=Leaf("Contact.stick_slope", "MPa/mm", optional=True), default=None)

    def __check_init__(self):
        if not isinstance(self.law, AbstractOverclosure):
            raise ValueError(f"Contact.law must be an overclosure law such as HardOverclosure(), got {self.law!r}.")
        check_non_negative("Contact.friction", "-", self.friction)
        if self.elastic_slip is not None and self.stick_slope is not None:
            raise ValueError("Contact takes elastic_slip [mm] or stick_slope [MPa/mm], got both. Pass one.")
        if self.elastic_slip is not None:
            check_positive("Contact.elastic_slip", "mm", self.elastic_slip)
        if self.stick_slope is not None:
            check_positive("Contact.stick_slope", "MPa/mm", self.stick_slope)

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def slip_limit(self, pressure: Array, element_size: Array) -> Array:
        """Compute the elastic slip [mm] at which a point starts to slide."""
        if self.stick_slope is not None:
            return self.friction * pressure / self.stick_slope
        slip = SLIP_TOLERANCE * element_size if self.elastic_slip is None else self.elastic_slip
        return jnp.broadcast_to(slip, pressure.shape)

    def stick_stiffness(self, pressure: Array, element_size: Array) -> Array:
        """Compute the sticking stiffness [MPa/mm] at a contact pressure [MPa]."""
        if self.stick_slope is not None:
            return jnp.where(pressure > 0, self.stick_slope, 0.0)
        return self.friction * pressure / self.slip_limit(pressure, element_size)


Side = Bonded | Roller | Contact
