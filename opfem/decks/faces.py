"""What a deck does to the faces of a soft block: rigid surfaces, constrained nodes, sides, springs, pins."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .bodies import SAME, Block, Body, Plane, plane_of
from .cards import Place
from .deck import Deck, Interaction, Pair
from .motion import displacements

# Displacements [mm] of less hold.
_STILL = 1e-12
# In-plane directions of two nodes that hold a body as a whole: x and y of one, and one of another.
_PINS = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """A rigid surface that a block is in contact with.

    Attributes:
        body: Its body.
        plane: Its nodes.
        rest: Their heights in the deck [mm] `(my, mx)`.
        heights: The same at the end of every step `(steps, my, mx)`.
        interaction: The contact.
        place: Where the pair is stated.
    """

    body: Body
    plane: Plane
    rest: np.ndarray
    heights: np.ndarray
    interaction: Interaction
    place: Place


@dataclass(frozen=True, eq=False)
class Constrained:
    """A face whose own nodes are constrained, or free.

    Attributes:
        lateral: Whether x and y are constrained at zero.
        uz: Displacement along z at the end of every step `(steps, my, mx)` [mm]; None where free.
        rest: Heights in the deck [mm] `(my, mx)`.
    """

    lateral: bool
    uz: np.ndarray | None
    rest: np.ndarray


End = Surface | Constrained


class Touching(NamedTuple):
    """What a face of a block is in contact with."""

    pair: Pair
    other: Body
    quads: np.ndarray


def touching(blocks: list[Block], bodies: list[Body], deck: Deck) -> dict[tuple[int, int], Touching]:
    """Find what the lower (0) and upper (-1) face of every block is in contact with.

    Raises:
        DeckError: If contact is not of one whole face with one surface.
    """
    found: dict[tuple[int, int], Touching] = {}
    for pair in deck.pairs:
        sides = [
            [(body, quads) for body in bodies if (quads := body.face_nodes(faces)).size]
            for faces in (pair.slave, pair.master)
        ]
        if any(len(side) != 1 for side in sides):
            raise pair.place.refuse("*CONTACT PAIR: each surface must lie on one body.")
        (one, its), (other, others) = sides[0][0], sides[1][0]
        if one is other:
            raise pair.place.refuse("*CONTACT PAIR: a body in contact with itself is not supported.")
        for body, quads, against, theirs in ((one, its, other, others), (other, others, one, its)):
            for number, block in enumerate(blocks):
                if block.body is body:
                    key = number, _which_face(block, quads, pair)
                    if key in found:
                        raise pair.place.refuse(f"*CONTACT PAIR: {body.name} has contact at this face already.")
                    found[key] = Touching(pair, against, theirs)
    return found


def _which_face(block: Block, quads: np.ndarray, pair: Pair) -> int:
    own = np.unique(quads)
    for side in (0, -1):
        if np.array_equal(own, np.unique(block.nodes[side])):
            return side
    raise pair.place.refuse(f"*CONTACT PAIR: the surface of {block.body.name} must be its whole lower or upper face.")


def rigid_surface(at: Touching, deck: Deck) -> Surface:
    """Collect what a rigid surface does.

    Raises:
        DeckError: If it is not rigid, moves sideways, or its nodes form no grid.
    """
    plane = plane_of(at.other, at.quads)
    moved = displacements(at.other, deck)[:, plane.nodes]
    if np.isnan(moved).any():
        raise at.pair.place.refuse(
            f"*CONTACT PAIR: {at.other.name} is neither soft (no *HYPERELASTIC) nor rigid: nodes of its surface are "
            "free in a step."
        )
    if np.abs(moved[..., :2]).max(initial=0.0) > _STILL:
        raise at.pair.place.refuse(f"*CONTACT PAIR: {at.other.name} moves sideways; opfem's surfaces move along z.")
    rest = at.other.X[plane.nodes, 2]
    return Surface(at.other, plane, rest, rest + moved[..., 2], deck.interactions[at.pair.interaction], at.pair.place)


@dataclass(frozen=True, eq=False)
class Supports:
    """What holds the nodes of a block.

    Attributes:
        low: Its lower face.
        high: Its upper face.
        sides: "free" or "roller" of x0, x1, y0, y1.
        pins: In-plane directions of single nodes that are constrained besides.
        hold: Stiffness of springs to ground [N/mm], in total; 0 without.
    """

    low: Constrained
    high: Constrained
    sides: tuple[str, str, str, str]
    pins: int
    hold: float


def supports(block: Block, deck: Deck) -> Supports:
    """Find what holds a block, and refuse what opfem cannot hold so.

    Raises:
        DeckError: If nodes are constrained that are no whole face, or constrained otherwise.
    """
    body = block.body
    moved = displacements(body, deck)[:, block.nodes]  # steps, z, y, x, component
    constrained = ~np.isnan(moved)
    if constrained.shape[0] and np.any(constrained != constrained[0]):
        raise body.place.refuse(f"{body.name} is constrained in some steps only; opfem constrains it in all.")
    mask = constrained[0] if len(constrained) else np.zeros((*block.nodes.shape, 3), bool)
    if np.abs(np.nan_to_num(moved[..., :2])).max(initial=0.0) > _STILL:
        raise body.place.refuse(f"nodes of {body.name} are moved sideways; opfem moves them along z only.")
    explained = np.zeros_like(mask)
    ends = {}
    for side in (0, -1):
        face = mask[side]
        normal = face[..., 2].all()
        lateral = normal and face[..., :2].all()
        if lateral:
            explained[side, ..., :2] = True
        if normal:
            explained[side, ..., 2] = True
        ends[side] = Constrained(bool(lateral), moved[:, side, :, :, 2] if normal else None, block.z[side])
    sides = []
    for component, at in ((0, 0), (0, -1), (1, 0), (1, -1)):
        all_of = slice(None)
        where = (all_of, all_of, at, component) if component == 0 else (all_of, at, all_of, component)
        rolls = bool(mask[where].all()) and not explained[where].all()
        explained[where] |= rolls
        sides.append("roller" if rolls else "free")
    rest = mask & ~explained
    pins = int(rest[[0, -1], ..., :2].sum())
    if rest[1:-1].any() or rest[..., 2].any() or pins > _PINS:
        level, row, column, component = np.argwhere(rest)[0]
        number = body.numbers[block.nodes[level, row, column]]
        raise body.place.refuse(
            f"{int(rest.sum())} displacements of {body.name} are constrained that are no whole face of it, such as "
            f"{'xyz'[component]} of node {number}. opfem holds faces: bonded, roller, or in contact."
        )
    x0, x1, y0, y1 = sides
    return Supports(ends[0], ends[-1], (x0, x1, y0, y1), pins, _hold(block, deck))


def _hold(block: Block, deck: Deck) -> float:
    """Add up the springs to ground [N/mm]."""
    body = block.body
    part = deck.parts[deck.instances[body.instance].part]
    stiffness = np.zeros(3)
    for members, direction, value in part.springs:
        for elements in part.elements:
            if elements.kind != "SPRING1":
                continue
            own = body.index(elements.nodes[np.isin(elements.numbers, members), 0])
            if not any(np.isin(own, block.nodes[side]).all() for side in (0, -1)):
                raise elements.place.refuse(f"springs of {body.name} must stand on one of its faces.")
            stiffness[direction] += value * own.size
    if stiffness[2] or not np.isclose(stiffness[0], stiffness[1], rtol=1e-6):
        raise body.place.refuse(
            f"springs of {body.name} must be alike along x and y and none along z, got {stiffness.tolist()} N/mm."
        )
    return float(stiffness[0])


def is_flat(heights: np.ndarray, size: float) -> bool:
    """Tell whether heights `(…, my, mx)` [mm] are the same all over, at every time."""
    return bool(np.ptp(heights, axis=(-2, -1)).max(initial=0.0) <= SAME * size)
