"""Keywords of properties: materials, amplitudes, contact."""

import numpy as np

from .cards import Card, Place, number
from .deck import Amplitude, Interaction, Material, Pair
from .state import Keyword, State

# Hyperelastic laws by what names them, and how many numbers each has, D included.
_LAWS = {"MOONEY-RIVLIN": ("mooney-rivlin", 3), "NEO HOOKE": ("neo-hooke", 2), "YEOH": ("yeoh", 6)}
_SERIES = {"OGDEN", "POLYNOMIAL", "REDUCED POLYNOMIAL"}
_FORMS = {("POLYNOMIAL", 1): "mooney-rivlin", ("REDUCED POLYNOMIAL", 1): "neo-hooke", ("REDUCED POLYNOMIAL", 3): "yeoh"}


def _material(card: Card, state: State) -> None:
    name = card.option("NAME").upper()
    if name in state.materials:
        raise card.refuse(f", NAME={name[:60]}: there is such a material already.")
    state.material = state.materials[name] = Material(name, card.place)


def _of_material(card: Card, state: State) -> Material:
    if state.material is None:
        raise card.refuse(" belongs to a *MATERIAL.")
    return state.material


def _density(card: Card, state: State) -> None:
    _of_material(card, state).density = card.numbers(1, 1)[0]


def _damping(card: Card, state: State) -> None:
    _of_material(card, state).damping = card.number_option("ALPHA")


def _elastic(card: Card, state: State) -> None:
    material = _of_material(card, state)
    if card.options.get("TYPE", "ISOTROPIC").upper() not in ("ISOTROPIC", "ISO"):
        raise card.refuse(f", TYPE={card.options['TYPE'][:20]} is not supported.")
    _once(card, material)
    material.kind, material.numbers = "elastic", tuple(card.numbers(2, 2))


def _hyperelastic(card: Card, state: State) -> None:
    material = _of_material(card, state)
    _once(card, material)
    named = [name for name in (*_LAWS, *_SERIES) if name in card.options]
    if len(named) != 1:
        raise card.refuse(" needs one law: MOONEY-RIVLIN, NEO HOOKE, YEOH, OGDEN, POLYNOMIAL or REDUCED POLYNOMIAL.")
    if named[0] in _LAWS:
        kind, count = _LAWS[named[0]]
    else:
        order = card.number_option("N") if "N" in card.options else 1.0
        if order not in (1.0, 2.0, 3.0):
            raise card.refuse(f", N={order:g} is not supported; 1 to 3 are.")
        kind = "ogden" if named[0] == "OGDEN" else _FORMS.get((named[0], int(order)), "")
        count = {"mooney-rivlin": 3, "neo-hooke": 2, "yeoh": 6, "ogden": int(3 * order)}.get(kind, 0)
        if not kind:
            raise card.refuse(f", {named[0]}, N={order:g} is not supported; MOONEY-RIVLIN, NEO HOOKE, YEOH, OGDEN are.")
    found = [number(word or "0", card, place) for place, fields in card.rows() for word in fields]
    if len(found) != count:
        raise card.refuse(f", {named[0]} takes {count} numbers, got {len(found)}.")
    material.kind, material.numbers = kind, tuple(found)


def _once(card: Card, material: Material) -> None:
    if material.kind:
        raise card.refuse(f": the material {material.name[:60]} has a law already.")


def _amplitude(card: Card, state: State) -> None:
    name = card.option("NAME").upper()
    kind = card.options.get("DEFINITION", "TABULAR").upper()
    if kind not in ("TABULAR", "SMOOTH STEP"):
        raise card.refuse(f", DEFINITION={kind[:30]} is not supported; TABULAR and SMOOTH STEP are.")
    time, value = (card.options.get(option, "").upper() for option in ("TIME", "VALUE"))
    if time not in ("", "STEP TIME", "TOTAL TIME") or value not in ("", "RELATIVE"):
        raise card.refuse(f", TIME={time[:20]}, VALUE={value[:20]} is not supported.")
    flat = np.array([number(word or "0", card, place) for place, fields in card.rows() for word in fields])
    if flat.size < 4 or flat.size % 2 or np.any(np.diff(flat[::2]) <= 0):
        raise card.refuse(" takes two or more pairs of rising time and factor.")
    state.amplitudes[name] = Amplitude(
        name, flat[::2], flat[1::2], kind == "SMOOTH STEP", time == "TOTAL TIME", card.place
    )


def _interaction(card: Card, state: State) -> None:
    name = card.option("NAME").upper()
    if name in state.interactions:
        state.ignore(card, f"the first definition of {name[:60]}; the later one holds", f"NAME={name[:60]}")
    state.interaction = state.interactions[name] = Interaction(name, card.place)
    for place, fields in card.rows():  # the thickness of a layer between, which solids do not use
        [number(word or "0", card, place) for word in fields]


def _of_interaction(card: Card, state: State) -> Interaction:
    if state.interaction is None:
        raise card.refuse(" belongs to a *SURFACE INTERACTION.")
    return state.interaction


