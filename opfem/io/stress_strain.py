"""Stress–strain curves from load frames: text with or without header, .mat, .npz, .npy, HDF5.

Ambiguous files are refused, with the argument that resolves them: sign, unit, columns. Force and position, where the
file has them, are compared with its own stress and strain: they state the specimen's area and height.
"""

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..measurement import MeasurementError, MeasurementWarning, Step
from ..measurement.stress_strain import BRANCHES, KINDS, MODES, Branch, Kind, Mode, StressStrain, on_branch
from .array_files import check_file, guarded, read_arrays
from .entry import MAX_BYTES, Entry, check_size
from .text_tables import Table, not_a_number, place, read_table

STRESS_UNITS = {"Pa": 1e-6, "kPa": 1e-3, "MPa": 1.0, "N": None}
"""Size of each unit of stress [MPa]; a force needs the area."""
STRAIN_UNITS = {"%": 1e-2, "1": 1.0, "-": 1.0, "stretch": 1.0, "log": 1.0, "mm": None}
"""Size of each unit of strain [-]; a displacement needs the height."""
SIGNS = ("auto", "compression", "tension")
_TEXT = (".csv", ".tsv", ".txt", ".dat")
_NAMES = ("strain", "stress", "position", "force", "time")
_AGREE = 0.01  # relative spread of F/σ and Δposition/Δstrain that still counts as one area, one height
_OTHER = 0.02  # relative difference from a stated area or height that is worth a warning
_SMALLEST_PERCENT, _LARGEST_FRACTION = 1.0, 10.0  # beyond, the unit of strain is another one
_UNIT_IN_NAME = re.compile(r"(?<![a-z])(kpa|mpa|pa)(?![a-z])", re.IGNORECASE)

Column = int | str


