"""Friction and moduli fitted to the phase increment and the force of a layer between two plates, truth on another mesh.

Run `python -m benchmarks.friction CASE [--elements 10x10x4] [--frictions 0.2,0.08 ...] [--draws 1] [--first 0]`.
Prints one JSON line per fit. The truth is solved on 1.7 times as many elements along each axis, hybrid ones; each block
has 2 nm of noise, all have a scale that is off by 1 %. A quarter of a layer of 5 × 5 × 0.5 mm is solved, pressed to
0.4 mm and by another 2 µm. CASE:

    phase    both frictions, bulk modulus and scale from the increment alone
    force    the same and C10, from a force with 2 % of noise as well
    plain    both frictions from that force and C10 known to 2 %
    middle   as phase, from mid depth alone, where the sum of the frictions does not show
    bulk     as phase, with the bulk modulus fixed at 50 times the true one
    decks    `--deck fQOCE_sim_frict_*.inp.gz`: as force, of the layer, thickness and frictions of a published deck,
             on its own elements where `--elements` names none; five layers through the thickness find frictions
             that three, as frict_med has, miss
"""

import argparse
import dataclasses
import json
import resource
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import opfem as op
from benchmarks.friction_decks import quarter
from opfem.identification.state_residuals import axial_increment

SIDE, THICKNESS, PRESSED, STEP = 2.5, 0.5, 0.4, 2e-3  # mm
C10, C01, BULK, STIFF_BULK = 2.23e-3, 7.03e-4, 0.11732, 5.9  # MPa; 20 and 1000 shear moduli
NOISE, SCALE_STD, FORCE_STD = 2e-6, 0.01, 0.02  # mm, -, -
FINER = 1.7
MARGIN, BLOCK = 0.5, (0.1, 0.05)  # mm; lateral and axial size of a block
PAIRS = ((0.2, 0.08), (0.1, 0.1), (0.3, 0.2), (0.05, 0.01), (0.15, 0.05), (0.3, 0.05))
PRIORS = {
    "window.friction": op.LogNormal(0.15, 0.7),
    "sample.friction": op.LogNormal(0.05, 1.0),
    "layer.material.bulk": op.LogNormal(0.15, 0.5),
}


def contact(friction: float) -> op.Contact:
    """State contact with a plate, by the penalty alone.

    Multipliers update at full load, which moves what slips: increments of frictions 0.3 and 0.05 on 26×26×10 elements
    change by 31 nm; those of the penalty change by 0.3 nm from 8 to 32 load increments.
    """
    return op.Contact(op.HardOverclosure(exact=False), friction)


def plates(frictions, elements, element, bulk=BULK) -> op.Palpation:
    """State a quarter of the layer between two plates."""
    contacts = [contact(one) for one in frictions]
    layer = op.Layer(THICKNESS, op.MooneyRivlin(C10, C01, bulk))
    sides = {"x0": "roller", "y0": "roller"}
    return op.Palpation(layer, (SIDE, SIDE), elements, *contacts, sides=sides, element=element)


def pressed(thickness: float, side: float = SIDE) -> op.Imprint:
    """Press a flat plate to a thickness [mm]."""
    return op.Imprint(op.ThicknessMap(np.full((2, 2), thickness), extent=(side, side)))


def points(thickness: float, side: float) -> np.ndarray:
    """Middles of the blocks, outside of the margin [mm]."""
    lateral, axial = np.arange(0.5 * BLOCK[0], side - MARGIN, BLOCK[0]), np.arange(0.5 * BLOCK[1], thickness, BLOCK[1])
    return np.stack(np.meshgrid(lateral, lateral, axial), axis=-1).reshape(-1, 3)


def solved(palpation: op.Palpation, loads) -> list[op.Solution]:
    """Solve the states in sequence."""
    solver = op.Newton(rtol=1e-7, krylov_rtol=1e-3)
    states: list[op.Solution] = []
    for load in loads:
        states.append(op.solve(palpation, load, solver, start=states[-1] if states else None, progress=False))
    return states


def finer(elements) -> tuple[int, ...]:
    """Return the elements of the truth."""
    return tuple(round(FINER * n) for n in elements)


def increment(truth, where, rng, scale) -> op.AxialIncrement:
    """Draw what phase measures."""
    values = scale * np.asarray(axial_increment(truth[0], truth[1], jnp.asarray(where)))
    return op.AxialIncrement(where, values + NOISE * rng.standard_normal(len(where)), NOISE, SCALE_STD)


def force(state: op.Solution, rng) -> tuple[int, op.ForceReading]:
    """Draw what a load cell measures in the first state."""
    exact = -float(state.stats["force_sample"][2])
    return 0, op.ForceReading(exact * (1.0 + FORCE_STD * rng.standard_normal()), FORCE_STD * exact)


def described(found: op.ParameterFit, truth: dict, seconds: float, cpu: float) -> dict:
    """Compare a fit with the truth."""
    inside = {name: low <= truth[name] <= high for name, (low, high) in found.intervals().items() if name in truth}
    return {
        "error": {name: float(f"{float(found.numbers[name]) - value:.4g}") for name, value in truth.items()},
        "std": {name: float(f"{float(found.std[name]):.2g}") for name in truth},
        "mesh_std": {name: float(f"{float(found.mesh_std[name]):.2g}") for name in truth},
        "inside": inside,
        "chi2_per_datum": {name: round(float(np.mean(np.square(v))), 3) for name, v in found.residuals.items()},
        "advice": found.advice(),
        "steps": found.steps,
        "s": round(seconds, 1),
        "cpu_s": round(cpu, 1),
    }


