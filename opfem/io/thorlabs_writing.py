"""Volumes and raw spectra as the OCITY containers that ThorImage reads: a ZIP file of uncompressed arrays.

Fields that OCITY lacks (origin, sign of the phase, dispersion) are in a separate element under MetaInfo.
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..measurement.oct import OctVolume, Spectra

_LINES = 25  # apodisation lines before each B-scan of spectra


def write_ocity(volume: OctVolume | Spectra, path: Path) -> None:
    """Write a volume or spectra."""
    if isinstance(volume, OctVolume):
        _write_volume(volume, path)
    else:
        _write_spectra(volume if not volume.is_ascending else _turned(volume), path)


def _write_volume(volume: OctVolume, path: Path) -> None:
    ny, nx, nz = volume.shape
    name, kind, dtype = ("Complex", "Complex", "<c8") if volume.scale == "complex" else ("Intensity", "Real", "<f4")
    dx, dy = np.asarray(volume.spacing, float).tolist()
    ranges = (float(volume.optical_spacing) * nz, dx * nx, dy * ny)
    entry = _entry(name, kind, (nz, nx, ny), ranges, np.dtype(dtype).itemsize)
    own = f'depth_origin="{float(volume.depth_origin)!r}" phase_sign="{volume.phase_sign}"'

    def rows() -> Iterator[bytes]:
        for row in range(ny):
            block = np.asarray(volume.values[row])
            if volume.scale == "linear":
                block = 10.0 * np.log10(np.maximum(block, 1e-30))
            yield np.ascontiguousarray(block, dtype).tobytes()

    header = _header(volume, "Processed", [entry], (nz, nx, ny), ranges, own)
    _write(path, header, {name: rows()})


def _write_spectra(spectra: Spectra, path: Path) -> None:
    ny, nx, pixels = spectra.values.shape
    scans, lines = spectra.repeats
    dx, dy = np.asarray(spectra.spacing, float).tolist()
    offset, reference, chirp = (np.asarray(getattr(spectra, name)) for name in ("offset", "reference", "chirp"))
    ranges = (0.5 * float(spectra.optical_spacing) * pixels, dx * nx / lines, dy * ny / scans)
    # Rounded up ever more often from line to line, so that their mean is the reference.
    part = (np.arange(_LINES)[:, None] + 0.5) / _LINES
    dark = np.floor(reference + offset + part)
    # Of 16 bits, as cameras have; electrons may need more.
    lowest, highest = float(min(np.min(spectra.values), dark.min())), float(max(np.max(spectra.values), dark.max()))
    dtype, is_signed = ("<u2", False) if lowest >= 0 and highest < 2**16 else ("<i4", True)
    if max(-lowest, highest) >= 2**31:
        raise ValueError(f"write_oct: counts of spectra must be below 2^31, got {highest:g}; write .h5.")
    regions = (
        f' ApoRegionStart0="0" ApoRegionEnd0="{_LINES}" ScanRegionStart0="{_LINES}" ScanRegionEnd0="{_LINES + nx}"'
    )
    entries = [_entry("Spectral0", "Raw", (pixels, nx + _LINES, ny), ranges, np.dtype(dtype).itemsize, regions)]
    entries += [
        f'<DataFile Type="Real" SizeZ="{pixels}" BytesPerPixel="4">data\\{name}.data</DataFile>'
        for name in ("Chirp", "OffsetErrors")
    ]
    second, third = np.asarray(spectra.dispersion, float).tolist()

    def rows() -> Iterator[bytes]:
        for row in range(ny):
            counts = np.concatenate([dark, np.rint(np.asarray(spectra.values[row], float))])
            yield counts.astype(dtype).tobytes()

    header = _header(
        spectra, "RawSpectra", entries, (pixels // 2, nx // lines, ny // scans), ranges,
        f'dispersion="{second!r} {third!r}"', spectra.repeats, is_signed,
    )  # fmt: skip
    vectors = {"Chirp": chirp, "OffsetErrors": offset}
    contents = {name: iter([values.astype("<f4").tobytes()]) for name, values in vectors.items()}
    _write(path, header, {"Spectral0": rows(), **contents})


def _turned(spectra: Spectra) -> Spectra:
    """Turn spectra round, so that they run from short to long wavelength."""
    last = spectra.shape[2] - 1
    return Spectra(
        spectra.values[..., ::-1],
        spectra.spacing,
        spectra.optical_spacing,
        reference=spectra.reference[::-1],
        offset=spectra.offset[::-1],
        chirp=last - spectra.chirp[::-1],
        origin=spectra.origin,
        wavelength=spectra.wavelength,
        dispersion=spectra.dispersion * np.array([-1.0, 1.0]),
        repeats=spectra.repeats,
        steps=spectra.steps,
    )


def _entry(name: str, kind: str, sizes, ranges, width: int, more: str = "") -> str:
    """Describe an array in the header; sizes and ranges [mm] along z, x and y."""
    said = [f'Size{axis}="{size}"' for axis, size in zip("ZXY", sizes, strict=True)]
    said += [f'Range{axis}="{length!r}"' for axis, length in zip("ZXY", ranges, strict=True)]
    return f'<DataFile Type="{kind}" {" ".join(said)} BytesPerPixel="{width}"{more}>data\\{name}.data</DataFile>'


def _header(
    volume: OctVolume | Spectra,
    kind: str,
    entries: list[str],
    sizes: tuple[int, int, int],
    ranges: tuple[float, float, float],
    own: str,
    repeats: tuple[int, int] = (1, 1),
    is_signed: bool = False,
) -> str:
    def along(values: Any) -> str:
        return "".join(f"<Size{axis}>{value!r}</Size{axis}>" for axis, value in zip("ZXY", values, strict=True))

    nanometres = 0.0 if volume.wavelength is None else 1e6 * float(volume.wavelength)
    x, y = np.asarray(volume.origin, float).tolist()
    scans, lines = repeats
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<Ocity version="1.0"><DataFiles>{"".join(entries)}</DataFiles>'
        f'<Image Type="{kind}"><SizePixel Unit="px">{along(sizes)}</SizePixel>'
        f'<SizeReal Unit="mm">{along(ranges)}</SizeReal><AxisOrder>ZXYT</AxisOrder></Image>'
        f"<Acquisition><IntensityAveraging><AScans>{lines}</AScans><BScans>{scans}</BScans></IntensityAveraging>"
        "<RefractiveIndex>1.000000</RefractiveIndex></Acquisition>"
        f"<Instrument><RawDataIsSigned>{is_signed}</RawDataIsSigned>"
        f"<CentralWavelength>{nanometres!r}</CentralWavelength></Instrument>"
        f'<MetaInfo><AcquisitionMode>Mode3D</AcquisitionMode><Opfem origin="{x!r} {y!r}" {own}/></MetaInfo></Ocity>\n'
    )


def _write(path: Path, header: str, contents: dict[str, Iterator[bytes]]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("Header.xml", header)
        for name, blocks in contents.items():
            with archive.open(zipfile.ZipInfo(f"data\\{name}.data"), "w", force_zip64=True) as entry:
                for block in blocks:
                    entry.write(block)
