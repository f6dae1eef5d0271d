"""How far an estimate of the pressure is from the truth of a virtual experiment: error map and the field's measures.

Last stage of the chain; both are read at the same places in space, because interface points move sideways.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from ..inverse import TractionFit
from ..measurement import ThicknessMap
from ..model import Box, Cylinder, Sphere
from ..solvers import ExperimentSolution, Solution
from .fields import under_pixels

# Directions that a radial profile averages over, and steps of the profile to a step of the grid.
_DIRECTIONS = 72
_FINER = 4
# Where the far field lies, over the distance from the centre to the side that is farther away: off the inclusion, and
# off the rim, where a free side disturbs the stress.
_FAR = (0.6, 0.8)
_ROUNDING = 1e-6  # of a position, in samples
_COVERED = 2.0  # standard deviations

Grid = Float[np.ndarray, "ny nx"]


class FieldMetrics(NamedTuple):
    """Measures of one pressure field.

    Attributes:
        force: Normal force [N]: of a solution its own, of a gridded pressure its integral over the plane.
        contrast: CON [-], pressure at the centre over that of the far field.
        resolution: RES [mm], full width at half maximum of |dp/dr|, p(r) the mean over directions, from the centre to
            the far field: how sharply the edge of the inclusion is seen. NaN where that slope does not fall to half on
            both sides.
        detectability: DET [mm], u_z + P·H over the centre: u_z at the layer's face, P·H the shortening of a layer of
            thickness H at the strain P of the far field. Negative over what is stiffer; NaN for a gridded pressure.
    """

    force: float
    contrast: float
    resolution: float
    detectability: float


class Comparison(eqx.Module):
    """An estimate of the pressure beside the truth, at the same places.

    Attributes:
        x: Positions along image columns [mm].
        y: Positions along image rows [mm].
        estimate_pressure: Estimated contact pressure there [MPa], NaN where it has none.
        truth_pressure: True contact pressure there [MPa], NaN where it has none.
        relative_error: Root of the summed squares of the error over those of the truth [-] (relative L2).
        covered: Share of places where the truth lies within two standard deviations of a fit [-]; NaN for others.
        estimate: Measures of the estimate.
        truth: Measures of the truth.
    """

    x: Float[np.ndarray, " nx"]
    y: Float[np.ndarray, " ny"]
    estimate_pressure: Grid
    truth_pressure: Grid
    relative_error: float
    covered: float
    estimate: FieldMetrics
    truth: FieldMetrics

    @property
    def error(self) -> Grid:
        """Estimated minus true pressure [MPa], NaN where one of them has none."""
        return self.estimate_pressure - self.truth_pressure

    def to_xarray(self) -> xr.Dataset:
        """Label the maps with positions and units; the measures are attributes."""
        attrs: dict[str, Any] = {"relative_error": self.relative_error, "covered": self.covered}
        for name, metrics in (("estimate", self.estimate), ("truth", self.truth)):
            attrs |= {f"{name}_{measure}": value for measure, value in metrics._asdict().items()}
        maps = {
            "estimate": (self.estimate_pressure, "estimated contact pressure"),
            "truth": (self.truth_pressure, "true contact pressure"),
            "error": (self.error, "estimated minus true contact pressure"),
        }
        return xr.Dataset(
            {
                name: (("y", "x"), values, {"units": "MPa", "long_name": words})
                for name, (values, words) in maps.items()
            },
            coords={axis: ((axis,), getattr(self, axis), {"units": "mm"}) for axis in ("x", "y")},
            attrs=attrs,
        )


class _Field(NamedTuple):
    """What is known of one field at the places."""

    pressure: Grid
    force: float
    uz: Grid | None
    std: Grid | None


def compare(
    estimate: Any,
    truth: Any,
    *,
    grid: ThicknessMap | None = None,
    centre: tuple[float, float] | None = None,
    far: tuple[float, float] | None = None,
    margin: float = 0.0,
) -> Comparison:
    """Compare an estimate of the contact pressure with the truth, place by place.

    Both are read at places in space on the grid of the truth's thickness map: a point of the interface that has moved
    sideways counts where it lies now.

    Args:
        estimate: A `Solution`, `TractionFit`, the solution of an experiment, or a pressure [MPa] as an array
            `(ny, nx)` of samples in space over the whole layer, such as `uniaxial_estimate` returns.
        truth: One of these, usually the solution of an experiment.
        grid: Map on whose samples an array lies, where that is not the whole layer; its thickness does not count.
        centre: (x, y) of the inclusion [mm], for contrast, resolution and detectability. None: that of the last
            inclusion of the experiment with a centre, else where the true pressure is farthest from its median.
        far: Distances (from, to) of the far field from the centre [mm]. None: 0.6 to 0.8 of the distance to the side
            that is farther away, along the shorter axis.
        margin: Width of a rim that is left out [mm], where free sides make stress singular.

    Raises:
        ValueError: For a failed or batched solution, arrays alone, or a margin or centre off the layer.

    Source:
        Measures: Jones, Fang & Kennedy, J. Biophotonics 2024.

    Example:
        >>> import opfem as op
        >>> def error_of_imprint(palpation, truth):
        ...     solution = op.solve(palpation, op.Imprint(truth.thickness))
        ...     return op.compare(solution, truth, margin=0.5).relative_error
    """
    solved = [part for part in (truth, estimate) if not _is_array(part)]
    if not solved:
        raise ValueError("compare needs a solution or a fit as estimate or truth; two arrays know no places.")
    places = _solution(solved[0]).thickness
    x, y = np.asarray(places.x), np.asarray(places.y)
    keep = [np.abs(axis - axis.mean()) <= 0.5 * np.ptp(axis) - margin + 1e-9 for axis in (x, y)]
    if min(part.sum() for part in keep) < 2:
        raise ValueError(f"compare.margin [mm] must leave part of the layer, got {margin:g}.")
    x, y = x[keep[0]], y[keep[1]]
    ours, theirs = (_read(part, x, y, places if grid is None else grid) for part in (estimate, truth))
    known = np.isfinite(ours.pressure) & np.isfinite(theirs.pressure)
    if not known.any():
        raise ValueError("compare finds no place where both have a pressure. Did a solve fail, or do they not overlap?")
    error = (ours.pressure - theirs.pressure)[known]
    centre = _centre(centre, truth, theirs.pressure, x, y)
    return Comparison(
        x,
        y,
        ours.pressure,
        theirs.pressure,
        float(np.linalg.norm(error) / np.linalg.norm(theirs.pressure[known])),
        math.nan if ours.std is None else float(np.mean(np.abs(error) <= _COVERED * ours.std[known])),
        _metrics(ours, x, y, centre, far),
        _metrics(theirs, x, y, centre, far),
    )


def _is_array(part: Any) -> bool:
    return not isinstance(part, (Solution, ExperimentSolution, TractionFit))


def _solution(part: Any) -> Solution | ExperimentSolution:
    return part.solution if isinstance(part, TractionFit) else part


def _read(part: Any, x: np.ndarray, y: np.ndarray, grid: ThicknessMap) -> _Field:
    """Read a field at places x, y."""
    if _is_array(part):
        return _read_array(np.asarray(part), x, y, grid)
    solution = _solution(part)
    if solution.displacement.ndim != 4:
        raise ValueError(
            f"compare takes one solution, got displacements of shape {solution.displacement.shape}. Pick one: "
            "jax.tree.map(lambda leaf: leaf[0], solutions)."
        )
    u = np.asarray(solution.displacement[:, -1])
    if not np.isfinite(u).all():
        raise ValueError("compare needs solutions that converged: this one's fields are NaN.")
    ys, xs = np.meshgrid(y, x, indexing="ij")
    reference = np.asarray(solution.positions[:2, -1])

    def at_places(nodal: Any) -> Grid:
        return under_pixels(np.asarray(nodal), reference, u[:2], xs, ys)

    return _Field(
        at_places(solution.pressure),
        -float(solution.stats["force_sample"][2]),
        at_places(u[2]),
        at_places(part.pressure_std) if isinstance(part, TractionFit) else None,
    )


def _read_array(values: np.ndarray, x: np.ndarray, y: np.ndarray, grid: ThicknessMap) -> _Field:
    if values.ndim != 2 or min(values.shape) < 2 or values.dtype.kind not in "fiu":
        raise ValueError(
            "compare takes solutions, fits, or a pressure [MPa] as an array (ny, nx) of samples in space, got "
            f"{type(values).__name__} of shape {values.shape} and {values.dtype}."
        )
    start, extent = np.asarray(grid.origin), np.asarray(grid.extent)
    ny, nx = values.shape
    i, j = (x - start[0]) / extent[0] * (nx - 1), (y - start[1]) / extent[1] * (ny - 1)
    pressure = _interpolate(values.astype(float), *np.meshgrid(i, j))
    columns, rows = (np.linspace(0.0, extent[axis], values.shape[1 - axis]) for axis in range(2))
    force = float(np.trapezoid(np.trapezoid(np.nan_to_num(values.astype(float)), columns, axis=1), rows))
    return _Field(pressure, force, None, None)


def _centre(
    given: tuple[float, float] | None, truth: Any, pressure: Grid, x: np.ndarray, y: np.ndarray
) -> tuple[float, float]:
    if given is not None:
        if not (x[0] <= given[0] <= x[-1] and y[0] <= given[1] <= y[-1]):
            raise ValueError(
                f"compare.centre [mm] must lie in x {x[0]:g} to {x[-1]:g} and y {y[0]:g} to {y[-1]:g}, got {given}."
            )
        return given
    inclusions = truth.experiment.sample.inclusions if isinstance(truth, ExperimentSolution) else ()
    for where, _ in reversed(inclusions):
        if isinstance(where, Cylinder | Sphere):
            return float(where.centre[0]), float(where.centre[1])
        if isinstance(where, Box):
            middle = 0.5 * (np.asarray(where.low) + np.asarray(where.high))
            return float(middle[0]), float(middle[1])
    off = np.abs(pressure - np.nanmedian(pressure))
    j, i = np.unravel_index(np.nanargmax(off), off.shape)
    return float(x[i]), float(y[j])


def _metrics(
    field: _Field, x: np.ndarray, y: np.ndarray, centre: tuple[float, float], far: tuple[float, float] | None
) -> FieldMetrics:
    reach = min(max(at - axis[0], axis[-1] - at) for at, axis in zip(centre, (x, y), strict=True))
    step = min(x[1] - x[0], y[1] - y[0]) / _FINER
    r = np.arange(0.0, reach, step)
    first, last = far or (_FAR[0] * reach, _FAR[1] * reach)
    ring = (r >= first) & (r <= last)
    if not ring.any():
        raise ValueError(f"compare.far [mm] must be two distances from 0 to {reach:.4g}, rising, got {far}.")
    profile = _profile(field.pressure, x, y, centre, r)
    away = np.nanmean(profile[ring])
    contrast = float(profile[0] / away) if away else math.nan
    detectability = math.nan
    if field.uz is not None:
        shortening = _profile(field.uz, x, y, centre, r)
        detectability = float(shortening[0] - np.nanmean(shortening[ring]))
    within = r <= first  # the rim beyond may be steeper
    return FieldMetrics(field.force, contrast, _edge_width(r[within], profile[within]), detectability)


def _profile(values: Grid, x: np.ndarray, y: np.ndarray, centre: tuple[float, float], r: np.ndarray) -> np.ndarray:
    """Average a field over directions at distances r [mm] from the centre; NaN where it is known nowhere."""
    angles = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    i = (centre[0] + r[:, None] * np.cos(angles) - x[0]) / (x[1] - x[0])
    j = (centre[1] + r[:, None] * np.sin(angles) - y[0]) / (y[1] - y[0])
    sampled = _interpolate(values, i, j)
    known = np.isfinite(sampled)
    total = np.sum(np.where(known, sampled, 0.0), axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _interpolate(values: Grid, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Interpolate bilinearly at columns i and rows j, NaN beyond the samples; a place on their rim may round."""
    j, i = (
        np.where(np.abs(np.clip(k, 0, n - 1) - k) < _ROUNDING, np.clip(k, 0, n - 1), k)
        for k, n in zip((j, i), values.shape, strict=True)
    )
    return map_coordinates(values, [j, i], order=1, mode="constant", cval=np.nan)


def _edge_width(r: np.ndarray, profile: np.ndarray) -> float:
    """Compute the full width at half maximum [mm] of the slope of a profile, NaN where it has no such peak."""
    slope = np.abs(np.gradient(profile, r))
    if not np.isfinite(slope).any() or not np.nanmax(slope) > 0.0:
        return math.nan
    peak = int(np.nanargmax(slope))
    half = 0.5 * slope[peak]
    below = np.flatnonzero(~(slope > half))
    before, after = below[below < peak], below[below > peak]
    if not before.size or not after.size:
        return math.nan
    ends = [(after[0] - 1, after[0]), (before[-1] + 1, before[-1])]
    shares = [(slope[inside] - half) / (slope[inside] - slope[outside]) for inside, outside in ends]
    outer, inner = (r[a] + share * (r[b] - r[a]) for (a, b), share in zip(ends, shares, strict=True))
    return float(outer - inner)