def _friction(card: Card, state: State) -> None:
    interaction = _of_interaction(card, state)
    given = [name for name in ("SLIP TOLERANCE", "ELASTIC SLIP", "SHEAR TRACTION SLOPE") if name in card.options]
    if len(given) > 1:
        raise card.refuse(f" takes one of {' and '.join(given)}.")
    values = card.numbers(1, 2)
    if values[0] < 0 or (len(values) == 2 and values[1] <= 0):
        raise card.refuse(f": friction must be zero or positive, got {values[0]:g}.")
    interaction.friction = values[0]
    interaction.slip = None
    if len(values) == 2:
        if given:
            raise card.refuse(" with rates of slip is not supported; friction is one number.")
        state.calculix = state.calculix or card.place
        interaction.slip = ("slope", values[1])
    elif given:
        state.abaqus = state.abaqus or card.place
        kind = {"SLIP TOLERANCE": "tolerance", "ELASTIC SLIP": "elastic"}.get(given[0], "slope")
        interaction.slip = (kind, _positive(card.number_option(given[0]), card, given[0]))


def _positive(value: float, card: Card, name: str) -> float:
    if value <= 0:
        raise card.refuse(f": {name} must be positive, got {value:g}.")
    return value


def _behavior(card: Card, state: State) -> None:
    interaction = _of_interaction(card, state)
    kind = card.options.get("PRESSURE-OVERCLOSURE", "HARD").upper()
    if kind == "HARD":
        if list(card.rows()):
            raise card.refuse(", PRESSURE-OVERCLOSURE=HARD takes no data.")
        interaction.law, interaction.numbers = "hard", ()
    elif kind == "EXPONENTIAL":
        interaction.law, interaction.numbers = "exponential", tuple(card.numbers(2, 2))
    elif kind == "LINEAR":
        values = card.numbers(1, 3)
        if len(values) > 1:
            state.calculix = state.calculix or card.place
            state.ignore(card, "tension at infinity and its range, which only smooth the start", "numbers 2 and 3")
        interaction.law, interaction.numbers = "linear", (values[0],)
    elif kind == "TABULAR":
        rows = [[number(word or "0", card, place) for word in fields] for place, fields in card.rows()]
        if len(rows) < 2 or any(len(row) != 2 for row in rows):
            raise card.refuse(", PRESSURE-OVERCLOSURE=TABULAR takes lines of pressure and overclosure.")
        interaction.law, interaction.numbers = "tabular", tuple(value for row in rows for value in row)
    else:
        raise card.refuse(
            f", PRESSURE-OVERCLOSURE={kind[:30]} is not supported; HARD, EXPONENTIAL, LINEAR, TABULAR are."
        )


def _pair(card: Card, state: State) -> None:
    name = card.option("INTERACTION").upper()
    if name not in state.interactions:
        raise card.refuse(f", INTERACTION={name[:60]}: there is no such *SURFACE INTERACTION.")
    if card.options.get("TYPE", "SURFACE TO SURFACE").upper() not in ("SURFACE TO SURFACE", "NODE TO SURFACE"):
        raise card.refuse(f", TYPE={card.options['TYPE'][:30]} is not supported.")
    rows = list(card.rows())
    if len(rows) != 1 or len(rows[0][1]) != 2:
        raise card.refuse(" takes one line of two surfaces.")
    place, words = rows[0]
    slave, master = (state.surface(word, card, place) for word in words)
    key = frozenset(word.upper() for word in words)
    if (key,) in state.pairs:
        state.ignore(card, f"the first definition of {' and '.join(words)[:80]}; the later one holds", words[0][:60])
    state.pairs[(key,)] = Pair(slave, master, name, Place(card.place.file, place.line))


_PAIR_UNUSED = ("TYPE", "WEIGHT", "MECHANICAL CONSTRAINT", "CPSET", "OP", "NO THICKNESS", "SUPPLEMENTARY CONSTRAINTS")
_LAW_ADVICE = " opfem has Coulomb friction: one coefficient."

PROPERTIES = {
    "MATERIAL": Keyword(_material, ("NAME",)),
    "DENSITY": Keyword(_density),
    "DAMPING": Keyword(_damping, ("ALPHA",)),
    "ELASTIC": Keyword(_elastic, ("TYPE",)),
    "HYPERELASTIC": Keyword(_hyperelastic, (*_LAWS, *_SERIES, "N"), ("MODULI",)),
    "AMPLITUDE": Keyword(_amplitude, ("NAME", "DEFINITION", "TIME", "VALUE"), within="anywhere"),
    "SURFACE INTERACTION": Keyword(_interaction, ("NAME",), within="anywhere"),
    "FRICTION": Keyword(
        _friction, ("SLIP TOLERANCE", "ELASTIC SLIP", "SHEAR TRACTION SLOPE"), within="anywhere", advice=_LAW_ADVICE
    ),
    "SURFACE BEHAVIOR": Keyword(_behavior, ("PRESSURE-OVERCLOSURE",), within="anywhere"),
    "CONTACT PAIR": Keyword(_pair, ("INTERACTION",), _PAIR_UNUSED, within="anywhere"),
}
