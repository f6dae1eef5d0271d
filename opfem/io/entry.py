"""One array of a file in a listing: its kind, and how to load it. Every format's reader makes them.

Listing reads no numbers: a neighbour that is huge, damaged or no array costs nothing and spoils nothing.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..measurement import MeasurementError

MAX_BYTES = 2**29
"""Default limit of the size of an array: 8000 by 8000 pixels in float64, above any OCT system's map."""


class Reading(NamedTuple):
    """Arguments of a reader, and its remarks.

    Attributes:
        path: The file.
        max_bytes: Largest array to load.
        extent: (Lx, Ly) of the map [mm], where known: it settles what text leaves open.
        spacing: (dx, dy) of the map [mm], where that is known instead.
        notes: Remarks for the user; filled by readers.
    """

    path: Path
    max_bytes: int
    extent: tuple[float, float] | None
    spacing: tuple[float, float] | None
    notes: list[str]


class Entry(NamedTuple):
    """One array of a file.

    Attributes:
        kind: "numbers", or a description of other contents.
        shape: Its shape, as the writing program shows it.
        load: Read it.
        fields: Lists the fields of a struct; None for other arrays.
        spacing: (dx, dy) between samples [mm], where the file states it.
    """

    kind: str
    shape: tuple[int, ...]
    load: Callable[[], np.ndarray]
    fields: Callable[[], dict[str, "Entry"]] | None = None
    spacing: tuple[float, float] | None = None


def other(kind: str, shape: tuple[int, ...] = (), fields: Callable[[], dict[str, Entry]] | None = None) -> Entry:
    """Make an entry that cannot be loaded as numbers; `kind` describes it."""

    def load() -> np.ndarray:
        raise MeasurementError(f"holds {kind}, no numbers.")

    return Entry(kind, shape, load, fields)


def damaged(cause: Exception) -> Entry:
    """List an entry that a library could not read."""
    return other(f"damaged ({type(cause).__name__}: {' '.join(str(cause).split())})")


def kind_of(dtype: np.dtype) -> str:
    """Describe the contents of an array of a type."""
    words = {"f": "numbers", "i": "numbers", "u": "numbers", "c": "complex numbers", "U": "text", "S": "text"}
    words |= {"b": "true/false values", "O": "a cell array or objects", "V": "a struct"}
    return words.get(dtype.kind, f"of type {dtype}")


def check_size(shape: tuple[int, ...], item: int, max_bytes: int) -> None:
    """Refuse an array that would take more than `max_bytes` once loaded.

    Raises:
        MeasurementError: Names both sizes.
    """
    size = math.prod(shape) * item
    if size > max_bytes:
        raise MeasurementError(
            f"an array of shape {shape} takes {size / 1e6:.0f} MB once loaded, above max_bytes={max_bytes}; "
            "pass a larger max_bytes= if the file is meant to hold so much."
        )
