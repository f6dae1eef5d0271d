"""The published decks by explicit dynamics and by implicit statics: maps, forces, energies, time.

Run `python -m benchmarks.explicit_coin SHARED [--case smooth smooth-frictionless sharp facets sin] [--duration 1 2]
[--precision float32 float64]`. SHARED holds data/decks and reference/ccx. Prints one JSON line per run.

`sharp` is fQOCE_validate_coin_t1_125um as published, with opfem's surface through the points of its rigid body,
`facets` the same with that body's facets, on which statics do not converge; `smooth` has the surface of the stored
CalculiX case; `sin` is fQOCE_sol_sin_t2, a preload and an actuation by µm that continues it. Explicit dynamics
integrate contact at the nodes, statics there in `smooth`, else at 2×2 points. The deck's D=0 is K/µ = 20.
Displacements of the deck's second step are taken as moves from where the first one ends.
"""

import argparse
import dataclasses
import json
import resource
import time
from pathlib import Path

import jax
import numpy as np

import opfem as op

NODES = 57  # of the imprint along a side, 0.125 mm apart, from -1 to 6 mm
OPFEM = "catmull-rom"  # interpolation


def with_friction(palpation: op.Palpation, frictions: tuple[float, float]) -> op.Palpation:
    """Replace the friction of window and sample."""
    window, sample = (
        op.Contact(side.law, friction)
        for side, friction in zip((palpation.window, palpation.sample), frictions, strict=True)
    )
    return dataclasses.replace(palpation, window=window, sample=sample)


def cases(shared: Path, name: str) -> tuple[op.Palpation, list[op.Imprint], float]:
    """State a case: the experiment, its steps, and the deck's mass scaling."""
    name_of_deck = "sol_sin_t2" if name == "sin" else "validate_coin_t1_125um"
    deck = op.read_inp(shared / "data" / "decks" / f"fQOCE_{name_of_deck}.inp.gz")
    palpation = deck.experiment()
    scaling = deck.solver().mass_scaling
    if not name.startswith("smooth"):
        return palpation, list(deck.loads("bilinear" if name == "facets" else OPFEM)), scaling
    stored = shared / "reference" / "ccx" / "cases" / "smoothcoin_muwin0p15_mutop0p05_C3D8.npz"
    with np.load(stored) as case:
        nodes, values = case["imprint_nodes"][: NODES**2], case["imprint_uz"][: NODES**2]
    uz = np.zeros((NODES, NODES))
    uz[tuple(np.rint((nodes[:, k] + 1.0) / 0.125).astype(int) for k in (1, 0))] = values
    loaded = op.ThicknessMap(palpation.layer.thickness + uz, extent=(7.0, 7.0), origin=(-1.0, -1.0))
    if name == "smooth-frictionless":
        palpation = with_friction(palpation, (0.0, 0.0))
    return palpation, [op.Imprint(loaded)], scaling


def relative(values, reference) -> float:
    """Compute the relative L2 distance."""
    return float(np.linalg.norm(np.asarray(values) - reference) / np.linalg.norm(reference))


def run(palpation: op.Palpation, steps: list[op.Imprint], solver) -> tuple[list[op.Solution], list[float]]:
    """Solve the steps one after the other."""
    solutions, seconds = [], []
    for load in steps:
        begin = time.perf_counter()
        start = solutions[-1] if solutions else None
        solutions.append(op.solve(palpation, load, solver, throw=False, start=start, progress=False))
        jax.block_until_ready(solutions[-1].pressure)
        seconds.append(round(time.perf_counter() - begin, 2))
    return solutions, seconds


def describe(solution: op.Solution, reference: op.Solution | None) -> dict:
    """Describe a solution, and its distance from the implicit one."""
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    record = {
        "message": op.RESULTS[solution.result],
        "force_N": -float(stats["force_sample"][2]),
        "increments": int(stats["increments"]),
        "min_volume_ratio": float(stats["min_volume_ratio"]),
        "max_penetration_um": 1e3 * float(stats["max_penetration"]),
    }
    if "kinetic_ratio" in stats:
        record |= {
            "increment_s": float(stats["increment"]),
            "kinetic_ratio": float(stats["kinetic_ratio"]),
            "energy_drift": float(stats["energy_drift"]),
            "residual": float(stats["residual"]),
            "energies_Nmm": {
                name.removeprefix("energy_"): float(stats[name][-1])
                for name in stats
                if name.startswith("energy_") and name != "energy_drift"
            },
        }
    if reference is not None:
        inner = (slice(1, -1), slice(1, -1))
        own, other = np.asarray(solution.pressure), np.asarray(reference.pressure)
        record |= {
            "force_from_reference": record["force_N"] / -float(reference.stats["force_sample"][2]) - 1.0,
            "map_from_reference": relative(own, other),
            "map_inside_from_reference": relative(own[inner], other[inner]),
            "stress_zz_from_reference": relative(solution.stress_zz, np.asarray(reference.stress_zz)),
            "displacement_from_reference": relative(solution.displacement, np.asarray(reference.displacement)),
        }
    return record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--case", nargs="+", default=["smooth", "smooth-frictionless", "sharp", "facets", "sin"])
    parser.add_argument("--duration", type=float, nargs="+", default=[1.0])
    parser.add_argument("--precision", nargs="+", default=["float32"], choices=("float32", "float64"))
    parser.add_argument("--no-implicit", action="store_true")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in chosen.case:
        palpation, steps, mass_scaling = cases(chosen.shared, name)
        implicit, first = None, None
        if not chosen.no_implicit and name != "facets":
            implicit, seconds = run(palpation, steps, op.Newton(face_rule="nodes" if "smooth" in name else "gauss2"))
            for k, solution in enumerate(implicit):
                record = {"case": name, "solver": "Newton", "step": k, "seconds": seconds[k]}
                print(json.dumps(record | describe(solution, None)), flush=True)
        for duration in chosen.duration:
            for precision in chosen.precision:
                single = "float32" if precision == "float32" else None
                settings = op.Explicit(duration=duration, mass_scaling=mass_scaling, precision=single)
                solutions, seconds = run(palpation, steps, settings)
                first = first or solutions
                for k, solution in enumerate(solutions):
                    record = {"case": name, "solver": "Explicit", "step": k, "duration_s": duration}
                    record |= {"precision": precision, "seconds": seconds[k]}
                    record |= describe(solution, None if implicit is None else implicit[k])
                    record["map_from_first_run"] = relative(solution.pressure, np.asarray(first[k].pressure))
                    if k > 0:  # what phase-sensitive OCT sees of the actuation
                        moves = [
                            np.asarray(s[k].displacement[2] - s[k - 1].displacement[2])
                            for s in (solutions, implicit)
                            if s is not None
                        ]
                        record["axial_move_um"] = [1e3 * float(moves[0].min()), 1e3 * float(moves[0].max())]
                        if implicit is not None:
                            record["axial_move_from_reference"] = relative(moves[0], moves[1])
                    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                    print(json.dumps(record | {"peak_MB": round(peak / 1024)}), flush=True)


if __name__ == "__main__":
    main()
