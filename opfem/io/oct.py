"""OCT volumes from and to files: which reader a file needs is read from its first bytes, never from its name.

First step from the microscope: Thorlabs' containers know their own grid; of other files the caller states it.
"""

import os
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ..measurement import MeasurementError, Step
from ..measurement.oct import OctVolume, Spectra
from ..measurement.oct.lines import profile_lattice
from ..measurement.oct.volume import SCALES, Scale
from .array_files import guarded
from .atomic import whole_file
from .oct_hdf5 import own_spectra, own_volume, write_hdf5
from .raw_volume import ordered, read_hdf5, read_mat5, read_npy, read_raw, read_tiff
from .thorlabs import Container
from .thorlabs_arrays import spectra_of, volume_of
from .thorlabs_writing import write_ocity

Quantity = Literal["auto", "intensity", "complex", "spectra"]

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

    Read are ThorImage's .oct and the folder it unpacks to, files of `write_oct`, TIFF stacks (those of myOCT are
    decoded; depth counts from their first row), HDF5 and MATLAB files, .npy, and raw numbers. Volumes that are not
    compressed stay in the file. Raw spectra are transformed; repeated A-lines and B-scans become their mean power.

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
        found = own_volume(stored) or own_spectra(stored)
        if found is not None:
            return _restated(found if isinstance(found, OctVolume) else found.to_volume(), scale, own)
        values = ordered(stored.values, order if order or form != "tiff" else "xzy")
        if "dz" in stored.attributes:
            return _of_myoct(values, stored.attributes, spacing, depth_spacing, index_applied, own)
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
    """Read raw spectra of a Thorlabs file or folder, or of a .h5 of `write_oct`; see `read_oct` for the arguments.

    Raises:
        MeasurementError: For anything wrong with the file; names the path and the cause.
    """
    path = Path(path)

    def read() -> Spectra:
        form = _form(path)
        if form == "thorlabs":
            return spectra_of(Container(path), spacing, depth_spacing, index_applied)
        spectra = own_spectra(read_hdf5(path, None)) if form == "hdf5" else None
        if spectra is None:
            raise MeasurementError(
                "raw spectra are read from Thorlabs' .oct and .h5 of write_oct; of others make op.Spectra of an array."
            )
        return spectra

    return guarded(path, read)


def write_oct(volume: OctVolume | Spectra, path: str | os.PathLike) -> None:
    """Write a volume, or raw spectra, to .h5 or to Thorlabs' .oct, whole or not at all.

    Both keep grid, scale and wavelength; .h5 keeps the steps as well. A .oct file holds dB or complex numbers: linear
    power is written as dB. Of spectra it holds whole counts, from short to long wavelength, after apodisation lines of
    the reference.

    Args:
        volume: Volume or spectra to write; what lies in a file is copied by B-scans.
        path: File to make or replace; must end in .h5 or .oct.

    Raises:
        ValueError: For another suffix.
    """
    path = Path(path)
    writers = {".h5": write_hdf5, ".hdf5": write_hdf5, ".oct": write_ocity}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"write_oct writes .h5 or .oct, got {path}.")
    with whole_file(path) as temporary:
        writer(volume, temporary)


def _form(path: Path) -> str:
    """Detect the format by the first bytes."""
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
    """Make a volume of an array with the caller's description."""
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


def _of_myoct(values: np.ndarray, known: dict[str, Any], spacing, depth_spacing, index_applied, own) -> OctVolume:
    """Make a volume in dB with myOCT's grid, unless the caller states one."""
    if spacing is None and None not in (known["dx"], known["dy"]):
        spacing = (known["dx"], known["dy"])
    if depth_spacing is None and known["dz"] is not None:
        if index_applied is None:
            raise MeasurementError(
                "needs index_applied=: myOCT does not state the refractive index it divided depth by."
            )
        depth_spacing = known["dz"]
    return _stated(values, spacing, depth_spacing, index_applied, "db", own)


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
    """Prefer the caller's values to those of the file."""
    said = {name: value for name, value in own.items() if value is not None}
    if scale is None and not said:
        return volume
    known: dict[str, Any] = {"wavelength": volume.wavelength, "phase_sign": volume.phase_sign} | said
    return OctVolume(
        volume.values, volume.spacing, volume.optical_spacing, scale or volume.scale, origin=volume.origin,
        depth_origin=volume.depth_origin, steps=volume.steps, **known,
    )  # fmt: skip


def _check_content(volume: OctVolume) -> None:
    """Refuse an empty volume, by a sample of its A-lines."""
    rows, columns = profile_lattice(volume.shape)
    some = np.asarray(volume.values[rows, columns])
    missing = ~np.isfinite(some)
    if missing.mean() > 0.5:
        raise MeasurementError(f"{missing.mean():.0%} of the samples are NaN or infinite.")
    known = some[~missing]
    if (known == known[0]).all():
        raise MeasurementError(f"all samples are {known[0]:g}; the volume is empty.")
