"""Sweeps of the published coin on n × n × 2 elements: against a loop, batches, failures, devices, memory.

Run `python benchmarks/sweep.py MAP --case loop`, and so on. Prints one JSON line per measurement.

    loop      16 materials × 8 frictions against the Python loop of jitted solves, compilation apart
    batches   time per point of batches of 1, 2, 8, 32, by `map` and by `vmap`
    failures  an impossible point and a slow one among the others
    devices   all devices, against one; for virtual ones set XLA_FLAGS=--xla_force_host_platform_device_count=2
    cluster   two workers of a dask LocalCluster, one of them killed, against this process
    memory    peak resident size of a small problem at 100 and at 1000 points, each in a process of its own

MAP is coin_5c_1-thickness.mat of the published toolbox. `--points` and `--elements` make a case shorter, `--cache DIR`
keeps what is compiled.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np

import opfem as op
from opfem.sweeps.design import Points
from opfem.sweeps.execution import Program
from opfem.sweeps.outputs import GOOD, Outputs

KEEP = ("pressure", "newton_steps")
IMPOSSIBLE = -1e-2  # C10 [MPa]: such a layer has no stable state
MANY_INCREMENTS = 100  # make a point slow
TURNS = 4


def say(**record) -> None:
    print(json.dumps({"backend": jax.default_backend(), "devices": jax.local_device_count(), **record}), flush=True)


def coin(path: Path, n: int):
    """State the pressed coin as a function of what is swept."""
    thickness = op.read_thickness(path, extent=(5.0, 5.0)).smoothed(fwhm=2.5 / n)

    def pressed(c10, friction, increments):
        palpation = op.Palpation(
            op.Layer(0.5, op.MooneyRivlin(c10=c10, c01=7.03e-4, bulk=0.11732)),
            extent=(5.0, 5.0),
            elements=(n, n, 2),
            window=op.Contact(op.HardOverclosure(), friction),
            sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), 0.05),
        )
        return op.solve(palpation, op.Imprint(thickness), op.Newton(increments=increments), throw=False)

    return pressed


def ladder(count: int) -> dict[str, np.ndarray]:
    """Take points of 16 materials × 8 frictions, spread over all of them."""
    c10, friction = np.meshgrid(np.geomspace(1e-3, 1e-2, 16), np.linspace(0.0, 0.3, 8), indexing="ij")
    chosen = np.linspace(0, 127, count).round().astype(int)
    return {"c10": c10.ravel()[chosen], "friction": friction.ravel()[chosen], "increments": np.full(count, 8.0)}


def compiled(fn, columns: dict[str, np.ndarray], execution) -> Program:
    """Compile what op.sweep compiles."""
    example = {name: column[:1] for name, column in columns.items()}
    return Program(fn, Outputs("value", KEEP, {}, tuple(columns)), execution.plan(None), example)


def compute(program: Program, columns: dict[str, np.ndarray], execution) -> tuple[float, list]:
    """Compute as op.sweep does; return the seconds, and the outcome of each point."""
    points: Points = op.zip_(columns)
    plan = execution.plan(None)
    starts = range(0, len(points), plan.points)
    batches = ((range(i, min(i + plan.points, len(points)))) for i in starts)
    begin = time.perf_counter()
    found = {}
    for batch, outcomes in execution.run(
        program, ((b, {k: v[b.start : b.stop] for k, v in columns.items()}) for b in batches)
    ):
        found |= dict(zip(batch, outcomes, strict=True))
    return time.perf_counter() - begin, [found[i] for i in range(len(points))]


def difference(outcomes: list, others: list) -> float:
    """Compare pressures: the largest difference over the largest pressure, of any point."""
    pairs = [(a.values["pressure"], b.values["pressure"]) for a, b in zip(outcomes, others, strict=True)]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def against_loop(fn, count: int) -> None:
    """Take turns with the loop, so that both see the same hours of a shared machine."""
    columns, execution = ladder(count), op.Batch()
    solved = jax.jit(lambda point: {name: getattr(fn(**point), name) for name in KEEP[:1]})
    rows = [{name: float(column[i]) for name, column in columns.items()} for i in range(count)]
    jax.block_until_ready(solved(rows[0]))
    program = compiled(fn, columns, execution)
    loop, swept, spent = [], [], []
    for turn in np.array_split(np.arange(count), TURNS):
        begin = time.perf_counter()
        loop += [jax.device_get(solved(rows[i])) for i in turn]
        seconds = time.perf_counter() - begin
        swept_s, outcomes = compute(program, {name: column[turn] for name, column in columns.items()}, execution)
        swept += outcomes
        spent.append((seconds, swept_s))
    worst = max(
        float(np.abs(a.values["pressure"] - b["pressure"]).max() / np.abs(b["pressure"]).max())
        for a, b in zip(swept, loop, strict=True)
    )
    loop_s, sweep_s = np.sum(spent, axis=0)
    say(
        case="loop",
        points=count,
        loop_s=loop_s,
        sweep_s=sweep_s,
        ratio=loop_s / sweep_s,
        ratios=[a / b for a, b in spent],
        difference=worst,
        failed=sum(outcome.status not in GOOD for outcome in swept),
    )


def batches(fn, count: int, sizes: list[int], modes: list[str]) -> None:
    columns = ladder(count)
    for mode in modes:
        for size in sizes:
            for threads in (1, 2) if mode == "map" and jax.default_backend() == "cpu" else (1,):
                execution = op.Batch(size, mode, threads)
                seconds, _ = compute(compiled(fn, columns, execution), columns, execution)
                say(
                    case="batches",
                    mode=mode,
                    size=size,
                    threads=threads,
                    points=count,
                    seconds_per_point=seconds / count,
                )


def failures(fn, count: int) -> None:
    columns = ladder(count)
    execution = op.Batch()
    program = compiled(fn, columns, execution)
    seconds, good = compute(program, columns, execution)
    say(case="failures", which="none", points=count, seconds=seconds)
    slow, bad = count // 3, count // 2
    columns["increments"][slow] = MANY_INCREMENTS
    with_slow, outcomes = compute(program, columns, execution)
    own = outcomes[slow].seconds
    say(case="failures", which="slow", seconds=with_slow, own_s=own, cost_over_own=(with_slow - seconds) / own)
    columns["c10"][bad] = IMPOSSIBLE
    with_both, outcomes = compute(program, columns, execution)
    others = [i for i in range(count) if i not in (slow, bad)]
    same = difference([outcomes[i] for i in others], [good[i] for i in others])
    say(case="failures", which="both", seconds=with_both, impossible=outcomes[bad].status, others_differ=same)


def devices(fn, count: int, sizes: list[int], modes: list[str]) -> None:
    columns = ladder(count)
    execution = op.Batch(threads=1)
    one, alone = compute(compiled(fn, columns, execution), columns, execution)
    say(case="devices", devices_used=1, points=count, points_per_s=count / one)
    for mode in modes:
        for size in sizes:
            execution = op.Devices(size, mode)
            seconds, outcomes = compute(compiled(fn, columns, execution), columns, execution)
            worst = difference(outcomes, alone)
            say(case="devices", mode=mode, size=size, points=count, points_per_s=count / seconds, difference=worst)


def cluster(fn, count: int, out: Path) -> None:
    from distributed import Client, LocalCluster

    points, keep = op.zip_(ladder(count)), ["pressure"]
    here = op.sweep(fn, points, keep=keep)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local, Client(local) as client:

        def kill() -> None:
            while len(list((out / "points").glob("*.npz"))) < count // 3:
                time.sleep(0.05)
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        there = op.sweep(fn, points, keep=keep, out=out, execution=op.Cluster(client))
        killer.join()
    off = float(np.abs(there.pressure - here.pressure).max() / np.abs(here.pressure).max())
    failed = int((there.status == "error").sum())
    say(
        case="cluster",
        points=count,
        difference=off,
        same_status=bool((there.status == here.status).all()),
        failed=failed,
    )


def memory(out: Path) -> None:
    for count in (100, 1000):
        code = f"""
