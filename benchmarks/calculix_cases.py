"""Every stored CalculiX case, solved by opfem: force, energy, displacements, stress, with the difference of each.

Run `python -m benchmarks.calculix_cases SHARED [--only PATTERN] [--element full mean_dilatation]` in the
repository's root. SHARED is the folder that holds reference/ccx/cases. Prints one JSON line per figure and then
the table. With `--refine [--elements 8 16 32]` it instead solves the problems of prescribed displacement, and of
contact, on finer and finer meshes: where both element forms, and CalculiX's other elements, go.
"""

import argparse
import fnmatch
import json
import re
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np

import opfem as op
from tests.reference import cases

ELEMENTS = ("full", "mean_dilatation")
# What CalculiX's element is, and what its numbers are to be held against.
WHY = {
    "C3D8": "plain 2x2x2, as full: to 0.1% at the same mesh",
    "C3D8I": "incompatible modes, another element: hold against the limit of refinement",
    "C3D20R": "quadratic, another element: hold against the limit of refinement",
    "contact": "C3D8 as full, but contact integrated over other facets: to 2%",
    "sharp": "slopes to 0.57: the surface between nodes, and where contact is integrated, move it by several per cent",
    "drifts": "layer drifted on springs of 1e-7 N/mm: opfem moves the map instead; to 2% where smoothed, else as sharp",
}
UNITS = {"force": "N", "energy": "N mm", "uz centre": "mm", "ux side": "mm", "S33 mean": "MPa", "S33 map": "MPa"}

Values = dict[str, float | np.ndarray]


def problem_of(name: str) -> str:
    """Name what a case solves: its own name without CalculiX's element."""
    return re.sub(r"_C3D(8I|20R|8)", "", name)


def drifts(name: str) -> bool:
    """Tell whether the reference's layer, without any friction, slid away under its rigid body."""
    return "bottom_slip" in name and "presc" not in name


def why(name: str) -> str:
    """Say what the difference of a case is to be judged by."""
    if drifts(name):
        return WHY["drifts"]
    if name.startswith("coin_ccxcontact"):
        return WHY["sharp"]
    if name.startswith(("smoothcoin", "fricsim")):
        return WHY["contact"]
    return WHY[re.search(r"C3D(8I|20R|8)", name).group()]


def statement(shared: Path, name: str, element: str) -> tuple[op.Palpation, op.Displacement | op.Imprint]:
    """State a stored case."""
    case, about = cases.load_case(shared, name)
    if name.startswith("fam"):
        return cases.formula_family(about["variant"], about["grid"][0], element)
    if name.startswith("coin_presc"):
        n = {800: 20, 6400: 40, 51200: 80}[len(case["elems"])]
        bonded = about["bottom"] == "bonded"
        spring = None if bonded else about["options"]["spring"] * (n + 1) ** 2  # N/mm, under every window node
        return prescribed_coin(cases.nodal_map(case, 2, n), bonded, about["material"]["K"], element, spring)
    friction, stiffness = about["friction"], 10.0
    if name.startswith("fricsim"):
        nodes = case["nodes"]
        window, sample = (
            op.Contact(op.LinearOverclosure(stiffness), friction[side], stick_slope=friction[f"lam_{side}"])
            for side in ("window", "sample")
        )
        L0 = about["layer"]["H"]
        palpation = op.Palpation(
            cases.layer(L0),
            (2.5, 2.5),
            (25, 25, len(np.unique(nodes[:, 2].round(6))) - 1),
            window,
            sample,
            sides={"x0": "roller", "y0": "roller"},
            element=element,
        )
        flat = np.full((26, 26), L0 + float(np.min(case["imprint_uz"])))
        return palpation, op.Imprint(op.ThicknessMap(flat, extent=(2.5, 2.5)))
    surface = cases.imprint_map(case)
    if drifts(name):
        surface = cases.seen_by_layer(surface, *cases.rigid_motion(case))
    window_friction = None if drifts(name) else friction["window"]
    palpation = cases.coin(window_friction, friction["sample"], about["top_law"]["k"], element=element)
    return palpation, op.Imprint(surface)


