"""What every command of the command line shares: how it reports, ends, and looks after its folder of results."""

import _thread
import json
import os
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import xarray as xr
from cyclopts import App, Parameter
from rich.console import Console

from ..compilation import cache_compilation, silence_alarm
from ..inverse import FitError
from ..io import whole_file, write_netcdf, write_vtu
from ..solvers import ConvergenceError

FINISHED = "result.nc"  # Written last: a folder that holds it holds a whole result.

INTERRUPTED = 130

app = App(
    name="opfem",
    help="Stress on tissue from the measured thickness of a soft layer.",
    default_parameter=Parameter(negative=()),
)


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 misused, 130 interrupted.

    Args:
        tokens: Arguments; None takes those of the process.
    """
    try:
        app(tokens)
    except SystemExit as end:
        if end.code == INTERRUPTED and tokens is None:
            # With a computation in flight jaxlib crashes while the interpreter winds down.
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(INTERRUPTED)
        raise


@contextmanager
def reporting(debug: bool) -> Iterator[None]:
    """End with a message and an exit status instead of a traceback."""
    try:
        with _redelivered_interrupts(), _warnings_in_yellow():
            yield
    except KeyboardInterrupt:
        _complain("Interrupted; no file was left half-written.")
        raise SystemExit(INTERRUPTED) from None
    except Exception as cause:
        if debug:
            raise
        expected = isinstance(cause, ValueError | OSError | ConvergenceError | FitError)
        unexpected = f"Unexpected {type(cause).__name__}: {cause} (--debug shows where; please report it.)"
        _complain(str(cause) if expected else unexpected)
        raise SystemExit(1) from None


@contextmanager
def _warnings_in_yellow() -> Iterator[None]:
    """Show warnings as this program says things: in a line of their own, each once, without the line of code."""
    said: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in said:
            said.add(str(message))
            console = Console(stderr=True, highlight=False)
            console.print(f"opfem: {message}", style="yellow", markup=False, soft_wrap=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def _redelivered_interrupts() -> Iterator[None]:
    """Raise Ctrl-C again where Python drops it.

    An exception in a callback of the garbage collector is printed and forgotten, and jax has such a callback, which
    runs often while it traces.
    """
    report = sys.unraisablehook

    def redeliver(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, _thread.interrupt_main).start()
        else:
            report(dropped)

    sys.unraisablehook = redeliver
    try:
        yield
    finally:
        sys.unraisablehook = report


def _complain(message: str) -> None:
    Console(stderr=True, highlight=False).print(f"opfem: {message}", style="bold red", markup=False, soft_wrap=True)


def configure_jax(no_cache: bool) -> None:
    """Compute in float64, and keep compiled programs for the commands to come."""
    jax.config.update("jax_enable_x64", True)
    if no_cache:
        silence_alarm()
    else:
        cache_compilation()


def refuse_finished(out: Path, force: bool) -> None:
    """Raise FileExistsError where a folder holds a finished result that may not be replaced."""
    if (out / FINISHED).exists() and not force:
        raise FileExistsError(
            f"{out} holds a finished result ({FINISHED}). Pass --force to replace it, or another --out."
        )


def prepare(out: Path) -> None:
    """Find out before the long solve whether the results can be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as cause:
        raise OSError(f"Cannot write results to {out}: {cause.strerror}. Choose another --out.") from cause


def write_files(
    dataset: xr.Dataset, figures: dict[str, Any], numbers: dict[str, Any], files: Sequence[str], out: Path
) -> None:
    """Write every file of a result, each whole or not at all, `result.nc` last.

    Args:
        dataset: What was solved or fitted.
        figures: Matplotlib figures by file name.
        numbers: For summary.json.
        files: All files of such a result.
        out: Folder of the results.
    """
    remove(out, files)
    for name, figure in figures.items():
        with whole_file(out / name) as temporary:
            figure.savefig(temporary, dpi=200)
    write_vtu(dataset, out / "result.vtu")
    write_summary(numbers, out)
    write_netcdf(dataset, out / FINISHED)


def write_summary(numbers: dict[str, Any], out: Path) -> None:
    """Write summary.json.

    Args:
        numbers: In types that JSON knows.
        out: Folder of the results.
    """
    with whole_file(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(numbers, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def remove(out: Path, files: Sequence[str]) -> None:
    """Remove files of an earlier result, the mark of a finished one, named last, first."""
    for name in reversed(files):
        (out / name).unlink(missing_ok=True)
