"""Thickness maps from and to files.

First step of every analysis: a file of any lab's format becomes a `ThicknessMap` in mm, oriented as the
program that wrote it shows it, with missing pixels masked and counted.
"""

import json
import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..measurement import MeasurementError, MeasurementWarning, Step, ThicknessMap
from ..measurement.checks import THICKEST, THINNEST, doubtful_unit, off_square, piles
from ..measurement.grid import LENGTH_UNITS as UNITS
from .array_files import Entry, guarded, read_arrays
from .atomic import whole_file
from .entry import MAX_BYTES
from .masks import read_mask

_FORMAT = "opfem thickness map 1"
_OTHER_SPACING = 0.01  # relative; files state pixel sizes to three digits at least
_A_ROW_OFF = 0.5  # samples that a map's rows may differ from those of square pixels


def read_thickness(
    path: str | os.PathLike,
    extent: Any = None,
    spacing: Any = None,
    unit: str = "mm",
    std: Any = None,
    variable: str | None = None,
    origin: Any = (0.0, 0.0),
    max_missing: float = 0.5,
    *,
    missing: Any = None,
    mask: Any = None,
    scale: float | None = None,
    max_bytes: int = MAX_BYTES,
) -> ThicknessMap:
    """Read a measured thickness map from .mat (v4 to v7.3), .npy, .npz, .tif, .csv, .tsv, .txt or .h5.

    Rows of the array run along y and columns along x; a .mat file comes out as MATLAB shows it. NaN, infinite
    and empty pixels are masked, and counted in `steps`. The pixel size of an ImageJ or OME image is used where
    neither `extent` nor `spacing` is given. A file of `write_thickness` comes back whole and takes no argument
    but `path`. Only the array that is the map is loaded.

    Text may have header rows, an index, coordinates of rows and columns, decimal commas, or be x, y, z triplets
    that fill a grid. Ambiguous texts are refused with line and column.

    Args:
        path: File to read.
        extent: (Lx, Ly) from the first to the last sample [mm]; this or `spacing`.
        spacing: (dx, dy) between samples [mm], or one number for both; this or `extent`.
        unit: Unit of the file's numbers: "mm", "um" (or "µm"), "m".
        std: Standard deviation of the noise [mm], one number or shape (ny, nx).
        variable: Name of the array, where a file holds several maps; "scan.thickness" is a field of a struct.
        origin: (x, y) of the first pixel [mm].
        max_missing: Largest fraction of missing pixels to accept.
        missing: Number or numbers that mark missing pixels in the file, such as 0 or 65535; "none" says that all
            are thickness, however odd.
        mask: Pixels that are no data: a bool array (ny, nx), or an image or array file, where not 0 is no data.
        scale: Thickness of one count [µm], for files of counts; instead of `unit`.
        max_bytes: Largest array to load; a compressed one may be far larger than its file.

    Raises:
        MeasurementError: For anything wrong with the file or its content; names the path and the cause.

    Warns:
        MeasurementWarning: For anomalies of a file that was read.
    """
    path, notes = Path(path), []
    entries = read_arrays(path, max_bytes, _lengths(extent), _lengths(spacing), notes)
    if _is_own(entries):
        given = {"extent": extent, "spacing": spacing, "std": std, "variable": variable}
        given |= {"missing": missing, "mask": mask, "scale": scale}
        extra = [name for name, value in given.items() if value is not None]
        if extra or unit != "mm":
            raise MeasurementError(
                f"{path}: was written by opfem and contains its grid; leave out {', '.join(extra) or 'unit'}."
            )
        return guarded(path, lambda: _restore(entries))
    size = _size_of_one(path, unit, scale)
    entry = _choose(path, entries, variable, notes)
    numbers = _loaded(path, entry)
    extent, spacing = _grid(path, entry, numbers.shape, extent, spacing, notes)
    absent = _absent(path, numbers, missing, mask, max_bytes, max_missing)
    numbers = numbers.astype(float)
    if not _is_none(missing):
        _check_piles(path, numbers, absent, notes)
    thickness = np.where(absent, np.median(numbers[~absent]), numbers) * size
    if scale is None:
        _check_unit(path, thickness[~absent], unit)
    _check_positive(path, numbers, absent)
    step = Step(
        "read",
        missing_pixels=int(absent.sum()),
        unit_mm=size,
        spacing_from_file=spacing is not None and spacing is entry.spacing,
    )
    try:
        read = ThicknessMap(thickness, extent, spacing, origin=origin, std=std, mask=absent, steps=(step,))
    except ValueError as cause:
        raise MeasurementError(f"{path}: {cause}") from cause
    for note in notes:
        warnings.warn(f"{path}: {note}{'' if note.endswith('?') else '.'}", MeasurementWarning, stacklevel=2)
    return read


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


