"""Thickness maps from and to files.

First step of every analysis: a file of any lab's format becomes a `ThicknessMap` in mm, oriented as the
program that wrote it shows it, with missing pixels masked and counted.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from ..measurement import MeasurementError, Step, ThicknessMap
from ..measurement.checks import THICKEST, THINNEST, doubtful_unit
from ..measurement.grid import LENGTH_UNITS as UNITS
from .array_files import Entry, guarded, read_arrays
from .atomic import whole_file

_FORMAT = "opfem thickness map 1"


def read_thickness(
    path: str | os.PathLike,
    extent: Any = None,
    spacing: Any = None,
    unit: str = "mm",
    std: Any = None,
    variable: str | None = None,
    origin: Any = (0.0, 0.0),
    max_missing: float = 0.5,
) -> ThicknessMap:
    """Read a measured thickness map from .mat (v5, v7.3), .npy, .npz, .tif or .csv.

    Rows of the array run along y and columns along x; a .mat file comes out as MATLAB shows it. NaN and
    infinite pixels are masked, and counted in `steps`. A file of `write_thickness` comes back whole and
    takes no argument but `path`.

    Args:
        path: File to read.
        extent: (Lx, Ly) from the first to the last sample [mm]; this or `spacing`.
        spacing: (dx, dy) between samples [mm], or one number for both; this or `extent`.
        unit: Unit of the file's numbers: "mm", "um" (or "µm"), "m".
        std: Standard deviation of the noise [mm], one number or shape (ny, nx).
        variable: Name of the array, where a file holds several maps.
        origin: (x, y) of the first pixel [mm].
        max_missing: Largest fraction of missing pixels to accept.

    Raises:
        MeasurementError: For anything wrong with the file or its content; names the path and the cause.
    """
    path = Path(path)
    entries = read_arrays(path)
    if _is_own(entries):
        given = {"extent": extent, "spacing": spacing, "std": std, "variable": variable}
        extra = [name for name, value in given.items() if value is not None]
        if extra or unit != "mm":
            raise MeasurementError(
                f"{path}: was written by opfem and knows its own grid; leave out {', '.join(extra) or 'unit'}."
            )
        return guarded(path, lambda: _restore(entries))
    if unit not in UNITS:
        raise MeasurementError(f"{path}: unit must be one of {', '.join(UNITS)}, got {unit!r}.")
    array = _choose(path, entries, variable)
    if (extent is None) == (spacing is None):
        raise MeasurementError(
            f"{path}: needs either extent=(Lx, Ly) or spacing=(dx, dy) in mm, got "
            f"{'neither' if extent is None else 'both'}; the map has (ny, nx) = {array.shape} samples."
        )
    thickness, missing = _mask_missing(path, array * UNITS[unit], max_missing)
    _check_unit(path, thickness[~missing], unit)
    step = Step("read", missing_pixels=int(missing.sum()), unit_mm=UNITS[unit])
    try:
        return ThicknessMap(thickness, extent, spacing, origin=origin, std=std, mask=missing, steps=(step,))
    except ValueError as cause:
        raise MeasurementError(f"{path}: {cause}") from cause


def write_thickness(thickness: ThicknessMap, path: str | os.PathLike) -> None:
    """Write a map with its grid, noise, mask and steps to .npz, whole or not at all.

    Args:
        thickness: Map to write.
        path: File to make or replace; must end in .npz.

    Raises:
        ValueError: For another suffix.
        FileNotFoundError: When the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise ValueError(f"write_thickness writes .npz, got {path}.")
    steps = [
        [step.name, {key: np.asarray(value).tolist() for key, value in step.numbers.items()}]
        for step in thickness.steps
    ]
    contents: dict[str, Any] = {
        "format": np.array(_FORMAT),
        "values": np.asarray(thickness.values),
        "extent": np.asarray(thickness.extent),
        "origin": np.asarray(thickness.origin),
        "mask": np.asarray(thickness.mask),
        "noise_length": np.asarray(thickness.noise_length),
        "is_filled": np.array(thickness.is_filled),
        "steps": np.array(json.dumps(steps)),
    }
    if thickness.std is not None:
        contents["std"] = np.asarray(thickness.std)
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, **contents)


