"""Stiffening of a cylinder between bonded platens over lubricated ones, at small strain."""

import math

import numpy as np

# Apparent over true Young's modulus of a bonded disc: rows by Poisson's ratio, columns by radius/(2 height).
# Own reference solutions by finite elements, 4 digits; below the first slenderness the excess grows with its square.
_POISSON = (0.4754, 0.49, 0.499, 0.49999)
_SLENDERNESS = (0.5, 1.0, 2.5, 5.0, 10.0)
_FACTOR = (
    (1.448, 2.301, 4.421, 5.709, 6.444),
    (1.503, 2.634, 7.022, 11.19, 13.97),
    (1.540, 2.918, 12.04, 36.21, 79.04),
    (1.545, 2.955, 13.15, 49.96, 196.0),
)


def bonded_factor(diameter: float, height: float, bulk: float | None) -> float:
    """Compute the apparent over the true Young's modulus of a cylinder bonded to both platens [-].

    Args:
        diameter: Of the specimen [mm].
        height: Of the specimen [mm].
        bulk: Bulk over shear modulus [-]; None: incompressible.

    Raises:
        ValueError: For a disc flatter, or more compressible, than those of the table.
    """
    slenderness = 0.25 * diameter / height
    poisson = _POISSON[-1] if bulk is None else (3.0 * bulk - 2.0) / (6.0 * bulk + 2.0)
    if slenderness > _SLENDERNESS[-1] or poisson < _POISSON[0] - 1e-3:
        raise ValueError(
            f"calibrate: bonded platens are corrected for up to diameter/height = {4 * _SLENDERNESS[-1]:g} and for a "
            f"bulk modulus of 20 shear moduli and more, got {diameter / height:.3g} and {bulk}. Lubricate the platens."
        )
    # Straight lines in logarithms: of the excess over 1 by slenderness, and by 1 - 2 poisson.
    excess = np.log(np.array(_FACTOR) - 1.0)
    place = math.log(max(slenderness, _SLENDERNESS[0]))
    by_poisson = [float(np.interp(place, np.log(_SLENDERNESS), row)) for row in excess]
    compressibility = [math.log(1.0 - 2.0 * ratio) for ratio in _POISSON]
    own = math.log(max(1.0 - 2.0 * poisson, math.exp(compressibility[-1])))
    at = float(np.interp(own, compressibility[::-1], by_poisson[::-1]))
    return 1.0 + math.exp(at) * min(slenderness / _SLENDERNESS[0], 1.0) ** 2
