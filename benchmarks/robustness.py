"""Random palpations with default options: how many converge, and what the others say.

Run `python -m benchmarks.robustness [--problems 200] [--first 0] [--seed 0] [--real]`. Problem k of a seed is the same
whatever the others are. Prints one JSON line per problem and then how many converged. An ending counts as honest
when it is "converged" with finite results, or a failure with a last converged state that is finite.

Drawn: maps with slopes up to 0.6 and strains up to 60%, a part of 0 to 80% that does not touch, unloaded
thickness that varies by up to 10%, friction 0 to 1 on each side, K/µ of 5 to 1e5 (`hybrid` above 1e3), p0 of 0.2 to
20 MPa and c0 of 1 to 100 µm, elements 0.2 to 5 times as wide as high.

`--real` draws problems of real size instead: layers of 7 × 7 × 0.5 mm on 80 × 80 × 6 to 120 × 120 × 6 elements, besides
lobes two pockets with walls of slope up to 2, and a corner that lifts off.
"""

import argparse
import json
import time

import jax
import numpy as np
from scipy.ndimage import gaussian_filter

import opfem as op

THICKNESS = 0.5  # mm
SHEAR = 5.866e-3  # MPa
PIXELS = 65
# Few meshes: each is compiled once per element.
MESHES = ((16, 16, 3), (24, 12, 2))
MOST_STRAIN, MOST_SLOPE, MOST_OPEN, MOST_FRICTION = 0.6, 0.6, 0.8, 1.0
HYBRID_ABOVE = 1e3  # K/µ
REAL_MESHES, REAL_SIDE, REAL_PIXELS, WALL_SLOPE = ((80, 80, 6), (100, 100, 6), (120, 120, 6)), 7.0, 281, 2.0


def random_field(rng: np.random.Generator, width: float, pixels: int = PIXELS) -> np.ndarray:
    """Draw smooth lobes with a sharper ridge on top, from 0 to 1; `width` is that of lobes, in pixels."""
    smooth = gaussian_filter(rng.standard_normal((pixels, pixels)), width, mode="nearest")
    ridge = np.tanh(4.0 * gaussian_filter(rng.standard_normal((pixels, pixels)), width, mode="nearest") / smooth.std())
    field = smooth / smooth.std() + rng.uniform(0.0, 1.0) * ridge
    return (field - field.min()) / np.ptp(field)


def random_map(rng: np.random.Generator, extent: tuple[float, float]) -> tuple[op.ThicknessMap, dict]:
    """Draw a loaded surface: pressed in most where the field is highest, above the layer where it is low."""
    strain, slope = rng.uniform(0.05, MOST_STRAIN), rng.uniform(0.05, MOST_SLOPE)
    touches_above = np.quantile(field := random_field(rng, rng.uniform(3.0, 12.0)), rng.uniform(0.0, MOST_OPEN))
    depth = strain * THICKNESS * (field - touches_above) / (1.0 - touches_above)  # mm
    spacing = [length / (PIXELS - 1) for length in extent[::-1]]
    steepest = np.hypot(*np.gradient(depth, *spacing)).max()
    depth *= min(1.0, slope / steepest)  # a short layer has no room for both
    about = {
        "strain": depth.max() / THICKNESS,
        "slope": min(slope, steepest),
        "open": float(np.mean(depth < 0.0)),
    }
    return op.ThicknessMap(THICKNESS - depth, extent=extent), about


def real_map(rng: np.random.Generator) -> tuple[op.ThicknessMap, dict]:
    """Draw a loaded surface of real size: lobes with slopes up to 0.6, pockets with steep walls, a lifted corner."""
    strain, slope = rng.uniform(0.2, MOST_STRAIN), rng.uniform(0.1, MOST_SLOPE)
    spacing = REAL_SIDE / (REAL_PIXELS - 1)
    field = random_field(rng, rng.uniform(0.4, 1.0) / spacing, REAL_PIXELS)
    touches_above = np.quantile(field, rng.uniform(0.0, MOST_OPEN))
    depth = 0.7 * strain * THICKNESS * (field - touches_above) / (1.0 - touches_above)
    depth *= min(1.0, slope / np.hypot(*np.gradient(depth, spacing)).max())
    y, x = np.meshgrid(*2 * (np.linspace(0.0, REAL_SIDE, REAL_PIXELS),), indexing="ij")
    rise = strain * THICKNESS - depth.max()
    wall = rise / (2.0 * rng.uniform(slope, WALL_SLOPE))  # rise / 2 × tanh(distance / wall) is that steep
    pocket = np.zeros_like(depth)
    for _ in range(2):
        (px, py), radius = rng.uniform(0.2 * REAL_SIDE, 0.8 * REAL_SIDE, 2), rng.uniform(0.4, 0.8)
        pocket = np.maximum(pocket, 0.5 + 0.5 * np.tanh((radius - np.hypot(x - px, y - py)) / wall))
    depth = np.where(depth > 0.0, depth, 0.1 * depth) + rise * pocket  # hollows no deeper than samples lift off
    lifted = 1.0 / (1.0 + np.exp((np.hypot(x, y) - rng.uniform(0.0, 3.0)) / 0.3))
    depth = depth * (1.0 - lifted) - 0.03 * lifted
    steepest = np.hypot(*np.gradient(depth, spacing)).max()
    about = {"strain": depth.max() / THICKNESS, "slope": float(steepest), "open": float(np.mean(depth < 0.0))}
    return op.ThicknessMap(THICKNESS - depth, extent=(REAL_SIDE, REAL_SIDE)), about


