"""Keywords of the mesh: parts and instances, nodes, elements, sets, surfaces, sections."""

import math
import re

import numpy as np

from .cards import Card, Place, number, whole_numbers
from .deck import Elements, Face, Instance, Members, Part, Section
from .state import Keyword, State

# Nodes of each type of element.
NODES = {
    "C3D4": 4, "C3D4H": 4, "C3D6": 6, "C3D8": 8, "C3D8R": 8, "C3D8H": 8, "C3D8RH": 8, "C3D8I": 8, "C3D8IH": 8,
    "C3D10": 10, "C3D10H": 10, "C3D10M": 10, "C3D15": 15, "C3D20": 20, "C3D20R": 20, "C3D20H": 20, "C3D20RH": 20,
    "SPRING1": 1,
}  # fmt: skip
_FACE = re.compile(r"S([1-6])")
_ROTATION = 7  # numbers of an instance's second line


def _part(card: Card, state: State) -> None:
    name = card.option("NAME").upper()
    if name in state.parts:
        raise card.refuse(f", NAME={name}: there is such a part already.")
    if state.assembly is not None:
        raise card.refuse(" belongs before *ASSEMBLY.")
    if "" in state.parts:
        raise card.refuse(" after nodes outside of any part.")
    state.part = state.parts[name] = Part(name, card.place)
    state.abaqus = state.abaqus or card.place


def _end_part(card: Card, state: State) -> None:
    if state.part is None:
        raise card.refuse(" without *PART.")
    state.part = None


def _assembly(card: Card, state: State) -> None:
    if state.assembly is not None or state.part is not None or "" in state.parts:
        raise card.refuse(" is misplaced: a deck has one, after its parts.")
    state.assembly = card.option("NAME").upper()


def _end_assembly(card: Card, state: State) -> None:
    if state.assembly is None:
        raise card.refuse(" without *ASSEMBLY.")


def _instance(card: Card, state: State) -> None:
    name, part = card.option("NAME").upper(), card.option("PART").upper()
    if state.assembly is None:
        raise card.refuse(" belongs into the *ASSEMBLY.")
    if part not in state.parts:
        raise card.refuse(f", PART={part[:60]}: there is no such part.")
    if name in state.instances:
        raise card.refuse(f", NAME={name[:60]}: there is such an instance already.")
    rows = [[number(word or "0", card, place) for word in fields] for place, fields in card.rows()]
    if len(rows) > 2 or (rows and len(rows[0]) > 3) or (len(rows) == 2 and len(rows[1]) != _ROTATION):
        raise card.refuse(" takes a translation of 3 numbers and a rotation of 7.")
    shift = np.array([*(rows[0] if rows else []), 0.0, 0.0, 0.0][:3])
    rotation, centre = np.eye(3), np.zeros(3)
    if len(rows) == 2:
        centre, end = np.array(rows[1][:3]), np.array(rows[1][3:6])
        rotation = _rotation(end - centre, math.radians(rows[1][6]), card)
    state.instances[name] = Instance(name, part, shift, rotation, centre, card.place)


def _rotation(axis: np.ndarray, angle: float, card: Card) -> np.ndarray:
    length = np.linalg.norm(axis)
    if not length:
        raise card.refuse(": the axis of its rotation has no length.")
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return np.where(np.isclose(matrix, np.rint(matrix), atol=1e-12), np.rint(matrix), matrix)


def _end_instance(card: Card, state: State) -> None:
    if not state.instances or state.assembly is None:
        raise card.refuse(" without *INSTANCE.")


def _node(card: Card, state: State) -> None:
    part = state.own_part(card)
    if card.options.get("SYSTEM", "R").upper() != "R":
        raise card.refuse(f", SYSTEM={card.options['SYSTEM'][:20]} is not supported: rectangular coordinates are.")
    rows = card.table(4)
    numbers = whole_numbers(rows[:, 0], card, card.place)
    part.numbers = np.concatenate([part.numbers, numbers])
    part.positions = np.concatenate([part.positions, rows[:, 1:]])
    if np.unique(part.numbers).size != part.numbers.size:
        raise card.refuse(": nodes are defined twice.")
    if "NSET" in card.options:
        _extend(part.node_sets, card.option("NSET"), numbers)


