"""Arrays of .npy and .npz files: headers are read first, and must agree with the size of what follows them.

`array_files` lists them; nothing is unpickled.
"""

import io
import math
import zipfile
from collections.abc import Callable
from typing import IO

import numpy as np

from ..measurement import MeasurementError
from .entry import Entry, Reading, check_size, damaged, kind_of, other


def list_npy(reading: Reading) -> dict[str, Entry]:
    """List the one array of a .npy file."""
    path = reading.path
    with open(path, "rb") as file:
        entry = _entry(file, path.stat().st_size, path.read_bytes, reading.max_bytes)
    return {"": entry}


def list_npz(reading: Reading) -> dict[str, Entry]:
    """List the arrays of an .npz file; a member that is damaged or no array is named."""
    entries = {}
    with zipfile.ZipFile(reading.path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in entries:
                entries[name] = other("stored twice")
            elif name == member.filename:
                entries[name] = other("no array")
            else:
                entries[name] = _member(archive, member, reading)
    return entries


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, reading: Reading) -> Entry:
    def contents() -> bytes:
        # Whole, so that the checksum is compared.
        with zipfile.ZipFile(reading.path) as again:
            return again.read(member)

    try:
        with archive.open(member) as file:
            return _entry(file, member.file_size, contents, reading.max_bytes)
    except Exception as cause:  # damaged members raise almost anything
        return damaged(cause)


def _entry(file: IO[bytes] | zipfile.ZipExtFile, size: int, contents: Callable[[], bytes], max_bytes: int) -> Entry:
    """Read the header that `file` is at; `size` is that of header and data [bytes]."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        return other("objects, which opfem never unpickles", shape)
    stated = file.tell() + math.prod(shape) * dtype.itemsize
    if stated != size:
        raise MeasurementError(f"the header states {stated} bytes (shape {shape}, {dtype}), the file holds {size}.")

    def load() -> np.ndarray:
        check_size(shape, dtype.itemsize, max_bytes)
        return np.lib.format.read_array(io.BytesIO(contents()), allow_pickle=False)

    return Entry(kind_of(dtype), shape, load)
