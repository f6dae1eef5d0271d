"""Tables of text, as spreadsheets, MATLAB, ImageJ and instruments write them: cells, and which of them are numbers.

The delimiter, the decimal sign and what marks a missing value follow from the whole file; where two readings are
possible the file is refused with line and column. `text_maps` finds the map in the table.
"""

import codecs
import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..measurement import MeasurementError

# Text of Excel and LibreOffice in cells without a value, in English, German, French, Spanish and Italian.
_SPREADSHEET = "#N/A #NV #N/D #NA #DIV/0! #¡DIV/0! #VALUE! #WERT! #VALEUR! #VALOR! #¡VALOR! #VALORE! #REF! #BEZUG! "
_SPREADSHEET += "#¡REF! #RIF! #NUM! #ZAHL! #NOMBRE! #¡NUM! #NAME? #NOM? #NOMBRE? #¿NOMBRE? #NOME? #NULL! #NUL! #NULO!"
_ERRORS = frozenset(_SPREADSHEET.split())
_MISSING = _ERRORS | {
    "NAN",
    "-NAN",
    "+NAN",
    "NAN(IND)",
    "-NAN(IND)",
    "1.#QNAN",
    "-1.#IND",
    "1.#IND",
    "1.#INF",
    "-1.#INF",
}
_MISSING |= {
    "",
    "NA",
    "N/A",
    "NULL",
    "NONE",
    "-",
    "--",
    "---",
    "INF",
    "+INF",
    "-INF",
    "INFINITY",
    "+INFINITY",
    "-INFINITY",
}
_PLAIN = re.compile(r"[\d.eE+-]*", re.ASCII)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
_WITH_COMMA = re.compile(r"[+-]?\d*,\d*(?:[eEdD][+-]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+", re.ASCII)
_SPACED = re.compile(r"[\d,.] +[-+.\d]", re.ASCII)
_ENCODINGS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
SHOWN = 40  # characters of a cell that a message repeats


class Table(NamedTuple):
    """Cells of a text, in rows of equal length.

    Attributes:
        numbers: Their numbers; NaN where there is none.
        empty: True where nothing is written.
        words: Cells that are neither numbers nor missing values, by (row, column).
        lines: Line number of each row.
    """

    numbers: np.ndarray
    empty: np.ndarray
    words: dict[tuple[int, int], str]
    lines: list[int]

    def part(self, rows: slice, columns: slice) -> "Table":
        """Cut rows and columns out."""
        top, left = rows.indices(len(self.lines))[0], columns.indices(self.numbers.shape[1])[0]
        numbers = self.numbers[rows, columns]
        ny, nx = numbers.shape
        words = {(j - top, i - left): word for (j, i), word in self.words.items()}
        inside = {(j, i): word for (j, i), word in words.items() if 0 <= j < ny and 0 <= i < nx}
        return Table(numbers, self.empty[rows, columns], inside, self.lines[rows])


def read_table(path: Path, notes: list[str]) -> Table:
    """Read the cells of a text file.

    Args:
        path: The file.
        notes: Receives remarks for the user.

    Raises:
        MeasurementError: For a text that is no table of numbers, or ambiguous; names line and column.
    """
    text = _decoded(path.read_bytes())
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip(" ")]
    lines = [(number, line) for number, line in lines if not _is_comment(line)]
    if not any("\t" in line.strip() for _, line in lines):  # where tabs separate nothing, a line of them is blank
        lines = [(number, line) for number, line in lines if line.strip()]
    stated = re.fullmatch(r"sep=(.)", lines[0][1].strip("\r\n"), re.IGNORECASE) if lines else None
    if stated:  # a line for Excel
        del lines[0]
    if not lines:
        return Table(np.empty((0, 0)), np.empty((0, 0), bool), {}, [])
    delimiter = stated.group(1) if stated else _delimiter([line for _, line in lines])
    rows = list(_rows(lines, delimiter))
    cells = _rectangle([row for _, row in rows], [number for number, _ in rows], notes)
    table = _parsed(cells, [number for number, _ in rows], delimiter)
    _check_gaps(table)
    last, others = cells[-1][-1], (len(cell) for row in cells for cell in row[:-1] if cell)
    if last and not text.endswith("\n") and len(last) < min(others, default=0):
        notes.append(f"the last number, {last!r}, is shorter than all others and ends the file: is it cut off?")
    return table


