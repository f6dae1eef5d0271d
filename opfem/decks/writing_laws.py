"""Materials and contact as text of Abaqus or CalculiX, exact or refused."""

import math

import numpy as np

from ..model import (
    AbstractMaterial,
    Contact,
    ExponentialOverclosure,
    HardOverclosure,
    LinearOverclosure,
    MooneyRivlin,
    NeoHooke,
    Ogden,
    TabularOverclosure,
    Yeoh,
)
from ..model.contact import SLIP_TOLERANCE
from ..model.material_field import numbers_of, points_of
from .deck import Code
from .laws import ELEMENTS
from .writing_bodies import Written, listed, show

# CalculiX' linear law is smooth: tension far away [MPa], and the clearance up to which springs are made [mm].
_CALCULIX_LINEAR = "1e-05, 0.001"
_NAMES = {"abaqus": "Abaqus", "calculix": "CalculiX"}


def element_name(element: str, code: Code) -> str:
    """Name the code's element that is opfem's.

    Raises:
        ValueError: If it has none that is the same.
    """
    found = [name for (whose, name), own in ELEMENTS.items() if whose == code and own == element]
    if not found or element == "reduced":
        why = {
            "full": "its C3D8 averages the volume change; take element='mean_dilatation'",
            "mean_dilatation": "its C3D8 is plain 2×2×2 integration; take element='full'",
            "reduced": "its C3D8R has another hourglass control",
            "hybrid": "it has no such element; take element='full'",
        }.get(element, "decks are written of hexahedra")
        raise ValueError(f"write_inp: {_NAMES[code]} has no element that is opfem's {element!r}: {why}.")
    return found[0]


def material_lines(
    body: Written, law: AbstractMaterial, element: str, density: float | None, damping: float
) -> list[str]:
    """Write the materials of a body and what is made of them.

    Raises:
        ValueError: If a law has no counterpart.
    """
    shape = points_of(law)
    if shape == ():
        lines = _law_lines(body.name, law, density, damping)
        return [*lines, f"*SOLID SECTION, ELSET={body.name}, MATERIAL={body.name}"]
    names = list(numbers_of(law))
    table = np.stack([np.broadcast_to(np.asarray(getattr(law, name)), shape).ravel() for name in names], axis=1)
    values, which = np.unique(table, axis=0, return_inverse=True)
    lines = []
    for number, row in enumerate(values, start=1):
        one = type(law)(**dict(zip(names, row.tolist(), strict=True)))
        name = f"{body.name}_{number}"
        lines += _law_lines(name, one, density, damping)
        lines += listed("ELSET", name, body.elements.ravel()[which.ravel() == number - 1].tolist())
        lines.append(f"*SOLID SECTION, ELSET={name}, MATERIAL={name}")
    return lines


def _law_lines(name: str, law: AbstractMaterial, density: float | None, damping: float) -> list[str]:
    bulk = float(law.bulk)
    d1 = 0.0 if math.isinf(bulk) else 2.0 / bulk
    match law:
        case MooneyRivlin():
            kind, numbers = "MOONEY-RIVLIN", [law.c10, law.c01, d1]
        case NeoHooke():
            kind, numbers = "NEO HOOKE", [law.c10, d1]
        case Yeoh():
            kind, numbers = "YEOH", [law.c10, law.c20, law.c30, d1, 0.0, 0.0]
        case Ogden() if law.mu.size <= 3:
            kind = f"OGDEN, N={law.mu.size}"
            pairs = np.stack([np.asarray(law.mu), np.asarray(law.alpha)], axis=1).ravel()
            numbers = [*pairs, d1, *[0.0] * (law.mu.size - 1)]
        case _:
            raise ValueError(f"write_inp: neither Abaqus nor CalculiX has the law {type(law).__name__}.")
    words = [show(value) for value in numbers]
    lines = [f"*MATERIAL, NAME={name}"]
    lines += [] if density is None else ["*DENSITY", f"{show(density)},"]
    lines += [f"*DAMPING, ALPHA={show(damping)}"] if damping else []
    return [*lines, f"*HYPERELASTIC, {kind}", ", ".join(words[:8]), *([", ".join(words[8:])] if words[8:] else [])]


def rigid_lines(bodies: list[Written], density: float | None) -> list[str]:
    """Write the material of rigid bodies, which nothing depends on: all of their nodes are constrained or moved."""
    if not bodies:
        return []
    lines = ["*MATERIAL, NAME=RIGID", *([] if density is None else ["*DENSITY", f"{show(density)},"])]
    lines += ["*ELASTIC", "1., 0."]
    return [*lines, *(f"*SOLID SECTION, ELSET={body.name}, MATERIAL=RIGID" for body in bodies)]


def interaction_lines(name: str, contact: Contact, code: Code, is_explicit: bool) -> list[str]:
    """Write the law of a contact.

    Raises:
        ValueError: If the code has no such law.
    """
    return [f"*SURFACE INTERACTION, NAME={name}", *_law(contact, code), *_friction(contact, code, is_explicit)]


def _law(contact: Contact, code: Code) -> list[str]:
    law, kind = contact.law, "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE="
    if code == "calculix" and not isinstance(law, LinearOverclosure):
        why = {
            ExponentialOverclosure: "its EXPONENTIAL is another law, without a clearance of zero pressure",
            HardOverclosure: "its contact always gives way",
            TabularOverclosure: "its tables give no pressure between surfaces",
        }.get(type(law), "it has no such law")
        raise ValueError(
            f"write_inp: CalculiX cannot say {type(law).__name__}: {why}. Take LinearOverclosure(stiffness) [MPa/mm]."
        )
    match law:
        case HardOverclosure():
            return [f"{kind}HARD"]
        case ExponentialOverclosure():
            return [f"{kind}EXPONENTIAL", f"{show(law.clearance)}, {show(law.pressure)}"]
        case LinearOverclosure():
            more = f", {_CALCULIX_LINEAR}" if code == "calculix" else ""
            return [f"{kind}LINEAR", f"{show(law.stiffness)}{more}"]
        case TabularOverclosure():
            rows = zip(np.asarray(law.pressure), np.asarray(law.clearance), strict=True)
            return [f"{kind}TABULAR", *(f"{show(pressure)}, {show(0.0 - clearance)}" for pressure, clearance in rows)]
    raise ValueError(f"write_inp: neither Abaqus nor CalculiX has the law {type(law).__name__}.")


def _friction(contact: Contact, code: Code, is_explicit: bool) -> list[str]:
    friction = float(contact.friction)
    if not friction:
        return []
    if code == "calculix":
        if contact.stick_slope is None:
            raise ValueError(
                "write_inp: CalculiX' friction sticks with a constant slope; pass Contact(..., stick_slope=) [MPa/mm]."
            )
        return ["*FRICTION", f"{show(friction)}, {show(contact.stick_slope)}"]
    if is_explicit:  # neither sticks with a slip there
        return ["*FRICTION", f"{show(friction)},"]
    if contact.stick_slope is not None:
        raise ValueError(
            "write_inp: Abaqus/Standard has no constant stick slope; pass Contact(..., elastic_slip=) [mm], or neither."
        )
    slip = (
        f"SLIP TOLERANCE={SLIP_TOLERANCE:g}"
        if contact.elastic_slip is None
        else f"ELASTIC SLIP={show(contact.elastic_slip)}"
    )
    return [f"*FRICTION, {slip}", f"{show(friction)},"]