def read_stress_strain(
    path: str | os.PathLike,
    *,
    strain: str = "%",
    stress: str = "kPa",
    columns: Sequence[Column] = (0, 1),
    sign: str = "auto",
    kind: Kind = "nominal",
    mode: Mode = "uniaxial",
    branch: Branch = "loading",
    area: float | int | None = None,
    height: float | int | None = None,
    std: float | int | None = None,
    variable: str | None = None,
    max_bytes: int = MAX_BYTES,
) -> StressStrain:
    """Read a stress–strain curve from .csv, .tsv, .txt, .dat, .mat (v4 to v7.3), .npz, .npy or .h5.

    Text may have header rows, semicolons and decimal commas. Rows of rest before the ramp are left out.

    Args:
        path: File to read.
        strain: Unit of the strain: "%", "1" or "-" (a fraction), "stretch", "log", or "mm", displacement over `height`.
        stress: Unit of the stress: "Pa", "kPa", "MPa", or "N", a force over `area`.
        columns: Of strain and stress, and, where there are more, of position [mm], force [N] and time [s]; numbers
            from 0, or names. Columns 2 and 3 count as position and force where they agree with strain and stress.
        sign: "compression" or "tension" where both columns are positive; "auto" where their signs say it: strain and
            stress both negative, or of opposite signs, are compression.
        kind: Whether the stress is "nominal" (over the initial area) or "true" (over the current one).
        mode: "uniaxial", "equibiaxial" or "planar".
        branch: "loading", "unloading", or the "mean" of both.
        area: Initial area of the specimen [mm²]; compared with that of the file.
        height: Its initial height [mm]; compared with that of the file.
        std: Standard deviation of the stress [MPa].
        variable: Name of the array or struct, where a file holds several.
        max_bytes: Largest array to load.

    Raises:
        MeasurementError: For anything wrong with the file or its content; names the path and the cause.

    Warns:
        MeasurementWarning: Where the file's own area or height is another than stated.
    """
    path = Path(path)
    for name, value, known in (
        ("strain", strain, tuple(STRAIN_UNITS)),
        ("stress", stress, tuple(STRESS_UNITS)),
        ("sign", sign, SIGNS),
        ("kind", kind, KINDS),
        ("mode", mode, MODES),
        ("branch", branch, BRANCHES),
    ):
        if value not in known:
            raise MeasurementError(f"{path}: {name} must be one of {', '.join(known)}, got {value!r}.")
    if not 2 <= len(columns) <= len(_NAMES):
        raise MeasurementError(
            f"{path}: columns must name 2 to 5 columns, {', '.join(_NAMES)}, got {tuple(columns)!r}."
        )
    for name, unit, needed, value in (("area", "mm²", stress == "N", area), ("height", "mm", strain == "mm", height)):
        if needed and value is None:
            raise MeasurementError(f"{path}: {name}= [{unit}] is needed to make sense of a force or a displacement.")
        if value is not None and not value > 0:
            raise MeasurementError(f"{path}: {name} [{unit}] must be positive, got {value!r}.")
    series, names = guarded(path, lambda: _series(path, tuple(columns), variable, max_bytes))
    _check_names(path, names, stress)
    e = _strain(path, series[0], strain, height)
    s = series[1] * (STRESS_UNITS[stress] or 1.0 / float(area or 1.0))
    own_area, own_height = _specimen(series, e, s)
    for name, unit, stated, own in (("area", "mm²", area, own_area), ("height", "mm", height, own_height)):
        if stated is not None and own is not None and abs(own / stated - 1.0) > _OTHER:
            warnings.warn(
                f"{path}: the file's own {'force and stress' if name == 'area' else 'position and strain'} give "
                f"{name} = {own:.4g} {unit}, {name}={stated:.4g} was stated; the stress is taken as it is in the file.",
                MeasurementWarning,
                stacklevel=2,
            )
    e, s, is_compression = _signed(path, e, s, sign)
    rate = None
    if len(series) == len(_NAMES):
        steps_of_time = np.diff(series[4])
        moving = steps_of_time > 0
        rate = float(np.median(np.abs(np.diff(e))[moving] / steps_of_time[moving]))
    try:
        e, s, loss = on_branch(e, s, branch)
        stretch = 1.0 + e
        if kind == "true":
            s = s / stretch
        step = Step("read", rows=series[0].size, kept=e.size, compression=is_compression)
        return StressStrain(
            stretch,
            s,
            std,
            mode,
            branch=branch,
            kind=kind,
            area=own_area,
            height=own_height,
            energy_loss=loss,
            rate=rate,
            steps=(step,),
        )
    except ValueError as cause:
        raise MeasurementError(f"{path}: {cause}") from cause


def _series(
    path: Path, columns: tuple[Column, ...], variable: str | None, max_bytes: int
) -> tuple[list[np.ndarray], list[str]]:
    """Read the columns, and their names where the file gives them."""
    check_file(path)
    if path.suffix.lower() in _TEXT:
        check_size((path.stat().st_size,), 1, max_bytes)
        return _text_series(path, columns)
    entries = read_arrays(path, max_bytes)
    if variable is not None:
        for part in variable.split("."):
            if part not in entries:
                raise MeasurementError(f"holds no variable {variable!r}; it holds {', '.join(entries) or 'nothing'}.")
            found = entries[part]
            entries = found.fields() if found.fields else {part: found}
    chosen, names = _named_pair(entries, columns)
    if chosen is None:
        return _array_series(entries, columns)
    series = [np.asarray(entry.load(), float).ravel() for entry in chosen]
    if len({one.size for one in series}) > 1:
        raise MeasurementError(f"{', '.join(names)} have different lengths: {[one.size for one in series]}.")
    return _checked(series, None), names


