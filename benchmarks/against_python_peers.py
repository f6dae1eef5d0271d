"""felupe and torch-fem on the same mesh: answer, time and memory beside opfem's.

Run `python -m benchmarks.against_python_peers [--variant B3] [--elements 16 32 64] [--increments 4] [--codes ...]`
in the repository's root. The problem is a quarter of the formula family, n/2 × n/2 × n/4 fully integrated hexahedra
of Mooney-Rivlin rubber, which all three integrate alike. Each solve runs in a process of its own. Prints one JSON
line per solve: seconds with compilation and, solved again, without; peak memory; the force against opfem's.

felupe is a development dependency; torch-fem (package torch-fem) is left out where it is not installed. Both use
the linear solver that they choose themselves; felupe pypardiso's where that is installed, as its manual advises.
"""

import argparse
import importlib.util
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import numpy as np

import opfem as op
from tests.reference import cases

MODULES = {"opfem": "opfem", "felupe": "felupe", "torch-fem": "torchfem"}
# Relative to the forces; what each code measures differs a little.
RTOL = 1e-7
# Corners of a hexahedron in VTK's order.
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]


class Statement:
    """The problem as arrays: points, cells, which displacements are given, and their end values."""

    def __init__(self, variant: str, n: int):
        self.palpation, self.load = cases.formula_family(variant, n, "full")
        X = np.asarray(self.palpation.mesh().positions())
        nz, ny, nx = (k - 1 for k in X.shape[1:])
        numbers = np.arange(X[0].size).reshape(X.shape[1:])
        self.points = X.reshape(3, -1).T
        self.cells = np.stack([numbers[z : z + nz, y : y + ny, x : x + nx] for x, y, z in CORNERS], -1).reshape(-1, 8)
        given, values = np.zeros(X.shape, bool), np.zeros(X.shape)
        given[0, ..., 0] = given[1, :, 0] = True  # planes of symmetry
        given[2, 0] = given[2, -1] = True
        given[:2, 0] |= variant in ("B1", "B2")
        given[:2, -1] |= variant == "B1"
        values[2, -1] = np.asarray(self.load.uz)
        self.given, self.values = given.reshape(3, -1).T, values.reshape(3, -1).T
        self.top = numbers[-1].ravel()


def by_opfem(problem: Statement, increments: int) -> Callable[[], tuple[float, int]]:
    settings = op.Newton(increments=increments, rtol=RTOL)

    def solve():
        solution = op.solve(problem.palpation, problem.load, settings, progress=False)
        return cases.normal_force(solution), int(solution.stats["newton_steps"])

    return solve


def by_felupe(problem: Statement, increments: int) -> Callable[[], tuple[float, int]]:
    import felupe as fem
    from felupe.constitution.tensortrax import Hyperelastic
    from felupe.constitution.tensortrax.models.hyperelastic import mooney_rivlin

    material = cases.MATERIAL
    law = fem.CompositeMaterial(
        Hyperelastic(mooney_rivlin, C10=material["c10"], C01=material["c01"]), fem.Volumetric(bulk=material["bulk"])
    )
    options = {}
    if importlib.util.find_spec("pypardiso"):
        options["solver"] = importlib.import_module("pypardiso").spsolve
    given, values = problem.given.ravel(), problem.values.ravel()
    fixed, free = np.flatnonzero(given), np.flatnonzero(~given)

    def solve():
        mesh = fem.Mesh(problem.points, problem.cells, "hexahedron")
        field = fem.FieldContainer([fem.Field(fem.RegionHexahedron(mesh), dim=3)])
        solid = fem.SolidBody(law, field)
        steps = 0
        for part in np.arange(1, increments + 1) / increments:
            end = fem.newtonrhapson(
                items=[solid], dof0=fixed, dof1=free, ext0=part * values[fixed], tol=RTOL, verbose=0, **options
            )
            steps += end.iterations
        force = solid.assemble.vector().toarray().reshape(-1, 3)
        return -float(force[problem.top, 2].sum()), steps

    return solve


def by_torch_fem(problem: Statement, increments: int) -> Callable[[], tuple[float, int | None]]:
    import torch
    import torchfem
    from torchfem.materials import Hyperelastic3D

    torch.set_default_dtype(torch.float64)

    def energy(F, parameters):
        c10, c01, bulk = parameters
        C = F.transpose(-1, -2) @ F
        J = torch.exp(0.5 * torch.logdet(C))
        first = torch.trace(C)
        second = 0.5 * (first**2 - torch.trace(C @ C))
        return c10 * (J ** (-2 / 3) * first - 3) + c01 * (J ** (-4 / 3) * second - 3) + 0.5 * bulk * (J - 1) ** 2

    material = Hyperelastic3D(energy, [cases.MATERIAL[name] for name in ("c10", "c01", "bulk")])

    def solve():
        body = torchfem.Solid(torch.tensor(problem.points), torch.tensor(problem.cells), material)
        body.constraints = torch.tensor(problem.given)
        body.displacements = torch.tensor(problem.values)
        steps = torch.linspace(0.0, 1.0, increments + 1)
        _, force, *_ = body.solve(increments=steps, rtol=RTOL, atol=1e-12)
        return -float(force[problem.top, 2].sum()), None

    return solve


CODES = {"opfem": by_opfem, "felupe": by_felupe, "torch-fem": by_torch_fem}


def peak_memory() -> float:
    """Read the most memory that this process held so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(code: str, variant: str, n: int, increments: int) -> dict:
    """Solve twice in this process."""
    jax.config.update("jax_enable_x64", True)
    problem = Statement(variant, n)
    solve = CODES[code](problem, increments)
    before, seconds = peak_memory(), []
    for _ in range(2):
        begin = time.perf_counter()
        force, steps = solve()
        seconds.append(round(time.perf_counter() - begin, 3))
    return {
        "code": code,
        "variant": variant,
        "elements": problem.palpation.elements,
        "increments": increments,
        "newton_steps": steps,
        "force_N": force,
        "first_seconds": seconds[0],
        "seconds": seconds[1],
        "peak_MB": round(peak_memory()),
        "peak_MB_before": round(before),
    }


def measure_apart(code: str, variant: str, n: int, increments: int) -> dict:
    """Solve in a fresh process."""
    worker = [sys.executable, "-m", "benchmarks.against_python_peers", "--worker", "--codes", code]
    options = ["--variant", variant, "--elements", str(n), "--increments", str(increments)]
    end = subprocess.run([*worker, *options], capture_output=True, text=True, check=False)
    if end.returncode:
        return {"code": code, "variant": variant, "n": n, "failed": end.stderr.strip().splitlines()[-1:]}
    return json.loads(end.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant", choices=("B1", "B2", "B3"), default="B3")
    parser.add_argument("--elements", type=int, nargs="+", default=[16, 32, 64], metavar="N")
    parser.add_argument("--increments", type=int, default=4)
    parser.add_argument("--codes", nargs="+", choices=list(CODES), default=list(CODES))
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    for n in chosen.elements:
        if chosen.worker:
            print(json.dumps(measure(chosen.codes[0], chosen.variant, n, chosen.increments)))
            return
        own = None
        for code in chosen.codes:
            if importlib.util.find_spec(MODULES[code]) is None:
                print(json.dumps({"code": code, "left out": "not installed"}))
                continue
            row = measure_apart(code, chosen.variant, n, chosen.increments)
            own = row if code == "opfem" else own
            if own is not None and code != "opfem" and "force_N" in row:
                row["force_off"] = row["force_N"] / own["force_N"] - 1.0
                row["opfem_times_faster"] = round(row["seconds"] / own["seconds"], 1)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
