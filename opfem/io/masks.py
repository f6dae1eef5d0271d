"""Masks of pixels that are no data: arrays, or files of arrays and black-and-white images.

`read_thickness` adds them to what the map itself marks as missing.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from ..measurement import MeasurementError
from .array_files import READERS, check_file, guarded, read_arrays
from .entry import check_size

_IMAGES = (".png", ".bmp", ".gif", ".jpg", ".jpeg")


def read_mask(map_path: Path, mask: Any, shape: tuple[int, ...], max_bytes: int) -> np.ndarray:
    """Read a mask of a map; True is no data.

    Args:
        map_path: The map's file, for messages.
        mask: Array, or path of a file with one array or image, where not 0 is no data.
        shape: (ny, nx) of the map.
        max_bytes: Largest array to load.

    Raises:
        MeasurementError: For another shape, and for more than two values.
    """
    where = f"{map_path}: mask"
    if isinstance(mask, str | os.PathLike):
        path = Path(mask)
        where, mask = f"{path}: the mask of {map_path.name}", _read(path, max_bytes)
    array = np.asarray(mask)
    if array.shape != shape:
        raise MeasurementError(f"{where} must have the map's shape {shape} (ny, nx), got {array.shape}.")
    values = np.unique(array)
    if array.dtype.kind not in "biuf" or np.isnan(values).any() or not 0 <= (values != 0).sum() <= 1:
        raise MeasurementError(
            f"{where} must be black and white: 0 for data and one other number for no data, got "
            f"{values.size} values from {values[0]} to {values[-1]}."
        )
    return array != 0


def _read(path: Path, max_bytes: int) -> np.ndarray:
    if path.suffix.lower() in _IMAGES:
        check_file(path)
        return guarded(path, lambda: _read_image(path, max_bytes))
    if path.suffix.lower() not in READERS:
        raise MeasurementError(
            f"{path}: cannot read {path.suffix or 'a file without suffix'} as a mask; opfem reads "
            f"{', '.join([*READERS, *_IMAGES])}."
        )
    entries = read_arrays(path, max_bytes)
    usable = {name: entry for name, entry in entries.items() if entry.kind in ("numbers", "true/false values")}
    if len(usable) != 1:
        raise MeasurementError(f"{path}: a mask file must hold one array, got {', '.join(entries) or 'none'}.")
    return guarded(path, next(iter(usable.values())).load)


def _read_image(path: Path, max_bytes: int) -> np.ndarray:
    with PIL.Image.open(path) as image:
        check_size((image.height, image.width), 4, max_bytes)
        colours = np.asarray(image.convert("RGB"))
    if np.ptp(colours, axis=-1).any():
        raise MeasurementError("is a colour image; a mask is black and white.")
    return colours[..., 0]
