"""Two contact faces evaluated together: concatenated along the last axis, window first.

Contact of window and sample differs in law, friction and surface only. The rest, most of the work, is traced, compiled
and run once for both.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..model import Contact
from ..model.overclosure import AbstractOverclosure


class PairedSurface(eqx.Module):
    """Rigid surfaces, each of one part of the points."""

    parts: tuple[Any, ...]

    @property
    def is_plane(self) -> bool:
        """Whether all are the plane z = 0."""
        return all(part.is_plane for part in self.parts)

    def derivatives(self, fraction: Array, x: Array, y: Array, order: int) -> Array:
        """Evaluate heights [mm] and their derivatives (`HeightField.derivatives`)."""
        return _in_parts([lambda x, y, part=part: part.derivatives(fraction, x, y, order) for part in self.parts], x, y)


class PairedLaw(eqx.Module):
    """Pressure–overclosure laws, each of one part of the points."""

    parts: tuple[AbstractOverclosure, ...]

    def pressure_at(self, clearance: Array, scale: Array) -> Array:
        """Compute the contact pressure [MPa]."""
        return _in_parts([lambda g, part=part: part.pressure_at(g, scale) for part in self.parts], clearance)

    def clearance_at(self, pressure: Array, scale: Array) -> Array:
        """Compute the clearance [mm] of a pressure."""
        return _in_parts([lambda p, part=part: part.clearance_at(p, scale) for part in self.parts], pressure)

    def multiplier_shift(self, pressure: Array, scale: Array) -> Array:
        """Compute the shift of each law's clearance [mm]."""
        return _in_parts([lambda p, part=part: part.multiplier_shift(p, scale) for part in self.parts], pressure)


class PairedContact(eqx.Module):
    """Laws and frictions, each of one part of the points."""

    parts: tuple[Contact, ...]

    @property
    def law(self) -> PairedLaw:
        """Their laws."""
        return PairedLaw(tuple(part.law for part in self.parts))

    def slip_limit(self, pressure: Array, element_size: Array) -> Array:
        """Compute the elastic slip [mm] at which a point starts to slide."""
        return _in_parts([lambda p, part=part: part.slip_limit(p, element_size) for part in self.parts], pressure)

    def stick_stiffness(self, pressure: Array, element_size: Array) -> Array:
        """Compute the sticking stiffness [MPa/mm] at a contact pressure [MPa]."""
        return _in_parts([lambda p, part=part: part.stick_stiffness(p, element_size) for part in self.parts], pressure)


def split(tree: Any, parts: int) -> list[Any]:
    """Split the last axis of every array into equal parts; `join` undoes it."""
    each = [jnp.split(leaf, parts, axis=-1) for leaf in jax.tree.leaves(tree)]
    return [jax.tree.unflatten(jax.tree.structure(tree), part) for part in zip(*each, strict=True)]


def join(parts: Sequence[Any]) -> Any:
    """Concatenate the arrays of several trees along their last axis."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *parts)


def _in_parts(functions: Sequence[Callable], *values: Array) -> Array:
    return join([function(*part) for function, part in zip(functions, split(values, len(functions)), strict=True)])
