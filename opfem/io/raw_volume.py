"""OCT volumes in general file formats: raw numbers, .npy, HDF5, .mat and TIFF stacks.

The caller states what the file cannot: order of the axes, spacing, and what the numbers are. Arrays stay in the file
where they lie there in one piece.
"""

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import scipy.io
import tifffile

from ..measurement import MeasurementError
from .myoct import decoded, myoct_description, spacing_of
from .thorlabs import LARGEST_UNPACKED

OWN_ATTRIBUTES = (
    "format", "scale", "spacing", "origin", "optical_spacing", "depth_origin", "wavelength", "phase_sign", "steps",
    "dispersion", "is_ascending", "repeats",
)  # fmt: skip
"""What `write_oct` states of a volume or spectra in HDF5."""

VECTORS = ("reference", "offset", "chirp")
"""What it states of every pixel of a spectrometer, as data sets."""

_MOST_PIXELS = 2**20  # of a spectrometer; real ones have 2048 or 4096
_LARGEST_ATTRIBUTE = 2**16  # bytes; HDF5 keeps no larger ones with their data set
_COMPLEX = (np.dtype([("real", "<f4"), ("imag", "<f4")]), np.dtype([("real", "<f8"), ("imag", "<f8")]))


class Stored(NamedTuple):
    """A 3-D array of a file, the fastest axis last, with its attributes."""

    values: np.ndarray
    attributes: dict[str, Any]
    vectors: dict[str, np.ndarray]


def read_raw(path: Path, shape: tuple[int, int, int] | None, order: str | None, dtype: Any) -> Stored:
    """Map a file of nothing but numbers; `shape` is (ny, nx, nz)."""
    if shape is None or order is None:
        raise MeasurementError(
            'needs shape=(ny, nx, nz) and order=, the axes from the fastest, such as "zxy": the file states neither. '
            f"It holds {path.stat().st_size} bytes."
        )
    kind = np.dtype("<f4" if dtype is None else dtype)
    if kind.kind not in "fiuc":
        raise MeasurementError(f"dtype must be one of numbers, got {kind}.")
    _check_order(order)
    if len(shape) != 3 or min(shape) < 1:
        raise MeasurementError(f"shape (ny, nx, nz) must be three positive numbers, got {shape}.")
    sizes = dict(zip("yxz", shape, strict=True))
    expected, size = math.prod(shape) * kind.itemsize, path.stat().st_size
    if size != expected:
        raise MeasurementError(f"shape {shape} of {kind} takes {expected} bytes, the file has {size}.")
    return Stored(np.memmap(path, kind, "r", shape=tuple(sizes[axis] for axis in order[::-1])), {}, {})


def read_npy(path: Path) -> Stored:
    """Map a .npy file."""
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    # Of an array in Fortran's order the first axis is the fastest.
    turned = values.flags.f_contiguous and not values.flags.c_contiguous
    return Stored(values.T if turned else values, {}, {})


def read_hdf5(path: Path, variable: str | None) -> Stored:
    """Read a data set of an HDF5 or MATLAB v7.3 file; one that lies there in one piece is mapped."""
    with h5py.File(path) as file:
        found: dict[str, h5py.Dataset] = {}
        file.visititems(lambda name, node: found.update({name: node}) if isinstance(node, h5py.Dataset) else None)
        volumes = {name: node for name, node in found.items() if node.ndim == 3}
        name = _chosen(variable, {name: node.shape for name, node in volumes.items()})
        data = volumes[name]
        kind = data.dtype
        if kind.names == ("real", "imag"):
            if kind not in _COMPLEX:
                raise MeasurementError(f"{name} holds complex numbers of {kind['real']}; float32 or float64 is read.")
            kind = np.dtype("<c8" if kind == _COMPLEX[0] else "<c16")
        if kind.kind not in "fiuc":
            raise MeasurementError(f"{name} must hold numbers, got {data.dtype}.")
        attributes = {name: data.attrs[name] for name in OWN_ATTRIBUTES if _is_short(data, name)}
        size = math.prod(data.shape) * kind.itemsize
        offset = _place(data, os.path.getsize(path))
        if offset is not None:
            if offset + size > os.path.getsize(path):
                raise MeasurementError(
                    f"{name} should end at byte {offset + size}, the file has {os.path.getsize(path)}."
                )
            values = np.memmap(path, kind, "r", offset, data.shape)
        else:
            _check_memory(name, size)
            values = np.ascontiguousarray(data[()]).view(kind)
        return Stored(values, attributes, _vectors(found, data.shape[2]) if "repeats" in attributes else {})


def _vectors(found: dict[str, h5py.Dataset], pixels: int) -> dict[str, np.ndarray]:
    """Read what is stated of every pixel of a spectrometer."""
    if pixels > _MOST_PIXELS:
        raise MeasurementError(f"spectra must have at most {_MOST_PIXELS} pixels, got {pixels}.")
    for name in VECTORS:
        if name not in found or found[name].shape != (pixels,) or found[name].dtype.kind != "f":
            raise MeasurementError(f"must state {name} as one number a pixel, {pixels}.")
    return {name: found[name][()] for name in VECTORS}


