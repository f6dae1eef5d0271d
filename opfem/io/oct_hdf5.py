"""Volumes and raw spectra in HDF5 as `write_oct` lays them out; MATLAB opens the same files.

One data set `values`, in chunks of one B-scan that lie one after another, so that they are read in place.
"""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..measurement import Step
from ..measurement.oct import OctVolume, Spectra
from .raw_volume import VECTORS, Stored

_VOLUME, _SPECTRA = "opfem oct 1", "opfem spectra 1"


def write_hdf5(volume: OctVolume | Spectra, path: Path) -> None:
    """Write a volume or spectra; complex numbers as MATLAB's {real, imag}."""
    values = volume.values
    is_complex = values.dtype.kind == "c"
    part = "<f8" if np.dtype(values.dtype).itemsize > (8 if is_complex else 4) else "<f4"
    kind = np.dtype([("real", part), ("imag", part)]) if is_complex else np.dtype(values.dtype)
    in_one_piece = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    in_one_piece.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    in_one_piece.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    # From this version on HDF5 stores checksums, which detect a damaged file.
    with h5py.File(path, "w", libver=("v108", "v110")) as file:
        data = file.create_dataset("values", values.shape, kind, chunks=(1, *values.shape[1:]), dcpl=in_one_piece)
        for row in range(values.shape[0]):
            block = np.ascontiguousarray(values[row])
            data[row] = block.view(kind) if is_complex else block
        data.attrs.update(_common(volume))
        if isinstance(volume, OctVolume):
            data.attrs.update(_of_volume(volume))
        else:
            data.attrs.update(_of_spectra(volume))
            for name in VECTORS:
                file[name] = np.asarray(getattr(volume, name))


def _common(volume: OctVolume | Spectra) -> dict[str, Any]:
    steps = [[s.name, {key: np.asarray(value).tolist() for key, value in s.numbers.items()}] for s in volume.steps]
    return {
        "spacing": np.asarray(volume.spacing),
        "origin": np.asarray(volume.origin),
        "optical_spacing": float(volume.optical_spacing),
        "wavelength": 0.0 if volume.wavelength is None else float(volume.wavelength),
        "steps": np.bytes_(json.dumps(steps)),
    }


def _of_volume(volume: OctVolume) -> dict[str, Any]:
    return {
        "format": np.bytes_(_VOLUME),
        "scale": np.bytes_(volume.scale),
        "depth_origin": float(volume.depth_origin),
        "phase_sign": volume.phase_sign or 0,
    }


def _of_spectra(spectra: Spectra) -> dict[str, Any]:
    return {
        "format": np.bytes_(_SPECTRA),
        "dispersion": np.asarray(spectra.dispersion),
        "is_ascending": int(spectra.is_ascending),
        "repeats": np.array(spectra.repeats),
    }


def own_volume(stored: Stored) -> OctVolume | None:
    """Read a volume of `write_hdf5`; None for other files."""
    known = stored.attributes
    if _text(known.get("format")) != _VOLUME:
        return None
    sign = int(known["phase_sign"])
    return OctVolume(
        stored.values,
        scale=_text(known["scale"]),  # pyright: ignore[reportArgumentType]
        depth_origin=float(known["depth_origin"]),
        phase_sign=sign or None,
        **_grid(known),
    )


def own_spectra(stored: Stored) -> Spectra | None:
    """Read spectra of `write_hdf5`; None for other files."""
    known = stored.attributes
    if _text(known.get("format")) != _SPECTRA:
        return None
    scans, lines = (int(count) for count in known["repeats"])
    return Spectra(
        stored.values,
        **{name: stored.vectors[name] for name in VECTORS},
        dispersion=known["dispersion"],
        is_ascending=bool(known["is_ascending"]),
        repeats=(scans, lines),
        **_grid(known),
    )


def _grid(known: dict[str, Any]) -> dict[str, Any]:
    wavelength = float(known["wavelength"])
    return {
        "spacing": known["spacing"],
        "origin": known["origin"],
        "optical_spacing": float(known["optical_spacing"]),
        "wavelength": wavelength if wavelength > 0 else None,
        "steps": tuple(Step(str(name), **numbers) for name, numbers in json.loads(_text(known["steps"]))),
    }


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
