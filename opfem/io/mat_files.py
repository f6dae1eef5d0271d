"""Variables of .mat files of versions 4 and 5, one by one; version 7.3 is HDF5.

A version 5 file is a row of elements, each a variable: SciPy is handed one at a time, so that damage or size of
one is no concern of the others. Source: MathWorks, MAT-File Format, R2024b, chapter 1.
"""

import io
import math
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import h5py
import numpy as np
import scipy.io
import scipy.sparse

from ..measurement import MeasurementError
from .entry import Entry, Reading, check_size, damaged, kind_of, other
from .hdf5_files import list_mat73

_HEADER = 128  # bytes before the first element
_MATRIX, _COMPRESSED = 14, 15
_HEAD = 2**16  # bytes of an element that surely hold its name, class and size
_COMPLEX = 0x0800  # in the word of array flags, which follows two tags
_CLASSES = {
    "char": "text",
    "cell": "a cell array",
    "struct": "a struct",
    "sparse": "a sparse matrix",
    "object": "an object",
    "opaque": "an object (a table, string or class of MATLAB)",
    "function": "a function",
}
_PARTS = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 14, 16, 17, 18))  # types of data: numbers, matrices, text
_INT32, _CONTAINERS = 5, (1, 2, 3)  # the type that sizes are of; cells, structs, objects
_DEEPEST = 32  # structs within structs
_BYTES = 8  # of a double, the largest number that MATLAB stores


class _Element(NamedTuple):
    """Where a variable lies in a version 5 file: its first byte after the tag, their number, and its type."""

    start: int
    count: int
    type: int


def list_mat(reading: Reading) -> dict[str, Entry]:
    """List the variables of a .mat file of any version."""
    if h5py.is_hdf5(reading.path):
        return list_mat73(reading)
    major, _ = scipy.io.matlab.matfile_version(reading.path)
    if major > 1:
        raise MeasurementError("states to be a .mat file of version 7.3, but holds no HDF5.")
    return _list_mat5(reading) if major else _list_mat4(reading)


def _list_mat4(reading: Reading) -> dict[str, Entry]:
    def entry(name: str, shape: tuple[int, ...], kind: str) -> Entry:
        def load() -> np.ndarray:
            check_size(shape, _BYTES, reading.max_bytes)
            return np.asarray(scipy.io.loadmat(reading.path, variable_names=[name])[name])

        return other(_CLASSES[kind], shape) if kind in _CLASSES else Entry("numbers", shape, load)

    return {name: entry(name, shape, kind) for name, shape, kind in scipy.io.whosmat(reading.path)}


def _list_mat5(reading: Reading) -> dict[str, Entry]:
    entries: dict[str, Entry] = {}
    with open(reading.path, "rb") as file:
        header = file.read(_HEADER)
    order = "<" if header[126:128] == b"IM" else ">"
    for number, element in enumerate(_elements(reading, order), start=1):
        try:
            name, entry = _variable(reading, header, order, element)
        except Exception as cause:  # damaged variables raise almost anything
            name, entry = f"variable {number}", damaged(cause)
        if not name.startswith("__"):  # the workspace of function handles
            entries[name] = other("stored twice") if name in entries else entry
    return entries


def _elements(reading: Reading, order: str) -> Iterator[_Element]:
    """Go from tag to tag."""
    size = reading.path.stat().st_size
    with open(reading.path, "rb") as file:
        at = _HEADER
        while at < size:
            file.seek(at)
            tag = file.read(8)
            type_, count = struct.unpack(order + "II", tag) if len(tag) == 8 else (0, 0)
            if type_ not in (_MATRIX, _COMPRESSED) or at + 8 + count > size:
                reading.notes.append(f"the file is damaged or cut off from byte {at} on")
                return
            yield _Element(at + 8, count, type_)
            at += 8 + count


def _head(reading: Reading, order: str, element: _Element) -> bytes:
    """Read the first bytes of a variable, inflated, its tag included."""
    with open(reading.path, "rb") as file:
        file.seek(element.start)
        stored = file.read(min(element.count, _HEAD))
    if element.type == _COMPRESSED:
        return zlib.decompressobj().decompress(stored, _HEAD)
    return struct.pack(order + "II", _MATRIX, element.count) + stored


