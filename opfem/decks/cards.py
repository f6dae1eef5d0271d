"""A deck as text: keyword lines with their options and data lines, included files in place.

Knows the format and no keyword's meaning; numbers are read in one go, line by line only where that fails.
"""

import gzip
import re
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

# Text of all files together; numbers and text of that much take 1.5 GB, of 50 MB some 0.2 GB.
MAX_BYTES = 512 * 2**20
_LARGEST = 1e15  # label that a float64 holds exactly
_LONGEST = 10_000  # letters of a keyword with its options
_DEEPEST = 16  # files included by included files
_KEYWORD = re.compile(rb"^[ \t]*\*(?!\*)[^\n]*", re.MULTILINE)
_NO_DATA = re.compile(rb"^[ \t]*(?:\*\*[^\n]*)?(?:\n|\Z)", re.MULTILINE)
_CONTINUED = re.compile(rb",[ \t]*\n")
_BREAK = re.compile(rb"[ \t]*,?[ \t]*\n")
_FIELD = re.compile(r'\s*((?:"[^"]*"|[^,"])*)(?:,|$)')
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?")
_COMMA, _NEWLINE = 44, 10


class DeckError(ValueError):
    """A deck that is wrong, or says what opfem does not know; the message begins with file and line."""


class Place(NamedTuple):
    """Where something is said: a file and a line of it."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"

    def refuse(self, message: str) -> DeckError:
        """Make the error that says what is wrong here."""
        return DeckError(f"{self}: {message}")


class Text(NamedTuple):
    """A stretch of data lines, and where it begins."""

    start: Place
    content: bytes

    def lines(self) -> Iterator[tuple[Place, str]]:
        """Yield data lines without comments and empty lines."""
        for number, line in enumerate(self.content.split(b"\n"), self.start.line):
            words = line.strip()
            if words and not words.startswith(b"**"):
                yield Place(self.start.file, number), words.decode("latin-1")


@dataclass
class Card:
    """A keyword line with its data lines.

    Attributes:
        name: Keyword in capitals, without the star.
        options: By name in capitals; "" for those without a value.
        place: Where it stands.
        data: Its data lines, in one stretch or, with included files, in several.
    """

    name: str
    options: dict[str, str]
    place: Place
    data: list[Text] = field(default_factory=list)

    def refuse(self, message: str, place: Place | None = None) -> DeckError:
        """Make the error that says what is wrong with this keyword."""
        return (place or self.place).refuse(f"*{self.name}{message}")

    def option(self, name: str) -> str:
        """Return the value of an option that must be given."""
        value = self.options.get(name, "")
        if not value:
            raise self.refuse(f" needs {name}=.")
        return value

    def number_option(self, name: str) -> float:
        """Return the value of an option that is a number."""
        return number(self.option(name), self, self.place)

    def rows(self) -> Iterator[tuple[Place, list[str]]]:
        """Yield the fields of each data line; a comma at its end opens no further field."""
        for text in self.data:
            for place, line in text.lines():
                fields = [part.strip() for part in line.split(",")]
                yield place, fields[:-1] if len(fields) > 1 and not fields[-1] else fields

    def numbers(self, least: int, most: int) -> list[float]:
        """Read the one data line of a keyword, of so many numbers."""
        rows = list(self.rows())
        if len(rows) != 1:
            raise self.refuse(f" takes one data line here, got {len(rows)}.", rows[1][0] if len(rows) > 1 else None)
        place, fields = rows[0]
        if not least <= len(fields) <= most:
            many = f"{least}" if least == most else f"{least} to {most}"
            raise self.refuse(f" takes {many} numbers, got {len(fields)}.", place)
        return [number(part, self, place) for part in fields]

    def table(self, columns: int, continued: bool = False) -> np.ndarray:
        """Read data lines of as many numbers each.

        Args:
            columns: Numbers of a line.
            continued: Whether a comma at the end of a line joins the next one to it.
        """
        parts = [self._part(text, columns, continued) for text in self.data]
        return np.concatenate(parts) if parts else np.zeros((0, columns))

    def _part(self, text: Text, columns: int, continued: bool) -> np.ndarray:
        content = _NO_DATA.sub(b"", text.content)
        if continued:
            content = _CONTINUED.sub(b",", content)
        content = content.rstrip(b"\n")
        if not content:
            return np.zeros((0, columns))
        letters = np.frombuffer(content, np.uint8)
        starts = np.concatenate([[0], np.flatnonzero(letters == _NEWLINE) + 1])
        if np.all(np.add.reduceat(letters == _COMMA, starts) == columns - 1):
            flat = _quick_numbers(content.replace(b"\n", b","))
            if flat is not None and flat.size == columns * starts.size and np.isfinite(flat).all():
                return flat.reshape(-1, columns)
        return np.array(list(self._slow_rows(text, columns, continued))).reshape(-1, columns)

    def _slow_rows(self, text: Text, columns: int, continued: bool) -> Iterator[list[float]]:
        fields: list[str] = []
        place = text.start
        for place, line in text.lines():
            fields += line.split(",")
            if continued and line.endswith(","):
                fields.pop()
                continue
            if len(fields) > 1 and not fields[-1].strip():
                fields.pop()
            yield self._row(fields, columns, place)
            fields = []
        if fields:
            yield self._row(fields, columns, place)

    def _row(self, fields: list[str], columns: int, place: Place) -> list[float]:
        if len(fields) != columns:
            raise self.refuse(f" needs {columns} numbers here, got {len(fields)}.", place)
        return [number(part.strip() or "0", self, place) for part in fields]

    def members(self) -> list[tuple[Place, np.ndarray | str]]:
        """Read the members of a set: numbers together, names one by one."""
        found: list[tuple[Place, np.ndarray | str]] = []
        for text in self.data:
            content = _BREAK.sub(b",", _NO_DATA.sub(b"", text.content)).strip(b" \t,")
            flat = _quick_numbers(content) if content else np.zeros(0)
            if flat is not None and flat.size == (content.count(b",") + 1 if content else 0):
                found.append((text.start, flat))
                continue
            for place, line in text.lines():
                found += [(place, _member(part.strip())) for part in line.split(",") if part.strip()]
        return found


def _member(word: str) -> np.ndarray | str:
    return np.array([float(word)]) if word.isdecimal() and word.isascii() else word


def _quick_numbers(content: bytes) -> np.ndarray | None:
    """Read numbers with commas between them; None where that is not all there is."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(content, sep=" , ")
        except (DeprecationWarning, ValueError):
            return None


