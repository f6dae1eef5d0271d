"""How the programs of an untraced solve are compiled: with less effort, and side by side.

XLA compiles such a program for longer than it then runs, so that what its optimiser gains is seldom earned back.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from .._device import choices

# On a CPU. LLVM's first level instead of its third, and the older of XLA's two code generators: together a load
# increment of the coin on 40×40×4 elements compiles in 7 CPU seconds instead of 15, and runs 8 % longer (4.0 s).
_QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Return options for `jax.jit` with which a function that solves compiles sooner, and runs about as fast.

    As in `jax.jit(jax.value_and_grad(mean_pressure), compiler_options=op.compiler_options())`. `solve`, outside of
    `jit`, takes them by itself. JAX refuses options inside of another `jit`.

    Returns:
        Those that this version of XLA knows, for the default device; on other devices than CPUs none.
    """
    known = {}
    for name, value in _QUICK.items() if choices().compiles_slowly else ():
        try:
            jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
        except jax.errors.JaxRuntimeError:  # "No such compile option"
            continue
        known[name] = value
    return known


def is_traced(tree: Any) -> bool:
    """Tell whether arrays are traced, or whatever is computed from them here would be."""
    # Whatever is made inside of a trace is traced.
    return any(isinstance(leaf, Tracer) for leaf in (jnp.zeros(()), *jax.tree.leaves(tree)))


class QuickJit:
    """`equinox.filter_jit` at a low XLA optimisation level; options follow the default device at the first call."""

    def __init__(self, function: Callable):
        functools.update_wrapper(self, function)
        self._function = function
        self._known: set[Any] = set()

    @functools.cached_property
    def _jitted(self) -> Any:
        # It hands options on to `jax.jit`, which its declared overloads leave out.
        return eqx.filter_jit(self._function, compiler_options=compiler_options())  # pyright: ignore[reportCallIssue]

    def __call__(self, *args: Any) -> Any:
        """Run it, compiled; as a part of the program where one is traced, whose options are then its own."""
        return self._inner(*args) if is_traced(args) else self._jitted(*args)

    @functools.cached_property
    def _inner(self) -> Any:
        return eqx.filter_jit(self._function)

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        """Serve as a method."""
        return self if instance is None else functools.partial(self, instance)

    def compile_for(self, *args: Any) -> None:
        """Compile for arguments of these shapes, so that a call need not."""
        leaves, structure = jax.tree.flatten(eqx.filter(args, eqx.is_array))
        shapes = (structure, *((leaf.shape, leaf.dtype) for leaf in leaves))
        if shapes not in self._known:
            self._jitted.lower(*args).compile()
            self._known.add(shapes)


@contextmanager
def compiled_meanwhile(programs: Sequence[tuple[QuickJit, tuple]]) -> Iterator[None]:
    """Compile programs for arguments in other threads while the body runs; XLA releases Python's lock.

    A program that fails is left to whoever calls it.
    """
    pool = ThreadPoolExecutor(max_workers=max(1, len(programs)))
    for program, args in programs:
        pool.submit(program.compile_for, *args)
    try:
        yield
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
