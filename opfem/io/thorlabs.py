"""The OCITY container of Thorlabs' microscopes: a ZIP file, or the folder it unpacks to, of arrays and an XML header.

Read in place where entries are stored uncompressed. Sizes come from each array's own attributes and are compared with
the bytes that are there; names are matched with either slash. What a header claims is never trusted with memory.
"""

import math
import struct
import zipfile
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from ..measurement import MeasurementError

LARGEST_UNPACKED = 2**31
"""Most bytes of a compressed array that are unpacked into memory."""

_LARGEST_HEADER = 16 * 2**20
_MOST_ENTRIES = 100_000
_MOST_ELEMENTS, _DEEPEST = 200_000, 50  # of a header; real ones hold a few thousand, five deep
_DEFLATE = 1032  # largest ratio that deflate can reach: an entry that claims more is not what it says
_DTYPES = {("Real", 4): "<f4", ("Real", 8): "<f8", ("Complex", 8): "<c8", ("Complex", 16): "<c16"}
_RAW = {(1, True): "i1", (1, False): "u1", (2, True): "<i2", (2, False): "<u2", (4, True): "<i4", (4, False): "<u4"}


class DataFile(NamedTuple):
    """One array of a container, as its header states it.

    Attributes:
        kind: "Real", "Complex", "Raw" or "Colored".
        name: Path in the container, with forward slashes.
        shape: (SizeY, SizeX, SizeZ).
        ranges: (RangeY, RangeX, RangeZ) [mm]; None where it is not stated.
        width: Bytes of a number.
        lines: Apodisation lines (first, last) and A-lines (first, last) of a B-scan of spectra; None where not stated.
    """

    kind: str
    name: str
    shape: tuple[int, int, int]
    ranges: tuple[float | None, float | None, float | None]
    width: int
    lines: tuple[int, int, int, int] | None

    @property
    def stem(self) -> str:
        """Name without folder and suffix."""
        return self.name.rsplit("/", 1)[-1].removesuffix(".data")


