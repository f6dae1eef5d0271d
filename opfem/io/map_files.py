"""Maps of a result for other programs: a table (.csv), images for ImageJ (.tif) and matrices for MATLAB (.mat).

Edge of the chain: on the pixels of the measured map, in kPa, µm and %, as pictures show them; names end in the unit.
"""

import io
import os
from pathlib import Path

import numpy as np
import scipy.io
import tifffile
import xarray as xr
from jaxtyping import Float

from ..measurement import ThicknessMap
from ..results import on_pixels
from .atomic import write_whole

Maps = dict[str, Float[np.ndarray, "my mx"]]

_SHOWN = {"MPa": (1e3, "_kPa"), "mm": (1e3, "_um"), "1": (1.0, "")}
_PERCENT = (1e2, "_percent")


def write_csv(dataset: xr.Dataset, path: str | os.PathLike, measured: ThicknessMap | None = None) -> None:
    """Write the maps of a result as a table with a row for each pixel, whole or not at all.

    Columns are x_mm, y_mm, pressure_kPa, compression_percent, thickness_um and so on; nan where there is nothing.

    Args:
        dataset: What `to_xarray` returned for a solve or a fit that converged.
        path: File to make or replace; must end in .csv.
        measured: Measured map, whose pixels are taken; None takes those of the load.

    Raises:
        ValueError: For another suffix, or a failed solution.
        FileNotFoundError: When the folder does not exist.
    """
    _write(dataset, path, measured, "csv")


def write_tiff(dataset: xr.Dataset, path: str | os.PathLike, measured: ThicknessMap | None = None) -> None:
    """Write the maps of a result as a stack of 32-bit images for ImageJ, whole or not at all.

    Each image is labelled by its name and unit; pixels have their size in mm.

    Args:
        dataset: What `to_xarray` returned for a solve or a fit that converged.
        path: File to make or replace; must end in .tif.
        measured: Measured map, whose pixels are taken; None takes those of the load.

    Raises:
        ValueError: For another suffix, or a failed solution.
        FileNotFoundError: When the folder does not exist.
    """
    _write(dataset, path, measured, "tiff")


def write_mat(dataset: xr.Dataset, path: str | os.PathLike, measured: ThicknessMap | None = None) -> None:
    """Write the maps of a result as matrices for MATLAB and Octave, whole or not at all.

    Rows run along y and columns along x: `imagesc(x_mm, y_mm, pressure_kPa)` shows them as opfem does.

    Args:
        dataset: What `to_xarray` returned for a solve or a fit that converged.
        path: File to make or replace; must end in .mat.
        measured: Measured map, whose pixels are taken; None takes those of the load.

    Raises:
        ValueError: For another suffix, or a failed solution.
        FileNotFoundError: When the folder does not exist.
    """
    _write(dataset, path, measured, "mat")


def encoded(dataset: xr.Dataset, kind: str, measured: ThicknessMap | None = None) -> bytes:
    """Encode the maps of a result in memory.

    Args:
        dataset: What `to_xarray` returned for a solve or a fit that converged.
        kind: One of `MAP_FILES`.
        measured: Measured map, whose pixels are taken; None takes those of the load.

    Raises:
        ValueError: For a failed solution, which has no maps.
    """
    if not np.isfinite(dataset["displacement"].values).all():
        raise ValueError(f"There are no maps to write: the solve did not converge ({dataset.attrs.get('status')!r}).")
    pixels = on_pixels(dataset, measured)
    maps: Maps = {}
    for name, values in pixels.data_vars.items():
        factor, suffix = _PERCENT if name == "compression" else _SHOWN[values.attrs["units"]]
        maps[f"{name}{suffix}"] = factor * values.values
    _, encode = MAP_FILES[kind]
    return encode(maps, pixels["x_image"].values, pixels["y_image"].values)


def _csv(maps: Maps, x: Float[np.ndarray, " mx"], y: Float[np.ndarray, " my"]) -> bytes:
    columns = dict(zip(("x_mm", "y_mm"), np.meshgrid(x, y), strict=True)) | maps
    table = io.StringIO()
    rows = np.stack([values.ravel() for values in columns.values()], axis=1)
    np.savetxt(table, rows, fmt="%.6g", delimiter=",", header=",".join(columns), comments="")
    return table.getvalue().encode()


def _tiff(maps: Maps, x: Float[np.ndarray, " mx"], y: Float[np.ndarray, " my"]) -> bytes:
    stack = np.stack(list(maps.values())).astype(np.float32)
    per_mm = 1.0 / float(x[1] - x[0]), 1.0 / float(y[1] - y[0])
    image = io.BytesIO()
    metadata = {"axes": "ZYX", "unit": "mm", "Labels": list(maps)}
    tifffile.imwrite(image, stack, imagej=True, resolution=per_mm, metadata=metadata)
    return image.getvalue()


def _mat(maps: Maps, x: Float[np.ndarray, " mx"], y: Float[np.ndarray, " my"]) -> bytes:
    matrices = io.BytesIO()
    scipy.io.savemat(matrices, {"x_mm": x, "y_mm": y, **maps}, do_compression=True, oned_as="row")
    return matrices.getvalue()


MAP_FILES = {"csv": (".csv", _csv), "tiff": (".tif", _tiff), "mat": (".mat", _mat)}
"""Suffix of each kind of file, and what encodes maps by name, with the positions of columns and rows [mm]."""


def _write(dataset: xr.Dataset, path: str | os.PathLike, measured: ThicknessMap | None, kind: str) -> None:
    suffix, _ = MAP_FILES[kind]
    if Path(path).suffix.lower() != suffix:
        raise ValueError(f"The file's name must end in {suffix}, got {path}.")
    write_whole(path, encoded(dataset, kind, measured))