def _is_own(entries: dict[str, Entry]) -> bool:
    return "format" in entries and entries["format"].kind == "text" and str(entries["format"].load()) == _FORMAT


def _restore(entries: dict[str, Entry]) -> ThicknessMap:
    stored = {name: entry.load() for name, entry in entries.items()}
    return ThicknessMap(
        stored["values"],
        extent=stored["extent"],
        origin=stored["origin"],
        std=stored.get("std"),
        mask=stored["mask"],
        noise_length=stored["noise_length"],
        steps=tuple(Step(name, **numbers) for name, numbers in json.loads(str(stored["steps"]))),
        is_filled=bool(stored["is_filled"]),
    )


def _fault(entry: Entry) -> str | None:
    """Say why an array cannot be a map; None when it can."""
    if entry.kind != "numbers":
        return entry.kind if entry.kind.startswith(("a ", "of ", "empty")) else f"{entry.kind}, not real numbers"
    if len(entry.shape) != 2:
        return f"{len(entry.shape)}-D"
    return "smaller than 2 by 2" if min(entry.shape) < 2 else None


def _choose(path: Path, entries: dict[str, Entry], variable: str | None) -> np.ndarray:
    """Pick the array that is the map: the one asked for, or the only one that can be."""
    listed = ", ".join(f"{name or 'array'} {entry.shape}" for name, entry in entries.items())
    if not entries:
        raise MeasurementError(f"{path}: the file holds no variable.")
    if variable is not None:
        if variable not in entries:
            raise MeasurementError(f"{path}: holds no variable {variable!r}; it holds {listed}.")
        chosen = variable
    else:
        maps = [name for name, entry in entries.items() if _fault(entry) is None]
        if len(maps) > 1 or (not maps and len(entries) > 1):
            which = "several variables could be the map" if maps else "none of its variables is a 2-D map"
            raise MeasurementError(f"{path}: {which}; pass variable= to name one of: {listed}.")
        chosen = maps[0] if maps else next(iter(entries))
    entry = entries[chosen]
    fault = _fault(entry)
    if fault:
        name = f"variable {chosen!r}" if chosen else "the array"
        raise MeasurementError(
            f"{path}: {name} must be a 2-D map (ny, nx) of thickness, got {fault}, shape {entry.shape}."
        )
    return np.asarray(guarded(path, entry.load), dtype=float)


def _mask_missing(path: Path, thickness: np.ndarray, max_missing: float) -> tuple[np.ndarray, np.ndarray]:
    """Find pixels that are not finite, and put the median of the data there; the mask tells them apart."""
    missing = ~np.isfinite(thickness)
    share = missing.mean()
    if share == 1 or share > max_missing:
        raise MeasurementError(
            f"{path}: {int(missing.sum())} of {missing.size} pixels ({share:.0%}) are NaN or infinite, "
            f"above max_missing={max_missing:g}; crop the map, or raise max_missing if the rest is enough."
        )
    placeholder = np.median(thickness[~missing])
    return np.where(missing, placeholder, thickness), missing


def _check_unit(path: Path, thickness: np.ndarray, unit: str) -> None:
    """Refuse a range [mm] that suggests another unit than the one passed."""
    doubt = None if (thickness <= 0).any() else doubtful_unit(thickness)
    if doubt is None:
        return
    span, guess, _ = doubt
    highest = thickness.max() / UNITS[unit]
    fitting = next((name for name in ("mm", "um", "m") if THINNEST <= highest * UNITS[name] <= THICKEST), None)
    if unit != "mm":
        span, guess = f"{span} when read with unit={unit!r}", fitting or "another unit"
    advice = f'Pass unit="{fitting}".' if fitting else "Convert it to mm."
    raise MeasurementError(f"{path}: {span}; is it in {guess}? {advice}")
