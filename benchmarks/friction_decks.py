"""The published friction decks, solved from the numbers in the deck: force, contact, statistics.

Run `python benchmarks/friction_decks.py DECK [DECK ...] [--element mean_dilatation full] [--increments 8 16]
[--law deck calculix]`. Prints one JSON line per solve. DECK is a fQOCE_sim_frict_*.inp or .inp.gz of the
published toolbox: a layer between two flat rigid plates, of which the upper one moves down. By symmetry a
quarter is solved; forces are those of the whole. The deck's D=0 means K/µ = 20 in Abaqus/Explicit.

The law of the decks is hard contact. "calculix" is what the stored CalculiX runs have instead, 0.7881 N
(low_0p5N_0p12) and 0.4456 N (med_0p5N_0p15_2) in plain 2x2x2 elements: 10 MPa/mm and a stick slope of
0.1 MPa/mm. At 20 kPa the former lets the layer into each plate by 2 µm, 1% of what it is pressed by.
"""

import argparse
import gzip
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

import opfem as op

CALCULIX = {"fQOCE_sim_frict_low_0p5N_0p12": 0.7881, "fQOCE_sim_frict_med_0p5N_0p15_2": 0.4456}  # N, law "calculix"
K_OVER_MU = 20.0  # what Abaqus/Explicit takes where D=0


@dataclass(frozen=True)
class Deck:
    """The numbers of a deck: mm, N, MPa."""

    c10: float
    c01: float
    bulk: float
    thickness: float
    extent: tuple[float, float]
    elements: tuple[int, int, int]
    window: op.Contact
    sample: op.Contact
    uz: float


@dataclass(frozen=True)
class Keyword:
    """One keyword of a deck with its options and data lines."""

    name: str
    options: dict[str, str]
    rows: list[list[str]]
    where: str

    def numbers(self) -> list[float]:
        """Read the first data line."""
        try:
            return [float(field) for field in self.rows[0] if field]
        except (IndexError, ValueError):
            raise ValueError(f"{self.where}: *{self.name} must be followed by numbers.") from None


def keywords(path: Path) -> Iterator[Keyword]:
    """Read a deck keyword by keyword."""
    opened = gzip.open if path.suffix == ".gz" else open
    current = None
    with opened(path, "rt") as lines:
        for number, line in enumerate(lines, 1):
            if line.startswith("**") or not line.strip():
                continue
            fields = [field.strip() for field in line.split(",")]
            if not line.startswith("*"):
                if current is not None:
                    current.rows.append(fields)
                continue
            if current is not None:
                yield current
            pairs = (field.partition("=") for field in fields[1:] if field)
            options = {key.strip().lower(): value.strip() for key, _, value in pairs}
            current = Keyword(fields[0][1:].upper(), options, [], f"{path.name}:{number}")
    if current is not None:
        yield current


def overclosure(behavior: Keyword) -> op.HardOverclosure | op.ExponentialOverclosure:
    """Build the pressure–overclosure law."""
    kind = behavior.options.get("pressure-overclosure", "").upper()
    if kind == "HARD":
        return op.HardOverclosure(exact=True)
    if kind == "EXPONENTIAL":
        clearance, pressure = behavior.numbers()
        return op.ExponentialOverclosure(pressure, clearance)
    raise ValueError(f"{behavior.where}: contact must be HARD or EXPONENTIAL, got {kind or 'neither'}.")


def collect(path: Path) -> dict[str, dict]:
    """Collect what a deck says by the name it says it of; a later definition replaces an earlier one."""
    part = interaction = ""
    found = {name: {} for name in ("nodes", "parts", "laws", "frictions", "pairs", "moves", "material")}

    def part_of(keyword: Keyword, reference: str) -> str:
        instance = reference.partition(".")[0]
        if instance not in found["parts"]:
            raise ValueError(f"{keyword.where}: *{keyword.name} of {reference}, which is no instance of a part.")
        return found["parts"][instance]

    for keyword in keywords(path):
        match keyword.name:
            case "PART":
                part = keyword.options["name"]
            case "NODE":
                found["nodes"][part] = np.array(keyword.rows, float)[:, 1:]
            case "INSTANCE":
                found["parts"][keyword.options["name"]] = keyword.options["part"]
            case "HYPERELASTIC":
                if "mooney-rivlin" not in keyword.options:
                    raise ValueError(f"{keyword.where}: the layer must be MOONEY-RIVLIN.")
                found["material"] = dict(zip(("c10", "c01", "d1"), keyword.numbers(), strict=True))
            case "SURFACE INTERACTION":
                interaction = keyword.options["name"]
            case "FRICTION":
                found["frictions"][interaction] = keyword.numbers()[0]
            case "SURFACE BEHAVIOR":
                found["laws"][interaction] = overclosure(keyword)
            case "CONTACT PAIR":
                found["pairs"][part_of(keyword, keyword.rows[0][1])] = keyword.options["interaction"]
            case "BOUNDARY":
                for row in keyword.rows:
                    if len(row) > 3 and row[1] == "3":
                        found["moves"][part_of(keyword, row[0])] = float(row[3])
    return found


