"""Fusion barriers: they stop the compiler from recomputing intermediate results.

XLA for CPU fuses cheap operations into each of their uses. Entries of a tangent then recompute kinematics 81 times, and
a stencil product its field 243 times: four times slower than memory bandwidth.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._device import choices


def unfused(function: Callable, *args: Any) -> Any:
    """Evaluate a function of PyTrees of arrays between fusion barriers.

    XLA does not fuse across a conditional. This one has a known predicate, hidden from the compiler, and remains one
    conditional for all lanes under `jax.vmap`. GPUs fuse better and would wait for the predicate: no barrier there.
    """
    if not choices().bordered:
        return function(*args)
    results = jax.eval_shape(function, *args)
    never = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), results)
    return jax.lax.cond(jax.lax.optimization_barrier(jnp.asarray(True)), function, lambda *_: never, *args)


def mapped(function: Callable, values: Any) -> Any:
    """Apply a function along the first axis of a PyTree of arrays: on a CPU one entry after the other."""
    return jax.lax.map(function, values) if choices().one_by_one else jax.vmap(function)(values)