def _decoded(stored: bytes) -> str:
    if stored.startswith(b"PK\x03\x04"):
        raise MeasurementError("is a spreadsheet or an archive, not text; save it as CSV.")
    encoding = next((name for mark, name in _ENCODINGS.items() if stored.startswith(mark)), "utf-8")
    try:
        text = stored.decode(encoding)
    except UnicodeDecodeError:
        text = stored.decode("latin-1")  # as spreadsheets on Windows write µ
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise MeasurementError(f"line {line} holds a zero byte and is no text; save it as text (CSV) in UTF-8.")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _is_comment(line: str) -> bool:
    start = re.split(r"[,;\t ]", line.strip(), maxsplit=1)
    if not start[0].startswith(("#", "%")) or start[0].upper() in _ERRORS:
        return False
    return not (set(start[0]) == {"#"} and len(start) > 1 and len(start[0]) > 2)


def _delimiter(lines: list[str]) -> str:
    """Find the delimiter of cells: a tab or semicolon wherever there is one, else a comma, else spaces."""
    for mark in "\t;":
        if any(mark in line for line in lines):
            return mark
    if any("," in line for line in lines):
        spaced = any(_SPACED.search(re.sub(r", +", ",", line.strip())) for line in lines)
        return " " if spaced else ","  # "0,41 0,42": spaces between numbers with decimal commas
    return " "


