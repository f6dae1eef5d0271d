"""Fitted numbers of the experiment: their priors, and their places in it."""

from collections.abc import Mapping
from functools import reduce
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._checks import Leaf, as_leaf, check_finite, check_positive
from .._types import ScalarLike
from ..measurement import ThicknessMap
from ..model import Palpation

INDEX, OFFSET = "refractive_index", "l0_offset"
"""Names that are no field of `Palpation`: refractive index of the layer over the one that both maps were scaled with
[-]; increment of its unloaded thickness [mm]."""


class AbstractNumberPrior(eqx.Module):
    """Prior of one number, as a function of a standard normal number."""

    def number(self, white: Array) -> Array:
        """Map a standard normal number to one of this distribution."""
        raise NotImplementedError


class Normal(AbstractNumberPrior):
    """A normal distribution.

    Args:
        mean: Its mean, in the number's own unit.
        std: Its standard deviation.

    Raises:
        ValueError: If the mean is not finite or the standard deviation is not positive.
    """

    mean: Array = eqx.field(converter=Leaf("Normal.mean", "the number's unit"))
    std: Array = eqx.field(converter=Leaf("Normal.std", "the number's unit"))

    def __check_init__(self):
        check_finite("Normal.mean", "the number's unit", self.mean)
        check_positive("Normal.std", "the number's unit", self.std)

    def number(self, white: Array) -> Array:
        """Map a standard normal number to one of this distribution."""
        return self.mean + self.std * white


class LogNormal(AbstractNumberPrior):
    """A positive number whose logarithm is normal: moduli, friction coefficients.

    Args:
        median: Its median, in the number's own unit.
        spread: Standard deviation of its logarithm [-]: 0.1 is about 10 %.

    Raises:
        ValueError: If one is not positive.
    """

    median: Array = eqx.field(converter=Leaf("LogNormal.median", "the number's unit"))
    spread: Array = eqx.field(converter=Leaf("LogNormal.spread", "-"))

    def __check_init__(self):
        check_positive("LogNormal.median", "the number's unit", self.median)
        check_positive("LogNormal.spread", "-", self.spread)

    def number(self, white: Array) -> Array:
        """Map a standard normal number to one of this distribution."""
        return self.median * jnp.exp(self.spread * white)


def with_numbers(palpation: Palpation, numbers: Mapping[str, ScalarLike]) -> Palpation:
    """Return an experiment with other numbers.

    Args:
        palpation: The experiment.
        numbers: By the path of the field, such as "layer.material.c10" or "window.friction", or `INDEX`, `OFFSET`.
    """
    for name, value in numbers.items():
        if name not in (INDEX, OFFSET):
            palpation = eqx.tree_at(lambda p, name=name: _field(p, name), palpation, as_leaf(value, name))
    thickness = palpation.layer.thickness
    values = thickness.values if isinstance(thickness, ThicknessMap) else thickness
    changed = (values + numbers.get(OFFSET, 0.0)) / numbers.get(INDEX, 1.0)
    if isinstance(thickness, ThicknessMap):
        changed = eqx.tree_at(lambda t: t.values, thickness, changed)
    return eqx.tree_at(lambda p: p.layer.thickness, palpation, changed)


def check_parameters(caller: str, palpation: Palpation, parameters: Mapping[str, Any]) -> None:
    """Raise ValueError unless every name is a number of the experiment, and every value a prior of it."""
    for name, prior in parameters.items():
        if not isinstance(prior, AbstractNumberPrior):
            raise ValueError(
                f"{caller}: parameters[{name!r}] must be Normal(mean, std) or LogNormal(median, spread), got {prior!r}."
            )
        if name in (INDEX, OFFSET):
            continue
        try:
            value = _field(palpation, name)
        except AttributeError:
            value = None
        if value is None or not eqx.is_inexact_array(value) or value.ndim != 0:
            raise ValueError(
                f"{caller}: parameters name numbers of the experiment by their path, such as 'layer.material.c10', "
                f"'window.friction', or {INDEX!r} and {OFFSET!r}; got {name!r}."
            )


def _field(palpation: Palpation, name: str) -> Any:
    return reduce(getattr, name.split("."), palpation)