def _lengths(value: Any) -> tuple[float, float] | None:
    """Two lengths [mm], or None for values that `ThicknessMap` refuses."""
    try:
        x, y = np.broadcast_to(np.asarray(value, dtype=float), 2).tolist()
    except (TypeError, ValueError):
        return None
    return (x, y) if x > 0 and y > 0 and math.isfinite(x + y) else None


def _size_of_one(path: Path, unit: str, scale: float | None) -> float:
    """Thickness [mm] that the number 1 in the file means."""
    if unit not in UNITS:
        raise MeasurementError(f"{path}: unit must be one of {', '.join(UNITS)}, got {unit!r}.")
    if scale is None:
        return UNITS[unit]
    if unit != "mm":
        raise MeasurementError(f"{path}: pass either unit= or scale=, got unit={unit!r} and scale={scale!r}.")
    if isinstance(scale, bool | str) or not (np.ndim(scale) == 0 and np.isfinite(scale) and scale > 0):
        raise MeasurementError(f"{path}: scale [µm per count] must be positive, got {scale!r}.")
    return 1e-3 * float(scale)


def _fault(entry: Entry) -> str | None:
    """Say why an array cannot be a map; None when it can."""
    if entry.kind != "numbers":
        plain = entry.kind in ("text", "complex numbers", "true/false values")
        return f"{entry.kind}, not real numbers" if plain else entry.kind
    if len(entry.shape) != 2:
        return f"{len(entry.shape)}-D"
    return "smaller than 2 by 2" if min(entry.shape) < 2 else None


def _listing(entries: dict[str, Entry]) -> str:
    """List the arrays of a file, those in structs included."""
    listed = []
    for name, entry in entries.items():
        what = f"{name or 'array'} {entry.shape if entry.kind == 'numbers' else f'({entry.kind})'}"
        try:
            fields = entry.fields() if entry.fields else {}
        except Exception:  # a damaged struct has no fields to name
            fields = {}
        listed += [what, *(f"{name}.{field} {inner.shape}" for field, inner in fields.items())]
    return ", ".join(listed)


def _named(entries: dict[str, Entry], variable: str) -> Entry | None:
    """Find an array by its name, or by the names of a struct and its field."""
    if variable in entries:
        return entries[variable]
    for place in (index for index, sign in enumerate(variable) if sign in "./"):
        struct = entries.get(variable[:place])
        if struct is not None and struct.fields is not None:
            return _named(struct.fields(), variable[place + 1 :])
    return None


def _choose(path: Path, entries: dict[str, Entry], variable: str | None, notes: list[str]) -> Entry:
    """Pick the array that is the map: the requested one, or the only candidate."""
    odd = "".join(f"; {note}" for note in notes)
    if not entries:
        raise MeasurementError(f"{path}: the file holds no variable{odd}.")
    if variable is not None:
        found = guarded(path, lambda: _named(entries, variable))
        if found is None:
            raise MeasurementError(f"{path}: holds no variable {variable!r}; it holds {_listing(entries)}{odd}.")
        name, entry = f"variable {variable!r}", found
    else:
        maps = [name for name, entry in entries.items() if _fault(entry) is None]
        if len(maps) > 1 or (not maps and len(entries) > 1):
            which = "several variables could be the map" if maps else "none of its variables is a 2-D map"
            raise MeasurementError(f"{path}: {which}; pass variable= to name one of: {_listing(entries)}{odd}.")
        chosen = maps[0] if maps else next(iter(entries))
        name, entry = f"variable {chosen!r}" if chosen else "the array", entries[chosen]
        unusual = ("damaged", "objects", "an object", "an external", "a link", "stored")
        notes += [f"{name} was passed over: {e.kind}" for name, e in entries.items() if e.kind.startswith(unusual)]
    fault = _fault(entry)
    if fault:
        inside = f"; it holds {_listing(entries)}" if entry.fields else ""
        raise MeasurementError(
            f"{path}: {name} must be a 2-D map (ny, nx) of thickness, got {fault}, shape {entry.shape}{inside}{odd}."
        )
    return entry


def _loaded(path: Path, entry: Entry) -> np.ndarray:
    array = guarded(path, entry.load)
    if array.dtype.kind not in "fiu" or array.shape != entry.shape:
        raise MeasurementError(
            f"{path}: must hold real numbers of shape {entry.shape}, got {array.dtype} {array.shape}."
        )
    return array


