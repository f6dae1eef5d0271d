"""CalculiX on the same problem: its deck written from opfem's, solved by `ccx`, answers and times side by side.

Run `python -m benchmarks.against_calculix SHARED [--case NAME ...] [--elements 20 40] [--limit 1800] [--no-opfem]`
in the repository's root; `ccx` must be installed (package calculix-ccx of Debian and Ubuntu). SHARED is the folder
that holds reference/ccx/cases; NAME is one of its contact cases of the coin. Prints one JSON line per case and
mesh. opfem's time is that of a second solve, without compilation; the first one's is beside it. A run of CalculiX
that is stopped at the limit is reported as a bound.
"""

import argparse
import dataclasses
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

import opfem as op
from benchmarks.calculix_cases import contact_on_mesh, described
from benchmarks.stream import cores
from tests.reference import cases

CASES = ("coin_ccxcontact_top_mu0_bottom_slip_C3D8", "coin_ccxcontact_muwin0p15_mutop0p05_lam0p02_C3D8")

SPRING = 1e-7  # N/mm in the plane under each node of a layer without friction, as in the stored cases


@dataclass(frozen=True)
class Run:
    """What a run of CalculiX took and found; `finished` is False where it was stopped or failed."""

    finished: bool
    seconds: float
    memory_MB: float
    iterations: int
    force: float  # N
    stress: np.ndarray  # mean S33 of the top elements [MPa], NaN without


def run_calculix(palpation: op.Palpation, load: op.Imprint, limit: float) -> Run:
    """Solve a palpation with ccx, on all cores unless OMP_NUM_THREADS says otherwise.

    Args:
        palpation: The palpation.
        load: Its load.
        limit: Wall time [s] after which it is stopped.
    """
    with tempfile.TemporaryDirectory() as folder:
        op.write_inp(Path(folder) / "job.inp", palpation, load, op.Newton(increments=10), code="calculix")
        environment = {"OMP_NUM_THREADS": str(cores())} | os.environ
        begin = time.perf_counter()
        process = subprocess.Popen(["ccx", "-i", "job"], cwd=folder, env=environment, stdout=subprocess.DEVNULL)
        memory = 0.0
        try:
            while process.poll() is None and time.perf_counter() - begin < limit:
                memory = max(memory, peak_memory(process.pid))
                time.sleep(0.05)
            seconds = time.perf_counter() - begin
        finally:
            process.kill()
        status = process.wait()
        force, stress = read_results(Path(folder) / "job.dat", palpation)
        return Run(
            finished=status == 0 and bool(np.isfinite(force)),
            seconds=seconds,
            memory_MB=memory,
            iterations=count_iterations(Path(folder) / "job.sta"),
            force=force,
            stress=stress,
        )


def peak_memory(process: int) -> float:
    """Read the most memory that a process held so far [MB]; 0 where the system does not tell."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0.0
    peak = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(peak.group(1)) / 1024 if peak else 0.0


def read_results(path: Path, palpation: op.Palpation) -> tuple[float, np.ndarray]:
    """Read the imprint's force [N] and the mean S33 [MPa] of the top elements at the end of the step."""
    try:
        data = op.read_dat(path, palpation).isel(time=-1)
    except (OSError, op.DeckError):
        return np.nan, np.full(palpation.elements[1::-1], np.nan)
    return -float(data.force_press.sel(component="z")), data.stress_zz.values


def count_iterations(path: Path) -> int:
    """Count the equilibrium iterations, those of repeated increments included."""
    lines = path.read_text().splitlines() if path.exists() else []
    counts = [line.split()[3] for line in lines if len(line.split()) >= 4 and line.split()[0].isdigit()]
    return sum(int(count) for count in counts)


def solve_twice(palpation: op.Palpation, load: op.Imprint) -> tuple[op.Solution, float, float]:
    """Solve; return also the seconds with compilation and, solved again, without."""
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        solution = op.solve(palpation, load, throw=False, progress=False)
        jax.block_until_ready(solution.pressure)
        seconds.append(time.perf_counter() - begin)
    return solution, *seconds


def measure(shared: Path, name: str, n: int, limit: float, with_opfem: bool) -> dict:
    """Solve one case on one mesh with both."""
    palpation, load = contact_on_mesh(shared, name, n, "full")
    row = {"case": name, "elements": palpation.elements}
    surface = cases.imprint_map(cases.load_case(shared, name)[0])  # not moved, as opfem's is where the layer drifts
    held = palpation
    if isinstance(palpation.window, op.Roller):  # nothing holds the layer in the plane
        held = dataclasses.replace(palpation, hold=SPRING * (n + 1) ** 2)
    run = run_calculix(held, op.Imprint(surface), limit)
    row |= {
        "calculix_finished": run.finished,
        "calculix_seconds": round(run.seconds, 1),
        "calculix_MB": round(run.memory_MB),
        "calculix_iterations": run.iterations,
        "calculix_force_N": run.force,
        "calculix_mean_S33_MPa": float(run.stress.mean()),
    }
    if not with_opfem:
        return row
    solution, first, second = solve_twice(palpation, load)
    values = described(solution, name)
    off = np.linalg.norm(values["S33 map"] - run.stress) / np.linalg.norm(run.stress)
    jax.clear_caches()
    return row | {
        "opfem_message": op.RESULTS[solution.result],
        "opfem_first_seconds": round(first, 1),
        "opfem_seconds": round(second, 2),
        "opfem_force_N": values["force"],
        "force_off": values["force"] / run.force - 1.0,
        "S33_map_off": float(off),
        "times_faster": round(run.seconds / second, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path, help="folder that holds reference/ccx/cases")
    parser.add_argument("--case", nargs="+", default=list(CASES), metavar="NAME")
    parser.add_argument("--elements", type=int, nargs="+", default=[40], help="meshes of n × n × n/10")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which CalculiX is stopped")
    parser.add_argument("--no-opfem", action="store_true", help="CalculiX alone: its own refinement")
    chosen = parser.parse_args()
    if shutil.which("ccx") is None:
        parser.error("ccx is not installed: install the package calculix-ccx, or put ccx on the PATH")
    jax.config.update("jax_enable_x64", True)
    for name in chosen.case:
        for n in chosen.elements:
            print(json.dumps(measure(chosen.shared, name, n, chosen.limit, not chosen.no_opfem)), flush=True)


if __name__ == "__main__":
    main()