def _whole(reading: Reading, order: str, element: _Element) -> bytes:
    """Read a variable, inflated, its tag included."""
    size = struct.unpack(order + "II", _head(reading, order, element)[:8])[1]
    check_size((size,), 1, reading.max_bytes)
    with open(reading.path, "rb") as file:
        file.seek(element.start)
        stored = file.read(element.count)
    if element.type == _MATRIX:
        return struct.pack(order + "II", _MATRIX, element.count) + stored
    inflating = zlib.decompressobj()
    inflated = inflating.decompress(stored, 8 + size)
    inflated += inflating.decompress(inflating.unconsumed_tail, 1)
    if len(inflated) != 8 + size or not inflating.eof:
        raise MeasurementError("is damaged: its compressed size is not the one it states.")
    return inflated


def _check_parts(stored: bytes, order: str, deep: int = 0) -> None:
    """Check tags and sizes of what a matrix is made of, to the last field of a struct.

    SciPy 1.17 ends the process where a type of data is unknown, and makes cells of any size before it reads them.
    """
    at, is_container = 0, False
    while at < len(stored):
        tag = stored[at : at + 8]
        if len(tag) < 8:
            raise MeasurementError("is damaged: it ends within a tag.")
        type_, count = struct.unpack(order + "II", tag)
        if type_ >> 16:  # up to 4 bytes of data, in the tag itself
            part, count, following = tag[4:], type_ >> 16, at + 8
        else:
            part, following = stored[at + 8 : at + 8 + count], at + 8 + count + -count % 8
        if type_ & 0xFFFF not in _PARTS or len(part) < count or deep > _DEEPEST:
            raise MeasurementError(f"is damaged: it holds data of type {type_ & 0xFFFF} with {count} bytes.")
        if at == 0:
            is_container = bool(part) and struct.unpack(order + "I", part[:4])[0] & 0xFF in _CONTAINERS
        elif (
            is_container and type_ == _INT32 and math.prod(np.frombuffer(part, order + "i4").tolist()) * 8 > len(stored)
        ):
            raise MeasurementError("is damaged: it holds fewer cells or structs than it says.")
        if type_ == _MATRIX:
            _check_parts(part, order, deep + 1)
        at = following


def _variable(reading: Reading, header: bytes, order: str, element: _Element) -> tuple[str, Entry]:
    head = _head(reading, order, element)
    [(name, shape, kind)] = scipy.io.whosmat(io.BytesIO(header + head))
    is_complex = struct.unpack(order + "I", head[16:20])[0] & _COMPLEX

    def load() -> np.ndarray:
        check_size(shape, _BYTES, reading.max_bytes)
        whole = _whole(reading, order, element)
        _check_parts(whole[8:], order)
        contents = scipy.io.loadmat(io.BytesIO(header + whole))
        return next(value for key, value in contents.items() if not key.startswith("__"))

    if kind == "struct":
        return name, other(_CLASSES[kind], shape, lambda: _fields(load()))
    if kind in _CLASSES or is_complex:
        return name, other(_CLASSES.get(kind, "complex numbers"), shape)
    return name, Entry("true/false values" if kind == "logical" else "numbers", shape, load)


def _fields(struct_array: np.ndarray) -> dict[str, Entry]:
    """List the fields of a 1 by 1 struct."""
    if struct_array.size != 1 or struct_array.dtype.names is None:
        return {}
    record = struct_array.reshape(())[()]
    return {name: _loaded(record[name]) for name in struct_array.dtype.names}


def _loaded(value: np.ndarray | scipy.sparse.sparray | scipy.sparse.spmatrix) -> Entry:
    if not isinstance(value, np.ndarray):
        return other("a sparse matrix")
    if value.dtype.names:
        return other("a struct", value.shape, lambda: _fields(value))
    return Entry(kind_of(value.dtype), value.shape, lambda: value)
