"""What a reader should know before relying on a result: where mesh, material or missing pixels limit it.

Part of `summary`, and so printed by the command line; each caution says what to do.
"""

import numpy as np
import xarray as xr
from scipy.ndimage import uniform_filter1d

from ..measurement import ThicknessMap
from ..solvers import ExperimentSolution, Solution

# Residual over the map's noise [-]. At 2 what the mesh misses is √3 times the noise, and so rules. The built-in
# example has 1.5 at 20 × 20 × 2 elements.
_MISSED = 2.0
# Volume that the whole layer has lost or gained [-]. Against a bulk modulus of 1000 shear moduli one of 20 gives 4 %
# less force on the built-in example, which loses 1.7 %, and 7 % less on the coin, which loses 3.9 %; but a third of
# the force with friction of 0.5 on both faces, where the example loses 8 %.
_SQUEEZED = 0.05
# Part of the force that rests on pixels without data nearby [-], about what friction, the largest other error, makes
# of it; and part of the highest pressures.
_UNMEASURED, _UNMEASURED_PEAK = 0.1, 0.5
_PEAK = 99.0  # percentile of the pressure that counts as highest from there on


def cautions(
    solution: Solution | ExperimentSolution, dataset: xr.Dataset, maps: xr.Dataset, measured: ThicknessMap | None
) -> list[str]:
    """Say in sentences what limits a result; nothing where nothing does.

    Args:
        solution: A solution that converged.
        dataset: What `to_xarray` returned for it.
        maps: The same on the pixels of the map.
        measured: The map, for its noise; None: there is none.
    """
    layer = solution.palpation.layer if isinstance(solution, Solution) else solution.experiment.layer
    bulk_ratio = float(layer.material.bulk / layer.material.shear)
    said = [_missed(dataset, maps, measured), _squeezed(dataset, bulk_ratio), _unmeasured(dataset, maps)]
    return [caution for caution in said if caution]


def residual_rms(maps: xr.Dataset) -> float:
    """Compute the root mean square of the residual [mm], NaN where there is none."""
    known = maps["residual"].values if "residual" in maps else np.full(1, np.nan)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def volume_ratio(dataset: xr.Dataset) -> float:
    """Compute the volume of the loaded over that of the unloaded layer [-]."""
    z = dataset["z"] * dataset["unloaded_thickness"]
    x, y, z = xr.broadcast(dataset["x"], dataset["y"], z)
    X = np.stack([axis.transpose("z", "y", "x").values for axis in (x, y, z)])
    u = dataset["displacement"].transpose("component", "z", "y", "x").values
    return _volume(X + u) / _volume(X)


def _volume(nodes: np.ndarray) -> float:
    """Sum the six tetrahedra of each hexahedron: from its first corner to its last, along the axes in every order."""
    total = 0.0
    for order, sign in _ORDERS.items():
        step = np.zeros(3, int)
        corners = [_corner(nodes, step)]
        for axis in order:
            step[axis] = 1
            corners.append(_corner(nodes, step))
        edges = [corner - corners[0] for corner in corners[1:]]
        total += sign * float(np.sum(np.cross(edges[0], edges[1], axis=0) * edges[2])) / 6.0
    return total


# Orders of the axes z, y, x, and whether their tetrahedron is right-handed.
_ORDERS = {(2, 1, 0): 1, (1, 0, 2): 1, (0, 2, 1): 1, (2, 0, 1): -1, (0, 1, 2): -1, (1, 2, 0): -1}


def _corner(nodes: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Take the same corner of every hexahedron."""
    k, j, i = (slice(s, s + n - 1) for s, n in zip(step, nodes.shape[1:], strict=True))
    return nodes[:, k, j, i]


def _missed(dataset: xr.Dataset, maps: xr.Dataset, measured: ThicknessMap | None) -> str:
    # A fit counts in what its mesh misses, by itself.
    if measured is None or measured.std is None or "imposed_thickness" not in dataset:
        return ""
    std = np.broadcast_to(measured.std, measured.shape)[np.isfinite(maps["residual"].values)]
    noise, rms = float(np.sqrt(np.mean(std**2))) if std.size else np.inf, residual_rms(maps)
    if not rms > _MISSED * noise:
        return ""
    return (
        f"The mesh does not follow the map: measured and computed thickness differ by {1e3 * rms:.2g} µm rms where "
        f"layer and sample touch, the noise of the map is {1e3 * noise:.2g} µm. Take more elements, or smooth the map "
        "less."
    )


def _squeezed(dataset: xr.Dataset, bulk_ratio: float) -> str:
    change = volume_ratio(dataset) - 1.0
    if abs(change) <= _SQUEEZED:
        return ""
    return (
        f"The layer has {'lost' if change < 0 else 'gained'} {abs(change):.1%} of its volume, which silicone does not: "
        f"its bulk modulus is only {bulk_ratio:.3g} shear moduli, and where it is confined pressure is far too low. "
        "Raise bulk=, to 1000 shear moduli, and see what changes."
    )


def _unmeasured(dataset: xr.Dataset, maps: xr.Dataset) -> str:
    """Look at pixels in holes of the map that are wider than an element; its neighbours tell a smaller one's."""
    if "missing" not in maps or not maps["missing"].values.any():
        return ""
    hole = maps["missing"].values.astype(float)
    for axis, name in enumerate(("y", "x")):
        element, pixel = (
            float(values[1] - values[0]) for values in (dataset[name].values, maps[f"{name}_image"].values)
        )
        hole = uniform_filter1d(hole, max(1, round(element / pixel)), axis, mode="nearest")
    hole = hole > 0.5
    pressure = np.maximum(np.nan_to_num(maps["pressure"].values), 0.0)
    total, highest = pressure.sum(), pressure >= max(np.percentile(pressure, _PEAK), np.finfo(float).tiny)
    share = float(pressure[hole].sum() / total) if total else 0.0
    at_peak = bool(highest.any() and hole[highest].mean() > _UNMEASURED_PEAK)
    if share <= _UNMEASURED and not at_peak:
        return ""
    what = f"{share:.0%} of the force" + (" and the highest pressure" if at_peak else "")
    return (
        f"{what} {'lie' if at_peak else 'lies'} where the map holds no data: thickness is filled in there, or left to "
        "the prior, and pressure is a guess. Measure there, or leave these places out of what you conclude."
    )
