"""Checks of the arguments of a fit, and their stacking over maps."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..measurement import ThicknessMap
from ..model import Contact, Palpation
from ..model.plausible import check_against_layer
from .measured_surface import MeasuredSurface, noise_std
from .observations import AxialDisplacement
from .parameters import check_parameters
from .prior import AbstractPrior


def as_tuple(value: Any) -> tuple:
    """Return a tuple of the values: one value becomes a tuple of one, None an empty one."""
    if value is None:
        return ()
    return tuple(value) if isinstance(value, Sequence) else (value,)


def stacked(name: str, value: Any, maps: int) -> Any:
    """Stack the values of each map."""
    if value is None:
        return None
    each = as_tuple(value)
    if len(each) != maps:
        raise ValueError(f"fit_traction.{name} needs one for each of {maps} maps, got {len(each)}.")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def stacked_maps(maps: tuple[ThicknessMap, ...]) -> tuple[ThicknessMap, Array]:
    """Stack maps, and the standard deviations of their noise."""
    plain = [ThicknessMap(m.values, m.extent, None, m.origin, None, m.mask, noise_length=m.noise_length) for m in maps]
    std = [jnp.broadcast_to(noise_std("fit_traction", m), m.shape) for m in maps]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *plain), jnp.stack(std)


def check_inputs(
    palpation: Palpation,
    maps: tuple[ThicknessMap, ...],
    prior: Any,
    lateral: Any,
    parameters: Mapping[str, Any],
    inside: tuple[AxialDisplacement, ...],
) -> None:
    """Raise ValueError for arguments that a fit cannot use."""
    if not isinstance(palpation.sample, Contact):
        raise ValueError(
            f"fit_traction needs sample=Contact(law, friction), got sample={type(palpation.sample).__name__}()."
        )
    if palpation.element in ("tet4", "tet10"):
        raise ValueError(f"fit_traction needs hexahedra, such as element='mean_dilatation', got {palpation.element!r}.")
    for m in maps:
        noise_std("fit_traction", m)
    if not maps or len({m.shape for m in maps}) > 1:
        raise ValueError(
            f"fit_traction.thickness must be one map, or several on one grid of pixels, got shapes "
            f"{[m.shape for m in maps]}."
        )
    for m in maps:
        check_against_layer("fit_traction.thickness", m, palpation.layer.thickness, palpation.extent, 4)
    check_parameters(palpation, parameters)
    nx, ny, nz = palpation.elements
    if min(nx, ny) < 4:
        raise ValueError(f"fit_traction needs at least 4 elements along x and y, got {(nx, ny)}.")
    for one in inside:
        if not isinstance(one, AxialDisplacement) or one.values.shape != (nz + 1, ny + 1, nx + 1):
            got = f"shape {one.values.shape}" if isinstance(one, AxialDisplacement) else type(one).__name__
            raise ValueError(
                f"fit_traction.inside [mm] must be AxialDisplacement(values, std) at the mesh's nodes "
                f"(nz+1, ny+1, nx+1) = {(nz + 1, ny + 1, nx + 1)}, one for each map; got {got}."
            )
    if isinstance(lateral, str):
        if lateral not in ("imprint", "friction"):
            raise ValueError(
                f'fit_traction.lateral must be "imprint", "friction", a prior or an array [MPa], got {lateral!r}.'
            )
    elif not isinstance(lateral, AbstractPrior) and (
        np.shape(lateral) != (2, ny + 1, nx + 1) or not np.all(np.isfinite(lateral))
    ):
        raise ValueError(
            f"fit_traction.lateral [MPa] must be a prior, such as Matern(...), or finite with shape "
            f"{(2, ny + 1, nx + 1)}: x then y on interface nodes; got shape {np.shape(lateral)}."
        )
    for name, one in (("prior", prior), *([("lateral", lateral)] if isinstance(lateral, AbstractPrior) else [])):
        if not isinstance(one, AbstractPrior):
            raise ValueError(
                f"fit_traction.{name} must be Matern(...), Tikhonov(...) or TotalVariation(...), got "
                f"{type(one).__name__}."
            )
        one.check_resolved(palpation.mesh().spacing)


def check_covered(maps: tuple[ThicknessMap, ...], surfaces: MeasuredSurface) -> None:
    """Raise ValueError for a map without data on the layer."""
    for number, (m, informed) in enumerate(zip(maps, np.asarray(surfaces.informed), strict=True)):
        if informed == 0:
            raise ValueError(
                f"fit_traction: map {number} has no pixel with data on the layer, which covers 0 to its extent [mm]; "
                f"the map starts at (x, y) = {np.asarray(m.origin).tolist()} and ends at "
                f"{np.asarray(m.origin + m.extent).tolist()} mm, {float(np.mean(m.mask)):.0%} of it masked. "
                "Pass ThicknessMap(origin=...) that matches, or unmask pixels."
            )
