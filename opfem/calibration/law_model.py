"""Model of a calibration: nominal stress of a law with unknown numbers at measured stretches."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement.stress_strain import Mode
from ..model.homogeneous import nominal_stress
from ..model.material import AbstractMaterial, MooneyRivlin, NeoHooke, Yeoh
from ..model.stretch_material import Hencky, Ogden

LAWS: dict[str, type[AbstractMaterial]] = {
    "neo_hooke": NeoHooke,
    "mooney_rivlin": MooneyRivlin,
    "yeoh": Yeoh,
    "ogden": Ogden,
    "hencky": Hencky,
}
"""Laws by name."""

Unknown = dict[str, Any]
"""`numbers` of the law by name, and `offset` of every curve, `(curves,)` or `(0,)`."""


class Curves(eqx.Module):
    """Measured curves as the fit takes them.

    Attributes:
        stretch: Of every curve [-].
        nominal: Of every curve, platens corrected for [MPa].
        weight: Of every point of every curve [-].
        modes: Of every curve; static.
    """

    stretch: tuple[Float[Array, " _"], ...]
    nominal: tuple[Float[Array, " _"], ...]
    weight: tuple[Float[Array, " _"], ...]
    modes: tuple[Mode, ...] = eqx.field(static=True)


class LawModel(eqx.Module):
    """A law whose numbers are unknown.

    Attributes:
        ratio: Bulk over shear modulus [-]; None: incompressible.
        law: Class of the law; static.
        toe: Kind of offset, "stress" or "strain"; static.
    """

    ratio: Array | None
    law: type[AbstractMaterial] = eqx.field(static=True)
    toe: str = eqx.field(static=True)

    def material(self, unknown: Unknown) -> AbstractMaterial:
        """Build the law with its bulk modulus."""
        numbers = unknown["numbers"]
        if self.ratio is None:
            return self.law(**numbers, bulk=jnp.asarray(jnp.inf))
        return self.law(**numbers, bulk=self.ratio * self.law(**numbers, bulk=jnp.ones(())).shear)

    def modulus(self, unknown: Unknown) -> Array:
        """Compute Young's modulus at rest [MPa]."""
        shear = self.material(unknown).shear
        return 3.0 * shear if self.ratio is None else 9.0 * self.ratio * shear / (3.0 * self.ratio + 1.0)

    def nominal(self, unknown: Unknown, stretch: Array, mode: Mode) -> Array:
        """Compute the law's nominal stress [MPa], without an offset."""
        return nominal_stress(self.material(unknown), stretch, mode, self.ratio is None)

    def measured(self, unknown: Unknown, curves: Curves) -> list[Array]:
        """Compute the nominal stress at every point of every curve [MPa], offsets included."""
        stresses = []
        for curve, (stretch, mode) in enumerate(zip(curves.stretch, curves.modes, strict=True)):
            shift = unknown["offset"][curve] if unknown["offset"].size else jnp.zeros(())
            if self.toe == "strain":
                stresses.append(self.nominal(unknown, stretch / (1.0 + shift), mode))
            else:
                stresses.append(self.nominal(unknown, stretch, mode) + shift)
        return stresses

    def residuals(self, unknown: Unknown, curves: Curves) -> Float[Array, " n"]:
        """Compute computed minus measured stress [MPa], weighted, of all curves concatenated."""
        parts = zip(self.measured(unknown, curves), curves.nominal, curves.weight, strict=True)
        return jnp.concatenate([weight * (computed - nominal) for computed, nominal, weight in parts])


def names_of(unknown: Unknown) -> tuple[str, ...]:
    """Name the unknowns in the order of `ravel_pytree`: by name, then offsets."""
    names = []
    for name, value in [*sorted(unknown["numbers"].items()), ("offset", unknown["offset"])]:
        several = value.ndim and (value.size > 1 or name in ("mu", "alpha"))
        names += [f"{name}[{place}]" for place in range(value.size)] if several else [name] * value.size
    return tuple(names)