def _place(data: h5py.Dataset, end: int) -> int | None:
    """Find the byte at which a data set begins that lies in one piece in a file of `end` bytes; None where none does.

    Chunks of whole B-scans may lie one after another, too.
    """
    if data.chunks is None:
        return None if data.external else data.id.get_offset()
    size = math.prod(data.shape) * data.dtype.itemsize
    if data.id.get_create_plist().get_nfilters() or data.chunks[1:] != data.shape[1:] or size > end:
        return None
    chunks: list[tuple[int, int]] = []
    data.id.chunk_iter(lambda chunk: chunks.append((chunk.chunk_offset[0], chunk.byte_offset)))
    step = data.chunks[0]
    size = math.prod(data.chunks) * data.dtype.itemsize
    begin = chunks[0][1] if chunks else 0
    expected = [(row, begin + size * (row // step)) for row in range(0, data.shape[0], step)]
    return begin if chunks == expected and data.shape[0] % step == 0 else None


def _is_short(data: h5py.Dataset, name: str) -> bool:
    """Return whether an attribute exists with fixed length: HDF5 reads damaged texts of variable length for ever."""
    if name not in data.attrs:
        return False
    kind = data.attrs.get_id(name)
    return kind.dtype.kind in "fiuS" and math.prod(kind.shape) * kind.dtype.itemsize < _LARGEST_ATTRIBUTE


def read_mat5(path: Path, variable: str | None) -> Stored:
    """Read a variable of a MATLAB file up to v7; its first axis is the fastest."""
    shapes = {name: shape for name, shape, _ in scipy.io.whosmat(path) if len(shape) == 3}
    name = _chosen(variable, shapes)
    _check_memory(name, 16 * math.prod(shapes[name]))
    return Stored(np.asarray(scipy.io.loadmat(path, variable_names=[name])[name]).T, {}, {})


def read_tiff(path: Path) -> Stored:
    """Read the pages of a TIFF file as one volume: [page, row, column]; of myOCT's with its grid."""
    attributes: dict[str, Any] = {}
    with tifffile.TiffFile(path) as file:
        if len(file.series) > 1 and all(series.shape == file.series[0].shape for series in file.series):
            shape = (len(file.series), *file.series[0].shape)
            _check_memory("the stack", math.prod(shape) * file.series[0].dtype.itemsize)
            values = np.stack([series.asarray() for series in file.series])
        elif len(file.series) == 1:
            series = file.series[0]
            if (
                series.dtype.kind == "u"
                and series.dtype.itemsize == 1
                and series.shape[-1] in (3, 4)
                and series.ndim > 2
            ):
                raise MeasurementError("a colour-mapped picture, not data; export RAW or 32-bit TIFF.")
            size = math.prod(series.shape) * series.dtype.itemsize
            if series.dataoffset is not None and series.dtype.isnative:
                if series.dataoffset + size > path.stat().st_size:
                    raise MeasurementError(f"the stack takes {size} bytes, more than the file has; is it cut off?")
                values = np.memmap(path, series.dtype, "r", series.dataoffset, series.shape)
            else:
                _check_memory("the stack", size)
                values = series.asarray()
        else:
            listed = ", ".join(str(series.shape) for series in file.series[:8])
            raise MeasurementError(f"holds images of several sizes, {listed}; a volume is a stack of one size.")
        said = myoct_description(file)
        if said is not None:
            _check_memory("the stack", 4 * values.size)
            values = decoded(values, said)
            attributes = {f"d{axis}": spacing_of(said, axis) for axis in "xyz"}
    return Stored(values[None] if values.ndim == 2 else values, attributes, {})


def ordered(values: np.ndarray, order: str | None) -> np.ndarray:
    """Turn an array whose axes are `order`, the last one first, to [y, x, z]; nothing is copied."""
    if order is None:
        raise MeasurementError(
            f'needs order=, the axes of the array of shape {values.shape} from the fastest (the last), such as "zxy".'
        )
    _check_order(order)
    if values.ndim != 3:
        raise MeasurementError(f"must hold a 3-D array, got shape {values.shape}.")
    axes = order[::-1]
    return values.transpose([axes.index(axis) for axis in "yxz"])


def _check_order(order: str) -> None:
    if sorted(order) != ["x", "y", "z"]:
        raise MeasurementError(
            f'order must name x, y and z once each, the fastest first, such as "zxy", got {order!r}.'
        )


def _chosen(variable: str | None, shapes: dict[str, tuple[int, ...]]) -> str:
    listed = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:12]) or "no 3-D array"
    if variable is None:
        if len(shapes) != 1:
            raise MeasurementError(f"holds {listed}" + ("; pass variable= to name the volume." if shapes else "."))
        return next(iter(shapes))
    if variable not in shapes:
        raise MeasurementError(f"holds no 3-D array {variable!r}; it holds {listed}.")
    return variable


def _check_memory(name: str, size: int) -> None:
    if size > LARGEST_UNPACKED:
        raise MeasurementError(
            f"{name} takes {size / 2**30:.1f} GB in memory, above 2 GB, and cannot be read in place; store it "
            "uncompressed and unchunked, or crop it."
        )
