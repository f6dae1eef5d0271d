"""An accelerator beside the CPU of its machine: bandwidth, tangent product, solves, explicit increments, a sweep.

Run `python -m benchmarks.device --out FILE.json [--limit 440] [--small]` on a machine with an NVIDIA GPU and
`pip install "jax[cuda12]"`. Each case is a process of its own, on one platform. The two platforms go side by side,
cases in order of worth; what does not fit into the limit [s] is left out and named. Without a GPU only the CPU's are
run. `--small` takes small meshes, to try the program. Prints one JSON line per case; FILE has all, with versions.

    bandwidth  a large array read, and copied [GB/s]
    product    tangent times a field, 40 × 40 × 4 and 200 × 200 × 6 elements, and its share of the bandwidth
    implicit   the lifted map of `tissue.py`, 50 × 50 × 4 and 200 × 200 × 6 elements: first and second solve
    explicit   increments per second of the same map in float32, with compiling apart
    sweep      16 materials × 8 frictions in batches: points per second, with compiling apart
"""

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import opfem as op
from benchmarks.tissue import BULK, C01, C10, FIELD, THICKNESS, lifted_map

WINDOW_FRICTION, SAMPLE_FRICTION = 0.15, 0.05
SMALL, MIDDLE, LARGE = (8, 8, 2), (50, 50, 4), (200, 200, 6)
EXPLICIT_DURATION = 0.1
READ = 2**29  # byte, far larger than any cache


def palpation(elements: tuple[int, int, int], c10=C10, friction=WINDOW_FRICTION) -> op.Palpation:
    """State the layer of `tissue.py`."""
    return op.Palpation(
        op.Layer(THICKNESS, op.MooneyRivlin(c10, C01, BULK)),
        extent=(FIELD, FIELD),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), friction),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), SAMPLE_FRICTION),
    )


