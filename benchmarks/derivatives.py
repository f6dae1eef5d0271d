"""Derivatives of the published coin: what a gradient costs, and how far it is from central differences.

Run `python benchmarks/derivatives.py MAP [--elements 40] [--no-differences]`. Prints one JSON line per
figure: the time of a gradient by the whole thickness map beyond the solve itself, over that solve, in one
run with compile time apart; forward against reverse; and, for mean and peak pressure by every number of
the experiment, the gradient, the central difference at each step, and how many contact points change
their status between its ends. MAP is coin_5c_1-thickness.mat of the published toolbox.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import opfem as op

NUMBERS = {"c10": 0.00223, "bulk": 0.11732, "window_friction": 0.15, "sample_friction": 0.05, "p0": 2.0}
STEPS = (1e-3, 1e-4, 1e-5, 1e-6)


def solve(numbers: dict, thickness: op.ThicknessMap, n: int, settings: op.Newton) -> op.Solution:
    material = op.MooneyRivlin(numbers["c10"], 0.000703, numbers["bulk"])
    palpation = op.Palpation(
        op.Layer(0.5, material),
        extent=(5.0, 5.0),
        elements=(n, n, n // 10),
        window=op.Contact(op.HardOverclosure(), numbers["window_friction"]),
        sample=op.Contact(op.ExponentialOverclosure(numbers["p0"], 0.01), numbers["sample_friction"]),
    )
    return op.solve(palpation, op.Imprint(thickness), settings)


def timed(function, *arguments) -> tuple:
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - begin


def cost(numbers: dict, thickness: op.ThicknessMap, n: int) -> dict:
    """Time a solve and its gradient by the whole map, compiled, in turns; maps differ a little."""

    def mean_pressure(values, numbers):
        moved = eqx.tree_at(lambda m: m.values, thickness, values)
        return 1e3 * solve(numbers, moved, n, op.Newton()).pressure.mean()

    def along_a_tilt(values, numbers):
        tilt = jnp.broadcast_to(jnp.linspace(-1e-3, 1e-3, values.shape[1]), values.shape)  # mm
        return jax.jvp(lambda v: mean_pressure(v, numbers), (values,), (tilt,))

    ways = {"solve": mean_pressure, "gradient": jax.value_and_grad(mean_pressure), "jvp": along_a_tilt}
    compiled = {name: jax.jit(way) for name, way in ways.items()}
    first = {name: timed(way, thickness.values, numbers)[1] for name, way in compiled.items()}
    seconds = {name: [] for name in ways}
    for shift in (1e-6, 2e-6, 3e-6):
        for name, way in compiled.items():
            seconds[name].append(timed(way, thickness.values + shift, numbers)[1])
    beyond = {
        name: [round(t / alone - 1.0, 3) for t, alone in zip(seconds[name], seconds["solve"], strict=True)]
        for name in ("gradient", "jvp")
    }
    return {
        "figure": "cost of a gradient by the map, and of a derivative along one direction",
        "pixels": int(thickness.values.size),
        "compile_s": {name: round(first[name] - min(seconds[name]), 1) for name in ways},
        "seconds": {name: [round(t, 2) for t in times] for name, times in seconds.items()},
        "beyond_the_solve": beyond,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("--elements", type=int, default=40)
    parser.add_argument("--smooth", type=float, default=0.06, help="FWHM [mm]")
    parser.add_argument("--no-differences", action="store_true", help="only the cost")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    thickness = op.read_thickness(chosen.map, extent=(5.0, 5.0)).smoothed(fwhm=chosen.smooth)
    numbers = {name: jnp.asarray(value) for name, value in NUMBERS.items()}
    print(json.dumps({"elements": chosen.elements, **cost(numbers, thickness, chosen.elements)}), flush=True)
    if chosen.no_differences:
        return
    accurate = op.Newton(rtol=1e-10)

    def pressures(numbers):
        pressure = 1e3 * solve(numbers, thickness, chosen.elements, accurate).pressure
        return jnp.stack([pressure.mean(), pressure.max()])

    def linear(numbers, direction):
        values, along = jax.linearize(pressures, numbers)
        back = jax.linear_transpose(along, numbers)
        return values, along(direction), [back(unit)[0] for unit in jnp.eye(2)]

    direction = {name: value * (-1.0) ** k for k, (name, value) in enumerate(numbers.items())}
    values, forward, gradients = jax.jit(linear)(numbers, direction)
    for output, value, along, gradient in zip(("mean", "peak"), values, forward, gradients, strict=True):
        reverse = sum(float(gradient[name] * direction[name]) for name in numbers)
        print(json.dumps({"output": output, "kPa": float(value), "forward": float(along), "reverse": reverse}))
    for name, value in numbers.items():
        for step in STEPS:
            ends = [
                solve({**numbers, name: value * (1 + s * step)}, thickness, chosen.elements, accurate) for s in (1, -1)
            ]
            statuses = [np.stack([end.contact_status, end.window.status]) for end in ends]
            pressure = [1e3 * np.asarray(end.pressure) for end in ends]
            record = {
                "by": name,
                "relative_step": step,
                "nodes_that_change_status": int((statuses[0] != statuses[1]).sum()),
                "increments": [int(end.stats["increments"]) for end in ends],
            }
            for k, (output, reduce) in enumerate({"mean": np.mean, "peak": np.max}.items()):
                difference = float((reduce(pressure[0]) - reduce(pressure[1])) / (2 * step * value))
                slope = float(gradients[k][name])
                allowed = max(abs(difference), 0.01 * float(values[k] / value))
                record[output] = {
                    "gradient": slope,
                    "difference": difference,
                    "error": abs(slope - difference) / allowed,
                }
            print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
