"""Images of .tif files, with the pixel size that ImageJ and OME write.

tifffile reads them; LZW and other compressions for which it needs imagecodecs are read by Pillow instead.
"""

import logging
import lzma
import math
import xml.etree.ElementTree
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import PIL.Image
import tifffile

from ..measurement import MeasurementError
from .entry import Entry, Reading, check_size, kind_of, other

_UNITS = {"nm": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "microns": 1e-3, "mm": 1.0, "cm": 10.0}
_UNITS |= {"millimeter": 1.0, "millimeters": 1.0, "m": 1e3, "inch": 25.4, "inches": 25.4, "in": 25.4}
"""Units of length in ImageJ and OME files [mm]; others, such as "pixel", are no length."""

_PILLOW_MODES = {"L": "u1", "I;16": "u2", "I;16B": "u2", "I": "i4", "F": "f4"}
_LONGEST_XML = 2**24
# tifffile inflates a strip to whatever size it has.
_INFLATERS = {8: zlib.decompressobj, 32946: zlib.decompressobj, 34925: lzma.LZMADecompressor}


def list_tiff(reading: Reading) -> dict[str, Entry]:
    """List the images of a .tif file: by number, where there are several."""
    with _open(reading) as file:
        images = [_image(reading, file, index) for index in range(len(file.series))]
    if len(images) == 1:
        return {"": images[0]}
    return {str(index): image for index, image in enumerate(images)}


@contextmanager
def _open(reading: Reading) -> Iterator[tifffile.TiffFile]:
    """Open a file; what tifffile would log goes to the notes, and files that OME metadata names stay closed."""
    said = _Notes(reading.notes)
    log = logging.getLogger("tifffile")
    propagate, log.propagate = log.propagate, False
    log.addHandler(said)
    try:
        with tifffile.TiffFile(reading.path, _multifile=False) as file:
            yield file
    finally:
        log.removeHandler(said)
        log.propagate = propagate


class _Notes(logging.Handler):
    def __init__(self, notes: list[str]):
        super().__init__(logging.WARNING)
        self.notes = notes

    def emit(self, record: logging.LogRecord) -> None:
        note = " ".join(record.getMessage().split())
        if note not in self.notes:
            self.notes.append(note)


def _image(reading: Reading, file: tifffile.TiffFile, index: int) -> Entry:
    series = file.series[index]
    page = series.keyframe
    assert isinstance(page, tifffile.TiffPage)
    if page.samplesperpixel > 1:
        return other("a colour image: it shows numbers but does not hold them", series.shape)
    kind = kind_of(series.dtype) if series.dtype is not None else "of an unknown type"
    item = series.dtype.itemsize if series.dtype is not None else 1
    _check_stored(page, item)
    shape, offset, slope = series.shape, *_calibration(file)

    def load() -> np.ndarray:
        check_size(shape, item, reading.max_bytes)
        with _open(reading) as again:
            tile = (page.tilelength, page.tilewidth) if page.is_tiled else ()
            check_size(tile, item, reading.max_bytes)
            _check_inflation(reading, again.series[index], max(page.nbytes, math.prod(tile) * item))
            pixels = _decoded(reading, again.series[index])
        return pixels if (offset, slope) == (0, 1) else offset + slope * pixels.astype(float)

    return Entry(kind, shape, load, spacing=_spacing(reading, file, index))