def _grid(
    path: Path, entry: Entry, shape: tuple[int, ...], extent: Any, spacing: Any, notes: list[str]
) -> tuple[Any, Any]:
    """Return (extent, spacing): as given, else those of the file."""
    if (extent is None) == (spacing is None):
        if extent is None and entry.spacing is not None:
            return None, entry.spacing
        raise MeasurementError(
            f"{path}: needs either extent=(Lx, Ly) or spacing=(dx, dy) in mm, got "
            f"{'neither' if extent is None else 'both'}; the map has (ny, nx) = {shape} samples."
        )
    sides = _lengths(extent)
    steps = _lengths(spacing) if sides is None else (sides[0] / (shape[1] - 1), sides[1] / (shape[0] - 1))
    if steps is None:
        return extent, spacing
    pixels = f"{steps[0]:.4g} × {steps[1]:.4g} mm"
    if entry.spacing is not None and not np.allclose(steps, entry.spacing, _OTHER_SPACING):
        said = " × ".join(f"{step:.4g}" for step in entry.spacing)
        notes.append(f"the file says that pixels are {said} mm, but {pixels} as given is used")
    if sides is not None and abs(off_square(sides, shape)) > _A_ROW_OFF:
        notes.append(
            f"extent= makes the {shape[1]} × {shape[0]} pixels {pixels} large, not square: is a row or column too many "
            "or missing? If they are so, pass spacing=(dx, dy)"
        )
    return extent, spacing


def _absent(path: Path, numbers: np.ndarray, missing: Any, mask: Any, max_bytes: int, max_missing: float) -> np.ndarray:
    """Find pixels that are no data: not finite, marked by a number, or masked."""
    invalid = ~np.isfinite(numbers)
    marked = np.isin(numbers, _markers(path, numbers, missing)) & ~invalid
    masked = np.zeros(numbers.shape, bool) if mask is None else read_mask(path, mask, numbers.shape, max_bytes)
    absent = invalid | marked | masked
    share = absent.mean()
    if share == 1 or share > max_missing:
        counts = {"are NaN or infinite": invalid, "hold missing=": marked, "are masked": masked}
        said = ", ".join(f"{int(pixels.sum())} {what}" for what, pixels in counts.items() if pixels.any())
        inverted = ". In a mask 0 is data and all else is not: is it inverted?" if masked.mean() > 0.5 else "."
        raise MeasurementError(
            f"{path}: {int(absent.sum())} of {absent.size} pixels ({share:.0%}) are missing ({said}), "
            f"above max_missing={max_missing:g}; crop the map, or pass a larger max_missing= if the rest is "
            f"enough{inverted}"
        )
    return absent


def _is_none(missing: Any) -> bool:
    return isinstance(missing, str) and missing == "none"


def _markers(path: Path, numbers: np.ndarray, missing: Any) -> np.ndarray:
    """Numbers that mark missing pixels, as the file's type of number has them."""
    markers = np.atleast_1d(np.asarray([] if missing is None or _is_none(missing) else missing))
    if markers.size and markers.dtype.kind not in "fiu":
        raise MeasurementError(f'{path}: missing= must be a number or numbers of the file, or "none", got {missing!r}.')
    return markers.astype(numbers.dtype if numbers.dtype.kind == "f" else float)


def _check_piles(path: Path, numbers: np.ndarray, absent: np.ndarray, notes: list[str]) -> None:
    """Refuse a number far outside the others that several pixels share; note what may be saturated."""
    for pile in piles(numbers[~absent]):
        said = (
            f"{pile.count} of {numbers.size} pixels hold exactly {pile.value:g}, {pile.suspicion} the others "
            f"({pile.low:g} to {pile.high:g}): "
        )
        advice = f'pass missing={pile.value:g} if it marks missing pixels, or missing="none" if it is thickness'
        if pile.is_refused:
            raise MeasurementError(f"{path}: {said}{advice}.")
        notes.append(f"{said}{advice}")


def _check_positive(path: Path, numbers: np.ndarray, absent: np.ndarray) -> None:
    low = (numbers <= 0) & ~absent
    if low.any():
        value, (j, i) = numbers[low][0], np.argwhere(low)[0]
        raise MeasurementError(
            f"{path}: thickness must be positive, got {value:g} in {int(low.sum())} of {low.size} pixels, first at "
            f"[y={j}, x={i}]; pass missing={value:g} if it marks missing pixels, or mask=."
        )


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
