"""Checks of what a user hands to a `ThicknessMap`; each raises a `ValueError` that names the next step.

Only concrete numbers can be checked: inside jit, grad and vmap the checks of values do nothing,
those of shapes still hold.
"""

from typing import Any

import numpy as np

from .._checks import concrete

THINNEST = 1e-3
THICKEST = 50.0
"""Range [mm] that the thickest pixel of a plausible map lies in; outside it the unit is in doubt."""


def check_map_shape(values: Any) -> None:
    """Refuse what is not a 2-D array of at least 2 by 2 samples."""
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
            "mask what is not data: mask= here, NaN in a file."
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
        None when the range is plausible; else what the map spans, the guessed unit, and its size [mm].
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
