"""Volumes and raw spectra of an OCITY container, from its arrays and its header.

Second step of reading a Thorlabs file, after `Container`; depths are kept as in air.
"""

import math
from typing import Any

import numpy as np

from ..measurement import MeasurementError, Step
from ..measurement.oct import OctVolume
from ..measurement.oct.spectra import Spectra
from .thorlabs import LARGEST_UNPACKED, Container, DataFile, number_in


def volume_of(
    container: Container, file: DataFile, spacing: Any, depth_spacing: float | None, index_applied: float | None
) -> OctVolume:
    """Make a volume of an array of processed data."""
    if file.kind not in ("Real", "Complex"):
        raise MeasurementError(f"{file.stem} is of Type {file.kind!r}; a volume is Real or Complex.")
    values = container.array(file)
    applied = container.number("Acquisition/RefractiveIndex", 1.0) if index_applied is None else index_applied
    known = container.own
    wavelength = container.number("Instrument/CentralWavelength", 0.0)
    return OctVolume(
        values,
        _lateral(file, *file.shape[:2]) if spacing is None else spacing,
        _depth(file, applied) if depth_spacing is None else depth_spacing * applied,
        "complex" if file.kind == "Complex" else "db",
        origin=_pair("origin", known),
        depth_origin=number_in("Opfem depth_origin", known.get("depth_origin", "0")),
        wavelength=wavelength * 1e-6 if wavelength > 0 else None,
        phase_sign={"1": 1, "-1": -1}.get(known.get("phase_sign", "")),
        steps=(Step("read", index_applied=applied),),
    )


def spectra_of(container: Container, spacing: Any, depth_spacing: float | None, index_applied: float | None) -> Spectra:
    """Make spectra of the raw data, one array for each part of the scan.

    Lines and scans that repeat stay apart, until `Spectra.to_volume` has made depths of them.
    """
    files = [file for file in container.files if file.kind == "Raw" and file.stem.startswith("Spectral")]
    if not files:
        raise MeasurementError(f"holds no raw spectra; it holds {', '.join(file.stem for file in container.files)}.")
    files.sort(key=lambda file: (len(file.stem), file.stem))
    if len({(file.shape[1:], file.lines, file.width) for file in files}) > 1:
        raise MeasurementError("parts of the raw spectra differ in size.")
    pixels, first = files[0].shape[2], files[0]
    if len(files) > 1:
        # One for each B-scan: how far they reach is said of all together.
        whole = container.number("Image/SizeReal/SizeY", first.ranges[0] or 0.0)
        first = first._replace(ranges=(whole, *first.ranges[1:]))
    total = sum(math.prod(file.shape) for file in files)
    if 4 * total > LARGEST_UNPACKED:
        raise MeasurementError(
            f"the raw spectra take {4 * total / 2**30:.1f} GB, above 2 GB; export Complex or Intensity."
        )
    counts = np.concatenate([np.asarray(container.array(file), np.float32) for file in files])
    counts *= np.float32(container.number("Instrument/BinaryToElectronCountScaling", 1.0))
    offset = container.vector("OffsetErrors", pixels)
    offset = np.zeros(pixels) if offset is None else offset
    lines = first.lines or (0, 0, 0, first.shape[1])
    bounds = (0 <= lines[0] <= lines[1] <= first.shape[1]) and (0 <= lines[2] < lines[3] <= first.shape[1])
    if not bounds:
        raise MeasurementError(f"regions of apodisation and scan, {lines}, do not fit {first.shape[1]} lines.")
    reference = container.vector("ApodizationSpectrum", pixels)
    if lines[1] > lines[0]:
        reference = counts[:, lines[0] : lines[1]].mean(axis=(0, 1), dtype=float) - offset
    applied = container.number("Acquisition/RefractiveIndex", 1.0) if index_applied is None else index_applied
    chirp = container.vector("Chirp", pixels)
    columns, rows = lines[3] - lines[2], counts.shape[0]
    repeats = _repeats(container, first, rows, columns)
    own = container.own
    wavelength = container.number("Instrument/CentralWavelength", 0.0)
    return Spectra(
        counts[:, lines[2] : lines[3]],
        _lateral(first, rows // repeats[0], columns // repeats[1]) if spacing is None else spacing,
        2.0 * _depth(first, applied) if depth_spacing is None else depth_spacing * applied,
        reference=reference,
        offset=offset,
        chirp=chirp,
        origin=_pair("origin", own),
        wavelength=wavelength * 1e-6 if wavelength > 0 else None,
        dispersion=_pair("dispersion", own),
        is_ascending=False,  # Thorlabs' spectrometers and chirps run from short to long wavelength
        repeats=repeats,
        steps=(Step("read", index_applied=applied),),
    )


def _repeats(container: Container, file: DataFile, rows: int, columns: int) -> tuple[int, int]:
    """Count the B-scans and the A-lines that follow one another at each place."""

    def product(*tags: str) -> int:
        total = 1
        for tag in tags:
            value = container.number(f"Acquisition/{tag}", 1.0)
            if not 1 <= value < 1e6 or value != int(value):
                raise MeasurementError(f"{tag} must be a positive whole number, got {value:g}.")
            total *= int(value)
        return total

    lines = product("IntensityAveraging/AScans", "SpeckleAveraging/FastAxis")
    scans = product("IntensityAveraging/BScans", "SpeckleAveraging/SlowAxis")
    # A negative length says that all B-scans lie at one place.
    if (file.ranges[0] or 0.0) < 0:
        scans = rows
    for name, count, times in (("A-lines", columns, lines), ("B-scans", rows, scans)):
        if count % times:
            raise MeasurementError(f"{file.stem} has {count} {name}, which averaging over {times} does not divide.")
    return scans, lines


def _pair(name: str, known: dict[str, str]) -> tuple[float, ...]:
    return tuple(number_in(f"Opfem {name}", text) for text in known.get(name, "0 0").split())[:2]


def _lateral(file: DataFile, ny: int, columns: int) -> tuple[float, float]:
    """Compute the distance between places (dx, dy) [mm]."""
    range_y, range_x, _ = file.ranges
    if not range_x or range_x < 0:
        raise MeasurementError(f"{file.stem} states no RangeX; pass spacing=(dx, dy) [mm].")
    if ny == 1:
        return range_x / columns, range_x / columns
    if not range_y or range_y < 0:
        raise MeasurementError(
            f"{file.stem} has {ny} frames over RangeY = {range_y} mm: repeated B-scans, or a missing length; pass "
            "spacing=(dx, dy) [mm] if they lie side by side."
        )
    return range_x / columns, range_y / ny


def _depth(file: DataFile, applied: float) -> float:
    if not file.ranges[2] or file.ranges[2] < 0:
        raise MeasurementError(f"{file.stem} states no RangeZ; pass depth_spacing= [mm], as in air.")
    return file.ranges[2] / file.shape[2] * applied
