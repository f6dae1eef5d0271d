"""The command line: `opfem palpate MAP --out DIR` turns a thickness map into files and pictures of stress.

It reads, solves and writes with the same public functions as a notebook, and says what it assumed. Here is only its
beginning, which loads next to nothing: help, errors and Ctrl-C do not wait for JAX.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Sequence

INTERRUPTED = 130


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 misused, 130 interrupted.

    Args:
        tokens: Arguments; None takes those of the process, which is then looked after: Ctrl-C ends it, and output goes
            on where its encoding lacks a character.
    """
    if tokens is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave)
    from .running import tolerant_output, without_notes_of_matplotlib

    tolerant_output()
    without_notes_of_matplotlib()
    try:
        from .commands import run

        try:
            run(tokens)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except OSError as cause:
        if not isinstance(cause, BrokenPipeError):  # the reader has gone, as `head` does
            os.write(2, f"opfem: cannot write the output: {cause.strerror}.\n".encode())
        # What Python flushes at the very end must not raise again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        raise SystemExit(1) from None
    except SystemExit as end:
        if end.code == INTERRUPTED and tokens is None:
            os._exit(INTERRUPTED)  # with a computation in flight jaxlib crashes while the interpreter winds down
        raise


def leave(*_: object) -> None:
    """End the process at once, as the answer to Ctrl-C where there is nothing to put in order."""
    with contextlib.suppress(OSError):
        os.write(2, b"opfem: Interrupted; no file was left half-written.\n")
    os._exit(INTERRUPTED)
