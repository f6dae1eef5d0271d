"""Material laws whose numbers vary from point to point: one law of the most general kind for several laws.

A kind that is a special case of another is written as the other: neo-Hooke as Mooney–Rivlin with c01 = 0.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .material import AbstractMaterial, MooneyRivlin, NeoHooke, Yeoh
from .stretch_material import Ogden

_WIDER: dict[type, dict[type, Callable]] = {
    NeoHooke: {
        MooneyRivlin: lambda law: MooneyRivlin(law.c10, jnp.zeros_like(law.c10), law.bulk),
        Yeoh: lambda law: Yeoh(law.c10, jnp.zeros_like(law.c10), jnp.zeros_like(law.c10), law.bulk),
    }
}
"""Conversion of a law of one kind to another kind, of which the former is a special case."""


def numbers_of(law: AbstractMaterial) -> dict[str, Array]:
    """Return the numbers of a law by name [MPa]."""
    return {name: getattr(law, name) for name in law.__dataclass_fields__ if name != "calibrated"}


def points_of(law: AbstractMaterial) -> tuple[int, ...]:
    """Return the shape of the points that a law's numbers are given for; () where they are the same everywhere."""
    if isinstance(law, Ogden):
        return ()  # its arrays are terms
    return np.broadcast_shapes(*(np.shape(value) for value in numbers_of(law).values()))


def combined(
    law: AbstractMaterial, inclusions: Sequence[tuple[Bool[Array, "*points"], AbstractMaterial]], shape: tuple[int, ...]
) -> AbstractMaterial:
    """Build one law that is another one in parts of its points; the last of these wins.

    Args:
        law: Law outside of the parts.
        inclusions: Points of each part, and its law.
        shape: Of the points.

    Returns:
        A law with numbers of this shape; the given one without parts and if it is uniform.

    Raises:
        ValueError: If the laws are of kinds that none of them includes, or vary and have several terms (`Ogden`).
    """
    if not inclusions and points_of(law) == ():
        return law
    laws = widened([law, *(other for _, other in inclusions)])
    values = [numbers_of(one) for one in laws]
    merged = {name: jnp.broadcast_to(value, shape) for name, value in values[0].items()}
    for (inside, _), numbers in zip(inclusions, values[1:], strict=True):
        merged = {name: jnp.where(inside, numbers[name], value) for name, value in merged.items()}
    return type(laws[0])(**merged)  # pyright: ignore[reportArgumentType]


def widened(laws: Sequence[AbstractMaterial]) -> list[AbstractMaterial]:
    """Write laws as the most general kind among them.

    Raises:
        ValueError: If there is none, or it is `Ogden`.
    """
    kinds = {type(law): None for law in laws}
    if Ogden in kinds:
        raise ValueError(
            "Sample: Ogden's numbers are one for each of its terms and cannot vary from place to place. Use NeoHooke, "
            "MooneyRivlin, Yeoh or Hencky for a sample with inclusions."
        )
    for kind in kinds:
        if all(other is kind or kind in _WIDER.get(other, {}) for other in kinds):
            return [law if type(law) is kind else _WIDER[type(law)][kind](law) for law in laws]
    names = " and ".join(kind.__name__ for kind in kinds)
    raise ValueError(
        f"Sample: laws of sample and inclusions must be of one kind, or NeoHooke beside MooneyRivlin or Yeoh, whose "
        f"special case it is; got {names}. State them all by one law."
    )
