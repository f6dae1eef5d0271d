"""The published coin map, as `opfem palpate` solves it: time, balance, increments, refinement, variants.

Run `python benchmarks/coin.py MAP [--increments 8 32] [--elements 20 40 80] [--case NAME ...]` in a
fresh process: the first line's time includes compilation, with nothing cached. Prints one JSON line per
solve. MAP is coin_5c_1-thickness.mat of the published toolbox.
"""

import argparse
import json
import time
from pathlib import Path

START = time.perf_counter()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import opfem as op  # noqa: E402
from opfem.mechanics.face import gather_face, surface_tangents  # noqa: E402
from opfem.solvers.discretise import discretise  # noqa: E402


def experiment(n: int, element: str, c10: float, window: float, sample: float) -> op.Palpation:
    """State the coin with n × n × n/10 elements."""
    return op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=c10, c01=0.000703, bulk=0.11732)),
        extent=(5.0, 5.0),
        elements=(n, n, n // 10),
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
        element=element,
    )


def interface_error(solution: op.Solution, settings: op.Newton) -> float:
    """Compute the rms distance [µm] of closed contact points from the imprint's own surface."""
    problem = discretise(solution.palpation, solution.load, None, settings.face_rule)
    corners = gather_face(problem.positions[:, -1] + solution.displacement[:, -1])
    position = surface_tangents(corners, settings.face_rule)[0]
    height, slope_x, slope_y = problem.contacts.sample.surface.at(jnp.ones(()), position[0], position[1])
    distance = np.asarray((height - position[2]) / jnp.sqrt(1.0 + slope_x**2 + slope_y**2))
    start = np.asarray(solution.palpation.sample.law.zero_pressure_clearance)
    closed = distance + start < start  # pressure acts below the law's zero-pressure clearance
    return 1e3 * float(np.sqrt(np.mean(distance[closed] ** 2)))


def run(thickness: op.ThicknessMap, palpation: op.Palpation, settings: op.Newton, interpolation: str, **about) -> dict:
    """Solve once and describe the result."""
    begin = time.perf_counter()
    solution = op.solve(palpation, op.Imprint(thickness, interpolation=interpolation), settings, throw=False)
    jax.block_until_ready(solution.pressure)
    ready = time.perf_counter()
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    total = stats["force_sample"] + stats["force_window"] + stats["force_hold"]
    return {
        **about,
        "elements": palpation.elements,
        "element": palpation.element,
        "interpolation": interpolation,
        "face_rule": settings.face_rule,
        "asked_increments": settings.increments,
        "seconds": round(ready - begin, 2),
        "since_start_s": round(ready - START, 2),
        "message": op.RESULTS[solution.result],
        "load_fraction": float(solution.last_converged.load_fraction),
        "force_N": -float(stats["force_sample"][2]),
        "imbalance": float(np.abs(total).max() / abs(stats["force_sample"][2])),
        "interface_rms_um": interface_error(solution, settings),
        "mean_pressure_kPa": 1e3 * float(solution.pressure.mean()),
        "smoothed_map_kPa": smoothed(solution),
        **{
            name: stats[name].tolist()
            for name in ("min_volume_ratio", "attempts", "increments", "newton_steps", "krylov_steps")
        },
    }


def smoothed(solution: op.Solution, cells: int = 10) -> list[list[float]]:
    """Average −stress_zz [kPa] over a coarse grid, for comparing meshes."""
    stress = -1e3 * np.asarray(solution.stress_zz)
    ny, nx = stress.shape
    blocks = stress.reshape(cells, ny // cells, cells, nx // cells).mean(axis=(1, 3))
    return np.round(blocks, 4).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("--increments", type=int, nargs="+", default=[8])
    parser.add_argument("--elements", type=int, nargs="+", default=[40])
    parser.add_argument("--element", default="mean_dilatation")
    parser.add_argument("--interpolation", nargs="+", default=["cubic"])
    parser.add_argument("--face-rule", nargs="+", default=["gauss2"])
    parser.add_argument("--window-friction", type=float, default=0.15)
    parser.add_argument("--sample-friction", type=float, default=0.05)
    parser.add_argument("--smooth", type=float, default=0.06, help="FWHM [mm]")
    parser.add_argument("--again", action="store_true", help="solve each case a second time with another c10")
    parser.add_argument("--cache", type=Path, help="keep what is compiled in this folder, and use it")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if chosen.cache is not None:
        op.cache_compilation(chosen.cache)
    thickness = op.read_thickness(chosen.map, extent=(5.0, 5.0)).smoothed(fwhm=chosen.smooth)
    for n in chosen.elements:
        for interpolation in chosen.interpolation:
            for rule in chosen.face_rule:
                for increments in chosen.increments:
                    settings = op.Newton(increments=increments, face_rule=rule)
                    for c10 in (0.00223, 0.00226) if chosen.again else (0.00223,):
                        palpation = experiment(n, chosen.element, c10, chosen.window_friction, chosen.sample_friction)
                        record = run(thickness, palpation, settings, interpolation, c10=c10)
                        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
