"""Checks of the arguments of a `ThicknessMap`; each raises a `ValueError` that names the next step.

Only concrete numbers can be checked: inside jit, grad and vmap the checks of values do nothing,
those of shapes still apply. `piles` and `off_square` are for readers: their findings may be intended.
"""

from typing import Any, NamedTuple

import numpy as np

from .._checks import concrete

THINNEST = 1e-3
THICKEST = 50.0
"""Range [mm] that the thickest pixel of a plausible map lies in; outside it the unit is in doubt."""

_FULL_SCALE = (255, 1023, 4095, 16383, 65535, 2**31 - 1, 2**32 - 1)  # largest numbers of 8 to 32 bits
_FEWEST_OTHERS = 4  # distinct numbers that make a range to compare with
_FEWEST_ALIKE = 4  # pixels that share a number by more than chance
_APART = 0.25  # of the range of the others; one step of a map in whole µm is below 0.1
_TOO_OFTEN = 10  # times the number of pixels that share any other number


def check_map_shape(values: Any) -> None:
    """Raise ValueError unless values are a 2-D array of at least 2 by 2 samples."""
    if values.ndim != 2:
        raise ValueError(
            f"ThicknessMap.values [mm] must be 2-D (ny, nx), got shape {values.shape}; "
            "pass one map, or use jax.vmap for many."
        )
    if min(values.shape) < 2:
        raise ValueError(
            f"ThicknessMap.values [mm] must have at least 2 by 2 samples (ny, nx), got shape {values.shape}."
        )


def check_mask(mask: Any, shape: tuple[int, ...]) -> None:
    """Refuse a mask that is not bool, has not the map's shape, or leaves no data."""
    if mask.dtype != bool or mask.shape != shape:
        raise ValueError(
            f"ThicknessMap.mask must be bool of shape {shape} (ny, nx), got {mask.dtype} of shape {mask.shape}; "
            "True means not data."
        )
    known = concrete(mask)
    if known is not None and known.all():
        raise ValueError("ThicknessMap.mask must leave data, got True in every pixel; True means not data.")


def _pixels(bad: np.ndarray) -> str:
    j, i = np.argwhere(bad)[0]
    return f"{int(bad.sum())} of {bad.size} pixels, first at [y={j}, x={i}]"


def check_thickness(values: Any, mask: Any) -> None:
    """Refuse thickness [mm] that is not finite, not positive, or evidently in another unit."""
    thickness, masked = concrete(values), concrete(mask)
    if thickness is None:
        return
    finite = np.isfinite(thickness)
    if not finite.all():
        raise ValueError(
            f"ThicknessMap.values [mm] must be finite, got NaN or infinity in {_pixels(~finite)}; "
            "read files with read_thickness, which masks them, or put any positive number there and pass mask=."
        )
    if masked is None:
        return
    low = (thickness <= 0) & ~masked
    if low.any():
        raise ValueError(
            f"ThicknessMap.values [mm] must be positive, got {thickness[low][0]:g} in {_pixels(low)}; "
            "mask what is not data: mask= here, missing= in read_thickness."
        )
    doubt = doubtful_unit(thickness[~masked])
    if doubt:
        span, unit, factor = doubt
        raise ValueError(f"{span}; is it in {unit}? Multiply by {factor:g}.")


def doubtful_unit(thickness: np.ndarray) -> tuple[str, str, float] | None:
    """Guess the unit of a map that cannot be in mm.

    Args:
        thickness: Thickness that should be in mm, without masked pixels.

    Returns:
        None for a plausible range; else the range, the guessed unit, and its size [mm].
    """
    low, high = float(thickness.min()), float(thickness.max())
    if THINNEST <= high <= THICKEST:
        return None
    span = f"Thickness map spans {low:g} to {high:g} mm"
    if high < THINNEST:
        return span, "metres", 1e3
    whole = bool(np.all(thickness == np.round(thickness)))
    return span, "µm or pixels" if whole else "µm", 1e-3


def check_grid(extent: Any, origin: Any) -> None:
    """Refuse an extent [mm] that is not positive, and an origin [mm] that is not finite."""
    Lx_Ly, start = concrete(extent), concrete(origin)
    if Lx_Ly is not None and not (np.isfinite(Lx_Ly) & (Lx_Ly > 0)).all():
        raise ValueError(
            f"ThicknessMap.extent (Lx, Ly) [mm] must be positive, got {tuple(Lx_Ly.tolist())}; "
            "it is the distance from the first to the last sample (spacing times samples less one)."
        )
    if start is not None and not np.isfinite(start).all():
        raise ValueError(f"ThicknessMap.origin (x, y) [mm] must be finite, got {tuple(start.tolist())}.")


def check_std(std: Any, mask: Any, shape: tuple[int, ...]) -> None:
    """Refuse a noise std [mm] that is neither one number nor a map, or not positive and finite."""
    if std.shape not in ((), shape):
        raise ValueError(f"ThicknessMap.std [mm] must be one number or have shape {shape} (ny, nx), got {std.shape}.")
    known, masked = concrete(std), concrete(mask)
    if known is None or masked is None:
        return
    known = np.broadcast_to(known, shape)
    bad = ~(np.isfinite(known) & (known > 0)) & ~masked
    if bad.any():
        raise ValueError(
            f"ThicknessMap.std [mm] must be positive and finite, got {known[bad][0]:g} in {_pixels(bad)}; "
            "leave std=None where the noise is not known."
        )


class Pile(NamedTuple):
    """Pixels at the edge of a map's range with one common value.

    Attributes:
        value: The number.
        count: Number of these pixels.
        low: Lowest of the other numbers.
        high: Highest of them.
        suspicion: The anomaly, as in "far from the others".
        is_refused: Whether it cannot be thickness.
    """

    value: float
    count: int
    low: float
    high: float
    suspicion: str
    is_refused: bool


def piles(numbers: np.ndarray) -> list[Pile]:
    """Find numbers at either end of a map's range that look like a mark for missing pixels, or saturated.

    Args:
        numbers: The map's numbers in any unit, without missing pixels.
    """
    values, counts = np.unique(numbers, return_counts=True)
    if values.size <= _FEWEST_OTHERS:
        return []
    found = (_pile(values, counts, 0), _pile(values, counts, values.size - 1))
    return [pile for pile in found if pile is not None]


def _pile(values: np.ndarray, counts: np.ndarray, end: int) -> Pile | None:
    others, times = np.delete(values, end).astype(float), np.delete(counts, end)
    value, count, total = float(values[end]), int(counts[end]), int(counts.sum())
    low, high = float(others[0]), float(others[-1])
    gap = max(low - value, value - high)

    def made(suspicion: str, is_refused: bool = False) -> Pile:
        return Pile(value, count, low, high, suspicion, is_refused)

    if gap > high - low and not low / 2 <= value <= 2 * high:
        return made("far from", is_refused=count > 1)
    if count > 1 and value in _FULL_SCALE and end:
        return made("a full scale beyond")
    if _FEWEST_ALIKE <= count <= total / 2:
        if gap > _APART * (high - low):
            return made("apart from")
        if count > _TOO_OFTEN * times.max():
            return made("far more often than any of")
    return None


def off_square(extent: tuple[float, float], shape: tuple[int, ...]) -> float:
    """Count the rows that a map of (Lx, Ly) has too many, if its pixels are square."""
    ny, nx = shape
    return ny - 1 - extent[1] * (nx - 1) / extent[0]