def read_deck(path: Path) -> Deck:
    """Read the numbers of a layer between two flat plates."""
    found = collect(path)
    nodes, pairs = found["nodes"], found["pairs"]
    if not found["material"] or "layer" not in nodes:
        raise ValueError(f"{path.name}: no part named layer with a *HYPERELASTIC material.")
    start, end = nodes["layer"].min(axis=0), nodes["layer"].max(axis=0)
    counts = [np.unique(x.round(6)).size for x in nodes["layer"].T]
    if start.any() or len(nodes["layer"]) != np.prod(counts):
        raise ValueError(f"{path.name}: the layer must be a regular grid of nodes that starts at 0, 0, 0.")
    below, above = plates(path, nodes, pairs)
    if set(found["moves"]) != {above}:
        raise ValueError(f"{path.name}: only the plate above may move along z, got {sorted(found['moves'])}.")
    gaps = {below: -nodes[below][:, 2].max(), above: nodes[above][:, 2].min() - end[2]}
    contacts = []
    for plate, gap in gaps.items():
        contact = op.Contact(found["laws"][pairs[plate]], found["frictions"][pairs[plate]])
        if not np.isclose(gap, contact.law.zero_pressure_clearance, atol=1e-6):
            raise ValueError(f"{path.name}: {plate} starts {gap} mm away, which is not where its law starts.")
        contacts.append(contact)
    c10, c01, d1 = (found["material"][name] for name in ("c10", "c01", "d1"))
    return Deck(
        c10,
        c01,
        2.0 / d1 if d1 else K_OVER_MU * 2.0 * (c10 + c01),
        float(end[2]),
        (float(end[0]), float(end[1])),
        tuple(n - 1 for n in counts),
        *contacts,
        found["moves"][above],
    )


def plates(path: Path, nodes: dict[str, np.ndarray], pairs: dict[str, str]) -> tuple[str, str]:
    """Find the parts below and above the layer that it touches."""
    bottom, top = nodes["layer"][:, 2].min(), nodes["layer"][:, 2].max()
    below = [part for part in pairs if nodes[part][:, 2].max() <= bottom]
    above = [part for part in pairs if nodes[part][:, 2].min() >= top]
    if len(below) != 1 or len(above) != 1:
        raise ValueError(f"{path.name}: the layer must touch one part below and one above, got {below} and {above}.")
    return below[0], above[0]


def quarter(deck: Deck, element: str, law: str) -> tuple[op.Palpation, op.Imprint]:
    """State the quarter of the deck that starts in its middle."""
    nx, ny, nz = deck.elements
    if nx % 2 or ny % 2:
        raise ValueError(f"A quarter of the deck needs even numbers of elements, got {deck.elements}.")
    contacts = [deck.window, deck.sample]
    if law == "calculix":
        contacts = [op.Contact(op.LinearOverclosure(10.0), c.friction, stick_slope=0.1) for c in contacts]
    extent = (deck.extent[0] / 2, deck.extent[1] / 2)
    palpation = op.Palpation(
        op.Layer(deck.thickness, op.MooneyRivlin(deck.c10, deck.c01, bulk=deck.bulk)),
        extent,
        (nx // 2, ny // 2, nz),
        *contacts,
        sides={"x0": "roller", "y0": "roller"},
        element=element,
    )
    flat = np.full((ny // 2 + 1, nx // 2 + 1), deck.thickness + deck.uz)
    return palpation, op.Imprint(op.ThicknessMap(flat, extent=extent))


def shares(face) -> dict[str, float]:
    """Count the nodes of a face that are open, stick or slip."""
    status = np.asarray(face.status)
    return {name: round(float((status == code).mean()), 4) for code, name in enumerate(("open", "stick", "slip"))}


def run(path: Path, element: str, increments: int, law: str) -> dict:
    """Solve a deck and describe the result."""
    deck = read_deck(path)
    begin = time.perf_counter()
    solution = op.solve(*quarter(deck, element, law), op.Newton(increments=increments), throw=False)
    stats = {name: np.asarray(value) for name, value in solution.stats.items()}
    return {
        "deck": path.name,
        "element": element,
        "law": law,
        "asked_increments": increments,
        "c10_MPa": deck.c10,
        "c01_MPa": deck.c01,
        "bulk_MPa": deck.bulk,
        "thickness_mm": deck.thickness,
        "extent_mm": deck.extent,
        "elements": deck.elements,
        "friction_window": float(deck.window.friction),
        "friction_sample": float(deck.sample.friction),
        "uz_mm": deck.uz,
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
