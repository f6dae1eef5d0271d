"""The map in a table of text: without header, index and coordinates, or put together from x, y, z triplets.

Equal steps and the range distinguish coordinates from thickness; where both remain possible, or a row or
column of nothing at the edge may be a delimiter too many, the given grid decides, or else the file is refused.
"""

import itertools
from typing import NamedTuple

import numpy as np

from ..measurement import MeasurementError
from ..measurement.checks import off_square
from .entry import Entry, Reading, check_size
from .text_tables import Table, not_a_number, place, read_table

_UNEVEN = 0.3  # of a step: positions printed with two digits of a step are off by less
_SAME = 0.02  # relative difference of lengths that count as equal: half a sample of 25
_UNITS = (1.0, 1e3, 1e6, 1e-1, 1e-3)  # coordinates in mm, µm, nm, cm, m
_OFF_SQUARE = 0.1  # samples; a row or column more or less is off by 1
_FEW = 4  # columns of what may be a list of points


class _Axis(NamedTuple):
    """Coordinates of rows or columns.

    Attributes:
        positions: One a row or column.
        where: Line and column of the first.
        is_index: Whether they only count.
    """

    positions: np.ndarray
    where: str
    is_index: bool


def list_text(reading: Reading) -> dict[str, Entry]:
    """List the one map of a text file."""
    check_size((reading.path.stat().st_size,), 1, reading.max_bytes)
    table = read_table(reading.path, reading.notes)
    if not table.lines:
        return {}
    array = _find_map(table, reading)
    return {"": Entry("numbers", array.shape, lambda: array)}


def _find_map(table: Table, reading: Reading) -> np.ndarray:
    table, names = _without_words(table)
    table = _without_index(table)
    points = _triplets(table, reading, names)
    if points is not None:
        return points
    foreign = sorted(set(table.words) - {(0, 0)})
    if foreign:
        raise not_a_number(table, *foreign[0])
    axes = _axes(table, reading)
    if axes is not None:
        table, x, y = axes
        _check_spans(reading, x, y, table.numbers.shape)
        return _ascending(table.numbers, x, y)
    ny, nx = table.numbers.shape
    if 1 < nx <= _FEW and ny > 4 * nx:
        raise MeasurementError(
            f"{place(table.lines[0], 0)}: {ny} rows of {nx} columns look like a list of points, not like a map; "
            "x, y, z triplets are read where they fill a grid."
        )
    return _settled_edges(table, reading)


def _without_words(table: Table) -> tuple[Table, list[str]]:
    """Leave out header rows and a column of row names; returns the names of the columns too."""
    names: list[str] = []
    ny, nx = table.numbers.shape
    top = 0
    while (
        top < ny
        and all((top, i) in table.words or table.empty[top, i] for i in range(nx))
        and not table.empty[top].all()
    ):
        names += [table.words.get((top, i), "").lower() for i in range(nx)]
        top += 1
    if top == ny:
        raise not_a_number(table, *min(table.words))
    table = table.part(slice(top, None), slice(None))
    rows = range(len(table.lines))
    if (
        nx > 2
        and len(rows) > 1
        and all((j, 0) in table.words for j in rows[1:])
        and ((0, 0) in table.words or table.empty[0, 0])
    ):
        table = table.part(slice(None), slice(1, None))
    return table, names


def _is_axis(numbers: np.ndarray) -> bool:
    """Whether numbers rise or fall in equal steps."""
    if numbers.size < 2 or not np.isfinite(numbers).all():
        return False
    steps = np.diff(numbers)
    if not (np.all(steps > 0) or np.all(steps < 0)):
        return False
    even = np.linspace(numbers[0], numbers[-1], numbers.size)
    return bool(np.abs(numbers - even).max() < _UNEVEN * abs(steps.mean()))


def _is_index(numbers: np.ndarray) -> bool:
    return numbers[0] in (0, 1) and np.array_equal(np.diff(numbers), np.ones(numbers.size - 1))


def _is_apart(numbers: np.ndarray, body: np.ndarray) -> bool:
    """Whether some of the numbers lie where thickness next to that of the body does not."""
    body = body[np.isfinite(body)]
    if not body.size:
        return False
    low, high = body.min(), body.max()
    spread = high - low
    return bool(np.any((numbers < min(low - spread, low / 2)) | (numbers > max(high + spread, 2 * high))))


