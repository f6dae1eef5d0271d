"""Checks of user input that hold both for plain numbers and for traced values.

A value is checked when it is concrete; a tracer passes, because the solve checks what it
computes. Every message says field, unit, expected, got.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array


def as_leaf(value: Any, field: str = "value", unit: str = "-") -> Array:
    """Convert a number or array of any precision and byte order to a leaf of the default one: float64, once it is on.

    The type is stated, so that 0, 0.0, np.float32(0) and np.float64(0) share one compilation.

    Raises:
        ValueError: If it is no number.
    """
    try:
        array = value
        if not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
            array = np.asarray(value)
            array = array.astype(float) if array.dtype.kind in "fiu" else array
        array = jnp.asarray(array)
    except (TypeError, ValueError):
        array = None
    if array is None or not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"{field} [{unit}] must be a number, got {value!r}.")
    return jnp.asarray(array, float)


@dataclasses.dataclass(frozen=True)
class Leaf:
    """Converter of a module's field, with the name that messages use and the unit that `repr` writes.

    Attributes:
        field: Name, such as "NeoHooke.c10".
        unit: Its unit; "-" for none.
        optional: Whether it may be None.
    """

    field: str
    unit: str
    optional: bool = False

    def __call__(self, value: Any) -> Any:
        """Convert a value to a leaf."""
        return None if value is None and self.optional else as_leaf(value, self.field, self.unit)


def concrete(value: Any) -> np.ndarray | None:
    """Return the value as a NumPy array, or None where it is traced."""
    return None if isinstance(value, Tracer) else np.asarray(value)


def _number(field: str, unit: str, value: Any, holds, expected: str) -> None:
    known = concrete(value)
    if known is None:
        return
    if known.dtype.kind not in "fiu":
        raise ValueError(f"{field} [{unit}] must be a number, got {value!r}.")
    if not np.all(np.isfinite(known)) or not np.all(holds(known)):
        low, high = known.min(), known.max()
        got = f"values from {low:g} to {high:g}" if low < high else low.item()
        raise ValueError(f"{field} [{unit}] must be {expected}, got {got}.")


def check_modulus(field: str, unit: str, value: Any) -> None:
    """Raise ValueError unless the value is positive, infinite included, or traced."""
    known = concrete(value)
    if known is not None and known.dtype.kind == "f":
        value = known[known != np.inf]
    if known is None or np.size(value):
        _number(field, unit, value, lambda v: v > 0, "positive, or jnp.inf for incompressible")


def check_positive(field: str, unit: str, value: Any) -> None:
    """Raise ValueError unless the value is finite and positive, or traced."""
    _number(field, unit, value, lambda v: v > 0, "positive")


def check_non_negative(field: str, unit: str, value: Any) -> None:
    """Raise ValueError unless the value is finite and not negative, or traced."""
    _number(field, unit, value, lambda v: v >= 0, "zero or positive")


def check_finite(field: str, unit: str, value: Any) -> None:
    """Raise ValueError unless the value is finite, or traced."""
    _number(field, unit, value, lambda v: np.ones(v.shape, bool), "finite")