def _check_stored(page: tifffile.TiffPage, item: int) -> None:
    """Refuse an uncompressed image that states another size than it has, by a row or a column at least."""
    if page.compression != tifffile.COMPRESSION.NONE:
        return
    stored, stated = sum(page.databytecounts), page.nbytes
    if page.is_tiled:
        tiles = -(-page.imagelength // page.tilelength) * -(-page.imagewidth // page.tilewidth)
        stated = tiles * page.tilelength * page.tilewidth * item
    if not 0 <= stored - stated < min(page.shape) * item:
        raise MeasurementError(f"an image of shape {page.shape} takes {stated} bytes, the file holds {stored}.")


def _check_inflation(reading: Reading, series: tifffile.TiffPageSeries, largest: int) -> None:
    """Refuse compressed strips or tiles of more than `largest` bytes, those of the image or of a whole tile."""
    page = series.keyframe
    inflater = _INFLATERS.get(page.compression)
    if inflater is None:
        return
    with open(reading.path, "rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            if len(inflater().decompress(file.read(count), largest + 1)) > largest:
                raise MeasurementError(f"is damaged: a part of an image inflates to more than its {largest} bytes.")


def _decoded(reading: Reading, series: tifffile.TiffPageSeries) -> np.ndarray:
    try:
        return series.asarray()
    except (ImportError, ValueError) as cause:
        # An ImportError is of a decompressor too.
        if isinstance(cause, ValueError) and "imagecodecs" not in str(cause):
            raise
        return _by_pillow(reading, series)


def _by_pillow(reading: Reading, series: tifffile.TiffPageSeries) -> np.ndarray:
    page = series.keyframe
    with PIL.Image.open(reading.path) as image:
        image.seek(page.index)
        expected = _PILLOW_MODES.get(image.mode)
        # Pillow turns images that count from white around.
        stored = "" if page.dtype is None else page.dtype.str[1:]
        if expected != stored or page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            raise MeasurementError(
                f"{tifffile.COMPRESSION(page.compression).name} compression of {page.dtype} needs imagecodecs: "
                "install it (pip install imagecodecs), or save without compression."
            )
        return np.asarray(image).reshape(series.shape)


def _calibration(file: tifffile.TiffFile) -> tuple[float, float]:
    """Offset and slope by which ImageJ turns what is stored into what it shows, signed numbers among them."""
    said = (file.imagej_metadata or {}) if file.is_imagej else {}
    if "cf" not in said:
        return 0.0, 1.0
    if said["cf"] != 0 or not {"c0", "c1"} <= set(said):
        raise MeasurementError(
            "is calibrated by a curve in ImageJ; save it as 32-bit numbers, which are what it shows."
        )
    return float(said["c0"]), float(said["c1"])


def _spacing(reading: Reading, file: tifffile.TiffFile, index: int) -> tuple[float, float] | None:
    """Pixel size (dx, dy) [mm] that ImageJ or OME wrote; plain resolution tags are seldom true, and left out."""
    try:
        spacing = _ome_spacing(file, index) if file.is_ome else _imagej_spacing(file) if file.is_imagej else None
    except (xml.etree.ElementTree.ParseError, TypeError, ValueError, ZeroDivisionError) as cause:
        reading.notes.append(f"its pixel size cannot be read ({cause})")
        return None
    if spacing is not None and not all(math.isfinite(step) and step > 0 for step in spacing):
        reading.notes.append(f"states a pixel size of {spacing} mm, which is not used")
        return None
    return spacing


def _imagej_spacing(file: tifffile.TiffFile) -> tuple[float, float] | None:
    tags = file.pages.first.tags
    unit = str((file.imagej_metadata or {}).get("unit", "")).replace("\\u00B5", "µ")
    across, down = tags.get("XResolution"), tags.get("YResolution")
    if unit not in _UNITS or across is None or down is None:
        return None
    # Pixels per unit, as fractions.
    return _UNITS[unit] * across.value[1] / across.value[0], _UNITS[unit] * down.value[1] / down.value[0]


def _ome_spacing(file: tifffile.TiffFile, index: int) -> tuple[float, float] | None:
    text = file.ome_metadata or ""
    if len(text) > _LONGEST_XML:
        raise ValueError(f"OME metadata of {len(text)} bytes")
    images = [node.attrib for node in xml.etree.ElementTree.fromstring(text).iter() if node.tag.endswith("}Pixels")]
    if len(images) != len(file.series):
        return None
    said = images[index]
    units = [said.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XY"]
    if not {"PhysicalSizeX", "PhysicalSizeY"} <= set(said) or not set(units) <= set(_UNITS):
        return None
    x, y = (float(said[f"PhysicalSize{axis}"]) * _UNITS[unit] for axis, unit in zip("XY", units, strict=True))
    return x, y