def _text_series(path: Path, columns: tuple[Column, ...]) -> tuple[list[np.ndarray], list[str]]:
    notes: list[str] = []
    table = read_table(path, notes)
    if not table.lines:
        raise MeasurementError("holds no numbers.")
    width = table.numbers.shape[1]
    top = 0
    while top < len(table.lines) and all((top, i) in table.words or table.empty[top, i] for i in range(width)):
        top += 1
    header = [table.words.get((top - 1, i), "") if top else "" for i in range(width)]
    table = table.part(slice(top, None), slice(None))
    if not table.lines:
        raise MeasurementError("holds no numbers below its header.")
    return _taken(table.numbers, columns, header, table)


def _taken(
    numbers: np.ndarray, columns: tuple[Column, ...], header: list[str], table: Table | None
) -> tuple[list[np.ndarray], list[str]]:
    width = numbers.shape[1]
    places = []
    for column in columns:
        names = [name.strip().lower() for name in header]
        at = names.index(column.lower()) if isinstance(column, str) and column.lower() in names else column
        if isinstance(at, str) or not -width <= at < width:
            named = f" named {', '.join(header)}" if any(header) else ""
            raise MeasurementError(f"has no column {column!r}; it has {width} columns{named}.")
        places.append(at % width)
    if tuple(columns) == (0, 1) and width >= 4:
        places += [2, 3]
    if table is not None:
        for row, i in sorted(table.words):
            if i in places[: len(columns)]:
                raise not_a_number(table, row, i)
    lines = None if table is None else [place(line, places[0]) for line in table.lines]
    series = [numbers[:, i] for i in places]
    return _checked(series, lines, len(columns)), [header[i] for i in places[: len(columns)]]


def _checked(series: list[np.ndarray], lines: list[str] | None, needed: int | None = None) -> list[np.ndarray]:
    """Drop rows without numbers at the end; refuse gaps, and guessed columns with gaps."""
    needed = len(series) if needed is None else needed
    known = np.all([np.isfinite(one) for one in series[:needed]], axis=0)
    if known.sum() < 3:
        raise MeasurementError(f"holds {int(known.sum())} rows of numbers; a curve has at least 3.")
    last = int(np.flatnonzero(known)[-1]) + 1
    if not known[:last].all():
        row = int(np.argmin(known))
        where = f"row {row + 1}" if lines is None else lines[row]
        raise MeasurementError(f"{where}: has no number; fill the gap or remove the row.")
    series = [one[:last] for one in series]
    return [one for number, one in enumerate(series) if number < needed or np.isfinite(one).all()]


def _named_pair(entries: dict[str, Entry], columns: tuple[Column, ...]) -> tuple[list[Entry] | None, list[str]]:
    """Find vectors by name: those of `columns`, else the one strain and the one stress, also within one struct."""
    vectors = {
        name: entry
        for name, entry in entries.items()
        if entry.kind == "numbers" and max(entry.shape, default=0) > 2 and np.prod(entry.shape) == max(entry.shape)
    }
    if all(isinstance(column, str) for column in columns):
        missing = [column for column in columns if column not in vectors]
        if missing:
            raise MeasurementError(f"holds no vector {missing[0]!r}; it holds {', '.join(entries) or 'nothing'}.")
        return [vectors[str(column)] for column in columns], [str(column) for column in columns]
    chosen = []
    for what in (("strain", "stretch"), ("stress",)):
        near = [name for name in vectors if name.lower().startswith(what)]
        if len(near) > 1:
            raise MeasurementError(
                f"{', '.join(near)} could each be the {what[0]}; pass columns=(strain, stress) by name."
            )
        chosen += near
    if len(chosen) == 2:
        return [vectors[name] for name in chosen], chosen
    inside = [entry.fields() for entry in entries.values() if entry.fields]
    found = [pair for pair in (_named_pair(fields, columns) for fields in inside) if pair[0] is not None]
    if len(found) > 1:
        raise MeasurementError(
            f"several structs hold a strain and a stress; pass variable= to name one of {', '.join(entries)}."
        )
    return found[0] if found else (None, [])


