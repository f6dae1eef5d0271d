"""Options that have to do with decks: how `opfem deck` takes one, and the deck that other commands write."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from .quantities import NewFile, count, positive, whole


@Parameter(name="*", group=Group("Deck", sort_key=5))
@dataclass(frozen=True)
class WriteOptions:
    """The problem as a deck for another code."""

    write_inp: Annotated[
        Path | None,
        Parameter(help="File (.inp) to write the problem to, too, before it is solved.", validator=NewFile(".inp")),
    ] = None
    code: Annotated[Literal["abaqus", "calculix"], Parameter(help="Whose deck it is.")] = "abaqus"
    contact_stiffness: Annotated[
        float | None,
        Parameter(
            help="Stiffness in MPa/mm of linear contact on all faces, solved and written: the only law of CalculiX.",
            validator=positive("MPa/mm"),
        ),
    ] = None
    stick_slope: Annotated[
        float | None,
        Parameter(help="Stiffness in MPa/mm of sticking friction, as CalculiX has it.", validator=positive("MPa/mm")),
    ] = None


@Parameter(name="*", group=Group("Deck", sort_key=1))
@dataclass(frozen=True)
class DeckOptions:
    """How a deck is taken."""

    code: Annotated[
        Literal["abaqus", "calculix"] | None,
        Parameter(help="Whose deck it is: C3D8 and EXPONENTIAL mean different things. Default: as its keywords tell."),
    ] = None
    bulk: Annotated[
        float | None,
        Parameter(
            help="Bulk modulus in MPa of materials with D = 0; inf for incompressible. Default: what the deck's own "
            "code takes for it.",
            validator=positive("MPa", infinite=True),
        ),
    ] = None
    layer: Annotated[
        str | None, Parameter(help="Instance that is the layer, where two bodies are soft and neither is called so.")
    ] = None
    interpolation: Annotated[
        Literal["cubic", "catmull-rom", "bilinear"],
        Parameter(help="How a rigid surface runs between its nodes; the deck's own facets are bilinear."),
    ] = "cubic"
    solver: Annotated[
        Literal["deck", "newton", "explicit"],
        Parameter(help="The deck's own kind of solver, implicit statics, or explicit dynamics as published."),
    ] = "deck"
    increments: Annotated[
        int | None,
        Parameter(
            help="Load increments of newton in each step. Default: the solver's own.",
            validator=count(),
            converter=whole,
        ),
    ] = None
    precision: Annotated[
        Literal["float32", "float64"], Parameter(help="Precision of explicit; float32 takes half the time.")
    ] = "float64"
