"""What holds a face of the layer: bonded, roller, or contact with Coulomb friction."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._checks import as_leaf, check_non_negative, check_positive
from .overclosure import AbstractOverclosure

# Abaqus's default slip tolerance: elastic slip over element size.
SLIP_TOLERANCE = 0.005


class Bonded(eqx.Module):
    """Displacement zero in every direction."""


class Roller(eqx.Module):
    """Normal displacement zero both ways, free to slide."""


class Contact(eqx.Module):
    """Unilateral contact with Coulomb friction.

    Friction sticks with a small elastic slip, then slides at friction × pressure; the slip of
    every point is remembered from increment to increment.

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
    friction: Array = eqx.field(converter=as_leaf)
    elastic_slip: Array | None
    stick_slope: Array | None

    def __init__(self, law: AbstractOverclosure, friction, elastic_slip=None, stick_slope=None):
        if not isinstance(law, AbstractOverclosure):
            raise ValueError(f"Contact.law must be an overclosure law such as HardOverclosure(), got {law!r}.")
        check_non_negative("Contact.friction", "-", friction)
        if elastic_slip is not None and stick_slope is not None:
            raise ValueError("Contact takes elastic_slip [mm] or stick_slope [MPa/mm], got both. Pass one.")
        if elastic_slip is not None:
            check_positive("Contact.elastic_slip", "mm", elastic_slip)
        if stick_slope is not None:
            check_positive("Contact.stick_slope", "MPa/mm", stick_slope)
        self.law = law
        self.friction = as_leaf(friction)
        self.elastic_slip = None if elastic_slip is None else as_leaf(elastic_slip)
        self.stick_slope = None if stick_slope is None else as_leaf(stick_slope)

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
