"""`summary`: the numbers of a solution that people ask for first, in kPa, µm and N.

Last stage of the chain; written as summary.json and printed by the command line.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..solvers import ExperimentSolution, Solution
from .dataset import status_message, status_name
from .fields import node_areas

_KPA = 1e3
_UM = 1e3


def summary(solution: Solution | ExperimentSolution) -> dict[str, Any]:
    """Summarise a solution in types that JSON knows; every key states its unit.

    Means and fractions are weighted by area: pressure by the current area, contact by the reference area.
    The percentile is over interface nodes. What a failed solve does not know is None.

    Args:
        solution: One solution, outside jit.
    """
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    outer = ("force_window", "force_hold")
    outer = ("force_plate", *outer) if isinstance(solution, ExperimentSolution) else ("force_sample", *outer)
    forces = {f"{name}_N": stats[name].tolist() for name in dict.fromkeys(("force_sample", *outer))}
    pressing = np.linalg.norm(stats["force_sample"])
    unbalanced = np.linalg.norm(sum(stats[name] for name in outer))
    numbers = {
        "status": status_name(solution),
        "status_message": status_message(solution),
        "load_reached_percent": 100.0 * float(solution.last_converged.load_fraction),
        **forces,
        "force_imbalance_percent": 100.0 * float(unbalanced / pressing) if pressing else math.nan,
        **_pressures(solution),
        **_contact(solution),
        "max_lateral_displacement_um": _UM * float(np.hypot(*np.asarray(solution.displacement[:2, -1])).max()),
        "approach_um": _UM * float(stats["approach"]),
        "max_penetration_um": _UM * float(stats["max_penetration"]),
        "min_volume_ratio": float(stats["min_volume_ratio"]),
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
    shares = [f"{100 * numbers[f'{state}_fraction']:.0f}" for state in ("open", "stick", "slip")]
    return [
        ("force on the layer, normal", f"{0.0 - fz:.4g}", "N"),
        ("force on the layer, lateral", f"{math.hypot(fx, fy):.2g}", "N"),
        ("mean pressure", f"{numbers['pressure_mean_kPa']:.3g}", "kPa"),
        ("99th percentile of pressure", f"{numbers['pressure_p99_kPa']:.3g}", "kPa"),
        ("largest pressure", f"{numbers['pressure_max_kPa']:.3g}", "kPa"),
        ("open, stick, slip", ", ".join(shares), "% of area"),
        ("largest lateral displacement", f"{numbers['max_lateral_displacement_um']:.3g}", "µm"),
        ("approach left by the contact law", f"{numbers['approach_um']:.2g}", "µm"),
        ("largest penetration", f"{numbers['max_penetration_um']:.2g}", "µm"),
        ("smallest volume ratio", f"{numbers['min_volume_ratio']:.3f}", ""),
        *_effort(numbers),
    ]


def _effort(numbers: dict[str, Any]) -> list[tuple[str, str, str]]:
    increments = f"{numbers['increments_count']}"
    if "kinetic_energy_percent" not in numbers:
        return [("load increments, Newton steps", f"{increments}, {numbers['newton_steps_count']}", "")]
    shares = f"{numbers['kinetic_energy_percent']:.2g}, {numbers['energy_drift_percent']:.2g}"
    return [("time increments", increments, ""), ("kinetic energy, energy missing", shares, "%")]


def _pressures(solution: Solution | ExperimentSolution) -> dict[str, float]:
    pressure = _KPA * np.asarray(solution.pressure)
    current = np.asarray(solution.positions[:, -1]) + np.asarray(solution.displacement[:, -1])
    area = node_areas(*current)
    return {
        "pressure_mean_kPa": float(np.sum(pressure * area) / np.sum(area)),
        "pressure_max_kPa": float(pressure.max()),
        "pressure_p99_kPa": float(np.percentile(pressure, 99)),
    }


def _contact(solution: Solution | ExperimentSolution) -> dict[str, float]:
    area = node_areas(*np.asarray(solution.positions[:, -1]))
    failed = not np.isfinite(np.asarray(solution.pressure)).all()
    status = np.asarray(solution.contact_status)

    def share(where: Bool[np.ndarray, "ny nx"]) -> float:
        return math.nan if failed else _share(where, area)

    return {
        "contact_area_fraction": share(status != 0),
        "open_fraction": share(status == 0),
        "stick_fraction": share(status == 1),
        "slip_fraction": share(status == 2),
    }


def _share(where: Bool[np.ndarray, "ny nx"], area: Float[np.ndarray, "ny nx"]) -> float:
    return float(np.sum(area[where]) / np.sum(area))


def _known(value: Any) -> Any:
    if isinstance(value, list):
        return [_known(item) for item in value]
    if not isinstance(value, float):
        return value
    return value + 0.0 if math.isfinite(value) else None  # -0.0 becomes 0.0
