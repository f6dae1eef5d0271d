"""The command line of this run, kept for the record of its result; loads nothing that takes time."""

import shlex
import sys
from collections.abc import Sequence
from contextvars import ContextVar

_TOKENS: ContextVar[tuple[str, ...]] = ContextVar("tokens", default=())


def remember(tokens: Sequence[str] | None) -> None:
    """Keep the command line.

    Args:
        tokens: Arguments; None takes those of the process.
    """
    _TOKENS.set(tuple(sys.argv[1:] if tokens is None else tokens))


def command_line() -> str:
    """Write it as a shell takes it; a file name that is no text becomes escapes."""
    return shlex.join(("opfem", *_TOKENS.get())).encode("utf-8", "backslashreplace").decode()


def given_options() -> set[str]:
    """Collect the options on it, as `--c10`."""
    return {token.split("=", 1)[0] for token in _TOKENS.get() if token.startswith("--")}
