"""Compiled programs kept on disk, so that a new process does not compile them again."""

import hashlib
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

# Programs that compile faster than this [s] are not worth a file.
_WORTH_KEEPING = 0.1


def cache_compilation(folder: str | os.PathLike | None = None) -> Path:
    """Keep what is compiled on disk, for all processes to come: call it once in each, before the first solve.

    The first solve of a process then only traces, a few seconds, and runs, where one of the same mesh, element,
    contact and JAX was solved before on this machine. Each takes some 2 MB; JAX removes none.

    Args:
        folder: Where to keep it; None takes the folder in the environment variable JAX_COMPILATION_CACHE_DIR, else
            the user's cache.

    Returns:
        The folder in use: compiled code fits one version of jaxlib on one kind of processor, each has its own.

    Raises:
        OSError: If the folder cannot be made.
    """
    import pooch  # loaded here, so that `import opfem` stays free of it

    root = Path(folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or pooch.os_cache("opfem") / "compiled")
    own = root / f"jaxlib-{version('jaxlib')}-{_processor()}"
    own.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(own))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    compilation_cache.reset_cache()  # else what was compiled before this call would have settled that there is none
    return own


# What a process that computes for another must share with it.
_SHARED = ("jax_enable_x64", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def configuration() -> dict[str, Any]:
    """Return how JAX is configured here, for `configure` in another process."""
    return {name: getattr(jax.config, name) for name in _SHARED}


def configure(settings: dict[str, Any]) -> None:
    """Configure JAX as another process has it."""
    for name, value in settings.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)


def _processor() -> str:
    """Name the kind of processor, by what it can do where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        known = {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}
    except OSError:
        known = {platform.machine(), platform.processor()}
    return hashlib.sha256("\n".join(sorted(known)).encode()).hexdigest()[:12]
