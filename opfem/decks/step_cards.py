"""Keywords of the analysis: steps, procedures, prescribed displacements, forces, outputs."""

from collections.abc import Iterator

import numpy as np

from .cards import Card, Place, number
from .deck import Condition, Members, Step
from .state import Keyword, State

# Names of Abaqus for what is constrained, as directions 1 to 3.
_HELD = {"ENCASTRE": (1, 2, 3), "PINNED": (1, 2, 3), "XSYMM": (1,), "YSYMM": (2,), "ZSYMM": (3,)}
_LAST = 6  # direction, of rotations
# Results that only CalculiX calls so.
_CALCULIX = {"CDIS", "CSTR", "ZZS"}


def _step(card: Card, state: State) -> None:
    if state.step is not None:
        raise card.refuse(": the step before has no *END STEP.")
    if state.part is not None:
        raise card.refuse(": the part before has no *END PART.")
    large = card.options.get("NLGEOM", "NO").upper() or "YES"
    if large not in ("YES", "NO"):
        raise card.refuse(f", NLGEOM={large[:20]} must be YES or NO.")
    state.step = Step(card.options.get("NAME", "") or f"Step-{len(state.steps) + 1}", card.place)
    state.step.is_nonlinear = large == "YES"
    state.steps.append(state.step)


def _own(card: Card, state: State) -> Step:
    if state.step is None:
        raise card.refuse(" belongs into a *STEP.")
    return state.step


def _end_step(card: Card, state: State) -> None:
    if not _own(card, state).kind:
        raise card.refuse(": the step has no procedure; *STATIC and *DYNAMIC, EXPLICIT are supported.")
    state.step = None


def _procedure(step: Step, card: Card, kind: str) -> None:
    if step.kind:
        raise card.refuse(": the step has a procedure already.")
    step.kind = kind


def _times(card: Card) -> list[float]:
    rows = list(card.rows())
    if len(rows) > 1:
        raise card.refuse(" takes one data line.", rows[1][0])
    return [number(word or "0", card, place) for place, fields in rows for word in fields]


def _static(card: Card, state: State) -> None:
    step = _own(card, state)
    _procedure(step, card, "static")
    first, time, _, largest = [*_times(card), 0.0, 0.0, 0.0, 0.0][:4]
    if min(first, time, largest) < 0:
        raise card.refuse(": times must be positive.")
    step.time = time or 1.0
    step.first, step.largest = first or None, largest or None


def _dynamic(card: Card, state: State) -> None:
    step = _own(card, state)
    if "EXPLICIT" not in card.options:
        raise card.refuse(" without EXPLICIT is not supported.")
    _procedure(step, card, "explicit")
    state.abaqus = state.abaqus or card.place
    step.is_nonlinear = step.is_nonlinear or True
    times = [*_times(card), 0.0, 0.0][:2]
    if times[1] <= 0:
        raise card.refuse(", EXPLICIT needs the duration of the step, its second number.")
    step.time = times[1]


def _bulk_viscosity(card: Card, state: State) -> None:
    linear, quadratic = card.numbers(2, 2)
    _own(card, state).bulk_viscosity = (linear, quadratic)


def _mass_scaling(card: Card, state: State) -> None:
    factor = card.number_option("FACTOR")
    if factor <= 0:
        raise card.refuse(f", FACTOR= must be positive, got {factor:g}.")
    _own(card, state).mass_scaling = factor


def _boundary(card: Card, state: State) -> None:
    if card.options.get("TYPE", "DISPLACEMENT").upper() != "DISPLACEMENT":
        raise card.refuse(f", TYPE={card.options['TYPE'][:20]} is not supported; DISPLACEMENT is.")
    found = _conditions(card, state, _held(card, state))
    if state.step is None:
        state.prescribed += found
        return
    state.step.is_new = state.step.is_new or card.options.get("OP", "MOD").upper() == "NEW"
    state.step.prescribed += found


def _force(card: Card, state: State) -> None:
    rows = []
    for place, fields in card.rows():
        if len(fields) != 3 or fields[1] not in ("1", "2", "3"):
            raise card.refuse(" takes nodes, a direction 1 to 3 and a force.", place)
        rows.append((place, fields[0], (int(fields[1]),), number(fields[2], card, place)))
    _own(card, state).forces += _conditions(card, state, iter(rows))


def _held(card: Card, state: State) -> Iterator[tuple[Place, str, tuple[int, ...], float]]:
    """Yield place, nodes, directions and displacement of each data line."""
    for place, fields in card.rows():
        if len(fields) == 2 and fields[1].upper() in _HELD:
            yield place, fields[0], _HELD[fields[1].upper()], 0.0
            continue
        if not 2 <= len(fields) <= 4:
            raise card.refuse(" takes nodes, first and last direction, and a displacement.", place)
        first = number(fields[1], card, place)
        last = number(fields[2], card, place) if len(fields) > 2 and fields[2] else first
        value = number(fields[3], card, place) if len(fields) > 3 and fields[3] else 0.0
        if not (1 <= first <= last <= _LAST and first == int(first) and last == int(last)):
            raise card.refuse(f": directions must be 1 to 3, got {fields[1][:20]} to {last:g}.", place)
        if last > 3:
            state.ignore(card, "nodes of solids do not rotate", "directions 4 to 6")
        yield place, fields[0], tuple(range(int(first), min(int(last), 3) + 1)), value


