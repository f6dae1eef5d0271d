"""Compiled programs kept on disk, so that a new process does not compile them again.

JAX writes and reads the entries; this module gives each kind of machine its own folder, bounds their size, and
turns whatever goes wrong with them into a compilation and one line.
"""

import contextlib
import hashlib
import os
import platform
import re
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

# Programs that compile faster than this [s] are not kept. With 0.1, a second `opfem palpate` still compiled 30 of its
# 48, for 1.4 s; with this, none that counts.
_WORTH_KEEPING = 0.02
_NEVER = 1e9
# How JAX reports an entry that it could not read or write; it compiles instead.
_REPORT = re.compile(r"Error (reading|writing) persistent compilation cache entry for '(.*)': (\w+: .*)", re.DOTALL)


def cache_compilation(folder: str | os.PathLike | None = None, *, gigabytes: float = 1.0) -> Path | None:
    """Keep compiled programs on disk: call it once in each process, before the first solve.

    The first solve of a process then only traces, a few seconds, and runs, where one of the same mesh, element,
    contact and JAX was solved before on this machine. Processes may share a folder. A folder that cannot be used, or a
    damaged entry, costs the compilation and a line on stderr. XLA's alarm for slow compilation is switched off.

    Args:
        folder: Where to keep them; None takes the folder in the environment variable JAX_COMPILATION_CACHE_DIR, else
            the user's cache.
        gigabytes: Size that the entries may have when a process begins; those unused for longest are removed.

    Returns:
        The folder in use: one for each version of jaxlib, kind of processor and number of cores. None: nothing is
        kept, because the folder cannot be made or the environment variable OPFEM_NO_CACHE is set.
    """
    silence_alarm()
    if os.environ.get("OPFEM_NO_CACHE", "") not in ("", "0"):
        return None
    own = None
    try:
        root = _root(folder)
        own = root / f"jaxlib-{version('jaxlib')}-{_processor()}"
        own.mkdir(parents=True, exist_ok=True)
        _prune(root, int(1e9 * gigabytes))
    except (OSError, RuntimeError) as cause:  # platformdirs raises the latter where there is no home folder
        _say(f"compiled programs are not kept: {cause}")
        return None
    jax.config.update("jax_compilation_cache_dir", str(own))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING if _writable(own) else _NEVER)
    # Else the path would be part of the key of each entry, and a folder that was moved or copied would be of no use.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    compilation_cache.reset_cache()  # else what was compiled before this call would have settled that there is none
    if not getattr(warnings.showwarning, "of_cache", False):
        warnings.showwarning = _translated(warnings.showwarning)
    return own


def silence_alarm() -> None:
    """Switch off what XLA logs while it compiles slowly; what goes wrong in XLA reaches Python as an exception."""
    former = _option("jax_logging_level")
    # JAX itself sets the variable to 1.
    if former in (None, "NOTSET") and os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        # The level of jaxlib's C++ log outlasts the second update, that of Python's does not.
        jax.config.update("jax_logging_level", "CRITICAL")
        jax.config.update("jax_logging_level", former)


def configuration() -> dict[str, Any]:
    """Return how JAX is configured here, for `configure` in another process."""
    kept = _option("jax_compilation_cache_dir")
    return {"jax_enable_x64": _option("jax_enable_x64"), "root": None if kept is None else str(Path(kept).parent)}


def configure(settings: dict[str, Any]) -> None:
    """Configure JAX as another process has it; each machine keeps what it compiled in its own folder."""
    if _option("jax_enable_x64") != settings["jax_enable_x64"]:
        jax.config.update("jax_enable_x64", settings["jax_enable_x64"])
    if settings["root"] is not None:
        cache_compilation(settings["root"])


def _option(name: str) -> Any:
    return getattr(jax.config, name)


def _root(folder: str | os.PathLike | None) -> Path:
    import pooch  # loaded here, so that `import opfem` stays free of it

    root = Path(folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or pooch.os_cache("opfem") / "compiled")
    if str(root).startswith("~"):
        raise FileNotFoundError("this user has no home folder. Name one in JAX_COMPILATION_CACHE_DIR")
    return root


def _writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError as cause:
        _say(f"compiled programs are read from {folder} but not kept: {cause.strerror}")
        return False


def _processor() -> str:
    """Name the kind of processor, by what it can do where the system tells, and how many cores programs are cut for."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        known = {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}
    except OSError:
        known = {platform.machine(), platform.processor()}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    kind = hashlib.sha256("\n".join(sorted(known)).encode()).hexdigest()[:12]
    return f"{kind}-{cores}"


def _prune(root: Path, largest: int) -> None:
    """Remove the entries unused for longest, of every version and processor, down to a size [bytes].

    JAX's own limit is not used: it locks a file on every read, and an entry without its time stamp, as a killed process
    leaves, makes each later write fail. File systems note the last use only once a day, or never: then the last write.
    """
    known = []
    for path in root.glob("jaxlib-*/*-cache"):
        try:
            status = path.stat()
        except OSError:  # another process has just removed it
            continue
        known.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    size = 0
    for _, bytes_, path in sorted(known, reverse=True):
        size += bytes_
        if size > largest:
            _remove(path)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):  # what cannot be removed now, the next process tries again
        path.unlink(missing_ok=True)


def _translated(show: Callable) -> Callable:
    """Show warnings, but JAX's of its cache as one line of this package, after putting right what it is about."""

    def showwarning(message, category, filename, lineno, file=None, line=None):
        report = _REPORT.match(str(message))
        if report is None:
            return show(message, category, filename, lineno, file, line)
        folder = Path(_option("jax_compilation_cache_dir") or "")
        doing, program, cause = report.groups()
        _drop_damaged(folder, program)
        if doing == "writing":
            jax.config.update("jax_persistent_cache_min_compile_time_secs", _NEVER)
            _say(f"compiled programs are no longer kept in {folder}: {cause}")
        else:
            _say(f"a program kept in {folder} is damaged; it is compiled and kept anew")

    showwarning.of_cache = True
    return showwarning


def _drop_damaged(folder: Path, program: str) -> None:
    """Remove what is damaged among the entries of a program; JAX would neither use nor replace it."""
    entries = [path for path in folder.glob("*-cache") if path.name.startswith(f"{program}-")]
    for path in [path for path in entries if not _is_whole(path)] or entries:
        _remove(path)


def _is_whole(path: Path) -> bool:
    try:
        return bool(zlib.decompress(path.read_bytes()))
    except (OSError, zlib.error):
        return False


def _say(text: str) -> None:
    """Say the first thing that went wrong in this process, in one line."""
    if not _SAID:
        _SAID.append(text)
        sys.stderr.write(f"opfem: {text}\n")


_SAID: list[str] = []
