"""The published friction decks, solved from the numbers in the deck: force, contact, statistics.

Run `python benchmarks/friction_decks.py DECK [DECK ...] [--element mean_dilatation full] [--increments 8 16]
[--law deck calculix]`. Prints one JSON line per solve. DECK is a fQOCE_sim_frict_*.inp or .inp.gz of the
published toolbox: a layer between two flat rigid plates, of which the upper one moves down. By symmetry a
quarter is solved; forces are those of the whole, extent and elements the quarter's.

The law of the decks is hard contact. "calculix" is what the stored CalculiX runs have instead, 0.7881 N
(low_0p5N_0p12) and 0.4456 N (med_0p5N_0p15_2) in plain 2x2x2 elements: 10 MPa/mm and a stick slope of
0.1 MPa/mm. At 20 kPa the former lets the layer into each plate by 2 µm, 1% of what it is pressed by.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

import opfem as op

CALCULIX = {"fQOCE_sim_frict_low_0p5N_0p12": 0.7881, "fQOCE_sim_frict_med_0p5N_0p15_2": 0.4456}  # N, law "calculix"


def quarter(deck: op.Deck, element: str, law: str) -> tuple[op.Palpation, op.Imprint]:
    """State the quarter of the deck that starts in its middle."""
    whole, load = deck.experiment(), deck.loads()[-1]
    if not isinstance(whole, op.Palpation) or not isinstance(load, op.Imprint):
        raise ValueError(f"{deck.name} is no layer between two rigid plates.")
    nx, ny, nz = whole.elements
    if nx % 2 or ny % 2:
        raise ValueError(f"A quarter of the deck needs even numbers of elements, got {whole.elements}.")
    contacts = [op.Contact(op.HardOverclosure(exact=True), side.friction) for side in (whole.window, whole.sample)]
    if law == "calculix":
        contacts = [op.Contact(op.LinearOverclosure(10.0), side.friction, stick_slope=0.1) for side in contacts]
    extent = tuple(float(length) / 2 for length in whole.extent)
    sides = {"x0": "roller", "y0": "roller"}
    palpation = op.Palpation(whole.layer, extent, (nx // 2, ny // 2, nz), *contacts, sides=sides, element=element)
    flat = np.full((ny // 2 + 1, nx // 2 + 1), float(load.thickness.values[0, 0]))
    return palpation, op.Imprint(op.ThicknessMap(flat, extent=extent))


def shares(face) -> dict[str, float]:
    """Count the nodes of a face that are open, stick or slip."""
    status = np.asarray(face.status)
    return {name: round(float((status == code).mean()), 4) for code, name in enumerate(("open", "stick", "slip"))}


def run(path: Path, element: str, increments: int, law: str) -> dict:
    """Solve a deck and describe the result."""
    palpation, load = quarter(op.read_inp(path), element, law)
    begin = time.perf_counter()
    solution = op.solve(palpation, load, op.Newton(increments=increments), throw=False)
    material = palpation.layer.material
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    return {
        "deck": path.name,
        "element": element,
        "law": law,
        "asked_increments": increments,
        "c10_MPa": float(material.c10),
        "c01_MPa": float(material.c01),
        "bulk_MPa": float(material.bulk),
        "thickness_mm": float(palpation.layer.thickness),
        "extent_mm": np.asarray(palpation.extent).tolist(),
        "elements": palpation.elements,
        "friction_window": float(palpation.window.friction),
        "friction_sample": float(palpation.sample.friction),
        "uz_mm": float(load.thickness.values[0, 0] - palpation.layer.thickness),
        "calculix_N": CALCULIX.get(path.name.partition(".")[0]),
        "seconds": round(time.perf_counter() - begin, 1),
        "message": op.RESULTS[solution.result],
        "force_N": -4.0 * float(stats["force_sample"][2]),
        "increments": int(stats["increments"]),
        "newton_steps": int(stats["newton_steps"]),
        "max_penetration_um": 1e3 * float(stats["max_penetration"]),
        "window": shares(solution.window),
        "sample": shares(solution.sample),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("decks", type=Path, nargs="+")
    parser.add_argument("--element", nargs="+", default=["mean_dilatation", "full"])
    parser.add_argument("--increments", type=int, nargs="+", default=[8])
    parser.add_argument("--law", nargs="+", choices=("deck", "calculix"), default=["deck"])
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for path in chosen.decks:
        for law in chosen.law:
            for element in chosen.element:
                for increments in chosen.increments:
                    print(json.dumps(run(path, element, increments, law)), flush=True)


if __name__ == "__main__":
    main()
