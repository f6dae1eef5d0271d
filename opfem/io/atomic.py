"""Writing a file, or the files of a result, whole or not at all; every writer of the package goes through it.

What is new is complete on disk before anything old is touched. A path that is a link is followed.
"""

import errno
import os
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

# Errors of file systems and platforms that cannot flush, or open, a folder.
_CANNOT_FLUSH = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM}
_FULL = {errno.ENOSPC, errno.EDQUOT}
# Folders inside a folder of results, in the order in which a new result passes through them. In the first it is
# written; once it has the second name it is complete, and the old files go; in the third it takes their place.
_NEW, _COMPLETE, _MOVING, _OLD = ".opfem-new-", ".opfem-complete", ".opfem-moving", ".opfem-old"
# A killed process leaves temporary files. Writing takes seconds: files older than this [s] are abandoned.
_STALE = 3600.0


@contextmanager
def whole_file(path: str | os.PathLike, size: int | None = None) -> Iterator[Path]:
    """Yield a temporary path to write to, which becomes `path` when the block ends well.

    Until then, and after any error or crash, `path` is as it was before. The temporary file lies in the
    same folder and has the same suffix, so that writers which go by the suffix write the right format.
    Where `path` is a link, the file that it points to is made or replaced, and the link stays.

    Args:
        path: File to make or replace; its folder must exist.
        size: Bytes that it takes, where they are known, for the message when the disk is full.

    Raises:
        FileNotFoundError: When the folder does not exist, or the block wrote nothing.
        OSError: When the disk is full, with the space that is needed.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"Cannot write {path}: the folder {target.parent} does not exist.")
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        with _space_is_said(path, target.parent, size):
            yield temporary
            if not temporary.is_file():
                raise FileNotFoundError(f"Nothing was written for {path}.")
            _flush(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    _flush(target.parent)


def write_whole(path: str | os.PathLike, content: bytes | memoryview) -> None:
    """Write bytes to a file, whole or not at all.

    Libraries that write files themselves crash on a full disk (HDF5, VTK); what they made in memory is written here.

    Args:
        path: File to make or replace.
        content: All of it.
    """
    with whole_file(path, len(content)) as temporary:
        temporary.write_bytes(content)


def write_together(folder: Path, contents: Mapping[str, bytes], names: Iterable[str]) -> None:
    """Write the files of a result; they take the place of an old result together, once all are on disk.

    Args:
        folder: Folder of the result.
        contents: Files by name, the one that marks a finished result last.
        names: Everything that a result may have, in the order in which it takes its place; the rest is left alone.

    Raises:
        OSError: When the disk is full, with the space that is needed; the old result is as it was.
    """
    names = tuple(names)
    finish(folder, names)
    staged = folder / f"{_NEW}{secrets.token_hex(6)}"
    try:
        with _space_is_said(folder, folder, sum(map(len, contents.values()))):
            staged.mkdir()
            for name, content in contents.items():
                (staged / name).write_bytes(content)
                _flush(staged / name)
            take_place(folder, staged, names)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def take_place(folder: Path, staged: Path, names: Iterable[str]) -> None:
    """Let a complete result in a folder inside `folder` take the place of the old one.

    Killed at any moment, `finish` completes it.

    Args:
        folder: Folder of the result.
        staged: Where the new one lies.
        names: As in `write_together`.
    """
    _flush(staged)
    (folder / _OLD).mkdir(exist_ok=True)  # now, while a full disk still leaves all as it was
    os.rename(staged, folder / _COMPLETE)
    _flush(folder)
    finish(folder, names)


def finish(folder: Path, names: Iterable[str]) -> None:
    """Complete a `take_place` of a killed process, if there is one.

    Args:
        folder: Folder of the result, which need not exist.
        names: As in `write_together`.
    """
    names = tuple(names)
    complete, moving, old = folder / _COMPLETE, folder / _MOVING, folder / _OLD
    if complete.is_dir():
        old.mkdir(exist_ok=True)
        for name in reversed(names):  # the mark of a finished result first
            _move(folder / name, old / name)
        os.rename(complete, moving)
    if moving.is_dir():
        for name in names:
            _move(moving / name, folder / name)
        _flush(folder)
        shutil.rmtree(moving, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)
    for left in folder.glob(f"{_NEW}*"):
        with suppress(FileNotFoundError):
            if time.time() - left.stat().st_mtime > _STALE:
                shutil.rmtree(left, ignore_errors=True)


def _move(source: Path, target: Path) -> None:
    with suppress(FileNotFoundError):
        if target.is_dir():  # what a killed process left half-removed
            shutil.rmtree(target)
        os.replace(source, target)


def _flush(path: Path) -> None:
    """Make a file, or the names in a folder, durable, where the file system can."""
    if path.is_dir() and os.name != "posix":
        return
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as cause:
        if cause.errno not in _CANNOT_FLUSH:
            raise


@contextmanager
def _space_is_said(path: str | os.PathLike, folder: Path, size: int | None) -> Iterator[None]:
    try:
        yield
    except OSError as cause:
        if cause.errno not in _FULL:
            raise
        needs = "" if size is None else f"{size / 1e6:.3g} MB are needed, "
        full = OSError(
            f"The disk is full: {needs}{shutil.disk_usage(folder).free / 1e6:.3g} MB are free. Nothing was written to "
            f"{os.fspath(path)}; what was there is as it was."
        )
        full.errno = cause.errno
        raise full from cause
