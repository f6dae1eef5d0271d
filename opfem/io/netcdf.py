"""Datasets of results to and from netCDF-4 files.

Edge of the chain: a data set of `to_xarray` is stored with all its attributes, and read back unchanged.
"""

import os
import sys
from contextlib import nullcontext
from pathlib import Path

import xarray as xr

from .atomic import write_whole

_COMPRESSION = {"zlib": True, "complevel": 4, "shuffle": True}


def write_netcdf(dataset: xr.Dataset, path: str | os.PathLike) -> None:
    """Write a dataset to a compressed netCDF-4 file, whole or not at all.

    Args:
        dataset: Result of `to_xarray`.
        path: File to make or replace.

    Raises:
        ValueError: For anything but a dataset.
        FileNotFoundError: When the folder does not exist.
    """
    if not isinstance(dataset, xr.Dataset):
        raise ValueError(f"write_netcdf takes a dataset, got {type(dataset).__name__}. Pass to_xarray(solution).")
    write_whole(path, netcdf_bytes(dataset))


def netcdf_bytes(dataset: xr.Dataset) -> memoryview:
    """Encode a dataset as compressed netCDF-4 in memory; HDF5 itself crashes on a full disk.

    Args:
        dataset: Result of `to_xarray`.
    """
    numeric = [name for name, values in dataset.variables.items() if values.ndim and values.dtype.kind in "fiub"]
    encoding = dict.fromkeys(numeric, _COMPRESSION)
    # With an active dask client xarray would request a lock named by the buffer, and fail.
    dask = sys.modules.get("dask")
    with nullcontext() if dask is None else dask.config.set(scheduler="synchronous"):
        # What another file stored by is not how this one is to be stored.
        content = dataset.drop_encoding().to_netcdf(engine="h5netcdf", encoding=encoding)
    assert isinstance(content, memoryview)
    return content


def read_netcdf(path: str | os.PathLike) -> xr.Dataset:
    """Read a dataset that `write_netcdf` wrote, all of it into memory.

    Args:
        path: File to read.

    Raises:
        FileNotFoundError: When there is no such file.
        ValueError: When it is no netCDF-4 file, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"Cannot read {path}: there is no such file.")
    try:
        return xr.load_dataset(path, engine="h5netcdf")
    except OSError as cause:
        raise ValueError(f"{path}: is not a netCDF-4 file, or is damaged ({cause}).") from cause