def fitted(experiment, observations, priors, truth: dict) -> dict:
    """Fit and compare."""

    def cpu() -> float:
        return sum(resource.getrusage(resource.RUSAGE_SELF)[:2])

    begin, used = time.perf_counter(), cpu()
    found = op.fit_parameters(experiment, observations, priors, throw=False)
    out = described(found, truth, time.perf_counter() - begin, cpu() - used)
    return {"converged": found.converged, **out}


def plate_case(case: str, frictions, elements, draw: int):
    """State a fit of one draw: experiment, observations, priors, truth and number of blocks."""
    rng = np.random.default_rng((1, draw))
    loads = [pressed(PRESSED), pressed(PRESSED - STEP)]
    truth = solved(plates(frictions, finer(elements), "hybrid"), loads)
    where = points(PRESSED, SIDE)
    if case == "middle":
        where = where[np.abs(where[:, 2] - 0.5 * PRESSED) < 0.51 * BLOCK[1]]
        where[:, 2] = 0.5 * PRESSED
    scale = 1.0 + SCALE_STD * rng.standard_normal()
    observations: list = [increment(truth, where, rng, scale)]
    priors = dict(PRIORS)
    known = {"window.friction": frictions[0], "sample.friction": frictions[1], "layer.material.bulk": BULK}
    known["scale"] = scale
    if case == "bulk":
        del known["layer.material.bulk"], priors["layer.material.bulk"]
    if case in ("force", "plain"):
        observations.append(force(truth[0], rng))
        known["layer.material.c10"] = C10
        priors["layer.material.c10"] = op.LogNormal(2.4e-3, 0.2)
    if case == "plain":
        del observations[0], known["scale"]
        priors["layer.material.c10"] = op.LogNormal(C10 * (1.0 + 0.02 * rng.standard_normal()), 0.02)
    experiment = plates((0.15, 0.05), elements, "mean_dilatation", STIFF_BULK if case == "bulk" else BULK), loads
    return experiment, observations, priors, known


def deck_case(path: Path, elements, draw: int):
    """State a fit to what is simulated of a published deck: its frictions from its force and an increment."""
    rng = np.random.default_rng((1, draw))
    palpation, load = quarter(op.read_inp(path), "mean_dilatation", "deck")
    side, thickness = float(palpation.extent[0]), float(load.thickness.values[0, 0])
    loads = [load, pressed(thickness - STEP, side)]
    faces = {name: contact(float(getattr(palpation, name).friction)) for name in ("window", "sample")}
    palpation = dataclasses.replace(palpation, elements=elements or palpation.elements, **faces)
    finest = dataclasses.replace(palpation, elements=finer(palpation.elements), element="hybrid")
    truth = solved(finest, loads)
    scale = 1.0 + SCALE_STD * rng.standard_normal()
    observations = [increment(truth, points(thickness, side), rng, scale), force(truth[0], rng)]
    material = palpation.layer.material
    guessed = dataclasses.replace(palpation, window=contact(0.15), sample=contact(0.05))
    if not isinstance(material, op.MooneyRivlin):
        raise ValueError(f"{path.name} holds no Mooney–Rivlin material.")
    c10 = float(material.c10)
    priors = PRIORS | {"layer.material.c10": op.LogNormal(c10 * (1.0 + 0.02 * rng.standard_normal()), 0.02)}
    known = {f"{face}.friction": float(getattr(palpation, face).friction) for face in ("window", "sample")}
    known |= {"layer.material.c10": c10, "layer.material.bulk": float(material.bulk), "scale": scale}
    return (guessed, loads), observations, priors, known


def main() -> None:
    """Run a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=("phase", "force", "plain", "middle", "bulk", "decks"))
    parser.add_argument("--elements", help="nx x ny x nz; default: 10x10x4, or those of the deck")
    parser.add_argument("--frictions", nargs="*", default=[",".join(map(str, pair)) for pair in PAIRS])
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--deck", type=Path, nargs="*", default=[])
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    op.cache_compilation()
    elements = tuple(int(n) for n in chosen.elements.split("x")) if chosen.elements else None
    for what in chosen.deck if chosen.case == "decks" else chosen.frictions:
        for draw in range(chosen.first, chosen.first + chosen.draws):
            if chosen.case == "decks":
                stated, about = deck_case(what, elements, draw), what.name
            else:
                about = tuple(float(one) for one in what.split(","))
                stated = plate_case(chosen.case, about, elements or (10, 10, 4), draw)
            blocks = sum(one.values.size for one in stated[1] if isinstance(one, op.AxialIncrement))
            line = {"case": chosen.case, "of": about, "elements": stated[0][0].elements, "draw": draw, "blocks": blocks}
            print(json.dumps(line | fitted(*stated)), flush=True)


if __name__ == "__main__":
    main()
