"""Compilation of the programs of an untraced solve: at a low optimisation level, and concurrently.

XLA takes longer to compile such a program than to run it; its higher optimisation levels rarely pay.
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
_LEVEL = "xla_backend_optimization_level"
_QUICK = {_LEVEL: 1, "xla_cpu_use_fusion_emitters": False}
# Level of a short program that runs once a solve: `prepare` compiles in 0.2 CPU seconds instead of 0.7, and takes 5
# instead of 4 ms on 40×40×4 elements. Not `finish`, which would take 0.2 instead of 0.08 s.
_LEVEL_OF_ONE_RUN = 0


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Return options for `jax.jit` that compile a function with a solve faster, at about the same run time.

    As in `jax.jit(jax.value_and_grad(mean_pressure), compiler_options=op.compiler_options())`. `solve`, outside of
    `jit`, takes them by itself. JAX refuses options inside of another `jit`.

    Returns:
        Options that this version of XLA supports on the default device; none on other devices than CPUs.
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
    """Return whether arrays, or results computed from them here, are traced."""
    # Inside of a trace new arrays are traced.
    return any(isinstance(leaf, Tracer) for leaf in (jnp.zeros(()), *jax.tree.leaves(tree)))


class QuickJit:
    """`equinox.filter_jit` at a low XLA optimisation level; options follow the default device at the first call."""

    def __init__(self, function: Callable, once: bool = False):
        """Wrap a function.

        Args:
            function: The function.
            once: Whether it is short and runs once a solve: it compiles at a still lower level.
        """
        functools.update_wrapper(self, function)
        self._function, self._once = function, once
        self._known: set[Any] = set()

    @functools.cached_property
    def _jitted(self) -> Any:
        # It passes options to `jax.jit`, which its declared overloads omit.
        options = compiler_options()
        if self._once and _LEVEL in options:
            options = {**options, _LEVEL: _LEVEL_OF_ONE_RUN}
        return eqx.filter_jit(self._function, compiler_options=options)  # pyright: ignore[reportCallIssue]

    def __call__(self, *args: Any) -> Any:
        """Run the compiled function; inside of a trace, inline it: the options of the outer program apply."""
        return self._inner(*args) if is_traced(args) else self._jitted(*args)

    @functools.cached_property
    def _inner(self) -> Any:
        return eqx.filter_jit(self._function)

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        """Bind to an instance, as a method."""
        return self if instance is None else functools.partial(self, instance)

    def compile_for(self, *args: Any) -> None:
        """Compile for arguments of these shapes ahead of a call."""
        leaves, structure = jax.tree.flatten(eqx.filter(args, eqx.is_array))
        shapes = (structure, *((leaf.shape, leaf.dtype) for leaf in leaves))
        if shapes not in self._known:
            self._jitted.lower(*args).compile()
            self._known.add(shapes)


@contextmanager
def compiled_meanwhile(programs: Sequence[tuple[QuickJit, tuple]]) -> Iterator[None]:
    """Compile programs in other threads while the body runs; XLA releases Python's lock.

    A failed compilation is repeated, and its error raised, by the first call.
    """
    pool = ThreadPoolExecutor(max_workers=max(1, len(programs)))
    for program, args in programs:
        pool.submit(program.compile_for, *args)
    try:
        yield
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
