"""The noise of a measured map, as a fit needs it."""

import numpy as np
from jaxtyping import Array

from .._checks import concrete
from ..measurement import ThicknessMap


def noise_std(caller: str, thickness: ThicknessMap) -> Array:
    """Take the standard deviation of a map's noise [mm].

    Raises:
        ValueError: If it is missing or zero: a fit weighs the map against the prior by it.
    """
    if not isinstance(thickness, ThicknessMap):
        raise ValueError(f"{caller} needs a ThicknessMap, got {type(thickness).__name__}.")
    if thickness.std is None:
        raise ValueError(
            f"{caller} needs the standard deviation of the map's noise, thickness.std [mm], got None. "
            "Measure it on a flat target or between repeated scans, and pass read_thickness(..., std=0.002)."
        )
    std, mask = concrete(thickness.std), concrete(thickness.mask)
    if std is not None and mask is not None:
        used = np.broadcast_to(std, thickness.shape)[~mask]
        if not (used > 0).all():
            raise ValueError(
                f"{caller}: thickness.std [mm] must be positive where pixels are data, got {used.min():g}. "
                "A pixel without noise would outweigh all others; pass what repeated scans differ by."
            )
    return thickness.std
