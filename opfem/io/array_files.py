"""The arrays that a .mat, .npy, .npz, .tif or .csv file holds, as the program that wrote them shows them.

`read_thickness` chooses among them; nothing here knows what they mean. Each reader maps names to
`Entry`s; formats that name nothing use the empty name.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import h5py
import numpy as np
import scipy.io
import scipy.sparse
import tifffile

from ..measurement import MeasurementError

Result = TypeVar("Result")


class Entry(NamedTuple):
    """One array of a file: what it is, and how to get it when it is numbers.

    Attributes:
        kind: "numbers", or what it is instead, in words.
        shape: Its shape, as the writing program shows it.
        load: Read it.
    """

    kind: str
    shape: tuple[int, ...]
    load: Callable[[], np.ndarray]


def _entry(array: np.ndarray) -> Entry:
    words = {"f": "numbers", "i": "numbers", "u": "numbers", "c": "complex numbers", "U": "text", "S": "text"}
    words |= {"b": "true/false values", "O": "a cell array or objects", "V": "a struct"}
    return Entry(words.get(array.dtype.kind, f"of type {array.dtype}"), array.shape, lambda: array)


def _hdf5_entry(path: Path, node: h5py.Dataset | h5py.Group) -> Entry:
    if isinstance(node, h5py.Group):
        return Entry("a struct or sparse matrix", (), _nothing)
    if node.shape is None or "MATLAB_empty" in node.attrs:
        return Entry("empty", (0,), _nothing)
    # MATLAB stores columns first, h5py reads rows first: every array arrives transposed.
    shape = node.shape[::-1]
    stated = node.attrs.get("MATLAB_class", b"")
    stated = stated.decode() if isinstance(stated, bytes) else str(stated)
    words = {"char": "text", "cell": "a cell array", "struct": "a struct", "logical": "true/false values"}
    if stated in words:
        return Entry(words[stated], shape, _nothing)
    if node.dtype.names == ("real", "imag"):
        return Entry("complex numbers", shape, _nothing)
    if node.dtype.kind not in "fiu":
        return Entry(f"of type {node.dtype}", shape, _nothing)
    name = str(node.name)

    def load() -> np.ndarray:
        with h5py.File(path) as file:
            return np.asarray(file[name]).T

    return Entry("numbers", shape, load)


def _nothing() -> np.ndarray:
    return np.empty((0, 0))


def _read_mat(path: Path) -> dict[str, Entry]:
    if h5py.is_hdf5(path):
        with h5py.File(path) as file:
            return {name: _hdf5_entry(path, node) for name, node in file.items() if not name.startswith("#")}
    with warnings.catch_warnings():
        # SciPy warns of a variable that it could not read, and leaves it out.
        warnings.simplefilter("error", scipy.io.matlab.MatReadWarning)
        classes = {name: kind for name, _, kind in scipy.io.whosmat(path)}
        contents = scipy.io.loadmat(path)
    return {name: _mat5_entry(contents[name], kind) for name, kind in classes.items()}


def _mat5_entry(value: np.ndarray | scipy.sparse.sparray | scipy.sparse.spmatrix, kind: str) -> Entry:
    if not isinstance(value, np.ndarray):
        return Entry("a sparse matrix", (), _nothing)
    # SciPy returns MATLAB's logical as numbers.
    return _entry(value.astype(bool)) if kind == "logical" else _entry(value)


def _read_npy(path: Path) -> dict[str, Entry]:
    return {"": _entry(np.load(path, allow_pickle=False))}


def _read_npz(path: Path) -> dict[str, Entry]:
    # Opened here, because np.load leaves the file open when the archive is damaged.
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
        return {name: _entry(archive[name]) for name in archive.files}


def _read_tiff(path: Path) -> dict[str, Entry]:
    with tifffile.TiffFile(path) as file:
        images = [series.asarray() for series in file.series]
    if len(images) == 1:
        return {"": _entry(images[0])}
    return {str(index): _entry(image) for index, image in enumerate(images)}


def _read_csv(path: Path) -> dict[str, Entry]:
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        separator = next((mark for mark in (";", "\t", ",") if mark in text), None)
        row = [_csv_number(cell, number, column) for column, cell in enumerate(text.split(separator), start=1)]
        if rows and len(row) != len(rows[0]):
            raise MeasurementError(f"line {number} has {len(row)} columns, the lines before have {len(rows[0])}.")
        rows.append(row)
    return {"": _entry(np.array(rows, dtype=float))} if rows else {}


def _csv_number(cell: str, line: int, column: int) -> float:
    cell = cell.strip()
    if not cell:
        return float("nan")
    try:
        return float(cell)
    except ValueError:
        raise MeasurementError(
            f"line {line}, column {column}: {cell!r} is not a number; start header lines with #, "
            "leave missing pixels empty or NaN, and write decimals with a point."
        ) from None


READERS: dict[str, Callable[[Path], dict[str, Entry]]] = {
    ".mat": _read_mat,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".csv": _read_csv,
}
"""Reader of each supported suffix."""


def read_arrays(path: Path) -> dict[str, Entry]:
    """List the arrays of a file.

    Raises:
        MeasurementError: For a missing, empty or damaged file, and an unknown suffix.
    """
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise MeasurementError(
            f"{path}: cannot read {path.suffix or 'a file without suffix'}; opfem reads {', '.join(READERS)}."
        )
    if not path.is_file():
        raise MeasurementError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}.")
    if path.stat().st_size == 0:
        raise MeasurementError(f"{path}: the file is empty (0 bytes).")
    return guarded(path, lambda: read(path))


def guarded(path: Path, action: Callable[[], Result]) -> Result:
    """Run `action`, turning whatever a file library raises on a damaged file into one exception type."""
    try:
        return action()
    except Exception as cause:  # damaged files raise almost anything: IndexError, zlib.error, MemoryError, ...
        if isinstance(cause, MeasurementError):
            raise MeasurementError(f"{path}: {cause}") from cause
        raise MeasurementError(
            f"{path}: cannot be read, it may be damaged or of another format ({type(cause).__name__}: {cause})."
        ) from cause
