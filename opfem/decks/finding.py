"""Which bodies of a deck are layer, sample, window and plate.

The layer is soft, between a window at rest and what presses it: a rigid body, or a soft sample on a plate.
"""

import numpy as np

from .bodies import SAME, Block, find_bodies
from .cards import Place
from .deck import Deck
from .faces import Constrained, Surface, Touching, is_flat, rigid_surface, supports, touching
from .laws import contact_of, is_soft
from .problem import HINT, Problem


def find_problem(deck: Deck, layer: str | None = None) -> Problem:
    """Find layer, sample, window and plate in a deck.

    Args:
        deck: The deck.
        layer: Which body is the layer, where there are two soft ones.

    Raises:
        DeckError: If the deck is not of this kind.
    """
    start = Place(deck.name, 1)
    if not deck.steps:
        raise start.refuse("the deck has no *STEP, so that nothing is loaded.")
    if deck.code == "abaqus" and not deck.steps[0].is_nonlinear:  # it then holds for later steps, too
        place = deck.steps[0].place
        raise place.refuse("*STEP without NLGEOM is linear; opfem solves large strain. Say NLGEOM=YES.")
    bodies = find_bodies(deck)
    soft = [body for body in bodies if is_soft(body, deck)]
    if len(soft) not in (1, 2):
        names = ", ".join(body.name for body in soft) or "none"
        raise start.refuse(f"the deck has {len(soft)} bodies of *HYPERELASTIC ({names}). {HINT}")
    blocks = sorted((body.block for body in soft), key=lambda block: float(block.z.mean()))
    at = touching(blocks, bodies, deck)
    if len(blocks) == 1:
        if layer is not None and layer.upper() != blocks[0].body.name.upper():
            raise start.refuse(f"layer={layer!r}: the soft body is {blocks[0].body.name}.")
        return _of_one(deck, blocks[0], {side: rigid_surface(found, deck) for (_, side), found in at.items()})
    return _of_two(deck, blocks, at, layer)


def _of_one(deck: Deck, block: Block, surfaces: dict[int, Surface]) -> Problem:
    """Tell window and sample apart: the window is flat and at rest; the lower one, where both are."""
    size = float(np.ptp(block.body.X, axis=0).max())

    def can_be_window(side: int, face: Constrained) -> bool:
        surface = surfaces.get(side)
        if surface is None:
            return face.uz is not None and is_flat(face.rest, size) and not np.any(face.uz)
        heights = np.concatenate([surface.rest[None], surface.heights])
        return is_flat(heights, size) and float(np.ptp(heights)) <= SAME * size

    found = supports(block, deck)
    low, high = _end(surfaces.get(0), found.low), _end(surfaces.get(-1), found.high)
    if can_be_window(0, found.low):
        return Problem(deck, block, None, False, low, None, high)
    if can_be_window(-1, found.high):
        return Problem(deck, block.flipped(), None, True, high, None, low)
    raise block.body.place.refuse(
        f"neither the lower nor the upper face of {block.body.name} has a window: a plane at rest, in contact "
        "or constrained. " + HINT
    )


def _end(surface: Surface | None, face: Constrained) -> Surface | Constrained:
    """Take what a face is in contact with, or how its nodes are constrained; not both."""
    if surface is not None and face.uz is not None:
        raise surface.place.refuse("*CONTACT PAIR: nodes of a face in contact are constrained along z besides.")
    return face if surface is None else surface


def _of_two(deck: Deck, blocks: list[Block], at: dict[tuple[int, int], Touching], layer: str | None) -> Problem:
    lower, upper = blocks
    start = Place(deck.name, 1)
    names = [block.body.name for block in blocks]
    wanted = [block for block in blocks if (layer or "LAYER").upper() in block.body.name.upper()]
    if layer is not None:
        wanted = [block for block in blocks if block.body.name.upper() == layer.upper()]
    if len(wanted) != 1:
        raise start.refuse(f"which of {' and '.join(names)} is the layer? Pass layer= one of these names.")
    is_flipped = wanted[0] is upper
    own, sample = (1, 0) if is_flipped else (0, 1)
    inner, outer = (0, -1) if is_flipped else (-1, 0)
    between = at.get((own, inner))
    if between is None or between.other is not blocks[sample].body:
        raise start.refuse(f"there is no *CONTACT PAIR between {' and '.join(names)}, the layer and the sample.")
    ends = []
    for number, side in ((own, outer), (sample, inner)):
        support = supports(blocks[number], deck)
        found = at.get((number, side))
        if found is not None and found.other in (lower.body, upper.body):
            raise found.pair.place.refuse("*CONTACT PAIR: layer and sample touch at one face only.")
        surface = None if found is None else rigid_surface(found, deck)
        ends.append(_end(surface, support.low if side == 0 else support.high))
        if (support.high if side == 0 else support.low).uz is not None:
            raise between.pair.place.refuse(
                "*CONTACT PAIR: nodes of a face in contact are constrained along z besides."
            )
    contact = contact_of(deck.interactions[between.pair.interaction], deck)
    layer_block, sample_block = blocks[own], blocks[sample]
    if is_flipped:
        layer_block, sample_block = layer_block.flipped(), sample_block.flipped()
    return Problem(deck, layer_block, sample_block, is_flipped, ends[0], contact, ends[1])
