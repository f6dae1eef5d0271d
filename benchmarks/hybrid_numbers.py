"""The hybrid form at any bulk modulus: uniform compression, Cook's membrane and a bonded disc.

Run `python benchmarks/hybrid_numbers.py [--cook 8 16 32]` from the repository's root. Prints one JSON line per
solve (value, reference, Krylov iterations of every Newton step, seconds) and a table at the end. The meshes are
those of tests/verification. A reference is null where none is stored for that K/µ.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402

import opfem as op  # noqa: E402
from opfem.solvers.sparse_statics import StaticProblem, StaticSettings, solve_statics  # noqa: E402
from tests.verification import meshes  # noqa: E402
from tests.verification.statics import at, body, held  # noqa: E402
from tests.verification.test_bonded_disc import apparent_modulus  # noqa: E402
from tests.verification.test_cook import SHEAR, TIP_Y, TIP_Y_AT_20, tip  # noqa: E402

RATIOS = (20.0, 1e3, 1e5, np.inf)
STRETCH = 0.8
SLENDERNESS = 2.5
# Ea/E of VALIDATION's table C; its K/µ = 5e4 is incompressible to 0.1%.
TABLE_C = {20.0: 4.421, 1e5: 13.15, np.inf: 13.15}


def compression_reference(ratio: float) -> float:
    """Nominal stress over µ of neo-Hooke under lubricated compression, solved for the lateral stretch."""
    if np.isinf(ratio):
        return STRETCH - STRETCH**-2

    def stresses(t):
        J = t * t * STRETCH
        mean = (2 * t * t + STRETCH**2) / 3
        return (J ** (-5 / 3) * (squared - mean) + ratio * (J - 1) for squared in (t * t, STRETCH**2))

    low, high = 1.0, 1.2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if next(stresses(middle)) < 0 else (low, middle)
    _, along = stresses(low)
    return along * low * low


def compression(ratio: float) -> tuple[float, float | None, tuple]:
    """Nominal stress over µ of a distorted cube compressed to 0.8 between lubricated plates."""
    points, cells = meshes.patch_cube()
    top = at(points[2], 1.0)
    fixed = held(points, x=at(points[0], 0.0), y=at(points[1], 0.0), z=at(points[2], 0.0) | top)
    u = np.zeros(points.shape)
    u[2, top] = STRETCH - 1.0
    solid = body(points, cells, op.NeoHooke(0.5, ratio), "hybrid")
    solution = solve_statics(StaticProblem(solid, points, fixed, displacement=u), StaticSettings())
    return solution.reaction[2, top].sum(), compression_reference(ratio), solution.krylov_iterations


def cook(ratio: float, n: int) -> tuple[float, float | None, tuple]:
    """Tip u_y [mm] of Cook's membrane; the reference's own K/µ is 4999, whose tip 1e5 and infinity share to 0.02%."""
    u, solution = tip(n, "hybrid", bulk=ratio * SHEAR)
    reference = {20.0: TIP_Y_AT_20, 1e5: TIP_Y, np.inf: TIP_Y}.get(ratio)
    return u[1], reference, solution.krylov_iterations


def disc(ratio: float) -> tuple[float, float | None, tuple]:
    """Ea / E of a bonded disc whose radius is five times its height."""
    nu = 0.5 if np.isinf(ratio) else (3 * ratio - 2) / (6 * ratio + 2)
    value, solution = apparent_modulus(nu, SLENDERNESS)
    return value, TABLE_C.get(ratio), solution.krylov_iterations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cook", type=int, nargs="+", default=[8, 16, 32])
    sizes = parser.parse_args().cook
    cases = {"compression": compression, **{f"cook {n}²": lambda r, n=n: cook(r, n) for n in sizes}, "disc": disc}
    table = []
    for name, case in cases.items():
        for ratio in RATIOS:
            begin = time.perf_counter()
            value, reference, krylov = case(ratio)
            line = {"case": name, "bulk/shear": str(ratio), "value": float(value), "reference": reference}
            line |= {"krylov": krylov, "seconds": round(time.perf_counter() - begin, 2)}
            print(json.dumps(line), flush=True)
            error = f"{100 * (value / reference - 1):+.2f}%" if reference else "–"
            steps = [n for increment in krylov for n in increment]
            table.append(f"{name:12} {ratio:8g} {value:12.6g} {error:>8} {np.mean(steps):6.1f} {max(steps):4d}")
    print("\nKrylov iterations per Newton step: mean and most")
    print(f"{'case':12} {'K/µ':>8} {'value':>12} {'error':>8} {'mean':>6} {'most':>4}")
    print("\n".join(table))


if __name__ == "__main__":
    main()
