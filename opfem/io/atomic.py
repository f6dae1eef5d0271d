"""Writing a file whole or not at all; every writer of the package goes through it."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def _flush_to_disk(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def whole_file(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path to write to, which becomes `path` when the block ends well.

    Until then, and after any error or crash, `path` is as it was before. The temporary file lies in the
    same folder and has the same suffix, so that writers which go by the suffix write the right format.

    Args:
        path: File to make or replace; its folder must exist.

    Raises:
        FileNotFoundError: When the folder does not exist, or the block wrote nothing.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"Cannot write {target}: the folder {target.parent} does not exist.")
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        if not temporary.is_file():
            raise FileNotFoundError(f"Nothing was written for {target}.")
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    # Only POSIX can open a folder to make the rename itself durable.
    if os.name == "posix":
        _flush_to_disk(target.parent)