def _rows(lines: list[tuple[int, str]], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Split lines into cells; yields the line number of each row."""
    if delimiter == " ":
        yield from ((number, line.split()) for number, line in lines)
        return
    reader = csv.reader(
        [line for _, line in lines], delimiter=delimiter, skipinitialspace=delimiter != "\t", strict=True
    )
    first = 0
    try:
        for row in reader:
            yield lines[first][0], [cell.strip() for cell in row]
            first = reader.line_num
    except csv.Error as cause:
        raise MeasurementError(f"line {lines[first][0]}: its quotes do not match ({cause}).") from None


def _rectangle(rows: list[list[str]], lines: list[int], notes: list[str]) -> list[list[str]]:
    """Give all rows one length; only delimiters at the end of some lines may differ."""
    if len(rows) > 1 and len(rows[0]) + 1 == len(rows[1]) and not any(_number_in(cell) for cell in rows[0]):
        rows = [["", *rows[0]], *rows[1:]]  # R names no column of row names
    counts = [len(row) for row in rows]
    if len(set(counts)) == 1:
        return rows
    trimmed = [_trimmed(row) for row in rows]
    if len({len(row) for row in trimmed}) == 1:
        notes.append("some lines end in a delimiter, others do not; it is no column")
        return trimmed
    usual = max(dict.fromkeys(counts), key=counts.count)
    odd = next(index for index, count in enumerate(counts) if count != usual)
    raise MeasurementError(
        f"line {lines[odd]} has {counts[odd]} columns, others have {usual}; start header lines with #, "
        "and write NaN for missing pixels."
    )


def _trimmed(row: list[str]) -> list[str]:
    while row and not row[-1]:
        row = row[:-1]
    return row


def _number_in(cell: str) -> bool:
    return _NUMBER.fullmatch(cell.replace(",", ".", 1)) is not None


def _parsed(cells: list[list[str]], lines: list[int], delimiter: str) -> Table:
    comma = _decimal_comma(cells, lines, delimiter)
    numbers = np.full((len(cells), len(cells[0])), np.nan)
    words: dict[tuple[int, int], str] = {}
    for j, row in enumerate(cells):
        points = [cell.replace(",", ".", 1) for cell in row] if comma else row
        if _PLAIN.fullmatch("".join(points)) and all(points):
            try:
                numbers[j] = [float(cell) for cell in points]
                continue
            except ValueError:
                pass
        for i, (cell, number) in enumerate(zip(row, points, strict=True)):
            if cell.upper() in _MISSING:
                continue
            if _NUMBER.fullmatch(number):
                numbers[j, i] = float(number.upper().replace("D", "E"))
            else:
                words[j, i] = cell
    if np.isinf(numbers).any():
        j, i = np.argwhere(np.isinf(numbers))[0].tolist()
        raise MeasurementError(f"{place(lines[j], i)}: {cells[j][i][:SHOWN]} is too large a number.")
    return Table(numbers, np.array([[not cell for cell in row] for row in cells]), words, lines)


def _decimal_comma(cells: list[list[str]], lines: list[int], delimiter: str) -> bool:
    """Find out whether decimals are written with a comma."""
    commas = [(j, i) for j, row in enumerate(cells) for i, cell in enumerate(row) if "," in cell]
    found = [(j, i) for j, i in commas if _WITH_COMMA.fullmatch(cells[j][i]) or _THOUSANDS.fullmatch(cells[j][i])]
    if not found:
        if delimiter == ",":
            _refuse_split_decimals(cells, lines)
        return False
    j, i = found[0]
    said = f"{place(lines[j], i)}: {cells[j][i][:SHOWN]!r}"
    if any("." in cell and _NUMBER.fullmatch(cell) for row in cells for cell in row):
        raise MeasurementError(f"{said} has a comma, other numbers have a point; write all decimals with a point.")
    # Semicolons stand where the comma is the decimal sign.
    if delimiter != ";" and all(_THOUSANDS.fullmatch(cells[j][i]) for j, i in found):
        raise MeasurementError(
            f"{said} may be a decimal or thousands; write decimals with a point and thousands without a sign."
        )
    return True


def _refuse_split_decimals(cells: list[list[str]], lines: list[int]) -> None:
    """Refuse commas that may separate decimals as well as cells: 0,412,0,415."""
    if any("." in cell for row in cells for cell in row):
        return
    for j, row in enumerate(cells):
        for i, cell in enumerate(row):
            if re.fullmatch(r"[+-]?0\d+", cell, re.ASCII):
                raise MeasurementError(
                    f"{place(lines[j], i)}: {cell[:SHOWN]!r} starts with a zero: are commas also the decimal sign? "
                    "Write decimals with a point."
                )
    width = len(cells[0])
    if width < 4 or width % 2 or not all(re.fullmatch(r"[+-]?\d+", cell, re.ASCII) for row in cells for cell in row):
        return
    whole = np.array(cells, dtype=float)
    left, right = whole[:, ::2], whole[:, 1::2]
    if left.max() < right.min() or right.max() < left.min():
        raise MeasurementError(
            f"{place(lines[0], 1)}: every second column lies apart from the others: are commas also the decimal sign? "
            "Write decimals with a point."
        )


def _check_gaps(table: Table) -> None:
    """Refuse rows that a blank or comment line parts, unless every two are parted alike: it may be two maps."""
    top = next((j for j in range(len(table.lines)) if (j, table.numbers.shape[1] - 1) not in table.words), 0)
    gaps = np.diff(table.lines[top:])
    if not np.all(gaps == gaps[:1]):
        usual = np.bincount(gaps).argmax()
        after = table.lines[top + int(np.flatnonzero(gaps != usual)[0])]
        raise MeasurementError(
            f"line {after + 1} is blank or a comment between rows of numbers: are there two maps? Keep one in a file."
        )


def place(line: int, column: int) -> str:
    """Name a cell; `column` counts from 0."""
    return f"line {line}, column {column + 1}"


def not_a_number(table: Table, row: int, column: int) -> MeasurementError:
    """Make the error of a cell that contains words."""
    word = table.words[row, column]
    where = place(table.lines[row], column)
    if set(word) == {"#"}:
        return MeasurementError(f"{where}: {word!r} is what a spreadsheet shows in too narrow a column; widen it.")
    return MeasurementError(
        f"{where}: {word[:SHOWN]!r} is not a number; start header lines with #, leave missing pixels empty or NaN."
    )
