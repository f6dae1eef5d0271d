"""OCT volumes from and to files: which reader a file needs is read from its first bytes, never from its name.

First step from the microscope: Thorlabs' containers know their own grid; of other files the caller states it.
"""

import json
import os
import zipfile
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ..measurement import MeasurementError, Step
from ..measurement.oct import OctVolume
from ..measurement.oct.lines import profile_lattice
from ..measurement.oct.spectra import Spectra
from ..measurement.oct.volume import SCALES, Scale
from .array_files import guarded
from .atomic import whole_file
from .raw_volume import Stored, ordered, read_hdf5, read_mat5, read_npy, read_raw, read_tiff
from .thorlabs import Container, spectra_of, volume_of

Quantity = Literal["auto", "intensity", "complex", "spectra"]

_FORMAT = "opfem oct 1"
_EXPORT = "export RAW, 32-bit TIFF or HDF5 from the program that wrote it"
_UNREADABLE = {
    ".img": "Thorlabs' old swept-source .IMG",
    ".frg": "Thorlabs' old swept-source .FRG",
    ".phs": "Thorlabs' old swept-source .PHS",
    ".srr": "Thorlabs' .srr",
    ".sdr": "Thorlabs' .sdr",
    ".opt": "Optopol's .OPT",
}


def read_oct(
    path: str | os.PathLike,
    *,
    quantity: Quantity = "auto",
    spacing: Any = None,
    depth_spacing: float | None = None,
    index_applied: float | None = None,
    shape: tuple[int, int, int] | None = None,
    order: str | None = None,
    dtype: Any = None,
    scale: Scale | None = None,
    variable: str | None = None,
    wavelength: float | None = None,
    phase_sign: int | None = None,
) -> OctVolume:
    """Read an OCT volume.

    Read are ThorImage's .oct and the folder it unpacks to, files of `write_oct`, TIFF stacks, HDF5 and MATLAB files,
    .npy, and raw numbers. Volumes that are not compressed stay in the file.

    Args:
        path: File, or folder that holds a Header.xml.
        quantity: What to take of a file that holds several; "auto" takes complex data, intensity or spectra, the first
            there is.
        spacing: (dx, dy) between A-lines [mm]; needed where the file does not state it.
        depth_spacing: Distance between samples in depth [mm], after division by `index_applied`; the same.
        index_applied: Refractive index that depths of the file were divided by; None takes the header's, or 1.
        shape: (ny, nx, nz) of raw numbers.
        order: Axes as stored, the fastest first, such as "zxy": for raw numbers, .npy, HDF5 and .mat (there as size()
            lists them); a TIFF stack has "xzy" (page y, row z) unless stated.
        dtype: Type of raw numbers; None is little-endian float32.
        scale: "db", "linear" or "complex"; needed where the file does not state it.
        variable: Name of the array, where a file holds several.
        wavelength: Central wavelength [mm], where the file does not state it.
        phase_sign: +1 where the phase grows with motion away from the window, -1 where it falls.

    Raises:
        MeasurementError: For anything wrong with the file or what is stated of it; names the path and the cause.
    """
    path = Path(path)
    own: dict[str, Any] = {"wavelength": wavelength, "phase_sign": phase_sign}

    def read() -> OctVolume:
        form = _form(path)
        if form == "thorlabs":
            volume = _thorlabs(Container(path), quantity, variable, spacing, depth_spacing, index_applied)
            return _restated(volume, scale, own)
        readers = {
            "hdf5": lambda: read_hdf5(path, variable),
            "mat": lambda: read_mat5(path, variable),
            "npy": lambda: read_npy(path),
            "tiff": lambda: read_tiff(path),
            "raw": lambda: read_raw(path, shape, order, dtype),
        }
        stored = readers[form]()
        if _text(stored.attributes.get("format")) == _FORMAT:
            return _restated(_own(stored), scale, own)
        values = ordered(stored.values, order if order or form != "tiff" else "xzy")
        return _stated(values, spacing, depth_spacing, index_applied, scale, own)

    volume = guarded(path, read)
    guarded(path, lambda: _check_content(volume))
    return volume


def read_spectra(
    path: str | os.PathLike,
    *,
    spacing: Any = None,
    depth_spacing: float | None = None,
    index_applied: float | None = None,
) -> Spectra:
    """Read the raw spectra of a Thorlabs file or folder; see `read_oct` for the arguments.

    Raises:
        MeasurementError: For anything wrong with the file; names the path and the cause.
    """
    path = Path(path)

    def read() -> Spectra:
        if _form(path) != "thorlabs":
            raise MeasurementError("raw spectra are read from Thorlabs' .oct; of others make op.Spectra of an array.")
        return spectra_of(Container(path), spacing, depth_spacing, index_applied)

    return guarded(path, read)