def _element(card: Card, state: State) -> None:
    part = state.own_part(card)
    kind = card.option("TYPE").upper()
    if kind not in NODES:
        raise card.refuse(f", TYPE={kind[:20]} is not supported; opfem has solid elements, such as C3D8.")
    rows = whole_numbers(card.table(1 + NODES[kind], continued=True), card, card.place)
    known = [block.numbers for block in part.elements]
    if np.unique(np.concatenate([rows[:, 0], *known])).size != len(rows) + sum(block.size for block in known):
        raise card.refuse(": elements are defined twice.")
    part.elements.append(Elements(kind, rows[:, 0], rows[:, 1:], card.place))
    if "ELSET" in card.options:
        _extend(part.element_sets, card.option("ELSET"), rows[:, 0])


def _extend(sets: dict[str, np.ndarray], name: str, numbers: np.ndarray) -> None:
    known = sets.get(name.upper())
    sets[name.upper()] = numbers if known is None else np.unique(np.concatenate([known, numbers]))


def _set(card: Card, state: State) -> None:
    is_nodes = card.name == "NSET"
    name = card.option(card.name).upper()
    if state.part is None and state.assembly is not None:
        _set_of_assembly(card, state, name, is_nodes)
        return
    part = state.own_part(card)
    sets = part.node_sets if is_nodes else part.element_sets
    _extend(sets, name, _members(card, part, is_nodes))


def _set_of_assembly(card: Card, state: State, name: str, is_nodes: bool) -> None:
    sets = state.node_sets if is_nodes else state.element_sets
    if "INSTANCE" in card.options:
        instance = card.option("INSTANCE").upper()
        if instance not in state.instances:
            raise card.refuse(f", INSTANCE={instance[:60]}: there is no such instance.")
        found = {instance: _members(card, state.part_of(instance), is_nodes)}
    else:
        if "GENERATE" in card.options:
            raise card.refuse(", GENERATE in the assembly needs INSTANCE=.")
        found: Members = {}
        find = state.nodes if is_nodes else state.elements
        for place, word in card.members():
            if not isinstance(word, str):
                raise card.refuse(" in the assembly needs INSTANCE=, or instance.number.", place)
            for instance, numbers in find(word, card, place).items():
                _extend(found, instance, numbers)
    known = sets.setdefault(name, {})
    for instance, numbers in found.items():
        _extend(known, instance, numbers)


def _members(card: Card, part: Part, is_nodes: bool) -> np.ndarray:
    """Read the members of a set of one part."""
    known = part.numbers if is_nodes else np.concatenate([np.zeros(0, np.int64), *(e.numbers for e in part.elements)])
    sets = part.node_sets if is_nodes else part.element_sets
    if "GENERATE" in card.options:
        return _existing(_generated(card, known.size), known, card)
    if is_nodes and "ELSET" in card.options:
        chosen = part.element_sets.get(card.option("ELSET").upper())
        if chosen is None:
            raise card.refuse(f", ELSET={card.options['ELSET'][:60]}: there is no such set.")
        found = [block.nodes[np.isin(block.numbers, chosen)].ravel() for block in part.elements]
        return np.unique(np.concatenate(found))
    numbers = []
    for place, word in card.members():
        if isinstance(word, str):
            if word.upper() not in sets:
                raise card.refuse(f": there is no set {word[:60]}.", place)
            numbers.append(sets[word.upper()])
        else:
            numbers.append(whole_numbers(word, card, place))
    return _existing(np.unique(np.concatenate([np.zeros(0, np.int64), *numbers])), known, card)


def _generated(card: Card, most: int) -> np.ndarray:
    ranges = []
    for place, fields in card.rows():
        values = whole_numbers(np.array([number(word, card, place) for word in fields]), card, place)
        if not 2 <= values.size <= 3:
            raise card.refuse(", GENERATE takes first, last and step.", place)
        first, last, step = (*values.tolist(), 1)[:3]
        if last < first or (last - first) // step >= most:
            raise card.refuse(f", GENERATE from {first} to {last}: there are {most} to choose from.", place)
        ranges.append(np.arange(first, last + 1, step))
    return np.unique(np.concatenate([np.zeros(0, np.int64), *ranges]))