def prescribed_coin(
    uz: np.ndarray, bonded: bool, bulk: float, element: str, spring: float | None = None
) -> tuple[op.Palpation, op.Displacement]:
    """State the coin as a prescribed displacement of the interface."""
    n = len(uz) - 1
    side = op.Bonded() if bonded else op.Roller()
    palpation = op.Palpation(
        cases.layer(bulk=bulk), (cases.FIELD, cases.FIELD), (n, n, n // 10), side, side, element=element, hold=spring
    )
    return palpation, op.Displacement(uz, lateral="fixed" if bonded else "free")


def parts(name: str) -> int:
    """Count into how many like parts symmetry divides what opfem solves; the reference's families are whole."""
    return 4 if name.startswith(("fam", "fricsim")) else 1


def stored(shared: Path, name: str) -> Values:
    """Read what CalculiX found."""
    case, about = cases.load_case(shared, name)
    results = about["results"]
    if name.startswith("fam"):
        values = {"force": -results["top_force_N"][2], "energy": results.get("strain_energy_Nmm")}
        values |= {"uz centre": results["uz_centre_mid"], "ux side": results["ux_side_mid"]}
    else:
        forces = results["forces_N"]
        force = forces.get("top_reaction_on_layer", forces.get("top_reaction_on_imprint"))
        values = {"force": -parts(name) * force[2]}
        values["energy"] = results.get("strain_energy_Nmm", np.nan) * parts(name)
    values["S33 map"] = stress_map(case)
    values["S33 mean"] = values["S33 map"].mean()
    return {quantity: value for quantity, value in values.items() if value is not None and not np.isnan(value).any()}


def stress_map(case: dict[str, np.ndarray]) -> np.ndarray:
    """Arrange the mean S33 of the reference's top elements as a map."""
    centre = np.array([case["nodes"][corners[:8]].mean(axis=0) for corners in case["elems"]])
    top = np.isclose(centre[:, 2], centre[:, 2].max())
    column, row = (np.unique(centre[top, k].round(6), return_inverse=True)[1] for k in (0, 1))
    values = np.zeros((row.max() + 1, column.max() + 1))
    values[row, column] = case["S_elem_mean"][top, 2]
    return values


def described(solution: op.Solution, name: str) -> Values:
    """Read the same quantities of a solution."""
    u = np.asarray(solution.displacement)
    values = {
        "force": parts(name) * cases.normal_force(solution),
        "energy": parts(name) * float(solution.stats["strain_energy"]),
        "S33 map": np.asarray(solution.stress_zz),
        "S33 mean": float(solution.stress_zz.mean()),
    }
    if name.startswith("fam"):
        middle = u.shape[1] // 2
        values |= {"uz centre": u[2, middle, 0, 0], "ux side": u[0, middle, 0, -1]}
    return values


def compare(shared: Path, name: str, reference: Values, found: dict[str, Values]) -> list[dict]:
    """Make one row per quantity; of the stress map, root mean squares, and the distance of the two maps."""
    case, _ = cases.load_case(shared, name)
    where = np.ones_like(reference["S33 map"], bool)
    if drifts(name):
        where = cases.under_body(case)  # the reference's body ends at -1 and 6 mm
    rows = []
    for quantity in [q for q in UNITS if q in reference]:
        row = {"case": name, "quantity": quantity, "unit": UNITS[quantity]}
        expected = reference[quantity]
        for element, values in found.items():
            got = values[quantity]
            if quantity == "S33 map":
                inside = where[-len(got) :, -len(got) :]  # a quarter's own part
                a, b = got[inside], expected[-len(got) :, -len(got) :][inside]
                row["calculix"] = float(np.sqrt((b**2).mean()))
                row |= {element: float(np.sqrt((a**2).mean())), f"{element}_off": cases.relative_error(a, b)}
            else:
                row["calculix"] = float(expected)
                row |= {element: float(got), f"{element}_off": float(got / expected - 1.0)}
        rows.append({**row, "why": why(name)})
    return rows


def case_rows(shared: Path, names: list[str], elements: list[str]) -> list[dict]:
    """Solve every problem once in each element form; print its rows."""
    found: dict[tuple[str, str], Values] = {}
    table = []
    for name in sorted(names, key=lambda name: (problem_of(name), name)):
        seconds = {}
        for element in elements:
            if (problem_of(name), element) in found:
                continue
            begin = time.perf_counter()
            solution = op.solve(*statement(shared, name, element), throw=False, progress=False)
            found[problem_of(name), element] = described(solution, name)
            seconds[f"{element}_seconds"] = round(time.perf_counter() - begin, 1)
            jax.clear_caches()
        of_case = {element: found[problem_of(name), element] for element in elements}
        for row in compare(shared, name, stored(shared, name), of_case):
            print(json.dumps(row | seconds), flush=True)
            table.append(row)
    return table


def print_table(rows: list[dict], elements: list[str]) -> None:
    """Print the rows aligned: CalculiX's value, opfem's of each element form and its difference [%]."""
    width = max(len(row["case"]) for row in rows)
    heads = "".join(f"{element:>16}{'off %':>9}" for element in elements)
    print(f"\n{'case':<{width}}  {'quantity':<10}{'unit':<6}{'CalculiX':>12}{heads}  why")
    for row in rows:
        values = "".join(f"{row[element]:>16.6g}{100 * row[f'{element}_off']:>9.3f}" for element in elements)
        named = f"{row['case']:<{width}}  {row['quantity']:<10}{row['unit']:<6}"
        print(f"{named}{row['calculix']:>12.6g}{values}  {row['why']}")


@cache
def coin_uz(shared: Path, n: int) -> np.ndarray:
    """Read the coin's prescribed displacement [mm] on n × n elements."""
    name = "coin_presc_uz_bottom_slip_C3D8" + {20: "_20x20x2", 40: "", 80: "_80x80x8"}[n]
    return cases.nodal_map(cases.load_case(shared, name)[0], 2, n)


def case_names(shared: Path, pattern: str) -> list[str]:
    """List the stored cases of a pattern."""
    return fnmatch.filter((path.stem for path in (shared / "reference" / "ccx" / "cases").glob("*.json")), pattern)


def contact_on_mesh(shared: Path, name: str, n: int, element: str) -> tuple[op.Palpation, op.Imprint]:
    """State a stored contact case on n elements a side, and through the thickness in the same proportion."""
    palpation, load = statement(shared, name, element)
    nx, _, nz = palpation.elements
    return replace(palpation, elements=(n, n, n * nz // nx)), load


def refinement(shared: Path, pattern: str, elements: list[str], meshes: list[int] | None) -> None:
    """Solve problems on finer and finer meshes; print every figure, its limit, and how the stress maps close in.

    Maps, averaged over the elements of the coarsest mesh, are held against the finest of the last element form.
    """
    coin = {"coin_slip": (False, 0.11732), "coin_slip_k200": (False, 1.1732), "coin_bonded": (True, 0.11732)}
    problems = {f"fam_{v}": ((8, 16, 24, 32, 48), partial(cases.formula_family, v)) for v in ("B1", "B2", "B3")}
    for name, about in coin.items():
        problems[name] = (
            (20, 40, 80),
            lambda n, element, about=about: prescribed_coin(coin_uz(shared, n), *about, element),
        )
    for name in case_names(shared, "coin_ccxcontact*") + case_names(shared, "smoothcoin*"):
        problems[name] = ((20, 40, 60), partial(contact_on_mesh, shared, name))
    for name in case_names(shared, "fricsim*"):
        problems[name] = ((25, 50, 75), partial(contact_on_mesh, shared, name))
    for name in fnmatch.filter(problems, pattern):
        usual, state = problems[name]
        maps = {}
        for element in elements:
            found = {}
            for n in meshes or usual:
                solution = op.solve(*state(n, element), throw=False, progress=False)
                values = described(solution, name)
                maps[element, n] = values["S33 map"]
                found[n] = {q: float(values[q]) for q in UNITS if np.ndim(values.get(q, [])) == 0}
                print(json.dumps({"problem": name, "element": element, "n": n} | found[n]), flush=True)
                jax.clear_caches()
            for three in [(n, 2 * n, 4 * n) for n in found if {2 * n, 4 * n} <= set(found)]:
                limits = {quantity: limit(*(found[n][quantity] for n in three)) for quantity in found[three[0]]}
                print(json.dumps({"problem": name, "element": element, "limit_of": three} | limits), flush=True)
        cells = min(len(values) for values in maps.values())
        finest = averaged(maps[elements[-1], max(meshes or usual)], cells)
        for (element, n), values in maps.items():
            off = cases.relative_error(averaged(values, cells), finest)
            print(json.dumps({"problem": name, "element": element, "n": n, "S33 map from the finest": off}), flush=True)


def averaged(values: np.ndarray, cells: int) -> np.ndarray:
    """Average a map over cells × cells parts, for comparing meshes."""
    split = [np.array_split(np.arange(n), cells) for n in values.shape]
    return np.array([[values[np.ix_(rows, columns)].mean() for columns in split[1]] for rows in split[0]])


def limit(coarse: float, middle: float, fine: float) -> float:
    """Extrapolate three halvings whose differences fall geometrically (Aitken); NaN where they do not fall."""
    ratio = (fine - middle) / (middle - coarse)
    return fine + (fine - middle) * ratio / (1.0 - ratio) if 0.0 < ratio < 1.0 else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path, help="folder that holds reference/ccx/cases")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="names of cases, such as 'fam_B3*'")
    parser.add_argument("--element", nargs="+", choices=ELEMENTS, default=list(ELEMENTS))
    parser.add_argument(
        "--refine",
        action="store_true",
        help="refine instead: fam_B1 …, coin_slip, coin_bonded …, coin_ccxcontact…, smoothcoin…, fricsim…",
    )
    parser.add_argument("--elements", type=int, nargs="+", help="meshes of the refinement, elements per side")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if chosen.refine:
        refinement(chosen.shared, chosen.only, chosen.element, chosen.elements)
        return
    names = case_names(chosen.shared, chosen.only)
    if not names:
        parser.error(f"no stored case is called {chosen.only!r}")
    print_table(case_rows(chosen.shared, names, chosen.element), chosen.element)


if __name__ == "__main__":
    main()
