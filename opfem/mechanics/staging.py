"""What the compiler must not fuse: how to keep it from computing an intermediate result many times over.

XLA for CPU fuses whatever is cheap into each of its uses. Entries of a tangent then compute kinematics again, 81
times, and a product with a stencil its field, 243 times: four times slower than memory allows.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._device import choices


def apart(function: Callable, *args: Any) -> Any:
    """Evaluate a function of PyTrees of arrays, storing its arguments before and its results after.

    Nothing is fused across a conditional. This one has a known predicate, hidden from the compiler; so it stays
    one condition for all lanes under `jax.vmap`. GPUs fuse better and would wait for the predicate: no border there.
    """
    if not choices().bordered:
        return function(*args)
    results = jax.eval_shape(function, *args)
    never = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), results)
    return jax.lax.cond(jax.lax.optimization_barrier(jnp.asarray(True)), function, lambda *_: never, *args)


def mapped(function: Callable, values: Any) -> Any:
    """Apply a function along the first axis of a PyTree of arrays: on a CPU one entry after the other."""
    return jax.lax.map(function, values) if choices().one_by_one else jax.vmap(function)(values)