def _existing(numbers: np.ndarray, known: np.ndarray, card: Card) -> np.ndarray:
    missing = numbers[~np.isin(numbers, known)]
    if missing.size:
        what = "node" if card.name == "NSET" else "element"
        raise card.refuse(f": there is no {what} {missing[0]}.")
    return numbers


def _surface(card: Card, state: State) -> None:
    name = card.option("NAME").upper()
    if card.options.get("TYPE", "ELEMENT").upper() != "ELEMENT":
        raise card.refuse(f", TYPE={card.options['TYPE'][:20]} is not supported; give the faces of elements.")
    in_assembly = state.part is None and state.assembly is not None
    faces: list[Face] = []
    for place, fields in card.rows():
        face = _FACE.fullmatch(fields[1].upper()) if len(fields) == 2 else None
        if face is None:
            raise card.refuse(" takes an element or a set, and a face S1 to S6.", place)
        members = state.elements(fields[0], card, place) if in_assembly else _own(fields[0], card, state, place)
        faces.append((members, int(face[1])))
    if not faces:
        raise card.refuse(" has no faces.")
    surfaces = state.surfaces if in_assembly else state.own_part(card).surfaces
    surfaces.setdefault(name, []).extend(_by_face(faces))


def _own(word: str, card: Card, state: State, place: Place) -> Members:
    part, name = state.own_part(card), word.upper()
    if name.isdecimal():
        return {"": whole_numbers(np.array([number(name, card, place)]), card, place)}
    if name not in part.element_sets:
        raise card.refuse(f": there is no element set {word[:60]}.", place)
    return {"": part.element_sets[name]}


def _by_face(faces: list[Face]) -> list[Face]:
    """Put faces of the same side together: CalculiX has an element a line."""
    merged: dict[int, dict[str, list[np.ndarray]]] = {}
    for members, side in faces:
        for instance, numbers in members.items():
            merged.setdefault(side, {}).setdefault(instance, []).append(numbers)
    return [
        ({instance: np.unique(np.concatenate(parts)) for instance, parts in found.items()}, side)
        for side, found in merged.items()
    ]


def _section(card: Card, state: State) -> None:
    part = state.own_part(card)
    name = card.option("ELSET").upper()
    if name not in part.element_sets:
        raise card.refuse(f", ELSET={name[:60]}: there is no such set.")
    part.sections.append(Section(part.element_sets[name], card.option("MATERIAL").upper(), card.place))


def _spring(card: Card, state: State) -> None:
    part = state.own_part(card)
    name = card.option("ELSET").upper()
    if name not in part.element_sets:
        raise card.refuse(f", ELSET={name[:60]}: there is no such set.")
    rows = [fields for _, fields in card.rows()]
    if len(rows) != 2 or rows[0][0] not in ("1", "2", "3"):
        raise card.refuse(" takes a direction 1 to 3 and a stiffness; linear springs to ground are supported.")
    stiffness = number(rows[1][0], card, card.place)
    part.springs.append((part.element_sets[name], int(rows[0][0]) - 1, stiffness))


MESH = {
    "PART": Keyword(_part, ("NAME",)),
    "END PART": Keyword(_end_part),
    "ASSEMBLY": Keyword(_assembly, ("NAME",)),
    "END ASSEMBLY": Keyword(_end_assembly),
    "INSTANCE": Keyword(_instance, ("NAME", "PART")),
    "END INSTANCE": Keyword(_end_instance),
    "NODE": Keyword(_node, ("NSET", "SYSTEM", "INPUT")),
    "ELEMENT": Keyword(_element, ("TYPE", "ELSET", "INPUT")),
    "NSET": Keyword(_set, ("NSET", "GENERATE", "INSTANCE", "ELSET"), ("INTERNAL", "UNSORTED")),
    "ELSET": Keyword(_set, ("ELSET", "GENERATE", "INSTANCE"), ("INTERNAL", "UNSORTED")),
    "SURFACE": Keyword(_surface, ("NAME", "TYPE"), ("INTERNAL",)),
    "SOLID SECTION": Keyword(_section, ("ELSET", "MATERIAL"), ("CONTROLS",)),
    "SPRING": Keyword(_spring, ("ELSET",)),
}