class Container:
    """An opened OCITY file or folder: its header, and its arrays."""

    def __init__(self, path: Path):
        self.path = path
        if path.is_dir():
            self._entries: dict[str, Any] = {}
            header = path / "Header.xml"
            if not header.is_file():
                raise MeasurementError("the folder holds no Header.xml; name the file itself.")
            if header.stat().st_size > _LARGEST_HEADER:
                raise MeasurementError(f"Header.xml is larger than {_LARGEST_HEADER >> 20} MB.")
            content = header.read_bytes()
        else:
            with zipfile.ZipFile(path) as archive:
                infos = archive.infolist()
                if len(infos) > _MOST_ENTRIES:
                    raise MeasurementError(f"the ZIP file holds {len(infos)} entries, more than {_MOST_ENTRIES}.")
                self._entries = {info.filename.replace("\\", "/"): info for info in infos}
                if "Header.xml" not in self._entries:
                    raise MeasurementError(f"the ZIP file holds no Header.xml; it holds {_listed(self._entries)}.")
                content = self._unpacked(archive, self._entries["Header.xml"], _LARGEST_HEADER)
        self.header = parse_header(content)
        files = self.header.find("DataFiles")
        found = [] if files is None else [data_file(node) for node in files.findall("DataFile")]
        self.files = [file for file in found if file.kind != "Colored"]

    def text(self, tag: str, default: str | None = None) -> str | None:
        """Read the text of an element of the header, by its path."""
        node = self.header.find(tag)
        return default if node is None or node.text is None else node.text.strip()

    def number(self, tag: str, default: float) -> float:
        """Read the number in an element of the header, by its path."""
        text = self.text(tag)
        return default if text is None else number_in(tag, text)

    @property
    def own(self) -> dict[str, str]:
        """What `write_oct` states beyond OCITY."""
        node = self.header.find("MetaInfo/Opfem")
        return {} if node is None else dict(node.attrib)

    def choose(self, prefix: str, kind: str) -> DataFile | None:
        """Find the only array of a kind whose name begins so; None where there is none."""
        found = [file for file in self.files if file.kind == kind and file.stem.startswith(prefix)]
        if len(found) > 1:
            raise MeasurementError(
                f"holds several: {', '.join(file.stem for file in found)}; pass variable= to name one."
            )
        return found[0] if found else None

    def named(self, variable: str) -> DataFile:
        """Find the array of a name."""
        for file in self.files:
            if file.stem == variable:
                return file
        raise MeasurementError(f"holds no {variable!r}; it holds {', '.join(file.stem for file in self.files)}.")

    def array(self, file: DataFile) -> np.ndarray:
        """Read an array, in place where it is not compressed."""
        dtype = np.dtype(self._dtype(file))
        expected = math.prod(file.shape) * dtype.itemsize
        if self.path.is_dir():
            source, offset = self._inside(file.name), 0
            size = source.stat().st_size
            self._check_size(file, expected, size)
        else:
            info = self._entries.get(file.name)
            if info is None:
                raise MeasurementError(f"{file.name} is missing; the ZIP file holds {_listed(self._entries)}.")
            self._check_size(file, expected, info.file_size)
            if info.compress_type != zipfile.ZIP_STORED:
                with zipfile.ZipFile(self.path) as archive:
                    content = self._unpacked(archive, info, LARGEST_UNPACKED)
                return np.frombuffer(content, dtype).reshape(file.shape)
            source, offset = self.path, self._offset(info)
        return np.memmap(source, dtype, "r", offset, file.shape)

    def vector(self, stem: str, count: int) -> np.ndarray | None:
        """Numbers of one for each pixel of the spectrometer; None where they are missing."""
        found = [file for file in self.files if file.stem == stem and file.kind == "Real"]
        if not found:
            return None
        values = np.asarray(self.array(found[0]), float).ravel()
        if values.size != count:
            raise MeasurementError(f"{stem} holds {values.size} numbers, the spectra have {count} pixels.")
        if not np.isfinite(values).all():
            raise MeasurementError(f"{stem} holds NaN or infinite numbers.")
        return values

    def _dtype(self, file: DataFile) -> str:
        key = (file.kind, file.width)
        if file.kind == "Raw":
            signed = str(self.text("Instrument/RawDataIsSigned", "False")).lower() == "true"
            found = _RAW.get((file.width, signed))
        else:
            found = _DTYPES.get(key)
        if found is None:
            raise MeasurementError(
                f"{file.stem} is of Type {file.kind!r} with {file.width} bytes a number, which opfem does not know."
            )
        return found

    def _check_size(self, file: DataFile, expected: int, size: int) -> None:
        if size != expected:
            ny, nx, nz = file.shape
            raise MeasurementError(
                f"{file.stem} must have SizeZ × SizeX × SizeY = {nz} × {nx} × {ny} numbers of {file.width} bytes, "
                f"{expected} bytes, got {size}; is the file cut off?"
            )

    def _inside(self, name: str) -> Path:
        parts = name.split("/")
        if ".." in parts or "" in parts or ":" in name:
            raise MeasurementError(f"Header.xml names {name!r}, which is not inside the folder.")
        source = self.path.joinpath(*parts)
        # Unpacked elsewhere, the backslash may be a part of the name.
        flat = self.path / name.replace("/", "\\")
        source = flat if flat.is_file() and not source.is_file() else source
        if not source.is_file():
            raise MeasurementError(
                f"{name} is missing; the folder holds {_listed([p.name for p in self.path.iterdir()])}."
            )
        return source

    def _offset(self, info: zipfile.ZipInfo) -> int:
        """Find where the bytes of an uncompressed entry begin."""
        with open(self.path, "rb") as file:
            file.seek(info.header_offset)
            local = file.read(30)
            end = file.seek(0, 2)
        if len(local) < 30 or local[:4] != b"PK\x03\x04" or info.flag_bits & 1:
            raise MeasurementError(
                f"{info.filename} has no readable place in the ZIP file; it is damaged or encrypted."
            )
        name, extra = struct.unpack("<HH", local[26:30])
        offset = info.header_offset + 30 + name + extra
        if offset + info.file_size > end or info.compress_size != info.file_size:
            raise MeasurementError(
                f"{info.filename} should end at byte {offset + info.file_size}, the file ends at {end}."
            )
        return offset

    def _unpacked(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo, largest: int) -> bytes:
        size, packed = info.file_size, info.compress_size
        if size > largest:
            raise MeasurementError(
                f"{info.filename} takes {size / 2**20:.0f} MB unpacked, above {largest >> 20} MB; "
                "unpack the ZIP file to a folder and read that."
            )
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise MeasurementError(
                f"{info.filename} is compressed by method {info.compress_type}; only deflate is read."
            )
        if size > _DEFLATE * packed + 64 or info.flag_bits & 1:
            raise MeasurementError(f"{info.filename} claims {size} bytes from {packed}: damaged or encrypted.")
        with archive.open(info) as stream:
            content = stream.read(size + 1)
        if len(content) != size:
            raise MeasurementError(f"{info.filename} must unpack to {size} bytes, got {len(content)}.")
        return content


