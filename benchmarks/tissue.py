"""Maps of tissue, and the coin, at the size that people measure, with default options.

Run `python -m benchmarks.tissue lifted|tissue|smooth [--elements 200 200 6]` or `python -m benchmarks.tissue coin MAP
--elements 40 40 4`. `lifted` is a layer of 7 × 7 × 0.55 mm two corners of whose sample lift off (a third of the field);
`tissue` is pressed by up to 62 %, a tenth lifted off, with pockets whose walls have slopes to 2; `smooth` is the same
without steep walls, for comparing Newton with `--explicit`. Prints one JSON line: attempts, Newton and Krylov steps,
CPU and wall seconds (of the second solve with `--again`, compiled), peak memory, force, penetration, overlap of sides.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import jax
import numpy as np
from scipy.ndimage import gaussian_filter

import opfem as op

C10, C01, BULK = 2.23e-3, 7.03e-4, 0.11732  # MPa
FIELD, THICKNESS = 7.0, 0.55  # mm
BEYOND = 1.0  # mm that maps reach past the layer
PIXEL = 0.035  # mm
STRAIN, SLOPE, LIFT = 0.62, 2.0, 0.03  # -, -, mm
COIN_FIELD, COIN_THICKNESS = 5.0, 0.5  # mm


def plane() -> tuple[np.ndarray, np.ndarray]:
    """Lay out the pixels' x and y [mm]."""
    axis = np.arange(round((FIELD + 2.0 * BEYOND) / PIXEL) + 1) * PIXEL - BEYOND
    x, y = np.meshgrid(axis, axis)
    return x, y


def lobes(rng: np.random.Generator, width: float) -> np.ndarray:
    """Draw smooth noise of unit variance; `width` in mm."""
    noise = gaussian_filter(rng.standard_normal(plane()[0].shape), width / PIXEL, mode="reflect")
    return noise / noise.std()


def lifted_corners(radius: float, edge: float = 0.3) -> np.ndarray:
    """Say how far two corners are lifted, from 0 to 1; the second has 0.8 of the radius [mm]."""
    x, y = plane()
    away = np.hypot(x - FIELD, y) - radius, np.hypot(x, y - 0.9 * FIELD) - 0.8 * radius
    return np.clip(sum(1.0 / (1.0 + np.exp(distance / edge)) for distance in away), 0.0, 1.0)


def as_map(depth: np.ndarray, lifted: np.ndarray) -> op.ThicknessMap:
    """Press to a depth [mm] where corners are not lifted."""
    height = THICKNESS - depth * (1.0 - lifted) + LIFT * lifted
    return op.ThicknessMap(height, spacing=(PIXEL, PIXEL), origin=(-BEYOND, -BEYOND))


def lifted_map() -> op.ThicknessMap:
    """Make the map of trial 21: a third of the field lifted off."""
    return as_map(0.13 - 0.04 * lobes(np.random.default_rng(0), 0.4), lifted_corners(3.5))


def tissue_map(seed: int = 0, with_walls: bool = True) -> op.ThicknessMap:
    """Make a map like that of breast tissue: lobes, lifted corners, and pockets with steep walls."""
    rng = np.random.default_rng(seed)
    field = lobes(rng, 0.6)
    field = (field - field.min()) / np.ptp(field)
    x, y = plane()
    pocket = np.zeros_like(x)
    rise = 0.4 * STRAIN * THICKNESS
    # Of tanh(distance / wall) / 2, times the rise, the steepest slope is rise / (2 wall).
    wall = rise / (2.0 * SLOPE) if with_walls else 0.5
    for _ in range(4):
        (cx, cy), radius = rng.uniform(0.25 * FIELD, 0.75 * FIELD, 2), rng.uniform(0.4, 0.7)
        pocket = np.maximum(pocket, 0.5 * (1.0 + np.tanh((radius - np.hypot(x - cx, y - cy)) / wall)))
    depth = THICKNESS * 0.6 * STRAIN * (0.3 + 0.7 * field) + rise * pocket
    return as_map(depth * STRAIN * THICKNESS / depth.max(), lifted_corners(2.0))