import jax, numpy as np, opfem as op, resource
jax.config.update("jax_enable_x64", True)
thickness = op.ThicknessMap(np.full((5, 5), 0.45), extent=(1.0, 1.0))
def pressed(c10):
    layer = op.Layer(0.5, op.NeoHooke(c10=c10, bulk=0.1))
    sides = op.Contact(op.HardOverclosure(), 0.1)
    sample = op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.1)
    palpation = op.Palpation(layer, extent=(1.0, 1.0), elements=(3, 3, 1), window=sides, sample=sample)
    return op.solve(palpation, op.Imprint(thickness), op.Newton(increments=1), throw=False)
axes = {{"c10": np.linspace(1e-3, 2e-3, {count})}}
data = op.sweep(pressed, axes, keep=["max_pressure"], out={str(out / str(count))!r})
assert (data.status != "error").all()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
        answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        say(case="memory", points=count, peak_mb=int(answer.stdout) / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument(
        "--case", choices=["loop", "batches", "failures", "devices", "cluster", "memory"], required=True
    )
    parser.add_argument("--points", type=int, help="at most 128; default: 128, 64 for failures")
    parser.add_argument("--elements", type=int, default=20)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 2, 8, 32])
    parser.add_argument("--modes", nargs="+", default=["map", "vmap"])
    parser.add_argument("--cache", type=Path, help="keep what is compiled in this folder, and use it")
    parser.add_argument(
        "--out", type=Path, default=Path("sweep_memory"), help="folder of the sweeps of `cluster` and `memory`"
    )
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if chosen.cache is not None:
        op.cache_compilation(chosen.cache)
    if chosen.case == "memory":
        return memory(chosen.out)
    fn = coin(chosen.map, chosen.elements)
    count = chosen.points or (64 if chosen.case == "failures" else 128)
    if chosen.case == "loop":
        return against_loop(fn, count)
    if chosen.case == "failures":
        return failures(fn, count)
    if chosen.case == "cluster":
        return cluster(fn, count, chosen.out)
    return (batches if chosen.case == "batches" else devices)(fn, count, chosen.sizes, chosen.modes)


if __name__ == "__main__":
    main()
