"""What is waited for before the first result: size of the compiled programs, time to make them, and to load them.

Run `python benchmarks/compilation.py MAP [--case palpate gradient explicit fit sweep] [--elements 20x20x2 40x40x4]
[--baseline FOLDER] [--turns 1] [--out FILE.json]`. MAP is coin_5c_1-thickness.mat of the published toolbox; `fit` takes
the built-in example, as `opfem fit example` does. FOLDER is a checkout of another commit: it takes turns with this one,
and ratios of this one to it follow. Prints one JSON line per case, mesh, turn and checkout:

    programs       the largest programs of the first result, by name: operations of StableHLO, instructions of optimised
                   HLO, CPU seconds to trace and lower, and to compile; and the sum of all
    first, second  CPU and wall seconds of the first result of a fresh process with an empty cache, from the start of
                   the interpreter, and of the next, with another C10
    cached         the same of the first result of another process, with the cache that the one before left

CPU seconds hold where the machine is shared, wall seconds only where it is not.
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

START = time.perf_counter()

CASES = ("palpate", "gradient", "explicit", "fit", "sweep")
C10 = 2.23e-3  # MPa
SECOND_C10 = 2.26e-3
SIDE = 5.0  # mm
# Long enough to compile what a whole run needs; a whole one takes ten times as many increments [s].
EXPLICIT_DURATION = 0.1
# A program below this many instructions is listed in the sum alone.
LISTED = 500
SIZES = ("stablehlo_operations", "hlo_instructions", "compile_cpu_s")


class Programs:
    """Watches JAX compile, through its own functions for that: names, sizes and CPU seconds."""

    def __init__(self):
        from jax._src import compiler, dispatch

        self.own_cpu, self.own_wall = 0.0, 0.0  # spent here, to be left out
        self.prepared = defaultdict(float)  # CPU seconds to trace and lower, by name
        self._made, self._compiling, self._last, self._lock = [], [], 0.0, threading.Lock()
        self._compile = compiler.backend_compile_and_load
        compiler.backend_compile_and_load = self._compiled
        watched, prepared = (dispatch.JAXPR_TRACE_EVENT, dispatch.JAXPR_TO_MLIR_MODULE_EVENT), self.prepared

        class Watch(dispatch.LogElapsedTimeContextManager):
            __slots__ = ("begin",)

            def __enter__(self):
                self.begin = time.thread_time()
                super().__enter__()

            def __exit__(self, *how):
                super().__exit__(*how)
                if self.event in watched:
                    prepared[re.sub(r"^jit\((.*)\)$", r"\1", self.fun_name)] += time.thread_time() - self.begin

        dispatch.log_elapsed_time = Watch

    def _compiled(self, backend, module, *rest):
        begin = time.thread_time(), time.perf_counter()
        text = str(module)
        row = {
            "name": re.search(r"module @(\S+)", text).group(1).removeprefix("jit_"),
            "stablehlo_operations": text.count("stablehlo."),
        }
        self.own_cpu += time.thread_time() - begin[0]
        self.own_wall += time.perf_counter() - begin[1]
        row["compile_cpu_s"] = 0.0
        self._share(self._compiling.append, row)
        executable = self._compile(backend, module, *rest)
        self._share(self._compiling.remove, row)
        self._made.append((row, executable))
        return executable

    def _share(self, change, row: dict) -> None:
        """Share the CPU seconds since the last change between the programs that compile side by side."""
        with self._lock:
            now = time.process_time()
            for one in self._compiling:
                one["compile_cpu_s"] += (now - self._last) / len(self._compiling)
            self._last = now
            change(row)

    def described(self) -> dict:
        """Describe what was compiled; instructions are counted only now."""
        for row, executable in self._made:
            texts = [module.to_string() for module in executable.hlo_modules()]
            row["hlo_instructions"] = sum(" = " in line for text in texts for line in text.splitlines())
        named = {}
        for row, _ in self._made:
            entry = named.setdefault(row["name"], {"programs": 0, **dict.fromkeys(SIZES, 0)})
            entry["programs"] += 1
            for key in SIZES:
                entry[key] += row[key]
        for name, entry in named.items():
            entry["trace_lower_cpu_s"] = self.prepared.get(name, 0.0)
        total = {key: sum(entry[key] for entry in named.values()) for key in ("programs", *SIZES)}
        total["trace_lower_cpu_s"] = sum(self.prepared.values())
        largest = sorted(named.items(), key=lambda item: -item[1]["hlo_instructions"])
        listed = {name: _rounded(entry) for name, entry in largest if entry["hlo_instructions"] >= LISTED}
        return {"sum": _rounded(total), **listed}


def _rounded(record: dict) -> dict:
    return {key: round(value, 2) if isinstance(value, float) else value for key, value in record.items()}


def case(name: str, path: Path, elements: tuple[int, int, int]):
    """State a case as a function of C10 [MPa]; it returns when the result is there."""
    import equinox as eqx
    import jax

    import opfem as op

    def palpation(c10):
        return op.Palpation(
            op.Layer(0.5, op.MooneyRivlin(c10=c10, c01=7.03e-4, bulk=0.11732)),
            extent=(SIDE, SIDE),
            elements=elements,
            window=op.Contact(op.HardOverclosure(), 0.15),
            sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), 0.05),
        )

    if name == "fit":
        measured = op.datasets.example()
        estimate = op.uniaxial_estimate(palpation(C10), measured.filled().smoothed(fwhm=0.5 * SIDE / elements[0]))
        prior = op.Matern(length=3.0 * SIDE / elements[0], std=estimate.std(), mean=estimate.mean())
        return lambda c10: op.fit_traction(palpation(c10), measured, prior, progress=False).pressure_std

    loaded = op.read_thickness(path, extent=(SIDE, SIDE)).smoothed(fwhm=0.06)

    def mean_pressure(values, c10):
        moved = eqx.tree_at(lambda m: m.values, loaded, values)
        return op.solve(palpation(c10), op.Imprint(moved)).pressure.mean()

    def pressed(c10):
        return op.solve(palpation(c10), op.Imprint(loaded), throw=False)

    if name == "palpate":
        return lambda c10: op.solve(palpation(c10), op.Imprint(loaded), progress=False).pressure
    if name == "gradient":
        options = op.compiler_options() if hasattr(op, "compiler_options") else {}  # an older checkout has none
        gradient = jax.jit(jax.value_and_grad(mean_pressure), compiler_options=options)
        return lambda c10: gradient(loaded.values, c10)
    if name == "explicit":
        settings = op.Explicit(duration=EXPLICIT_DURATION)
        return lambda c10: op.solve(palpation(c10), op.Imprint(loaded), settings, throw=False, progress=False).pressure
    return lambda c10: op.sweep(pressed, {"c10": [c10]}, progress=False)


def child(name: str, path: Path, elements: tuple[int, int, int], folder: Path, cached: bool) -> dict:
    """Measure one case in this process, whose compiled programs are kept in a folder."""
    import jax

    programs = None if cached else Programs()
    import opfem as op

    jax.config.update("jax_enable_x64", True)
    op.cache_compilation(folder)
    run = case(name, path, elements)

    def seconds(c10, since):
        jax.block_until_ready(run(c10))
        used = resource.getrusage(resource.RUSAGE_SELF)
        own = (0.0, 0.0) if programs is None else (programs.own_cpu, programs.own_wall)
        now = used.ru_utime + used.ru_stime - own[0], time.perf_counter() - own[1]
        return _rounded({"cpu_s": now[0] - since[0], "wall_s": now[1] - since[1]}), now

    first, after = seconds(C10, (0.0, START))
    if programs is None:
        return {"cached": first}
    described = programs.described()
    used = resource.getrusage(resource.RUSAGE_SELF)
    after = used.ru_utime + used.ru_stime - programs.own_cpu, time.perf_counter() - programs.own_wall
    second, _ = seconds(SECOND_C10, after)
    return {"programs": described, "first": first, "second": second, "opfem": op.__file__}


def measured(checkout: Path, name: str, path: Path, elements: str) -> dict:
    """Measure a case of a checkout in two fresh processes, one with an empty cache, one with what it left."""
    record = {}
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, str(path), "--case", name, "--elements", elements, "--child", folder]
        for more in ([], ["--cached"]):
            done = subprocess.run([*command, *more], cwd=checkout, env=environment, stdout=subprocess.PIPE, check=True)
            record |= json.loads(done.stdout.splitlines()[-1])
    if checkout not in Path(record.pop("opfem")).parents:
        raise SystemExit(f"The opfem that was measured is not that of {checkout}.")
    return record


def ratios(here: dict, baseline: dict) -> dict:
    """Divide what was measured here by what was measured on the baseline; programs by their sum and their largest."""

    def largest(record):
        return next((row for name, row in record["programs"].items() if name != "sum"), record["programs"]["sum"])

    pairs = {part: (here[part], baseline[part]) for part in ("first", "second", "cached")}
    pairs["all_programs"] = here["programs"]["sum"], baseline["programs"]["sum"]
    pairs["largest_program"] = largest(here), largest(baseline)
    return {part: {key: round(a[key] / b[key], 3) for key in a if b.get(key)} for part, (a, b) in pairs.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--elements", nargs="+", default=["20x20x2", "40x40x4"])
    parser.add_argument("--baseline", type=Path, help="checkout of the commit to compare with")
    parser.add_argument("--turns", type=int, default=1, help="times that each case is measured")
    parser.add_argument("--out", type=Path, help="file for all that is measured, as JSON")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--cached", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    path = chosen.map.resolve()
    if chosen.child is not None:
        elements = tuple(int(n) for n in chosen.elements[0].split("x"))
        print(json.dumps(child(chosen.case[0], path, elements, chosen.child, chosen.cached)))
        return
    checkouts = {"here": Path(__file__).resolve().parents[1]}
    if chosen.baseline is not None:
        checkouts = {"baseline": chosen.baseline.resolve(), **checkouts}
    records = []

    def keep(record):
        print(json.dumps(record), flush=True)
        records.append(record)
        if chosen.out is not None:
            chosen.out.write_text(json.dumps(records, indent=1), encoding="utf-8")

    for elements in chosen.elements:
        for name in chosen.case:
            for turn in range(chosen.turns):
                about = {"case": name, "elements": elements, "turn": turn}
                found = {}
                for label, checkout in checkouts.items():
                    found[label] = measured(checkout, name, path, elements)
                    keep({**about, "checkout": label, **found[label]})
                if "baseline" in found:
                    keep({**about, "checkout": "here / baseline", **ratios(found["here"], found["baseline"])})


if __name__ == "__main__":
    main()
