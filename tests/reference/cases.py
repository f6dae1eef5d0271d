"""CalculiX problems stored beside the project, stated with opfem's names.

The reference element is fully integrated, so they are compared with `element="full"`.
"""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import opfem as op

MATERIAL = {"c10": 0.00223, "c01": 0.000703, "bulk": 0.11732}  # MPa
FIELD = 5.0  # mm
L0 = 0.5  # mm
IMPRINT_NODES = 57  # per side, 0.125 mm apart, from -1 to 6 mm


def load_case(shared: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read one stored case: arrays and description."""
    folder = shared / "reference" / "ccx" / "cases"
    with np.load(folder / f"{name}.npz") as arrays:
        stored = dict(arrays)
    return stored, json.loads((folder / f"{name}.json").read_text())


def layer(thickness: float = L0, bulk: float = MATERIAL["bulk"]) -> op.Layer:
    """Build the published layer, or one of another bulk modulus [MPa]."""
    return op.Layer(thickness, op.MooneyRivlin(**{**MATERIAL, "bulk": bulk}))


def formula_family(variant: str, n: int, element: str) -> tuple[op.Palpation, op.Displacement]:
    """State a quarter of a case of the formula family, whose whole has n × n × n/4 elements.

    The problem is symmetric about its middle, where the quarter's x and y start: a quarter of the force
    and of the energy are the reference's.

    Args:
        variant: "B1" (window bonded, interface held laterally), "B2" (window bonded) or "B3" (both slide).
        n: Elements along a side of the whole, a multiple of 4.
        element: As in `op.Palpation`.
    """
    bump = np.cos(np.pi * np.linspace(0.0, 1.0, n // 2 + 1))
    window = op.Roller() if variant == "B3" else op.Bonded()
    palpation = op.Palpation(
        layer(),
        extent=(1.0, 1.0),
        elements=(n // 2, n // 2, n // 4),
        window=window,
        sample=op.Bonded() if variant == "B1" else op.Roller(),
        sides={"x0": "roller", "y0": "roller"},
        element=element,
    )
    uz = -0.05 * (1.0 + np.outer(bump, bump))  # mm
    return palpation, op.Displacement(uz, lateral="fixed" if variant == "B1" else "free")


def imprint_map(case: dict[str, np.ndarray]) -> op.ThicknessMap:
    """Read the rigid surface of a coin case as a thickness map."""
    nodes, uz = case["imprint_nodes"][: IMPRINT_NODES**2], case["imprint_uz"][: IMPRINT_NODES**2]
    column, row = (np.rint((nodes[:, k] + 1.0) / 0.125).astype(int) for k in (0, 1))
    values = np.zeros((IMPRINT_NODES, IMPRINT_NODES))
    values[row, column] = L0 + uz
    return op.ThicknessMap(values, extent=(7.0, 7.0), origin=(-1.0, -1.0))


def nodal_map(case: dict[str, np.ndarray], component: int, n: int) -> np.ndarray:
    """Arrange one displacement component of the interface's corner nodes as a map `(n+1, n+1)`."""
    place = case["nodes"][case["top_nodes"], :2] * n / FIELD
    corner = np.all(np.abs(place - np.rint(place)) < 1e-6, axis=1)  # quadratic elements have nodes between
    column, row = np.rint(place[corner]).astype(int).T
    values = np.zeros((n + 1, n + 1))
    values[row, column] = case["u"][case["top_nodes"][corner], component]
    return values


def top_stress(case: dict[str, np.ndarray], n: int = 40) -> np.ndarray:
    """Arrange the reference's mean S33 of the top elements as a map `(n, n)`."""
    centre = case["nodes"][case["elems"][case["top_elems"]]].mean(axis=1)
    values = np.zeros((n, n))
    values[tuple((centre[:, k] * n / FIELD).astype(int) for k in (1, 0))] = case["S_elem_mean"][case["top_elems"], 2]
    return values


def coin(
    friction_window: float | None,
    friction_sample: float,
    stiffness: float,
    hold: float | None = None,
    element: str = "full",
) -> op.Palpation:
    """State a contact case of the coin; no window friction means the window's u_z is held."""
    window = op.Roller()
    if friction_window is not None:
        window = op.Contact(op.LinearOverclosure(10.0), friction_window, stick_slope=0.1)
    sample = op.Contact(op.LinearOverclosure(stiffness), friction_sample, stick_slope=0.02)
    return op.Palpation(layer(), (FIELD, FIELD), (40, 40, 4), window, sample, element=element, hold=hold)


def normal_force(solution: op.Solution) -> float:
    """Read the normal force [N], positive in compression."""
    return -float(solution.stats["force_sample"][2])


def relative_error(values, reference: np.ndarray) -> float:
    """Compute the relative L2 distance of two maps."""
    return float(np.linalg.norm(np.asarray(values) - reference) / np.linalg.norm(reference))


def rigid_motion(case: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Fit the in-plane rotation `(2, 2)` and shift [mm] about the field's centre that a layer's window face made."""
    face = np.abs(case["nodes"][:, 2]) < 1e-9
    X = case["nodes"][face, :2] - FIELD / 2
    x = X + case["u"][face, :2]
    shift = x.mean(axis=0)
    M = (x - shift).T @ X
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), shift


def seen_by_layer(thickness: op.ThicknessMap, rotation: np.ndarray, shift: np.ndarray) -> op.ThicknessMap:
    """Move a map against a layer's rigid motion."""
    y, x = np.meshgrid(thickness.y, thickness.x, indexing="ij")
    x, y = np.einsum("ij,jyx->iyx", rotation, np.stack([x, y]) - FIELD / 2) + (FIELD / 2 + shift)[:, None, None]
    values = thickness.sample(jnp.asarray(x), jnp.asarray(y))
    return op.ThicknessMap(values, extent=tuple(thickness.extent), origin=tuple(thickness.origin))


def under_body(case: dict[str, np.ndarray], n: int = 40) -> np.ndarray:
    """Tell which top elements lie under the rigid body, which ends at -1 and 6 mm, as a map `(n, n)`."""
    corners = (case["nodes"] + case["u"])[case["elems"][case["top_elems"]]]
    centre = case["nodes"][case["elems"][case["top_elems"]]].mean(axis=1)
    inside = np.all((corners[..., :2] > -1.0) & (corners[..., :2] < 6.0), axis=(1, 2))
    values = np.zeros((n, n), bool)
    values[tuple((centre[:, k] * n / FIELD).astype(int) for k in (1, 0))] = inside
    return values