def write_oct(volume: OctVolume, path: str | os.PathLike) -> None:
    """Write a volume to .h5, or to Thorlabs' .oct, whole or not at all.

    Both keep grid, scale and wavelength; .h5 keeps the steps as well. A .oct file holds dB or complex numbers: linear
    power is written as dB.

    Args:
        volume: Volume to write; one that lies in a file is copied by B-scans.
        path: File to make or replace; must end in .h5 or .oct.

    Raises:
        ValueError: For another suffix.
    """
    path = Path(path)
    writers = {".h5": _write_hdf5, ".hdf5": _write_hdf5, ".oct": _write_ocity}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"write_oct writes .h5 or .oct, got {path}.")
    with whole_file(path) as temporary:
        writer(volume, temporary)


def _form(path: Path) -> str:
    """Tell the format from the first bytes."""
    if path.is_dir():
        return "thorlabs"
    if not path.is_file():
        raise MeasurementError("no such file.")
    if path.stat().st_size == 0:
        raise MeasurementError("the file is empty (0 bytes).")
    with open(path, "rb") as file:
        begin = file.read(2048)
    suffix = path.suffix.lower()
    if begin[:4] == b"PK\x03\x04":
        return "thorlabs"
    if h5py.is_hdf5(path):
        return "hdf5"
    if begin[:6] == b"\x93NUMPY":
        return "npy"
    if begin[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "tiff"
    if begin[:6] == b"MATLAB":
        return "mat"
    if begin[128:132] == b"DICM":
        raise MeasurementError(f"is DICOM, which opfem does not read; {_EXPORT}.")
    if b"FRAMEHEADER" in begin:
        raise MeasurementError("is Bioptigen's .OCT, not Thorlabs'; convert it with the package oct-converter.")
    if suffix in _UNREADABLE:
        raise MeasurementError(f"is {_UNREADABLE[suffix]}, which opfem does not read; {_EXPORT}.")
    if suffix == ".oct":
        hint = " (a .txt beside it: Optovue's?)" if path.with_suffix(".txt").exists() else ""
        raise MeasurementError(f"is not Thorlabs' .oct, which is a ZIP file{hint}; {_EXPORT}.")
    return "raw"


def _thorlabs(container: Container, quantity: str, variable, spacing, depth_spacing, index_applied) -> OctVolume:
    given = (spacing, depth_spacing, index_applied)
    if variable is not None:
        return volume_of(container, container.named(variable), *given)
    wanted = {"auto": ("complex", "intensity", "spectra")}.get(quantity, (quantity,))
    for name in wanted:
        if name == "spectra":
            if quantity == "auto" and not any(file.kind == "Raw" for file in container.files):
                break
            return spectra_of(container, *given).to_volume()
        kind, prefix = ("Complex", "Complex") if name == "complex" else ("Real", "Intensity")
        file = container.choose(prefix, kind)
        if file is not None:
            return volume_of(container, file, *given)
    listed = ", ".join(file.stem for file in container.files) or "nothing"
    raise MeasurementError(f"holds no {' or '.join(wanted)}; it holds {listed}.")


def _stated(values: np.ndarray, spacing, depth_spacing, index_applied, scale, own: dict[str, Any]) -> OctVolume:
    """Make a volume of an array by what the caller says of it."""
    if scale is None:
        raise MeasurementError(f"needs scale=, one of {', '.join(SCALES)}: {_guess(values)}.")
    if scale not in SCALES:
        raise MeasurementError(f"scale must be one of {', '.join(SCALES)}, got {scale!r}.")
    for name, value in (("spacing=(dx, dy) [mm]", spacing), ("depth_spacing= [mm], as in air", depth_spacing)):
        if value is None:
            raise MeasurementError(f"needs {name}: the file does not state it.")
    applied = 1.0 if index_applied is None else index_applied
    step = Step("read", index_applied=applied)
    return OctVolume(values, spacing, depth_spacing * applied, scale, steps=(step,), **own)


def _guess(values: np.ndarray) -> str:
    if values.dtype.kind == "c":
        return "values are complex"
    rows, columns = profile_lattice(values.shape)
    some = np.asarray(values[rows, columns], float)
    some = some[np.isfinite(some)]
    low, high = np.quantile(some, (0.001, 0.999)) if some.size else (0.0, 0.0)
    looks = "dB" if low < 0 or high < 200 else "linear power"
    return f"values span {low:.3g} to {high:.3g}, which looks like {looks}"


def _restated(volume: OctVolume, scale, own: dict[str, Any]) -> OctVolume:
    """Take what the caller says over what the file says."""
    said = {name: value for name, value in own.items() if value is not None}
    if scale is None and not said:
        return volume
    known: dict[str, Any] = {"wavelength": volume.wavelength, "phase_sign": volume.phase_sign} | said
    return OctVolume(
        volume.values, volume.spacing, volume.optical_spacing, scale or volume.scale, origin=volume.origin,
        depth_origin=volume.depth_origin, steps=volume.steps, **known,
    )  # fmt: skip


def _check_content(volume: OctVolume) -> None:
    """Refuse a volume that holds nothing, by a sample of its A-lines."""
    rows, columns = profile_lattice(volume.shape)
    some = np.asarray(volume.values[rows, columns])
    missing = ~np.isfinite(some)
    if missing.mean() > 0.5:
        raise MeasurementError(f"{missing.mean():.0%} of the samples are NaN or infinite.")
    known = some[~missing]
    if (known == known[0]).all():
        raise MeasurementError(f"all samples are {known[0]:g}; the volume is empty.")


def _own(stored: Stored) -> OctVolume:
    known = stored.attributes
    steps = json.loads(_text(known["steps"]))
    sign, wavelength = int(known["phase_sign"]), float(known["wavelength"])
    return OctVolume(
        stored.values,
        known["spacing"],
        float(known["optical_spacing"]),
        _text(known["scale"]),  # pyright: ignore[reportArgumentType]
        origin=known["origin"],
        depth_origin=float(known["depth_origin"]),
        wavelength=wavelength if wavelength > 0 else None,
        phase_sign=sign or None,
        steps=tuple(Step(str(name), **numbers) for name, numbers in steps),
    )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _write_hdf5(volume: OctVolume, path: Path) -> None:
    """Write one data set in one piece, so that it can be read in place; complex as MATLAB's {real, imag}."""
    values = volume.values
    is_complex = volume.scale == "complex"
    wide = np.dtype(values.dtype).itemsize > (8 if is_complex else 4)
    part = "<f8" if wide else "<f4"
    kind = np.dtype([("real", part), ("imag", part)]) if is_complex else np.dtype(values.dtype)
    steps = [[s.name, {key: np.asarray(value).tolist() for key, value in s.numbers.items()}] for s in volume.steps]
    # From this version on HDF5 keeps checksums, which tell a damaged file.
    with h5py.File(path, "w", libver=("v108", "v110")) as file:
        data = file.create_dataset("values", volume.shape, kind)
        for row in range(volume.shape[0]):
            block = np.ascontiguousarray(values[row])
            data[row] = block.view(kind) if is_complex else block
        data.attrs.update(
            {
                "format": np.bytes_(_FORMAT),
                "scale": np.bytes_(volume.scale),
                "spacing": np.asarray(volume.spacing),
                "origin": np.asarray(volume.origin),
                "optical_spacing": float(volume.optical_spacing),
                "depth_origin": float(volume.depth_origin),
                "wavelength": 0.0 if volume.wavelength is None else float(volume.wavelength),
                "phase_sign": volume.phase_sign or 0,
                "steps": np.bytes_(json.dumps(steps)),
            }
        )


def _write_ocity(volume: OctVolume, path: Path) -> None:
    """Write a ZIP file of uncompressed entries, as ThorImage does."""
    ny, nx, nz = volume.shape
    is_complex = volume.scale == "complex"
    name, kind, dtype = ("Complex", "Complex", "<c8") if is_complex else ("Intensity", "Real", "<f4")
    dx, dy = np.asarray(volume.spacing, float).tolist()
    dz = float(volume.optical_spacing)
    sizes = f'SizeZ="{nz}" SizeX="{nx}" SizeY="{ny}" RangeZ="{dz * nz!r}" RangeX="{dx * nx!r}" RangeY="{dy * ny!r}"'
    nanometres = 0.0 if volume.wavelength is None else 1e6 * float(volume.wavelength)
    x, y = np.asarray(volume.origin, float).tolist()
    own = f'origin="{x!r} {y!r}" depth_origin="{float(volume.depth_origin)!r}" phase_sign="{volume.phase_sign}"'
    header = (
        f'<?xml version="1.0" encoding="utf-8"?>\n<Ocity version="1.0"><DataFiles><DataFile Type="{kind}" {sizes} '
        f'BytesPerPixel="{np.dtype(dtype).itemsize}">data\\{name}.data</DataFile></DataFiles>'
        f'<Image Type="Processed"><SizePixel Unit="px"><SizeZ>{nz}</SizeZ><SizeX>{nx}</SizeX><SizeY>{ny}</SizeY>'
        "</SizePixel>"
        f'<SizeReal Unit="mm"><SizeZ>{dz * nz!r}</SizeZ><SizeX>{dx * nx!r}</SizeX><SizeY>{dy * ny!r}</SizeY></SizeReal>'
        "<AxisOrder>ZXYT</AxisOrder></Image><Acquisition><RefractiveIndex>1.000000</RefractiveIndex></Acquisition>"
        f"<Instrument><CentralWavelength>{nanometres!r}</CentralWavelength></Instrument>"
        f"<MetaInfo><AcquisitionMode>Mode3D</AcquisitionMode><Opfem {own}/></MetaInfo></Ocity>\n"
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("Header.xml", header)
        with archive.open(zipfile.ZipInfo(f"data\\{name}.data"), "w", force_zip64=True) as entry:
            for row in range(ny):
                block = np.asarray(volume.values[row])
                if volume.scale == "linear":
                    block = 10.0 * np.log10(np.maximum(block, 1e-30))
                entry.write(np.ascontiguousarray(block, dtype).data)
