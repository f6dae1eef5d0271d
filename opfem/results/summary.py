"""`summary`: the numbers of a solution that people ask for first, in kPa, µm and N.

Last stage of the chain; written as summary.json and printed by the command line.
"""

import math
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ..measurement import ThicknessMap
from ..model import Imprint
from ..solvers import ExperimentSolution, Solution
from .cautions import cautions, residual_rms, volume_ratio
from .dataset import status_message, status_name, to_xarray
from .pixels import on_pixels, touching_compression

_KPA = 1e3
_UM = 1e3
_STATES = ("open", "stick", "slip")


def summary(solution: Solution | ExperimentSolution, measured: ThicknessMap | None = None) -> dict[str, Any]:
    """Summarise a solution in types that JSON knows; every key states its unit.

    Areas are current ones, and means of pressure weighted by them. Compression and residual are over the pixels of the
    map where the sample touches, percentiles over interface nodes. `warnings` says in sentences what limits the
    result. What a failed solve does not know is None, and so is the residual where nothing was measured.

    Args:
        solution: One solution, outside jit.
        measured: Measured map; None takes the map that was pressed in, or of other loads none.
    """
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    outer = ("force_window", "force_hold")
    outer = ("force_plate", *outer) if isinstance(solution, ExperimentSolution) else ("force_sample", *outer)
    forces = {f"{name}_N": stats[name].tolist() for name in dict.fromkeys(("force_sample", *outer))}
    pressing = np.linalg.norm(stats["force_sample"])
    unbalanced = np.linalg.norm(sum(stats[name] for name in outer))
    dataset = to_xarray(solution)
    numbers = {
        "status": status_name(solution),
        "status_message": status_message(solution),
        "load_reached_percent": 100.0 * float(solution.last_converged.load_fraction),
        **forces,
        "force_imbalance_percent": 100.0 * float(unbalanced / pressing) if pressing else math.nan,
        **_pressures(dataset),
        **_areas(dataset),
        **_of_map(solution, dataset, measured),
        "max_lateral_displacement_um": _UM * float(np.hypot(*np.asarray(solution.displacement[:2, -1])).max()),
        "approach_um": _UM * float(stats["approach"]),
        "max_penetration_um": _UM * float(stats["max_penetration"]),
        "min_volume_ratio": float(stats["min_volume_ratio"]),
        "mean_volume_ratio": volume_ratio(dataset),
        "residual_relative": float(stats["residual"]),
        **{f"{name}_count": int(stats[name]) for name in ("increments", "attempts", "newton_steps", "krylov_steps")},
    }
    if "kinetic_ratio" in stats:
        numbers["kinetic_energy_percent"] = 100.0 * float(stats["kinetic_ratio"])
        numbers["energy_drift_percent"] = 100.0 * float(stats["energy_drift"])
    return {key: _known(value) for key, value in numbers.items()}


