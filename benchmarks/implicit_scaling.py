"""The implicit solver on finer and larger meshes: time, memory, Newton and Krylov steps.

Run `python -m benchmarks.implicit_scaling coin MAP [--elements 40 80 160]`, MAP being coin_5c_1-thickness.mat of the
published toolbox, on n × n × n/10 elements; or `python -m benchmarks.implicit_scaling breast` for a map of 7 × 7 mm
made here, on 200 × 200 × 6. Each mesh is solved in a process of its own. Prints one JSON line per mesh: seconds with
compilation and, with `--again`, those of a second solve, without; peak memory; Krylov steps (applications of the
preconditioner) per Newton step, for linear systems solved to `--krylov-rtol`; and seconds over those of the mesh
before.

`--part 0.25` presses only to that part of the map's depth; `--smooth 0.3` smooths the coin over that width [mm];
`--sides roller` takes the field for a part of a larger layer, which goes on beyond it alike.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.ndimage import gaussian_filter

import opfem as op

C10, C01 = 0.00223, 0.000703  # MPa
COIN_FIELD, COIN_THICKNESS = 5.0, 0.5  # mm
BREAST_FIELD, BREAST_THICKNESS, BREAST_STRAIN, BREAST_OPEN = 7.0, 0.55, 0.62, 0.1
BREAST_ELEMENTS = (200, 200, 6)
PIXELS = 351  # 20 µm


def breast_map(seed: int = 0) -> op.ThicknessMap:
    """Make a map like that of breast tissue: smooth lobes, ducts with sharp edges, hollows that do not touch."""
    rng = np.random.default_rng(seed)

    def field(width: float) -> np.ndarray:  # mm
        noise = gaussian_filter(rng.standard_normal((PIXELS, PIXELS)), width * (PIXELS - 1) / BREAST_FIELD)
        return noise / noise.std()

    lobes, ducts = field(0.6), field(0.35)
    height = lobes + 0.8 * np.tanh(6.0 * (np.abs(ducts) - 0.8))
    lowest = np.quantile(height, BREAST_OPEN)
    strain = BREAST_STRAIN * (height - lowest) / (height.max() - lowest)
    surface = op.ThicknessMap(BREAST_THICKNESS * (1.0 - strain), extent=(BREAST_FIELD, BREAST_FIELD))
    return surface.smoothed(fwhm=0.1)


def statement(chosen: argparse.Namespace, n: int) -> tuple[op.Palpation, op.Imprint]:
    """State the problem on one mesh."""
    if chosen.problem == "coin":
        side, thickness, elements = COIN_FIELD, COIN_THICKNESS, (n, n, n // 10)
        loaded = op.read_thickness(chosen.map, extent=(side, side)).smoothed(fwhm=chosen.smooth)
    else:
        side, thickness, elements = BREAST_FIELD, BREAST_THICKNESS, BREAST_ELEMENTS
        loaded = breast_map()
    window, sample = chosen.friction
    palpation = op.Palpation(
        op.Layer(thickness, op.MooneyRivlin(c10=C10, c01=C01, bulk=chosen.bulk)),
        extent=(side, side),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
        element=chosen.element,
        sides=chosen.sides,
    )
    pressed = thickness - chosen.part * (thickness - np.asarray(loaded.values))
    return palpation, op.Imprint(op.ThicknessMap(pressed, extent=(side, side)))


def measure(chosen: argparse.Namespace, n: int) -> dict:
    """Solve on one mesh in this process."""
    jax.config.update("jax_enable_x64", True)
    palpation, load = statement(chosen, n)
    settings = op.Newton(krylov_rtol=chosen.krylov_rtol)
    seconds = []
    for _ in range(2 if chosen.again else 1):
        begin = time.perf_counter()
        solution = op.solve(palpation, load, settings, throw=False)
        jax.block_until_ready(solution.pressure)
        seconds.append(round(time.perf_counter() - begin, 2))
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    steps, krylov = int(stats["newton_steps"]), int(stats["krylov_steps"])
    return {
        "problem": chosen.problem,
        "elements": palpation.elements,
        "element": palpation.element,
        "sides": chosen.sides,
        "unknowns": 3 * int(np.prod([k + 1 for k in palpation.elements])),
        "friction": chosen.friction,
        "K_over_mu": round(chosen.bulk / (2.0 * (C10 + C01)), 1),
        "part": chosen.part,
        "message": op.RESULTS[solution.result],
        "load_fraction": float(solution.last_converged.load_fraction),
        "force_N": -float(stats["force_sample"][2]),
        "attempts": int(stats["attempts"]),
        "newton_steps": steps,
        "krylov_per_newton_step": round(krylov / max(steps, 1), 2),
        "krylov_rtol": chosen.krylov_rtol,
        "first_seconds": seconds[0],
        "seconds": seconds[-1] if chosen.again else None,
        "peak_MB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", choices=("coin", "breast"))
    parser.add_argument("map", type=Path, nargs="?", help="the coin's map")
    parser.add_argument("--elements", type=int, nargs="+", default=[40, 80], metavar="N")
    parser.add_argument("--element", default="mean_dilatation")
    parser.add_argument("--sides", choices=("free", "roller"), default="free")
    parser.add_argument("--friction", type=float, nargs=2, default=(0.15, 0.05), metavar=("WINDOW", "SAMPLE"))
    parser.add_argument("--bulk", type=float, default=0.11732, help="MPa; 0.11732 is K/µ = 20")
    parser.add_argument("--smooth", type=float, default=0.06, help="width of smoothing [mm]")
    parser.add_argument("--part", type=float, default=1.0, help="part of the depth that is pressed")
    parser.add_argument("--krylov-rtol", type=float, default=1e-2)
    parser.add_argument("--again", action="store_true", help="solve twice: the second time nothing is compiled")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.problem == "coin" and chosen.map is None:
        parser.error("the coin needs its map")
    return chosen


def main() -> None:
    chosen = parse(sys.argv[1:])
    if chosen.worker is not None:
        print(json.dumps(measure(chosen, chosen.worker)))
        return
    before = None
    for n in chosen.elements if chosen.problem == "coin" else BREAST_ELEMENTS[:1]:
        worker = [sys.executable, "-m", "benchmarks.implicit_scaling", *sys.argv[1:], "--worker", str(n)]
        row = json.loads(subprocess.run(worker, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])
        if before is not None and row["seconds"]:
            row["times_before"] = round(row["seconds"] / before["seconds"], 2)
        print(json.dumps(row), flush=True)
        before = row


if __name__ == "__main__":
    main()