def _without_index(table: Table) -> Table:
    """Leave out a first column that counts the rows."""
    numbers = table.numbers
    if (0, 0) in table.words or table.empty[:1, :1].all() or numbers.shape[0] < _FEW or numbers.shape[1] < 3:
        return table
    counts = _is_axis(numbers[:, 0]) and _is_index(numbers[:, 0])
    return table.part(slice(None), slice(1, None)) if counts and _is_apart(numbers[:, 0], numbers[:, 1:]) else table


def _triplets(table: Table, reading: Reading, names: list[str]) -> np.ndarray | None:
    """Assemble x, y, z of points that fill a grid to a map; None for other tables."""
    if table.numbers.shape[1] != 3 or table.words or len(table.lines) < 4:
        return None
    x, y, z = table.numbers.T
    are_named = any(name.startswith("x") for name in names) and any(name.startswith("y") for name in names)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        if are_named:
            raise MeasurementError(f"{place(table.lines[0], 0)}: x, y, z triplets need x and y in every line.")
        return None
    (xs, column), (ys, row) = _positions(x), _positions(y)
    fills = xs.size * ys.size == z.size and len(set(zip(row, column, strict=True))) == z.size
    fills = fills and _is_axis(xs) and _is_axis(ys)
    if not fills:
        repeat = xs.size < x.size and ys.size < y.size
        if are_named or (repeat and (_is_apart(x, z) or _is_apart(y, z))):
            raise MeasurementError(
                f"{place(table.lines[0], 0)}: {z.size} points x, y, z fill no grid of equal steps "
                f"({xs.size} positions in x, {ys.size} in y); write one line for every pixel, NaN where it is missing."
            )
        return None
    values = np.full((ys.size, xs.size), np.nan)
    values[row, column] = z
    where = place(table.lines[0], 0)
    _check_spans(reading, _Axis(xs, where, _is_index(xs)), _Axis(ys, where, _is_index(ys)), values.shape)
    return values


