"""Plausibility checks: numbers that suggest another unit, and a map that does not fit its layer.

They run on known numbers, before compilation. Impossible values raise an error, unlikely ones a warning.
"""

import warnings
from typing import Any

import numpy as np

from .._checks import concrete
from ..measurement import ThicknessMap

THINNEST, THICKEST = 0.02, 20.0
"""Range of the unloaded thickness [mm]."""
_MODULI = 1e-6, 1e3
"""Range of moduli and pressures [MPa]: 1 Pa to 1 GPa."""
_LONGEST_CLEARANCE = 1.0
"""Largest clearance of a contact law [mm]."""
# Loaded over unloaded thickness: least of an intact layer, possible with lift-off, impossible; and the share of the
# map's pixels on the layer that must be beyond.
_CRUSHED, _LIFTED, _ANOTHER_UNIT = 0.1, 1.2, 5.0
_RELEVANT = 0.05


def check_modulus_unit(field: str, value: Any) -> None:
    """Refuse a modulus or pressure [MPa] that looks like one in Pa."""
    known = concrete(value)
    if known is None:
        return
    size = float(np.max(np.abs(known)))
    low, high = _MODULI
    if np.isfinite(size) and not low <= size <= high:
        guess = "is it in Pa? Multiply by 1e-6." if size > high else "1 kPa is 1e-3 MPa."
        raise ValueError(f"{field} [MPa] must lie between {low:g} and {high:g} (1 Pa to 1 GPa), got {size:g}; {guess}")


def check_clearance_unit(field: str, value: Any) -> None:
    """Refuse a clearance of a contact law [mm] that looks like one in µm."""
    known = concrete(value)
    if known is not None and np.max(np.abs(known)) > _LONGEST_CLEARANCE:
        raise ValueError(
            f"{field} [mm] must be at most {_LONGEST_CLEARANCE:g}, got {np.max(np.abs(known)):g}; is it in µm? "
            "Multiply by 1e-3."
        )


def check_approach(approach: Any, height: Any) -> None:
    """Refuse an approach of the plate [mm] beyond what layer and sample can be pressed to.

    Args:
        approach: Of the plate.
        height: Between window and plate before [mm].
    """
    known, room = concrete(approach), concrete(height)
    if known is None or room is None or known.ndim or room.ndim or known <= (1.0 - _CRUSHED) * room:
        return
    raise ValueError(
        f"Compression.approach [mm] must be at most {1.0 - _CRUSHED:.0%} of the {room:.4g} mm between window and "
        f"plate, got {known:.4g}{': the plate would pass the window' if known >= room else ''}. Is it in mm?"
    )


def check_unloaded(thickness: Any, field: str = "Layer.thickness") -> None:
    """Refuse an unloaded thickness [mm], a number or a map, that looks like one in µm or m."""
    if isinstance(thickness, ThicknessMap):
        known = _known(thickness)
        values = None if known is None else known[0][~known[1]]
    else:
        values = concrete(thickness)
    if values is None:
        return
    low, high = _span(values)
    if high < THINNEST or low > THICKEST:
        guess = "m? Multiply by 1e3." if high < THINNEST else "µm? Multiply by 1e-3."
        raise ValueError(
            f"{field} [mm] must lie between {THINNEST:g} and {THICKEST:g}, got {_written(low, high)}; is it in {guess}"
        )


def check_against_layer(field: str, thickness: ThicknessMap, layer: Any, extent: Any, stacklevel: int) -> None:
    """Compare a loaded map with the unloaded thickness of its layer, where numbers are known.

    Warns where the sample has no contact, or more of the map lies above L0 than lift-off explains.

    Args:
        field: Name of the loaded map, for messages.
        thickness: The loaded map.
        layer: Unloaded thickness [mm], a number or a map.
        extent: Lx, Ly of the layer [mm].
        stacklevel: Frame that the warning names: 1 is this function, 2 its caller.

    Raises:
        ValueError: If map and layer are incompatible: most likely in different units.
    """
    pixels = _on_layer(thickness, layer, extent)
    if pixels is None or not pixels[0].size:
        return
    loaded, unloaded = pixels
    ratio = loaded / unloaded
    spans = f"{field} spans {_written(*_span(loaded))} mm on the layer, L0 {_written(*_span(unloaded))} mm"
    for beyond, far in ((ratio < _CRUSHED, f"below {_CRUSHED:g}"), (ratio > _ANOTHER_UNIT, f"above {_ANOTHER_UNIT:g}")):
        if np.mean(beyond) > _RELEVANT:
            raise ValueError(
                f"{spans}: {np.mean(beyond):.0%} of the pixels are {far} times L0. Are map and L0 in the same unit, "
                "and is L0 the unloaded thickness?"
            )
    if ratio.min() > 1.0:
        warnings.warn(
            f"{spans}: the map is thicker than L0 everywhere, so that the sample touches nowhere and every pressure is "
            "zero. Is L0 right, and in the same unit?",
            stacklevel=stacklevel,
        )
    elif np.mean(ratio > _LIFTED) > _RELEVANT:
        warnings.warn(
            f"{spans}: {np.mean(ratio > _LIFTED):.0%} of the pixels are above {_LIFTED:g} times L0, more than a sample "
            "lifts off. Is L0 right, or is something else measured there? Mask what is not the layer.",
            stacklevel=stacklevel,
        )


def _on_layer(thickness: ThicknessMap, layer: Any, extent: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the loaded thickness [mm] of measured pixels on the layer, and the unloaded one at the nearest sample."""
    loaded, reach = _known(thickness), concrete(extent)
    if loaded is None or reach is None:
        return None
    values, mask, x, y = loaded
    counted = ~mask & ((y >= 0) & (y <= reach[1]))[:, None] & ((x >= 0) & (x <= reach[0]))
    if not isinstance(layer, ThicknessMap):
        number = concrete(layer)
        return None if number is None or number.ndim else (values[counted], np.full(counted.sum(), number))
    unloaded = _known(layer)
    if unloaded is None:
        return None
    samples, missing, *grid = unloaded
    i, j = (
        np.clip(np.rint((at - own[0]) / (own[1] - own[0])), 0, own.size - 1).astype(int)
        for at, own in zip((x, y), grid, strict=True)
    )
    counted &= ~missing[j[:, None], i]
    return values[counted], samples[j[:, None], i][counted]


def _known(thickness: ThicknessMap) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return values, mask, x and y of one map of known numbers."""
    parts = (thickness.values, thickness.mask, thickness.origin, thickness.extent)
    values, mask, origin, sides = (concrete(part) for part in parts)
    if values is None or mask is None or origin is None or sides is None or values.ndim != 2:
        return None
    x, y = (origin[k] + sides[k] * np.linspace(0.0, 1.0, values.shape[1 - k]) for k in range(2))
    return values, mask, x, y


def _span(values: np.ndarray) -> tuple[float, float]:
    return float(np.min(values)), float(np.max(values))


def _written(low: float, high: float) -> str:
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
