"""Arguments of a fit: their checks, their stacking over maps, and the objective that they state."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import as_leaf
from ..measurement import ThicknessMap
from ..model import Contact, Palpation
from ..model.plausible import check_against_layer
from ..solvers.compiling import QuickJit
from .elastic_foundation import zero_foundation
from .measured_surface import MeasuredSurface, noise_std, project_map, unresolved_std
from .objective import Objective
from .observations import AxialDisplacement, ForceReading
from .parameters import AbstractNumberPrior, check_parameters
from .prior import AbstractPrior
from .settings import FitSettings


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
    check_parameters("fit_traction", palpation, parameters)
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


def state_objective(
    palpation: Palpation,
    maps: tuple[ThicknessMap, ...],
    prior: AbstractPrior,
    parameters: dict[str, AbstractNumberPrior],
    forces: ForceReading | None,
    inside: AxialDisplacement | None,
    lateral: AbstractPrior | Array | str,
    settings: FitSettings,
) -> Objective:
    """Project the maps and build the objective under a dead load, the lateral traction of an imprint still 0."""
    stacked_map, std = stacked_maps(maps)
    given = 0.0 if settings.model_std is None else settings.model_std
    surfaces = _project_maps(palpation.mesh(), stacked_map, std, as_leaf(given, "fit_traction.model_std", "mm"))
    if settings.model_std is None:
        surfaces = _project_maps(palpation.mesh(), stacked_map, std, unresolved_std(surfaces, std))
    check_covered(maps, surfaces)
    return Objective(
        palpation=palpation,
        surfaces=surfaces,
        prior=prior,
        lateral=lateral if isinstance(lateral, AbstractPrior) else None,
        known_lateral=_known_lateral(lateral, surfaces, parameters, settings),
        parameters=parameters,
        forces=forces,
        inside=inside,
        softness=settings.softness * palpation.layer.material.shear if settings.nonnegative else None,
        foundation=zero_foundation(palpation, surfaces, prior),
        solver=settings.solver.as_leaves(),
    )


def presses(settings: FitSettings) -> bool:
    """Return whether the fit starts with imprints of the maps."""
    return not settings.nonnegative and settings.foundation_stiffness != 0.0


def _known_lateral(
    lateral: AbstractPrior | Array | str, surfaces: MeasuredSurface, parameters: Mapping, settings: FitSettings
) -> Array | None:
    """Return the lateral traction, for now 0 where it is that of an imprint; None: fitted, or due to friction."""
    maps, my, mx = surfaces.surface.shape
    if isinstance(lateral, str):
        constant = not any(name.startswith(("layer.material", "sample.friction")) for name in parameters)
        known = lateral == "imprint" and presses(settings) and constant
        return jnp.zeros((maps, 2, my, mx)) if known else None
    return None if isinstance(lateral, AbstractPrior) else jnp.broadcast_to(lateral, (maps, 2, my, mx))


_project_maps = QuickJit(jax.vmap(project_map, in_axes=(None, 0, 0, None)))