def statement(chosen: argparse.Namespace) -> tuple[op.Palpation, op.Imprint]:
    """State the problem."""
    if chosen.problem == "coin":
        side, thickness = COIN_FIELD, COIN_THICKNESS
        loaded = op.read_thickness(chosen.map, extent=(side, side)).filled().smoothed(fwhm=chosen.smooth)
    else:
        side, thickness = FIELD, THICKNESS
        loaded = lifted_map() if chosen.problem == "lifted" else tissue_map(chosen.seed, chosen.problem == "tissue")
    window, sample = chosen.friction
    palpation = op.Palpation(
        op.Layer(thickness, op.MooneyRivlin(C10, C01, BULK)),
        extent=(side, side),
        elements=tuple(chosen.elements),
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
        **({} if chosen.side_contact is None else {"side_contact": chosen.side_contact}),
    )
    return palpation, op.Imprint(loaded)


def cpu() -> float:
    """Read the CPU time of this process [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def steepest(loaded: op.ThicknessMap) -> float:
    """Find the steepest slope of a map [-]."""
    spacing = [float(length) / (n - 1) for length, n in zip(loaded.extent[::-1], loaded.shape, strict=True)]
    return float(np.hypot(*np.gradient(np.asarray(loaded.values), *spacing)).max())


def measure(chosen: argparse.Namespace) -> dict:
    """Solve, and describe how it went."""
    palpation, load = statement(chosen)
    solver = op.Explicit() if chosen.explicit else op.Newton(max_increments=chosen.max_increments)
    for _ in range(1 + chosen.again):
        wall, begin = time.perf_counter(), cpu()
        solution = op.solve(palpation, load, solver, throw=False)
        jax.block_until_ready(solution.pressure)
        wall, begin = time.perf_counter() - wall, cpu() - begin
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    counts = ("attempts", "increments", "newton_steps", "krylov_steps")
    energies = ("kinetic_ratio", "energy_drift", "residual", "side_overlap")
    return {
        "problem": chosen.problem,
        "elements": palpation.elements,
        "friction": chosen.friction,
        "side_contact": chosen.side_contact,
        "solver": type(solver).__name__,
        "strain": float(1.0 - np.asarray(load.thickness.values).min() / np.max(np.asarray(palpation.mesh().thickness))),
        "slope": steepest(load.thickness),
        "message": op.RESULTS[solution.result],
        "load_fraction": float(solution.last_converged.load_fraction),
        **{name: int(stats[name]) for name in counts if name in stats},
        **{name: float(stats[name]) for name in energies if name in stats},
        "compiled": chosen.again,
        "cpu_s": round(begin, 1),
        "wall_s": round(wall, 1),
        "peak_MB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "force_N": -float(stats["force_sample"][2]),
        "max_penetration_um": 1e3 * float(stats["max_penetration"]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", choices=("lifted", "tissue", "smooth", "coin"))
    parser.add_argument("map", type=Path, nargs="?", help="the coin's map")
    parser.add_argument("--elements", type=int, nargs=3, default=(50, 50, 4), metavar=("NX", "NY", "NZ"))
    parser.add_argument("--friction", type=float, nargs=2, default=(0.15, 0.05), metavar=("WINDOW", "SAMPLE"))
    parser.add_argument("--smooth", type=float, default=0.06, help="FWHM [mm], of the coin")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--side-contact", action=argparse.BooleanOptionalAction, help="default: that of Palpation")
    parser.add_argument("--explicit", action="store_true", help="by explicit dynamics instead")
    parser.add_argument("--max-increments", type=int, default=1500)
    parser.add_argument("--again", action="store_true", help="solve twice: the second time nothing is compiled")
    parser.add_argument("--cache", type=Path, help="keep what is compiled in this folder, and use it")
    chosen = parser.parse_args()
    if chosen.problem == "coin" and chosen.map is None:
        parser.error("the coin needs its map")
    jax.config.update("jax_enable_x64", True)
    if chosen.cache is not None:
        op.cache_compilation(chosen.cache)
    print(json.dumps(measure(chosen)), flush=True)


if __name__ == "__main__":
    main()