def real_problem(seed: int, index: int) -> tuple[op.Palpation, op.Imprint, dict]:
    """Draw problem `index` of real size of a seed: the published layer and contact, friction 0.02 to 0.3."""
    rng = np.random.default_rng([seed, index, 1])
    elements = REAL_MESHES[rng.integers(len(REAL_MESHES))]
    frictions = rng.uniform(0.02, 0.3, 2)
    surface, about = real_map(rng)
    palpation = op.Palpation(
        op.Layer(THICKNESS, op.MooneyRivlin(0.38 * SHEAR, 0.12 * SHEAR, 20.0 * SHEAR)),
        (REAL_SIDE, REAL_SIDE),
        elements,
        op.Contact(op.HardOverclosure(), frictions[0]),
        op.Contact(op.ExponentialOverclosure(2.0, 0.01), frictions[1]),
    )
    about |= {"elements": elements, "window_friction": frictions[0], "sample_friction": frictions[1]}
    return palpation, op.Imprint(surface), about


def random_problem(seed: int, index: int) -> tuple[op.Palpation, op.Imprint, dict]:
    """Draw problem `index` of a seed."""
    rng = np.random.default_rng([seed, index])
    nx, ny, nz = MESHES[rng.integers(len(MESHES))]
    aspect, ratio = (10.0 ** rng.uniform(*np.log10(ends)) for ends in ((0.2, 5.0), (5.0, 1e5)))
    side = aspect * THICKNESS / nz
    extent = (nx * side, ny * side)
    pressure, clearance = 10.0 ** rng.uniform(np.log10(0.2), np.log10(20.0)), 10.0 ** rng.uniform(-3.0, -1.0)
    frictions = rng.uniform(0.0, MOST_FRICTION, 2) * (rng.random(2) > 0.1)  # some without any
    surface, about = random_map(rng, extent)
    varied = THICKNESS * (1.0 + rng.uniform(0.0, 0.1) * (random_field(rng, 12.0) - 0.5))
    palpation = op.Palpation(
        op.Layer(op.ThicknessMap(varied, extent=extent), op.MooneyRivlin(0.38 * SHEAR, 0.12 * SHEAR, ratio * SHEAR)),
        extent,
        (nx, ny, nz),
        op.Contact(op.HardOverclosure(), frictions[0]),
        op.Contact(op.ExponentialOverclosure(pressure, clearance), frictions[1]),
        element="hybrid" if ratio > HYBRID_ABOVE else "mean_dilatation",
    )
    about |= {
        "elements": palpation.elements,
        "element": palpation.element,
        "element_aspect": aspect,
        "K_over_mu": ratio,
        "window_friction": frictions[0],
        "sample_friction": frictions[1],
        "p0_MPa": pressure,
        "c0_mm": clearance,
    }
    return palpation, op.Imprint(surface), about


def finite(tree) -> bool:
    """Tell whether every number is finite."""
    return all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree) if np.issubdtype(np.asarray(leaf).dtype, float)
    )


def measure(seed: int, index: int, real: bool) -> dict:
    """Solve one problem and describe how it ended."""
    palpation, load, about = (real_problem if real else random_problem)(seed, index)
    begin = time.perf_counter()
    solution = op.solve(palpation, load, throw=False, progress=False)
    jax.block_until_ready(solution.pressure)
    # A layer that slides off without friction is in equilibrium, and says so.
    converged = bool((solution.result == op.RESULTS.successful) | (solution.result == op.RESULTS.slides_off))
    known = (
        (solution.displacement, solution.pressure, solution.stress_zz)
        if converged
        else solution.last_converged.displacement
    )
    return {
        "problem": index,
        "converged": converged,
        "honest": finite(known),
        "message": op.RESULTS[solution.result],
        "load_fraction": float(solution.last_converged.load_fraction),
        "seconds": round(time.perf_counter() - begin, 2),
        **{name: int(solution.stats[name]) for name in ("attempts", "newton_steps", "krylov_steps")},
        **{name: round(value, 5) if isinstance(value, float) else value for name, value in about.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real", action="store_true", help="problems of real size")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for index in range(chosen.first, chosen.first + chosen.problems):
        rows.append(measure(chosen.seed, index, chosen.real))
        print(json.dumps(rows[-1]), flush=True)
    converged, honest = (sum(row[name] for row in rows) for name in ("converged", "honest"))
    print(json.dumps({"problems": len(rows), "converged": converged, "honest": honest}))


if __name__ == "__main__":
    main()
