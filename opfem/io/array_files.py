"""The arrays of a file of any accepted format, as the program that wrote them shows them.

`read_thickness` chooses among them; their meaning is unknown here. Each reader maps names to
`Entry`s; formats that name nothing use the empty name.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ..measurement import MeasurementError
from .entry import MAX_BYTES, Entry, Reading
from .hdf5_files import list_hdf5
from .mat_files import list_mat
from .numpy_files import list_npy, list_npz
from .text_maps import list_text
from .tiff_files import list_tiff

Result = TypeVar("Result")

_MOST_SAID = 300  # characters of a library's message: some quote the damaged bytes

READERS: dict[str, Callable[[Reading], dict[str, Entry]]] = {
    ".mat": list_mat,
    ".npy": list_npy,
    ".npz": list_npz,
    ".tif": list_tiff,
    ".tiff": list_tiff,
    ".csv": list_text,
    ".tsv": list_text,
    ".txt": list_text,
    ".h5": list_hdf5,
    ".hdf5": list_hdf5,
}
"""Reader of each supported suffix."""


def read_arrays(
    path: Path,
    max_bytes: int = MAX_BYTES,
    extent: tuple[float, float] | None = None,
    spacing: tuple[float, float] | None = None,
    notes: list[str] | None = None,
) -> dict[str, Entry]:
    """List the arrays of a file.

    Args:
        path: The file.
        max_bytes: Largest array to load, and largest text file to read.
        extent: (Lx, Ly) of the map [mm], where known: it settles what delimiters at the edge of a text leave open.
        spacing: (dx, dy) of the map [mm], where that is known instead.
        notes: Receives remarks for the user.

    Raises:
        MeasurementError: For a missing, empty or damaged file, and an unknown suffix.
    """
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise MeasurementError(
            f"{path}: cannot read {path.suffix or 'a file without suffix'}; opfem reads {', '.join(READERS)}."
        )
    check_file(path)
    reading = Reading(path, max_bytes, extent, spacing, [] if notes is None else notes)
    return guarded(path, lambda: read(reading))


def check_file(path: Path) -> None:
    """Refuse a file that is not there, or empty.

    Raises:
        MeasurementError: Names the file.
    """
    if not path.is_file():
        raise MeasurementError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}.")
    if path.stat().st_size == 0:
        raise MeasurementError(f"{path}: the file is empty (0 bytes).")


def guarded(path: Path, action: Callable[[], Result]) -> Result:
    """Run `action`, turning whatever a file library raises on a damaged file into one exception type."""
    try:
        return action()
    except Exception as cause:  # damaged files raise almost anything: IndexError, zlib.error, MemoryError, ...
        if isinstance(cause, MeasurementError):
            raise MeasurementError(f"{path}: {cause}") from cause
        said = " ".join(str(cause).split())
        if len(said) > _MOST_SAID:
            said = said[:_MOST_SAID] + " …"
        raise MeasurementError(
            f"{path}: cannot be read, it may be damaged or of another format ({type(cause).__name__}: {said})."
        ) from cause