def _array_series(entries: dict[str, Entry], columns: tuple[Column, ...]) -> tuple[list[np.ndarray], list[str]]:
    """Take the columns of the only array of numbers."""
    tables = {name: entry for name, entry in entries.items() if entry.kind == "numbers" and len(entry.shape) == 2}
    if len(tables) != 1:
        listed = ", ".join(f"{name or 'array'} {entry.shape}" for name, entry in entries.items())
        raise MeasurementError(
            f"holds no strain and stress by name, and {len(tables)} arrays of columns; pass variable= or columns= to "
            f"name them. It holds {listed or 'nothing'}."
        )
    numbers = np.asarray(next(iter(tables.values())).load(), float)
    return _taken(numbers, columns, [""] * numbers.shape[1], None)


def _check_names(path: Path, names: list[str], stress: str) -> None:
    """Refuse a unit of stress that the file's own name of the column contradicts."""
    said = _UNIT_IN_NAME.search(names[1].replace("_", " ")) if len(names) > 1 else None
    unit = {"pa": "Pa", "kpa": "kPa", "mpa": "MPa"}[said[1].lower()] if said else stress
    if stress != "N" and unit != stress:
        raise MeasurementError(
            f"{path}: the stress is called {names[1]!r}, stress={stress!r} was passed; pass stress={unit!r}."
        )


def _strain(path: Path, numbers: np.ndarray, unit: str, height: float | int | None) -> np.ndarray:
    """Convert to nominal strain, deformed over initial length minus one but for the sign of compression."""
    largest = float(np.abs(numbers - (1.0 if unit == "stretch" else 0.0)).max())
    if unit == "%" and largest < _SMALLEST_PERCENT:
        raise MeasurementError(
            f'{path}: the strain reaches {largest:g} %; is it a fraction? Pass strain="1", or "stretch" for stretches.'
        )
    if unit in ("1", "-", "log") and largest > _LARGEST_FRACTION:
        raise MeasurementError(f'{path}: the strain reaches {largest:g}; is it in per cent? Pass strain="%".')
    if unit == "stretch":
        return numbers - 1.0
    if unit == "log":
        return np.expm1(numbers)
    return numbers * (STRAIN_UNITS[unit] or 1.0 / float(height or 1.0))


def _specimen(series: list[np.ndarray], e: np.ndarray, s: np.ndarray) -> tuple[float | None, float | None]:
    """Find the area [mm²] and height [mm] that the file's force and position imply, where they do so throughout."""
    if len(series) < 4:
        return None, None
    position, force = series[2], series[3]
    return _ratio(force, s), _ratio(position, e)


def _ratio(one: np.ndarray, other: np.ndarray) -> float | None:
    """Slope of one column over another, where one line holds both."""
    if not np.ptp(other) > 0 or not np.ptp(one) > 0:
        return None
    slope, level = np.polyfit(other, one, 1)
    off = np.abs(one - slope * other - level).max()
    return abs(float(slope)) if off < _AGREE * np.ptp(one) else None


def _signed(path: Path, e: np.ndarray, s: np.ndarray, sign: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Turn strain and stress to tension positive."""
    # By the farther end of each: toe and noise may be of the other sign.
    strain_sign, stress_sign = (float(np.sign(one[np.argmax(np.abs(one - one[0]))])) for one in (e, s))
    if sign == "auto":
        if strain_sign > 0 and stress_sign > 0:
            if e.max() < 1.0:
                raise MeasurementError(
                    f'{path}: strain and stress are both positive; pass sign="compression" or sign="tension".'
                )
            sign = "tension"
        else:
            sign = "compression"
    flip = -1.0 if sign == "compression" else 1.0
    e, s = flip * strain_sign * e, flip * stress_sign * s
    if e.min() <= -1.0:
        raise MeasurementError(
            f"{path}: the specimen would be compressed by {-e.min():.0%}; is the strain in another unit?"
        )
    return e, s, sign == "compression"
