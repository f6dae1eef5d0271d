"""Materials and contact laws of a deck as opfem's, and what D = 0 stands for."""

import math

from ..model import (
    AbstractMaterial,
    AbstractOverclosure,
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
from .bodies import Body
from .deck import Deck, Interaction, Material

# Bulk over shear modulus that Abaqus/Explicit and CalculiX take where D = 0 (of CalculiX: its test beamog, Ogden with
# D = 0, has the displacement of K/µ = 20 to 6 digits).
K_OVER_MU = 20.0
# Elements of the two codes that opfem has, exactly but for "reduced", whose hourglass control is its own.
ELEMENTS = {
    ("abaqus", "C3D8"): "mean_dilatation",
    ("abaqus", "C3D8H"): "hybrid",
    ("abaqus", "C3D8R"): "reduced",
    ("calculix", "C3D8"): "full",
}


def is_soft(body: Body, deck: Deck) -> bool:
    """Tell whether a body is of a hyperelastic material.

    Raises:
        DeckError: If it is so in part, or a material is missing.
    """
    names = set(body.material.tolist())
    missing = names - set(deck.materials) - {""}
    if missing:
        raise body.place.refuse(f"{body.name}: there is no *MATERIAL {sorted(missing)[0][:60]}.")
    soft = [name for name in names if name and deck.materials[name].kind not in ("", "elastic")]
    if soft and len(soft) < len(names):
        raise body.place.refuse(f"{body.name} is of *HYPERELASTIC in part only.")
    return bool(soft)


def element_of(body: Body, deck: Deck) -> str:
    """Name opfem's element of a soft body.

    Raises:
        DeckError: If it has no such element.
    """
    kind = body.kinds[0]
    found = ELEMENTS.get((deck.code, kind))
    if len(body.kinds) != 1 or found is None:
        known = ", ".join(name for code, name in ELEMENTS if code == deck.code)
        raise body.place.refuse(
            f"{body.name} has elements {', '.join(body.kinds)}; of {deck.code}'s opfem solves {known}."
        )
    return found


def zero_d(material: Material) -> bool:
    """Tell whether a hyperelastic material leaves its bulk modulus open, D = 0."""
    last = 3 if material.kind == "yeoh" else len(material.numbers) // 3 if material.kind == "ogden" else 1
    return not material.numbers[-last]


def law_of(material: Material, deck: Deck, element: str, bulk: float | None) -> AbstractMaterial:
    """Build a hyperelastic law.

    Args:
        material: The deck's.
        deck: Of the deck.
        element: opfem's element.
        bulk: For D = 0 [MPa]; None: what the code takes.

    Raises:
        DeckError: If the numbers are out of range, or the code itself would refuse D = 0.
    """
    numbers = material.numbers
    terms = {"yeoh": 3, "ogden": len(numbers) // 3}.get(material.kind, 1)
    coefficients, compressibility = numbers[:-terms], numbers[-terms:]
    if any(compressibility[1:]):
        raise material.place.refuse(f"material {material.name}: D2 and D3 are not supported; they must be 0.")
    shear = _shear(material)
    if not shear > 0:
        raise material.place.refuse(f"material {material.name}: its shear modulus must be positive, got {shear:g} MPa.")
    if compressibility[0] < 0:
        raise material.place.refuse(f"material {material.name}: D1 must be positive, got {compressibility[0]:g}.")
    modulus = 2.0 / compressibility[0] if compressibility[0] else _open_bulk(material, deck, element, shear, bulk)[0]
    try:
        match material.kind, coefficients:
            case "mooney-rivlin", (c10, c01):
                return MooneyRivlin(c10=c10, c01=c01, bulk=modulus)
            case "neo-hooke", (c10,):
                return NeoHooke(c10=c10, bulk=modulus)
            case "yeoh", (c10, c20, c30):
                return Yeoh(c10=c10, c20=c20, c30=c30, bulk=modulus)
            case _:
                return Ogden(mu=coefficients[::2], alpha=coefficients[1::2], bulk=modulus)
    except ValueError as cause:
        raise material.place.refuse(f"material {material.name}: {cause}") from None


def _shear(material: Material) -> float:
    numbers = material.numbers
    if material.kind == "mooney-rivlin":
        return 2.0 * (numbers[0] + numbers[1])
    return sum(numbers[: 2 * len(numbers) // 3 : 2]) if material.kind == "ogden" else 2.0 * numbers[0]


def _open_bulk(material: Material, deck: Deck, element: str, shear: float, bulk: float | None) -> tuple[float, str]:
    """Find the bulk modulus [MPa] of D = 0, and say where it comes from."""
    if bulk is not None:
        return float(bulk), "as passed"
    if element == "hybrid":
        return math.inf, "incompressible, as Abaqus' hybrid elements take it"
    if deck.code == "calculix" or any(step.kind == "explicit" for step in deck.steps):
        code = "CalculiX takes" if deck.code == "calculix" else "Abaqus/Explicit takes"
        return K_OVER_MU * shear, f"{K_OVER_MU:g} shear moduli, as {code} it"
    raise material.place.refuse(
        f"material {material.name} has D = 0, which Abaqus/Standard takes in hybrid elements only. Which bulk modulus "
        f"is meant? Pass bulk= in MPa ({K_OVER_MU * shear:.6g} is 20 shear moduli)."
    )


def said_of_bulk(material: Material, deck: Deck, element: str, bulk: float | None) -> str:
    """Say what D = 0 of a material is taken for."""
    modulus, why = _open_bulk(material, deck, element, _shear(material), bulk)
    return f"material {material.name}: D = 0 is read as a bulk modulus of {modulus:.6g} MPa ({why})"


def contact_of(interaction: Interaction, deck: Deck) -> Contact:
    """Build a contact.

    Raises:
        DeckError: If the law is none of opfem's, or numbers are out of range.
    """
    kind, value = interaction.slip or ("", 0.0)
    slip = {}
    if kind == "slope":
        slip = {"stick_slope": value}
    elif kind == "elastic":
        slip = {"elastic_slip": value}
    elif kind == "tolerance" and not math.isclose(value, SLIP_TOLERANCE):
        raise interaction.place.refuse(
            f"{interaction.name}: opfem's slip tolerance is {SLIP_TOLERANCE:g} of an element, got {value:g}. Give "
            "ELASTIC SLIP= in mm instead."
        )
    try:
        return Contact(_overclosure(interaction, deck), interaction.friction, **slip)
    except ValueError as cause:
        raise interaction.place.refuse(f"{interaction.name}: {cause}") from None


def _overclosure(interaction: Interaction, deck: Deck) -> AbstractOverclosure:
    numbers = interaction.numbers
    match interaction.law:
        case "exponential" if deck.code == "calculix":
            raise interaction.place.refuse(
                f"{interaction.name}: EXPONENTIAL is another law in CalculiX, without a clearance of zero pressure; "
                "opfem has Abaqus'. LINEAR is the same in both."
            )
        case "exponential":
            return ExponentialOverclosure(pressure=numbers[1], clearance=numbers[0])
        case "linear":
            return LinearOverclosure(numbers[0])
        case "tabular":
            return TabularOverclosure(pressure=numbers[::2], clearance=[0.0 - value for value in numbers[1::2]])
        case _:
            return HardOverclosure()
