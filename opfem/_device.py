"""What is done differently on a CPU and on an accelerator: every such choice is made here."""

import os
from typing import NamedTuple

import jax


class Choices(NamedTuple):
    """How programs are built for a kind of device.

    Attributes:
        bordered: Fusion barriers (`mechanics.unfused.unfused`).
        one_by_one: Go through layers or rows of elements, and blocks of their matrices, one after the other, so that
            intermediates stay in the cache; else all at once, as many threads want.
        threads: Compute batches of a sweep in threads, a point at a time; else in one, by `jax.vmap`.
        compiles_slowly: Compile with less effort (`solvers.compiling`).
    """

    bordered: bool
    one_by_one: bool
    threads: bool
    compiles_slowly: bool


# Linux lets a process map 65 530 regions of memory, and jaxlib crashes beyond. A compiled solve takes some 2000.
_MOST_REGIONS = 30_000

CPU = Choices(bordered=True, one_by_one=True, threads=True, compiles_slowly=True)
ACCELERATOR = Choices(bordered=False, one_by_one=False, threads=False, compiles_slowly=False)


def choices() -> Choices:
    """Return the choices for JAX's default device."""
    return CPU if jax.default_backend() == "cpu" else ACCELERATOR


def memory() -> int | None:
    """Return the memory of JAX's default device [byte]; None where it is unknown."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows has none of it
        return None


def make_room() -> None:
    """Forget compiled programs where they are so many that jaxlib would soon crash; what is needed is loaded again."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            regions = sum(1 for _ in maps)
    except OSError:  # not Linux: no such bound
        return
    if regions > _MOST_REGIONS:
        jax.clear_caches()