def summary_rows(numbers: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Lay out a summary for reading: name, value and unit of each row.

    Args:
        numbers: What `summary` returned for a solve that converged.
    """
    fx, fy, fz = numbers["force_sample_N"]
    residual = numbers["residual_rms_um"]
    return [
        ("force on the layer, normal", f"{0.0 - fz:.4g}", "N"),
        ("force on the layer, lateral", f"{math.hypot(fx, fy):.2g}", "N"),
        *pressure_rows(numbers),
        *layer_rows(numbers),
        *([] if residual is None else [("measured − computed thickness, rms", f"{residual:.2g}", "µm")]),
        ("largest lateral displacement", f"{numbers['max_lateral_displacement_um']:.3g}", "µm"),
        ("approach left by the contact law", f"{numbers['approach_um']:.2g}", "µm"),
        ("largest penetration", f"{numbers['max_penetration_um']:.2g}", "µm"),
        ("volume ratio, mean and smallest", _pair(numbers, "mean_volume_ratio", "min_volume_ratio"), ""),
        *_effort(numbers),
    ]


def pressure_rows(numbers: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Lay out what a summary says of the pressure."""
    mean = numbers["pressure_mean_touching_kPa"]
    return [
        ("mean pressure over the touching area", "none touches" if mean is None else f"{mean:.3g}", "kPa"),
        ("99th percentile of pressure", f"{numbers['pressure_p99_kPa']:.3g}", "kPa"),
        ("largest pressure", f"{numbers['pressure_max_kPa']:.3g}", "kPa"),
    ]


def layer_rows(numbers: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Lay out what a summary says of the layer: its compression, and contact on both of its faces."""
    return [
        ("compression, mean and largest", _pair(numbers, "compression_mean_percent", "compression_max_percent"), "%"),
        *(
            (
                f"open, stick, slip at the {face}",
                ", ".join(f"{numbers[f'{prefix}{state}_area_mm2']:.3g}" for state in _STATES),
                "mm²",
            )
            for face, prefix in (("sample", ""), ("window", "window_"))
        ),
    ]


def _pair(numbers: dict[str, Any], *names: str) -> str:
    return ", ".join("none" if numbers[name] is None else f"{numbers[name]:.3g}" for name in names)


def _effort(numbers: dict[str, Any]) -> list[tuple[str, str, str]]:
    increments = f"{numbers['increments_count']}"
    if "kinetic_energy_percent" not in numbers:
        return [("load increments, Newton steps", f"{increments}, {numbers['newton_steps_count']}", "")]
    shares = f"{numbers['kinetic_energy_percent']:.2g}, {numbers['energy_drift_percent']:.2g}"
    return [("time increments", increments, ""), ("kinetic energy, energy missing", shares, "%")]


def _pressures(dataset: xr.Dataset) -> dict[str, float]:
    pressure, area = _KPA * dataset["pressure"].values, dataset["node_area"].values
    touching = dataset["contact_status"].values > 0
    return {
        "pressure_mean_touching_kPa": _mean(pressure[touching], area[touching]),
        "pressure_max_kPa": float(pressure.max()),
        "pressure_p99_kPa": float(np.percentile(pressure, 99)),
    }


def _areas(dataset: xr.Dataset) -> dict[str, float]:
    """Sum the current areas [mm²] in each state, at the sample and at the window."""
    areas = {}
    for prefix in ("", "window_"):
        status, area = (dataset[f"{prefix}{name}"].values for name in ("contact_status", "node_area"))
        known = np.isfinite(area).all()
        states = {name: float(area[status == code].sum()) if known else math.nan for code, name in enumerate(_STATES)}
        areas[f"{prefix}contact_area_mm2"] = states["stick"] + states["slip"]
        areas |= {f"{prefix}{name}_area_mm2": size for name, size in states.items()}
    return areas


def _of_map(
    solution: Solution | ExperimentSolution, dataset: xr.Dataset, measured: ThicknessMap | None
) -> dict[str, Any]:
    """Say what the layer's thickness and the measured one tell, and what limits the result."""
    if not np.isfinite(dataset["pressure"].values).all():
        names = ("compression_mean_percent", "compression_max_percent", "residual_rms_um")
        return dict.fromkeys(names, math.nan) | {"warnings": []}
    if measured is None and isinstance(solution.load, Imprint):
        measured = solution.load.thickness
    maps = on_pixels(dataset, measured)
    mean, largest = touching_compression(maps)
    return {
        "compression_mean_percent": mean,
        "compression_max_percent": largest,
        "residual_rms_um": _UM * residual_rms(maps),
        "warnings": cautions(solution, dataset, maps, measured),
    }


def _mean(values: Float[np.ndarray, " nodes"], weights: Float[np.ndarray, " nodes"]) -> float:
    return float(np.sum(values * weights) / np.sum(weights)) if values.size else math.nan


def _known(value: Any) -> Any:
    if isinstance(value, list):
        return [_known(item) for item in value]
    if not isinstance(value, float):
        return value
    return value + 0.0 if math.isfinite(value) else None  # -0.0 becomes 0.0