def _conditions(card: Card, state: State, rows: Iterator[tuple[Place, str, tuple[int, ...], float]]) -> list[Condition]:
    """Put the lines of a keyword together by instance and direction."""
    amplitude = card.options.get("AMPLITUDE", "").upper()
    if amplitude and amplitude not in state.amplitudes:
        raise card.refuse(f", AMPLITUDE={amplitude[:60]}: there is no such *AMPLITUDE.")
    if card.options.get("OP", "MOD").upper() not in ("MOD", "NEW"):
        raise card.refuse(f", OP={card.options['OP'][:20]} must be MOD or NEW.")
    found: dict[tuple[str, int], tuple[Place, list[np.ndarray], list[np.ndarray]]] = {}
    for place, word, directions, value in rows:
        members: Members = state.nodes(word, card, place)
        for instance, numbers in members.items():
            for direction in directions:
                _, nodes, values = found.setdefault((instance, direction - 1), (place, [], []))
                nodes.append(numbers)
                values.append(np.full(numbers.size, value))
    conditions = []
    for (instance, component), (place, nodes, values) in found.items():
        numbers = np.concatenate(nodes)
        missing = numbers[~np.isin(numbers, state.part_of(instance).numbers)]
        if missing.size:
            raise card.refuse(f": there is no node {missing[0]}.", place)
        conditions.append(Condition(instance, numbers, component, np.concatenate(values), amplitude, card.place))
    return conditions


def _output(card: Card, state: State) -> None:
    step = _own(card, state)
    if "NUMBER INTERVAL" in card.options:
        frames = card.number_option("NUMBER INTERVAL")
        if not 1 <= frames <= 1e6 or frames != int(frames):
            raise card.refuse(f", NUMBER INTERVAL= must be a whole number, got {frames:g}.")
        if "FIELD" in card.options:
            step.frames = int(frames)
    step.outputs.append(" ".join((card.name, *card.options)))


def _variables(card: Card, state: State) -> None:
    step = _own(card, state)
    if "OUTPUT" in card.options:
        state.calculix = state.calculix or card.place
    words = [word.upper() for _, fields in card.rows() for word in fields if word]
    if _CALCULIX & set(words):
        state.calculix = state.calculix or card.place
    step.outputs.append(f"{card.name}: {', '.join(words)}")


_OUTPUT = ("FIELD", "HISTORY", "NUMBER INTERVAL", "VARIABLE", "FREQUENCY", "TIME INTERVAL", "TIME MARKS", "NAME", "OP")
_VARIABLES = (
    "NSET", "ELSET", "DIRECTIONS", "POSITION", "FREQUENCY", "TOTALS", "VARIABLE", "OUTPUT", "GLOBAL", "EXTERIOR",
    "CPSET", "SLAVE", "MASTER", "INTERACTION", "REBAR", "LAST ITERATIONS", "CONTACT ELEMENTS", "TIME POINTS",
)  # fmt: skip
_REQUEST = Keyword(_variables, _VARIABLES, within="a step")
_REQUESTS = (
    "NODE OUTPUT", "ELEMENT OUTPUT", "CONTACT OUTPUT", "ENERGY OUTPUT", "INCREMENTATION OUTPUT", "NODE FILE", "EL FILE",
    "ELEMENT FILE", "CONTACT FILE", "NODE PRINT", "EL PRINT", "CONTACT PRINT", "ENERGY PRINT", "ENERGY FILE",
)  # fmt: skip

STEPS = {
    "STEP": Keyword(_step, ("NAME", "NLGEOM"), ("INC", "UNSYMM", "EXTRAPOLATION"), within="anywhere"),
    "END STEP": Keyword(_end_step, within="a step"),
    "STATIC": Keyword(_static, (), ("DIRECT", "SOLVER"), within="a step"),
    "DYNAMIC": Keyword(_dynamic, ("EXPLICIT",), within="a step"),
    "BULK VISCOSITY": Keyword(_bulk_viscosity, within="a step"),
    "FIXED MASS SCALING": Keyword(_mass_scaling, ("FACTOR",), within="a step"),
    "BOUNDARY": Keyword(_boundary, ("AMPLITUDE", "OP", "TYPE"), within="anywhere"),
    "CLOAD": Keyword(_force, ("AMPLITUDE",), within="a step"),
    "OUTPUT": Keyword(_output, _OUTPUT, within="a step"),
    **dict.fromkeys(_REQUESTS, _REQUEST),
}