def _positions(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct positions in order, to a millionth of their span, and which of them each number is."""
    span = np.ptp(numbers) or 1.0
    _, first, which = np.unique(
        np.round(1e6 * (numbers - numbers.min()) / span), return_index=True, return_inverse=True
    )
    return numbers[first], which


def _axes(table: Table, reading: Reading) -> tuple[Table, _Axis | None, _Axis | None] | None:
    """Separate coordinates of columns and rows; None where the table contains thickness only."""
    numbers = table.numbers
    if min(numbers.shape) < 2:
        return None
    row, column, body = numbers[0, 1:], numbers[1:, 0], numbers[1:, 1:]
    x = _Axis(row, place(table.lines[0], 1), _is_index(row)) if _is_axis(row) else None
    y = _Axis(column, place(table.lines[1], 0), _is_index(column)) if _is_axis(column) else None
    x_apart, y_apart = x is not None and _is_apart(row, body), y is not None and _is_apart(column, body)
    inner = table.part(slice(1, None), slice(1, None))
    corner = place(table.lines[0], 0)
    if (0, 0) in table.words:
        if x is None or y is None:
            raise not_a_number(table, 0, 0)
        return inner, x, y
    if table.empty[0, 0]:
        if x_apart and y_apart:
            return inner, x, y
        fits = x is not None and y is not None and _fits(reading, x, y)
        if x_apart or y_apart or fits:
            raise MeasurementError(
                f"{corner} is empty: coordinates of columns and rows, or a missing pixel? Remove the coordinates, or "
                "write NaN for the pixel."
            )
        return None
    if x_apart and y_apart:
        return inner, x, y
    return _single_axis(table)


def _single_axis(table: Table) -> tuple[Table, _Axis | None, _Axis | None] | None:
    """Split off coordinates that only the columns have, or only the rows."""
    numbers = table.numbers
    row, column = numbers[0], numbers[:, 0]
    where = place(table.lines[0], 0)
    if row.size >= _FEW and _is_axis(row) and _is_apart(row, numbers[1:]):
        return table.part(slice(1, None), slice(None)), _Axis(row, where, _is_index(row)), None
    if column.size >= _FEW and _is_axis(column) and _is_apart(column, numbers[:, 1:]):
        return table.part(slice(None), slice(1, None)), None, _Axis(column, where, _is_index(column))
    return None


def _factors(reading: Reading, x: _Axis | None, y: _Axis | None) -> list[float]:
    """Span of coordinates over that of the given grid, for those that do more than count."""
    factors = []
    for along, axis in enumerate((x, y)):
        if axis is None or axis.is_index:
            continue
        if reading.extent is not None:
            factors.append(float(np.ptp(axis.positions)) / reading.extent[along])
        elif reading.spacing is not None:
            steps = axis.positions.size - 1
            factors.append(float(np.ptp(axis.positions)) / (steps * reading.spacing[along]))
    return factors


def _fits(reading: Reading, x: _Axis, y: _Axis) -> bool:
    factors = _factors(reading, x, y)
    return len(factors) == 2 and any(np.allclose(factors, unit, _SAME) for unit in _UNITS)


def _check_spans(reading: Reading, x: _Axis | None, y: _Axis | None, shape: tuple[int, ...]) -> None:
    """Compare coordinates with the given extent."""
    factors = _factors(reading, x, y)
    axis = x or y
    if not factors or axis is None or any(np.allclose(factors, unit, _SAME) for unit in _UNITS):
        return
    spans = " × ".join(f"{np.ptp(axis.positions):g}" for axis in (x, y) if axis is not None)
    grid = f"extent= {reading.extent}" if reading.extent is not None else f"spacing= {reading.spacing}"
    said = f"{axis.where}: the coordinates span {spans}, which is not {grid} mm"
    if len(factors) == 2 and abs(factors[0] / factors[1] - 1) > _SAME:
        raise MeasurementError(f"{said}; the map has (ny, nx) = {shape} samples. Which is right?")
    reading.notes.append(f"{said}; what was given is used")


def _ascending(values: np.ndarray, x: _Axis | None, y: _Axis | None) -> np.ndarray:
    if x is not None and x.positions[0] > x.positions[-1]:
        values = values[:, ::-1]
    if y is not None and y.positions[0] > y.positions[-1]:
        values = values[::-1]
    return values


def _settled_edges(table: Table, reading: Reading) -> np.ndarray:
    """Leave out, or keep as missing, rows and columns of empty cells at the edges.

    They may be missing pixels or delimiters too many. The extent settles it where just one of the readings has
    square pixels.
    """
    empty = table.empty
    rows, columns = np.flatnonzero(~empty.all(axis=1)), np.flatnonzero(~empty.all(axis=0))
    ny, nx = empty.shape
    if not rows.size:
        return table.numbers
    edges = (
        int(rows[0]),
        ny - 1 - int(rows[-1]),
        int(columns[0]),
        nx - 1 - int(columns[-1]),
    )  # top, bottom, left, right
    if not any(edges) or (reading.extent is None and reading.spacing is None):
        return table.numbers
    top, bottom, left, right = edges
    if reading.extent is None:
        if top == left == 0:
            reading.notes.append(f"{bottom} rows and {right} columns at the end are empty and were left out")
            return table.numbers[: ny - bottom, : nx - right]
        fitting = []
    else:
        choices = itertools.product(*(range(count + 1) for count in edges))
        fitting = [cut for cut in choices if _is_square(reading.extent, ny - cut[0] - cut[1], nx - cut[2] - cut[3])]
    if len(fitting) != 1:
        line, column = table.lines[0 if top else -1], 0 if left else nx - 1
        where = place(line, column) if left or right else f"line {line}"
        raise MeasurementError(
            f"{where}: empty in every {'line' if left or right else 'column'}, a delimiter too many or missing pixels? "
            "Remove the delimiters, or write NaN for missing pixels."
        )
    above, below, before, after = fitting[0]
    return table.numbers[above : ny - below, before : nx - after]


def _is_square(extent: tuple[float, float], ny: int, nx: int) -> bool:
    return min(ny, nx) > 1 and abs(off_square(extent, (ny, nx))) < _OFF_SQUARE