def parse_header(content: bytes) -> Element:
    """Parse Header.xml; declarations of a document type, and so of entities, are refused."""
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.CharacterDataHandler = builder.data
    count, deep = 0, 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count, deep
        count, deep = count + 1, deep + 1
        if count > _MOST_ELEMENTS or deep > _DEEPEST:
            raise MeasurementError(
                f"Header.xml holds more than {_MOST_ELEMENTS} elements, or is nested beyond {_DEEPEST}."
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal deep
        deep -= 1
        builder.end(tag)

    parser.StartElementHandler, parser.EndElementHandler = start, end

    def refuse(*_: Any) -> None:
        raise MeasurementError("Header.xml declares a document type; an OCT file has none.")

    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
        root = builder.close()
    except expat.ExpatError as cause:
        raise MeasurementError(f"Header.xml is not XML: {cause}.") from cause
    if root.tag != "Ocity":
        raise MeasurementError(f"Header.xml must hold <Ocity>, got <{root.tag[:40]}>.")
    return root


def data_file(node: Element) -> DataFile:
    """Read the attributes of a <DataFile>."""
    name = (node.text or "").strip().replace("\\", "/")
    if not name:
        raise MeasurementError("Header.xml has a DataFile without a name.")

    def whole(key: str, default: int | None = None) -> int:
        text = node.get(key)
        if text is None and default is not None:
            return default
        try:
            value = int(text or "")
        except ValueError:
            value = -1
        if not 1 <= value < 2**31:
            raise MeasurementError(f"{name}: {key} must be a positive whole number, got {text!r}.")
        return value

    def length(key: str) -> float | None:
        text = node.get(key)
        return None if text is None else number_in(f"{name}: {key}", text)

    keys = ("ApoRegionStart0", "ApoRegionEnd0", "ScanRegionStart0", "ScanRegionEnd0")
    stated = [node.get(key) for key in keys]
    lines = None if None in stated else tuple(int(number_in(k, str(v))) for k, v in zip(keys, stated, strict=True))
    kind = node.get("Type", "")
    sizes = (1, 1, 1) if kind == "Colored" else (whole("SizeY", 1), whole("SizeX", 1), whole("SizeZ"))
    return DataFile(
        kind,
        name,
        sizes,
        (length("RangeY"), length("RangeX"), length("RangeZ")),
        4 if kind == "Colored" else whole("BytesPerPixel"),
        lines,  # pyright: ignore[reportArgumentType]
    )


def number_in(what: str, text: str) -> float:
    """Read a finite number; `what` names it in the error."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 1e12:
        raise MeasurementError(f"{what[:60]} must be a number, got {text[:40]!r}.")
    return value


def _listed(names: Any) -> str:
    names = [str(name)[:60] for name in names]
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") if names else "nothing"