def number(word: str, card: Card, place: Place) -> float:
    """Read a number as Fortran writes it.

    Raises:
        DeckError: If it is none, or too large.
    """
    if _NUMBER.fullmatch(word):
        value = float(word.upper().replace("D", "E"))
        if abs(value) < np.inf:
            return value
    raise card.refuse(f": expected a number, got {_shown(word)}.", place)


def whole_numbers(values: np.ndarray, card: Card, place: Place) -> np.ndarray:
    """Turn labels of nodes or elements, read as numbers, into whole ones."""
    wrong = (values != np.rint(values)) | (values < 1) | (values > _LARGEST)
    if wrong.any():
        raise card.refuse(
            f": numbers of nodes and elements must be whole and positive, got {values[wrong][0]:g}.", place
        )
    return values.astype(np.int64)


def _shown(word: str) -> str:
    """Show a word of a deck in one short line."""
    return repr(word if len(word) <= 40 else word[:37] + "...")


def read_cards(path: str | Path, max_bytes: int = MAX_BYTES) -> Iterator[Card]:
    """Read a deck keyword by keyword, files of *INCLUDE and INPUT= in place.

    Args:
        path: The deck; one that ends in .gz is unpacked.
        max_bytes: Most bytes of text to read, of all files together.

    Raises:
        DeckError: If the text is no deck, or a file cannot be read.
    """
    return _joined(_Files(max_bytes).pieces(Path(path), ()))


