"""How a command runs: it reports what goes wrong in one line, and ends where Ctrl-C asks for it."""

import _thread
import codecs
import io
import logging
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from . import INTERRUPTED, leave
from .messages import in_options

# What compiles cannot be interrupted from Python; a process that has not ended by then [s] is ended.
_GRACE = 5.0
# Characters of the field that an encoding may lack, and what stands for them.
_PLAIN = str.maketrans({"×": "x", "–": "-", "µ": "u", "μ": "u", "χ": "chi", "²": "2", "±": "+-", "³": "3", "…": "..."})


def tolerant_output() -> None:
    """Replace what the encoding of the output lacks, where Python would raise."""
    codecs.register_error("opfem", _degraded)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="opfem")


def without_notes_of_matplotlib() -> None:
    """Leave out two lines on a list of fonts that cannot be kept; opfem says the same of its programs in one."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def _degraded(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    plain = error.object[error.start : error.end].translate(_PLAIN)
    return "".join(letter if ord(letter) < 128 else "?" for letter in plain), error.end


@contextmanager
def reporting(debug: bool) -> Iterator[None]:
    """End with a message and an exit status instead of a traceback."""
    interrupts: list[int] = []
    try:
        with _interruptible(interrupts), _remarks():
            yield
    except KeyboardInterrupt:
        _end_interrupted()
    except BrokenPipeError:
        raise
    except Exception as cause:
        if interrupts:  # what was interrupted may turn that into its own error
            _end_interrupted()
        if debug:
            raise
        expected = isinstance(cause, ValueError | OSError) or type(cause).__module__.startswith("opfem.")
        unexpected = f"Unexpected {type(cause).__name__}: {cause} (--debug shows where; please report it.)"
        complain(in_options(str(cause)) if expected else unexpected)
        raise SystemExit(1) from None


def complain(message: str) -> None:
    """Say what is wrong."""
    from rich.console import Console

    Console(stderr=True, highlight=False).print(f"opfem: {message}", style="bold red", markup=False, soft_wrap=True)


@contextmanager
def _remarks() -> Iterator[None]:
    """Say what the library warns of as this program says things: in a line, each once, in options."""
    from rich.console import Console

    said: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        text = in_options(str(message))
        if text not in said:
            said.add(text)
            Console(stderr=True, highlight=False).print(f"opfem: {text}", style="yellow", markup=False, soft_wrap=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _end_interrupted() -> None:
    complain("Interrupted; no file was left half-written.")
    raise SystemExit(INTERRUPTED) from None


@contextmanager
def _interruptible(interrupts: list[int]) -> Iterator[None]:
    """Raise Ctrl-C as KeyboardInterrupt, also where Python drops it, and end the process if that does not.

    An exception in a callback of the garbage collector is printed and forgotten, and jax has such a callback, which
    runs often while it traces.

    Args:
        interrupts: Gets one entry for each Ctrl-C.
    """
    report = sys.unraisablehook

    def redeliver(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, _thread.interrupt_main).start()
        else:
            report(dropped)

    def interrupt(number: int, _: Any) -> None:
        interrupts.append(number)
        raise KeyboardInterrupt

    sys.unraisablehook = redeliver
    own = signal.getsignal(signal.SIGINT) is leave
    try:
        if own:
            with _ended_in_time():
                signal.signal(signal.SIGINT, interrupt)
                yield
        else:
            yield
    finally:
        if own:
            signal.signal(signal.SIGINT, leave)
        sys.unraisablehook = report


@contextmanager
def _ended_in_time() -> Iterator[None]:
    """End the process where a Ctrl-C has not done so in time: Python hears of it only between its own instructions."""
    heard, bell = socket.socketpair()
    bell.setblocking(False)
    ended = threading.Event()
    former = signal.set_wakeup_fd(bell.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        with heard:
            while signal.SIGINT not in (number := heard.recv(1)):
                if not number:
                    return
        if not ended.wait(_GRACE):
            leave()

    threading.Thread(target=watch, name="opfem Ctrl-C", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(former)
        bell.close()
