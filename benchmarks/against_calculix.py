"""CalculiX on the same problem: its deck written from opfem's, solved by `ccx`, answers and times side by side.

Run `python -m benchmarks.against_calculix SHARED [--case NAME ...] [--elements 20 40] [--limit 1800] [--no-opfem]`
in the repository's root; `ccx` must be installed (package calculix-ccx of Debian and Ubuntu). SHARED is the folder
that holds reference/ccx/cases; NAME is one of its contact cases of the coin. Prints one JSON line per case and
mesh. opfem's time is that of a second solve, without compilation; the first one's is beside it. A run of CalculiX
that is stopped at the limit is reported as a bound.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

import opfem as op
from benchmarks.calculix_cases import contact_on_mesh, described
from benchmarks.stream import cores
from tests.reference import cases

CASES = ("coin_ccxcontact_top_mu0_bottom_slip_C3D8", "coin_ccxcontact_muwin0p15_mutop0p05_lam0p02_C3D8")
# In-plane springs [N/mm] under the layer: without them a frictionless layer could drift without end.
SPRING = 1e-7


def deck(palpation: op.Palpation, load: op.Imprint) -> str:
    """Write a palpation as a CalculiX deck: C3D8 layer, rigid imprint of flat facets, face-to-face contact.

    Args:
        palpation: A flat layer of `MooneyRivlin`; contact laws `LinearOverclosure`, the window perhaps a `Roller`.
        load: The imprint.

    Raises:
        ValueError: If the palpation has something else.
    """
    return "\n".join([*_layer(palpation), *_imprint(palpation, load), *_window(palpation), *_steps(palpation, load)])


def _layer(palpation: op.Palpation) -> Iterator[str]:
    nx, ny, nz = palpation.elements
    material = palpation.layer.material
    if not isinstance(material, op.MooneyRivlin) or set(palpation.sides) != {"free"}:
        raise ValueError("A deck needs a layer of MooneyRivlin with free sides.")
    number = _layer_nodes(palpation)
    X = np.asarray(palpation.mesh().positions())
    yield "*NODE, NSET=NLAY"
    yield from _rows(number.ravel(), X.reshape(3, -1).T)
    low, high = number[:-1], number[1:]
    corners = [
        face[:, dy : dy + ny, dx : dx + nx] for face in (low, high) for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    yield "*ELEMENT, TYPE=C3D8, ELSET=ELAY"
    elements = np.arange(1, nx * ny * nz + 1)
    yield from _rows(elements, np.stack(corners).reshape(8, -1).T)
    yield "*ELSET, ELSET=ETOP"
    yield from _rows(elements[-nx * ny :])
    yield "*NSET, NSET=NBOT"
    yield from _rows(number[0].ravel())
    yield from ("*SURFACE, NAME=STOP", "ETOP, S2", "*SURFACE, NAME=SBOT")
    yield from (f"{element}, S1" for element in elements[: nx * ny])
    yield from ("*MATERIAL, NAME=LAYER", "*HYPERELASTIC, MOONEY-RIVLIN")
    yield f"{material.c10}, {material.c01}, {2.0 / material.bulk:.12g}"
    yield from ("*SOLID SECTION, ELSET=ELAY, MATERIAL=LAYER", "*MATERIAL, NAME=RIGID", "*ELASTIC", "1., 0.")
    for direction in (1, 2):
        springs = nx * ny * nz + (direction - 1) * number[0].size + number[0].ravel()
        yield f"*ELEMENT, TYPE=SPRING1, ELSET=ESPRING{direction}"
        yield from _rows(springs, number[0].reshape(-1, 1))
        yield from (f"*SPRING, ELSET=ESPRING{direction}", str(direction), f"{SPRING:.6E}")


def _layer_nodes(palpation: op.Palpation) -> np.ndarray:
    nx, ny, nz = palpation.elements
    return 1 + np.arange((nz + 1) * (ny + 1) * (nx + 1)).reshape(nz + 1, ny + 1, nx + 1)


def _rigid_number(palpation: op.Palpation) -> int:
    """First number of nodes and elements of the rigid bodies: beyond the layer's. CalculiX's memory grows with it."""
    nx, ny, nz = palpation.elements
    return (nx + 1) * (ny + 1) * (nz + 3) + 1


def _imprint(palpation: op.Palpation, load: op.Imprint) -> Iterator[str]:
    thickness = load.thickness
    y, x = (coordinates.ravel() for coordinates in np.meshgrid(thickness.y, thickness.x, indexing="ij"))
    z = np.full(x.size, float(palpation.layer.thickness))
    first = _rigid_number(palpation) + 8  # after the window's
    nodes = first + np.arange(2 * x.size)
    yield "*NODE, NSET=NIMP"
    yield from _rows(nodes, np.stack([np.tile(x, 2), np.tile(y, 2), np.concatenate([z, z + 0.5])], axis=1))
    low, high = nodes.reshape(2, *thickness.values.shape)
    around = (
        (slice(-1), slice(-1)),
        (slice(-1), slice(1, None)),
        (slice(1, None), slice(1, None)),
        (slice(1, None), slice(-1)),
    )
    corners = np.stack([face[at].ravel() for face in (low, high) for at in around], axis=1)
    yield "*ELEMENT, TYPE=C3D8, ELSET=EIMP"
    yield from _rows(first + np.arange(len(corners)), corners)
    yield from ("*SOLID SECTION, ELSET=EIMP, MATERIAL=RIGID", "*SURFACE, NAME=SIMP", "EIMP, S1")
    yield from _contact(palpation.sample, "TOP", "STOP, SIMP")


def _window(palpation: op.Palpation) -> Iterator[str]:
    if isinstance(palpation.window, op.Roller):
        return
    first = _rigid_number(palpation)
    width, depth = np.asarray(palpation.extent)
    ends = [(-width, -depth), (2 * width, -depth), (2 * width, 2 * depth), (-width, 2 * depth)]
    yield "*NODE, NSET=NWIN"
    yield from _rows(first + np.arange(8), np.array([(*end, z) for z in (-1.0, 0.0) for end in ends]))
    yield "*ELEMENT, TYPE=C3D8, ELSET=EWIN"
    yield from _rows([first], first + np.arange(8)[None])
    yield from ("*SOLID SECTION, ELSET=EWIN, MATERIAL=RIGID", "*SURFACE, NAME=SWIN", f"{first}, S2")
    yield from _contact(palpation.window, "BOTTOM", "SBOT, SWIN")


def _contact(side: op.Contact, name: str, pair: str) -> Iterator[str]:
    if not isinstance(side, op.Contact) or not isinstance(side.law, op.LinearOverclosure):
        raise ValueError(f"A deck needs Contact(LinearOverclosure(...)) there, got {side!r}.")
    yield f"*SURFACE INTERACTION, NAME=I{name}"
    yield from ("*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{side.law.stiffness}, 1e-05, 0.001")
    if side.friction > 0:
        yield from ("*FRICTION", f"{side.friction}, {side.stick_slope}")
    yield from (f"*CONTACT PAIR, INTERACTION=I{name}, TYPE=SURFACE TO SURFACE", pair)


def _steps(palpation: op.Palpation, load: op.Imprint) -> Iterator[str]:
    uz = np.tile(np.asarray(load.thickness.values - palpation.layer.thickness).ravel(), 2)
    yield from ("*BOUNDARY", "NIMP, 1, 2")
    if isinstance(palpation.window, op.Roller):
        yield "NBOT, 3, 3"
    else:  # friction holds the layer; two nodes in its middle keep it from drifting before it does
        nx, ny, _ = palpation.elements
        middle = _layer_nodes(palpation)[0, ny // 2]
        yield from ("NWIN, 1, 3", f"{middle[nx // 2]}, 1, 2", f"{middle[nx // 2 + max(nx // 20, 1)]}, 2, 2")
    yield from ("*STEP, NLGEOM, INC=400", "*STATIC", "0.1, 1., 1e-5, 0.15", "*BOUNDARY")
    first = _rigid_number(palpation) + 8
    yield from (f"{first + node}, 3, 3, {value:.9g}" for node, value in enumerate(uz))
    yield from ("*NODE PRINT, NSET=NIMP, TOTALS=ONLY, FREQUENCY=100000", "RF")
    yield from ("*EL PRINT, ELSET=ETOP, FREQUENCY=100000", "S", "*END STEP", "")


def _rows(numbers: Iterable, values: np.ndarray | None = None) -> Iterator[str]:
    for k, number in enumerate(numbers):
        yield f"{number}," if values is None else ", ".join([str(number), *(f"{value:.9g}" for value in values[k])])


@dataclass(frozen=True)
class Run:
    """What a run of CalculiX took and found; `finished` is False where it was stopped or failed."""

    finished: bool
    seconds: float
    memory_MB: float
    iterations: int
    force: float  # N
    stress: np.ndarray  # mean S33 of the top elements [MPa], NaN without


def run_calculix(text: str, shape: tuple[int, int], limit: float) -> Run:
    """Solve a deck with ccx, on all cores unless OMP_NUM_THREADS says otherwise.

    Args:
        text: The deck.
        shape: Top elements (ny, nx).
        limit: Wall time [s] after which it is stopped.
    """
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "job.inp").write_text(text)
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
        force, stress = read_results(Path(folder) / "job.dat", shape)
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


def read_results(path: Path, shape: tuple[int, int]) -> tuple[float, np.ndarray]:
    """Read the imprint's force [N] and the mean S33 [MPa] of the top elements at the end of the step."""
    text = path.read_text() if path.exists() else ""
    nothing = np.full(shape, np.nan)
    total = re.findall(r"total force \(fx,fy,fz\) for set NIMP and time\s+1\.0+E\+00\s+(\S+)\s+(\S+)\s+(\S+)", text)
    total += re.findall(r"total force \(fx,fy,fz\) for set NIMP and time\s+0?\.10+E\+01\s+(\S+)\s+(\S+)\s+(\S+)", text)
    if not total:
        return np.nan, nothing
    table = text[text.rindex("stresses (elem") :].split("\n\n")[1]
    values = np.array([line.split() for line in table.strip().splitlines()], float)
    elements, where = np.unique(values[:, 0], return_inverse=True)
    mean = np.bincount(where, values[:, 4]) / np.bincount(where)
    return -float(total[-1][2]), mean.reshape(shape) if elements.size == nothing.size else nothing


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
    run = run_calculix(deck(palpation, op.Imprint(surface)), palpation.elements[1::-1], limit)
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