def fastest(work, repeats: int = 10) -> float:
    """Time a piece of work on the device [s]; the fastest is the one least disturbed."""
    jax.block_until_ready(work())
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def bandwidth() -> dict:
    """Measure how fast the device reads and copies [GB/s]."""
    values = jnp.ones(READ // 4, jnp.float32)
    read, copied = jax.jit(jnp.sum), jax.jit(lambda v: v + 1.0)
    return {
        "read_GB_per_s": READ / fastest(lambda: read(values)) / 1e9,
        "copy_GB_per_s": 2 * READ / fastest(lambda: copied(values)) / 1e9,
    }


def product(elements: tuple[int, int, int]) -> dict:
    """Time the tangent's product."""
    from opfem.solvers.stencil import apply_stencil

    nodes = tuple(n + 1 for n in elements[::-1])
    stencil, field = jnp.ones((3, 9, 3, 3, *nodes), jnp.float32), jnp.ones((3, *nodes), jnp.float32)
    multiply = jax.jit(apply_stencil)
    seconds = fastest(lambda: multiply(stencil, field))
    moved = stencil.nbytes + 2 * field.nbytes
    return {"seconds": seconds, "GB_per_s": moved / seconds / 1e9, **bandwidth()}


def implicit(elements: tuple[int, int, int]) -> dict:
    """Solve twice."""
    seconds, load = [], op.Imprint(lifted_map())
    for c10 in (C10, 1.01 * C10):
        begin = time.perf_counter()
        solution = op.solve(palpation(elements, c10), load, throw=False)
        jax.block_until_ready(solution.pressure)
        seconds.append(time.perf_counter() - begin)
    return {
        "first_s": seconds[0],
        "second_s": seconds[1],
        "converged": bool(solution.result == op.RESULTS.successful),
        "force_N": -float(solution.stats["force_sample"][2]),
        **{name: int(solution.stats[name]) for name in ("attempts", "newton_steps", "krylov_steps")},
    }


def explicit(elements: tuple[int, int, int]) -> dict:
    """Run a short event twice; the second compiles nothing."""
    load, solver = op.Imprint(lifted_map()), op.Explicit(duration=EXPLICIT_DURATION)
    seconds = []
    for c10 in (C10, 1.01 * C10):
        begin = time.perf_counter()
        solution = op.solve(palpation(elements, c10), load, solver, throw=False)
        jax.block_until_ready(solution.pressure)
        seconds.append(time.perf_counter() - begin)
    increments = int(solution.stats["increments"])
    return {
        "first_s": seconds[0],
        "second_s": seconds[1],
        "increments": increments,
        "Melements_per_s": increments * float(np.prod(elements)) / seconds[1] / 1e6,
    }


def sweep(elements: tuple[int, int, int], counts: tuple[int, int] = (16, 8)) -> dict:
    """Sweep C10 and friction, as the device's defaults say, and once more: the rate of the second has no compiling."""
    load = op.Imprint(lifted_map())

    def pressed(c10, friction):
        return op.solve(palpation(elements, c10, friction), load, throw=False)

    axes = {"c10": np.linspace(1.5e-3, 4e-3, counts[0]), "friction": np.linspace(0.02, 0.3, counts[1])}
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        data = op.sweep(pressed, axes, keep=("pressure", "newton_steps"))
        seconds.append(time.perf_counter() - begin)
    return {
        "first_s": seconds[0],
        "second_s": seconds[1],
        "points_per_s": counts[0] * counts[1] / seconds[1],
        "failed": int((data.status != "successful").sum()),
    }


CASES = {
    "bandwidth": bandwidth,
    "product": lambda: product(LARGE),
    "product_small": lambda: product((40, 40, 4)),
    "explicit_large": lambda: explicit(LARGE),
    "implicit_middle": lambda: implicit(MIDDLE),
    "implicit_large": lambda: implicit(LARGE),
    "sweep": lambda: sweep((20, 20, 2)),
}
SMALL_CASES = {
    "product": lambda: product(SMALL),
    "explicit": lambda: explicit(SMALL),
    "implicit": lambda: implicit(SMALL),
    "sweep": lambda: sweep(SMALL, (2, 2)),
}


def with_gpu() -> bool:
    """Tell, in a process of its own, whether JAX sees an NVIDIA GPU."""
    program = "import jax; print(jax.devices('cuda'))"
    return subprocess.run([sys.executable, "-c", program], capture_output=True).returncode == 0


def run_cases(backend: str, names: list[str], small: bool, end: float, rows: list[dict]) -> None:
    """Run cases on one platform until the time is up."""
    for name in names:
        row = {"case": name, "platform": backend}
        left = end - time.monotonic()
        command = [sys.executable, "-m", "benchmarks.device", "--child", name, *(["--small"] if small else [])]
        try:
            done = subprocess.run(
                command, env={**os.environ, "JAX_PLATFORMS": backend}, capture_output=True, text=True,
                timeout=max(left, 0.1),
            )  # fmt: skip
            row |= json.loads(done.stdout) if done.returncode == 0 else {"error": done.stderr.strip()[-500:]}
        except subprocess.TimeoutExpired:
            row |= {"left_out": f"did not fit into the {left:.0f} s that were left"}
        rows.append(row)
        print(json.dumps(row), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--limit", type=float, default=440.0, help="seconds for all")
    parser.add_argument("--small", action="store_true", help="small meshes")
    parser.add_argument("--child", choices=sorted({*CASES, *SMALL_CASES}), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    cases = SMALL_CASES if chosen.small else CASES
    if chosen.child:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps({"device": jax.devices()[0].device_kind, **cases[chosen.child]()}))
        return
    rows: list[dict] = []
    end = time.monotonic() + chosen.limit
    backends = (["cuda"] if with_gpu() else []) + ["cpu"]
    workers = [
        threading.Thread(target=run_cases, args=(backend, list(cases), chosen.small, end, rows)) for backend in backends
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    versions = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "opfem")}
    if chosen.out is not None:
        about = {"machine": platform.machine(), "cores": os.cpu_count(), **versions}
        chosen.out.write_text(json.dumps({**about, "cases": rows}, indent=1))


if __name__ == "__main__":
    main()
