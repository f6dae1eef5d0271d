"""Datasets of HDF5 files: .mat of version 7.3 as MATLAB shows it, others as h5py shows them.

Links are followed one part at a time and only within the file: what would open another one is named and passed over.
"""

import math
import zlib

import h5py
import numpy as np

from ..measurement import MeasurementError
from .entry import Entry, Reading, check_size, damaged, other

_MATLAB = {"char": "text", "cell": "a cell array", "struct": "a struct", "logical": "true/false values"}
_MOST_INFLATION = 1032  # times, by deflate
_LONGEST_CHAIN = 16  # soft links in a row; a longer one leads in a circle


def list_mat73(reading: Reading) -> dict[str, Entry]:
    """List the variables of a .mat file of version 7.3."""
    return _list(reading, "/", matlab=True)


def list_hdf5(reading: Reading) -> dict[str, Entry]:
    """List the datasets and groups of an HDF5 file; arrays are as h5py shows them, rows first."""
    return _list(reading, "/", matlab=False)


def _list(reading: Reading, group: str, matlab: bool) -> dict[str, Entry]:
    with h5py.File(reading.path, "r") as file:
        here = file[group]
        assert isinstance(here, h5py.Group)
        names = [name for name in map(str, here) if not (matlab and name.startswith("#"))]
        return {name: _guarded_entry(reading, here, name, matlab) for name in names}


def _guarded_entry(reading: Reading, group: h5py.Group, name: str, matlab: bool) -> Entry:
    try:
        return _entry(reading, _follow(group, name), matlab)
    except MeasurementError as cause:
        return other(str(cause))
    except Exception as cause:  # damaged files raise almost anything
        return damaged(cause)


def _follow(group: h5py.Group, path: str, chain: int = 0) -> h5py.Group | h5py.Dataset:
    """Go along a path within the file, link by link.

    Raises:
        MeasurementError: For a link to another file, to nothing, or in a circle.
    """
    here: h5py.Group | h5py.Dataset | h5py.Datatype = group.file["/"] if path.startswith("/") else group
    for part in filter(None, path.split("/")):
        link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
        if isinstance(link, h5py.ExternalLink):
            raise MeasurementError(f"an external link, to {link.filename}, which opfem does not follow")
        if isinstance(link, h5py.SoftLink):
            if chain >= _LONGEST_CHAIN:
                raise MeasurementError("a link that leads in a circle")
            assert isinstance(here, h5py.Group)
            here = _follow(here, link.path, chain + 1)
        elif isinstance(link, h5py.HardLink):
            assert isinstance(here, h5py.Group)
            here = here[part]
        else:
            raise MeasurementError(f"a link to {path}, which is not there")
    if not isinstance(here, h5py.Group | h5py.Dataset):
        raise MeasurementError("a type, no array")
    return here


def _entry(reading: Reading, node: h5py.Group | h5py.Dataset, matlab: bool) -> Entry:
    name = str(node.name)
    if isinstance(node, h5py.Group):
        kind = "a struct or sparse matrix" if matlab else "a group"
        return other(kind, (), lambda: _list(reading, name, matlab))
    if node.shape is None or "MATLAB_empty" in node.attrs:
        return other("empty", (0,))
    # MATLAB stores columns first, h5py reads rows first: every array of MATLAB arrives transposed.
    shape = node.shape[::-1] if matlab else node.shape
    kind = _kind(node)
    if kind not in ("numbers", "true/false values"):
        return other(kind, shape)
    item = node.dtype.itemsize

    def load() -> np.ndarray:
        check_size(shape, item, reading.max_bytes)
        with h5py.File(reading.path, "r") as file:
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            check_size(stored.chunks or (), item, reading.max_bytes)
            _check_inflation(stored, reading.max_bytes)
            array = np.asarray(stored)
        return array.T if matlab else array

    return Entry(kind, shape, load)


def _kind(node: h5py.Dataset) -> str:
    stated = node.attrs.get("MATLAB_class", b"")
    stated = stated.decode() if isinstance(stated, bytes) else str(stated)
    if stated in _MATLAB:
        return _MATLAB[stated]
    if node.dtype.names is not None:
        return "complex numbers" if tuple(node.dtype.names) == ("real", "imag") else "a table"
    if h5py.check_enum_dtype(node.dtype) is not None or node.dtype.kind == "b":
        return "true/false values"
    if node.dtype.kind not in "fiu":
        return f"of type {node.dtype}"
    if node.external or node.is_virtual:
        return "stored in another file, which opfem does not open"
    return "numbers" if _is_whole(node) else "damaged or never wholly written"


def _is_whole(node: h5py.Dataset) -> bool:
    """Compare the size that a dataset states with what is stored."""
    if not node.chunks:
        return node.id.get_storage_size() == node.nbytes
    pieces = math.prod(-(-length // piece) for length, piece in zip(node.shape, node.chunks, strict=True))
    return node.id.get_num_chunks() == pieces


def _check_inflation(node: h5py.Dataset, max_bytes: int) -> None:
    """Refuse compressed chunks that inflate beyond the limit; HDF5 inflates them to whatever size they have."""
    if node.compression != "gzip":
        return
    for index in range(node.id.get_num_chunks()):
        chunk = node.id.get_chunk_info(index)
        if chunk.size * _MOST_INFLATION <= max_bytes:
            continue
        _, stored = node.id.read_direct_chunk(chunk.chunk_offset)
        if len(zlib.decompressobj().decompress(stored, max_bytes + 1)) > max_bytes:
            raise MeasurementError(f"is damaged: a chunk inflates to more than max_bytes={max_bytes}.")
