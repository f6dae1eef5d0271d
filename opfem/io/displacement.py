"""Axial displacement volumes in .npz files, as `opfem oct --phase` writes them."""

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..measurement import MeasurementError
from ..measurement.oct import DisplacementVolume
from .atomic import write_whole

_NUMBERS = ("spacing", "origin", "scale_std", "noise_length", "axial_noise")
_FIELDS = ("values", "std", "coherence", "mask", "depth", *_NUMBERS)


def displacement_bytes(volume: DisplacementVolume) -> bytes:
    """Encode a volume as .npz; its processing steps are not kept."""
    buffer = io.BytesIO()
    fields = {name: np.asarray(getattr(volume, name)) for name in _FIELDS}
    np.savez_compressed(buffer, **fields)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def write_displacement(volume: DisplacementVolume, path: str | os.PathLike) -> None:
    """Write a displacement volume as .npz, whole or not at all.

    Args:
        volume: What was measured.
        path: The file.
    """
    write_whole(Path(path), displacement_bytes(volume))


def read_displacement(path: str | os.PathLike) -> DisplacementVolume:
    """Read a displacement volume that opfem wrote.

    Args:
        path: The file, .npz.

    Raises:
        MeasurementError: If it cannot be read, or is no displacement volume.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as stored:
            fields: dict[str, Any] = {name: stored[name] for name in _FIELDS if name in stored}
    except FileNotFoundError:
        raise MeasurementError(f"Cannot read {path}: there is no such file.") from None
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile, MemoryError) as cause:
        raise MeasurementError(f"Cannot read {path} as .npz: it is damaged or of another kind ({cause}).") from cause
    missing = [name for name in _FIELDS if name not in fields]
    if missing:
        raise MeasurementError(f"{path} is no displacement volume of opfem oct --phase: it lacks {', '.join(missing)}.")
    shape = fields["values"].shape
    if len(shape) != 3 or fields["depth"].shape != shape[2:]:
        raise MeasurementError(
            f"{path} is no displacement volume: values must be [y, x, z] with as many depths, got shapes {shape} and "
            f"{fields['depth'].shape}."
        )
    fields |= {name: jnp.asarray(fields[name]) for name in _NUMBERS}
    return DisplacementVolume(**fields, steps=())
