"""`value_and_sensitivities`: a function's value and its derivatives by all of its arguments, in one call."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._checks import as_leaf
from .outputs import Sensitivities


def value_and_sensitivities(fn: Callable[..., Any]) -> Callable[..., Sensitivities]:
    """Make a function that also returns the derivatives by every argument it is called with.

    One number is differentiated in reverse, at the cost of one solve backward for all arguments; arrays forward, at
    the cost of one each. The function can be swept: its derivatives are called `d_<output>_d_<argument>`.

    Args:
        fn: Returns a number, an array, or a dict of these; its arguments are numbers.

    Raises:
        ValueError: For arguments without derivative, and for other results of `fn`.

    Example:
        >>> import opfem as op
        >>> def work(force, distance=2.0):
        ...     return force * distance
        >>> value, derivatives = op.value_and_sensitivities(work)(force=3.0, distance=2.0)
        >>> float(value), float(derivatives["force"])
        (6.0, 2.0)
    """
    signature = inspect.signature(fn)

    @functools.wraps(fn)
    def both(*args, **kwargs) -> Sensitivities:
        bound = signature.bind(*args, **kwargs).arguments
        named = [
            bound.pop(name) for name, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD and name in bound
        ]
        numbers = {name: _leaf(name, value) for group in (bound, *named) for name, value in group.items()}

        def of_numbers(numbers):
            answer = fn(**numbers)
            _check(answer)
            return jax.tree.map(as_leaf, answer)

        value, push = jax.linearize(of_numbers, numbers)
        leaves, structure = jax.tree.flatten(value)
        if len(leaves) == 1 and leaves[0].shape == ():
            (gradient,) = jax.linear_transpose(push, numbers)(jax.tree.map(jnp.ones_like, value))
            return Sensitivities(value, {name: structure.unflatten([g]) for name, g in gradient.items()})
        zeros = jax.tree.map(jnp.zeros_like, numbers)
        derivatives = {name: push({**zeros, name: jnp.ones_like(numbers[name])}) for name in numbers}
        return Sensitivities(value, derivatives)

    return both


def _leaf(name: str, value: Any):
    leaf = as_leaf(value) if not isinstance(value, str | bool) else None
    if leaf is None or leaf.ndim:
        raise ValueError(f"value_and_sensitivities differentiates by numbers, got {value!r} for {name!r}.")
    return leaf


def _check(answer: Any) -> None:
    parts = answer.values() if isinstance(answer, dict) else [answer]
    wrong = [type(part).__name__ for part in parts if not isinstance(part, jax.Array | float | int)]
    if wrong:
        raise ValueError(
            f"value_and_sensitivities needs a function of numbers, arrays or a dict of these, got {', '.join(wrong)}. "
            "Take out what is to be differentiated, such as solution.pressure.max()."
        )
