"""Array aliases, and the unit system of the whole package, stated once.

Units are consistent without factors: length mm, force N, stress MPa (N/mm²), time s, mass tonne
(density t/mm³; water is 1e-9). Only plots and printed summaries show kPa and µm. x runs along image
columns, y along image rows, z from the window to the sample; maps are indexed `[y, x]`.
"""

from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
"""One traceable number."""

ScalarLike = float | int | Float[Array, ""]
"""A number as a user writes it: Python or traced."""

Pair = Float[Array, "2"]
"""(x, y) of a length, a position or a spacing [mm]."""

Map = Float[Array, "ny nx"]
"""A field on the samples of a map, indexed [y, x]."""

Mask = Bool[Array, "ny nx"]
"""True where a map holds no data."""

Points = Float[Array, "*points"]
"""One coordinate, or one value, per point, in any arrangement."""
