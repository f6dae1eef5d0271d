"""Checks of user input that hold both for plain numbers and for traced values.

A value is checked when it is concrete; a tracer passes, because the solve checks what it
computes. Every message says field, unit, expected, got.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array


def as_leaf(value: Any) -> Array:
    """Convert a number or array to a floating-point leaf; what has no precision of its own gets the default.

    The type is stated, so that 0, 0.0 and np.float64(0) share one compilation.
    """
    array = jnp.asarray(value)
    return jnp.asarray(array, array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else float)


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
        got = known.item() if known.ndim == 0 else f"values from {known.min():g} to {known.max():g}"
        raise ValueError(f"{field} [{unit}] must be {expected}, got {got}.")


def check_modulus(field: str, unit: str, value: Any) -> None:
    """Raise ValueError unless the value is positive, infinite included, or traced."""
    known = concrete(value)
    if known is None or known.dtype.kind != "f" or not np.all(known == np.inf):
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
