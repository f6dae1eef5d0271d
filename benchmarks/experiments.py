"""Random virtual experiments with default options: how many converge, and what the others say.

Run `python -m benchmarks.experiments [--problems 100] [--first 0] [--seed 0]`. Problem k of a seed is the same
whatever the others are. Prints one JSON line per problem and then how many converged. An ending counts as honest
when it is "converged" with finite results, or a failure with a last converged state that is finite.

Drawn: sample moduli of 0.1 to 100 times the layer's, an inclusion (cylinder, sphere, box or half-space) of 0.1 to 10
times the sample's, ridges of the sample's face with slopes up to 0.5 in every other problem, friction 0 to 0.5 on each
face (none in a tenth), and a plate that approaches by 5 to 40 % of the layer's thickness beyond touching.
"""

import argparse
import json
import time

import jax
import numpy as np

import opfem as op

from .robustness import finite

THICKNESS, SAMPLE, EXTENT = 0.5, 2.0, 5.0  # mm
SHEAR, K_OVER_MU = 5.866e-3, 20.0  # MPa, -
ELEMENTS = (12, 12, (2, 6))  # one mesh: a program is compiled for flat samples, one for ridged ones
MOST_SLOPE, MOST_FRICTION, MOST_APPROACH = 0.5, 0.5, 0.4
SHAPES = ("cylinder", "sphere", "box", "half-space")
PIXELS = 65


def material(ratio: float) -> op.MooneyRivlin:
    """Build a law whose modulus is a multiple of the layer's."""
    shear = ratio * SHEAR
    return op.MooneyRivlin(0.38 * shear, 0.12 * shear, K_OVER_MU * shear)


def random_inclusion(rng: np.random.Generator, shape: str) -> op.Cylinder | op.Sphere | op.Box | op.HalfSpace:
    """Draw an inclusion that is wider than an element."""
    x, y = rng.uniform(1.5, 3.5, 2)
    size, depth = rng.uniform(0.6, 1.4), rng.uniform(0.2, 0.6)
    if shape == "cylinder":
        return op.Cylinder((x, y), size, (depth, depth + size))
    if shape == "sphere":
        return op.Sphere((x, y, depth + size), size)
    if shape == "box":
        return op.Box((x - size, y - size, depth), (x + size, y + size, depth + size))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return op.HalfSpace((x, y, 0.0), (np.cos(angle), np.sin(angle), 0.0))


def ridged(rng: np.random.Generator, slope: float) -> op.ThicknessMap:
    """Draw a sample with ridges along a random direction, of one and a half to three and a half waves, [mm]."""
    angle, waves = rng.uniform(0.0, np.pi), rng.uniform(1.5, 3.5)
    wave = 2.0 * np.pi * waves / EXTENT
    across = np.linspace(0.0, EXTENT, PIXELS)
    y, x = np.meshgrid(across, across, indexing="ij")
    ridges = np.cos(wave * (x * np.cos(angle) + y * np.sin(angle)))
    return op.ThicknessMap(SAMPLE + slope / wave * ridges, extent=(EXTENT, EXTENT))


def random_problem(seed: int, index: int) -> tuple[op.Experiment, op.Compression, dict]:
    """Draw problem `index` of a seed."""
    rng = np.random.default_rng([seed, index])
    ratio, contrast = 10.0 ** rng.uniform(-1.0, 2.0), 10.0 ** rng.uniform(-1.0, 1.0)
    shape = SHAPES[rng.integers(len(SHAPES))]
    slope = rng.uniform(0.05, MOST_SLOPE) * (index % 2)
    frictions = rng.uniform(0.0, MOST_FRICTION, 3) * (rng.random(3) > 0.1)
    approach = rng.uniform(0.05, MOST_APPROACH) * THICKNESS
    sample = op.Sample(ridged(rng, slope) if slope else SAMPLE, material(ratio))
    experiment = op.Experiment(
        op.Layer(THICKNESS, material(1.0)),
        sample.with_inclusion(random_inclusion(rng, shape), material(contrast * ratio)),
        extent=(EXTENT, EXTENT),
        elements=ELEMENTS,
        window=op.Contact(op.HardOverclosure(), frictions[0]),
        interface=op.Contact(op.ExponentialOverclosure(2.0, 0.01), frictions[1]),
        plate=op.Contact(op.HardOverclosure(), frictions[2]),
    )
    about = {
        "sample_over_layer": ratio,
        "inclusion_over_sample": contrast,
        "inclusion": shape,
        "slope": slope,
        "frictions": frictions.round(4).tolist(),
        "approach_mm": approach,
    }
    return experiment, op.Compression(approach), about


def measure(seed: int, index: int, increments: int) -> dict:
    """Solve one problem and describe how it ended."""
    experiment, load, about = random_problem(seed, index)
    begin = time.process_time()
    solution = op.solve(experiment, load, op.Newton(max_increments=increments), throw=False, progress=False)
    jax.block_until_ready(solution.pressure)
    converged = bool((solution.result == op.RESULTS.successful) | (solution.result == op.RESULTS.slides_off))
    known = (
        (solution.layer.displacement, solution.sample.displacement, solution.pressure)
        if converged
        else solution.last_converged.displacement
    )
    return {
        "problem": index,
        "converged": converged,
        "honest": finite(known),
        "message": op.RESULTS[solution.result],
        "load_fraction": float(solution.last_converged.load_fraction),
        "cpu_seconds": round(time.process_time() - begin, 2),
        **{name: int(solution.stats[name]) for name in ("attempts", "newton_steps", "krylov_steps")},
        **{name: round(value, 5) if isinstance(value, float) else value for name, value in about.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-increments", type=int, default=op.Newton().max_increments, help="to end sooner")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for index in range(chosen.first, chosen.first + chosen.problems):
        rows.append(measure(chosen.seed, index, chosen.max_increments))
        print(json.dumps(rows[-1]), flush=True)
    converged, honest = (sum(row[name] for row in rows) for name in ("converged", "honest"))
    print(json.dumps({"problems": len(rows), "converged": converged, "honest": honest}))


if __name__ == "__main__":
    main()
