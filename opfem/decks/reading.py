"""`read_inp`: an Abaqus or CalculiX input file as a `Deck`.

Every keyword and option is handled, listed as ignored, or refused with its line; handlers are in `mesh_cards`,
`property_cards` and `step_cards`.
"""

from pathlib import Path
from typing import Any, get_args

from .cards import MAX_BYTES, Card, DeckError, read_cards
from .deck import Code, Deck
from .mesh_cards import MESH
from .property_cards import PROPERTIES
from .state import Keyword, State
from .step_cards import STEPS

_UNUSED = "prints or stores what opfem does in its own way"
_IGNORED = dict.fromkeys(
    ("PREPRINT", "RESTART", "FILE FORMAT", "FILE OUTPUT", "MONITOR", "PRINT", "NO PRINT", "TIME POINTS", "FILTER"),
    _UNUSED,
) | {
    "SECTION CONTROLS": "controls of Abaqus' elements",
    "CONTROLS": "controls of another solver",
    "CONTACT CONTROLS": "controls of another solver",
    "SOLUTION TECHNIQUE": "controls of another solver",
    "DIAGNOSTICS": "controls of another solver",
    "PHYSICAL CONSTANTS": "nothing here depends on them",
    "HEADING": "a title",
}
_KEYWORDS: dict[str, Keyword] = {**MESH, **PROPERTIES, **STEPS}


def read_inp(path: str | Path, *, code: Code | None = None, max_bytes: int = MAX_BYTES) -> Deck:
    """Read an Abaqus or CalculiX input file (.inp, or .inp.gz).

    Args:
        path: The file.
        code: Whose semantics it has: C3D8 and EXPONENTIAL mean different things. None: CalculiX's, where the deck has
            data lines that only CalculiX knows (friction with a stick slope, linear contact with three numbers,
            CDIS in outputs), else Abaqus'.
        max_bytes: Largest text to read, with its included files.

    Raises:
        DeckError: In one line with file and line number: what is wrong, or not supported.
        FileNotFoundError: If there is no such file.

    Example:
        >>> import opfem as op
        >>> def stress_map(path):
        ...     deck = op.read_inp(path)
        ...     solution = None
        ...     for load in deck.loads():
        ...         solution = op.solve(deck.experiment(), load, deck.solver(), start=solution)
        ...     return op.to_xarray(solution)
    """
    if code is not None and code not in get_args(Code):
        raise ValueError(f'read_inp: code must be "abaqus" or "calculix", got {code!r}.')
    path = Path(path)
    state = State(path.name)
    card: Any = None
    for card in read_cards(path, max_bytes):
        _handle(card, state)
    if state.step is not None:
        raise state.step.place.refuse("*STEP without *END STEP: the deck ends in the middle.")
    return state.deck(code)


def _handle(card: Card, state: State) -> None:
    why = _IGNORED.get(card.name)
    if why is not None:
        state.ignore(card, why)
        return
    keyword = _KEYWORDS.get(card.name)
    if keyword is None:
        raise card.refuse(" is not supported.")
    for option, value in card.options.items():
        if option in keyword.unused:
            state.ignore(card, "option without effect here", option)
        elif option not in keyword.options:
            given = f"{option}={value}" if value else option
            raise card.refuse(f", {given[:60]} is not supported.{keyword.advice}")
    where = "a step" if state.step is not None else "the model"
    if keyword.within not in ("anywhere", where):
        raise card.refuse(f" belongs into {keyword.within}, got it in {where}.")
    try:
        keyword.handle(card, state)
    except DeckError:
        raise
    except (ValueError, OverflowError, MemoryError) as cause:
        raise card.refuse(f": {str(cause).splitlines()[0] if str(cause) else type(cause).__name__}") from cause