def _joined(pieces: "Iterator[Card | Text]") -> Iterator[Card]:
    """Give data lines to the keyword before them."""
    current: Card | None = None
    for piece in pieces:
        if isinstance(piece, Card):
            if current is not None:
                yield current
            current = piece
        elif current is not None:
            current.data.append(piece)
        else:
            stray = next(piece.lines(), None)
            if stray is not None:
                raise stray[0].refuse(f"a deck begins with a keyword such as *HEADING, got {_shown(stray[1])}.")
    if current is None:
        raise DeckError("The file holds no keyword: a deck has lines such as *NODE. Is it an .inp file?")
    yield current


class _Files:
    """Reads files until there is too much of them."""

    def __init__(self, max_bytes: int):
        self.left = max_bytes

    def pieces(self, path: Path, within: tuple[Path, ...]) -> Iterator[Card | Text]:
        """Yield keywords and stretches of data lines of a file."""
        whole = self._read(path)
        within = (*within, path.resolve())
        line, at = 1, 0
        for match in _KEYWORD.finditer(whole):
            if match.start() < at:
                continue  # part of a keyword that went on
            if match.start() > at:
                yield Text(Place(path.name, line), whole[at : match.start()])
            line += whole.count(b"\n", at, match.start())
            place = Place(path.name, line)
            end = match.end()
            while whole[match.start() : end].rstrip().endswith(b",") and end < len(whole):
                found = whole.find(b"\n", end + 1)
                end = len(whole) if found < 0 else found
                if end - match.start() > _LONGEST:
                    break
            if end - match.start() > _LONGEST:
                raise place.refuse(
                    f"a keyword of more than {_LONGEST} letters; does a comma at its end join what follows?"
                )
            card = _card(whole[match.start() : end].decode("latin-1"), place)
            line += whole.count(b"\n", match.start(), end + 1)
            at = end + 1
            yield from self._with_files(card, path, within)
        if at < len(whole):
            yield Text(Place(path.name, line), whole[at:])

    def _with_files(self, card: Card, path: Path, within: tuple[Path, ...]) -> Iterator[Card | Text]:
        """Yield a card and what the files that it names hold; an *INCLUDE is only these."""
        if card.name != "INCLUDE":
            yield card
        if card.name == "INCLUDE" or "INPUT" in card.options:
            other = path.parent / card.option("INPUT")
            if other.resolve() in within or len(within) > _DEEPEST:
                raise card.refuse(f": {other.name} includes itself.")
            try:
                yield from self.pieces(other, within)
            except OSError as cause:
                raise card.refuse(f": {other} cannot be read: {cause.strerror or cause}.") from None

    def _read(self, path: Path) -> bytes:
        """Read a file; line ends become those of Unix."""
        try:
            with gzip.open(path) if path.suffix.lower() == ".gz" else open(path, "rb") as file:
                whole = file.read(self.left + 1)
        except (EOFError, gzip.BadGzipFile, zlib.error) as cause:
            raise DeckError(f"{path.name}:1: the file cannot be unpacked: {cause}.") from None
        if len(whole) > self.left:
            raise DeckError(
                f"{path.name}:1: the deck is larger than max_bytes allows; pass more, if the memory is there."
            )
        self.left -= len(whole)
        whole = whole.removeprefix(b"\xef\xbb\xbf")
        return whole.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in whole else whole


def _card(line: str, place: Place) -> Card:
    """Take a keyword line apart."""
    words = " ".join(line.split("\n")).strip()
    parts = [part.strip() for part in _FIELD.findall(words)]
    name = " ".join(parts[0].lstrip("*").upper().split())
    if not name or not name.replace(" ", "").replace("-", "").isalnum() or not name.isascii():
        raise place.refuse(f"expected a keyword, got {_shown(words)}.")
    options: dict[str, str] = {}
    for part in parts[1:]:
        key, _, value = part.partition("=")
        key = " ".join(key.upper().split())
        if not key:
            continue
        if key in options:
            raise place.refuse(f"*{name} has {_shown(key)} twice.")
        options[key] = value.strip().strip('"').strip()
    return Card(name, options, place)
