"""The bodies of a deck: connected elements in their place, and blocks of hexahedra on a regular grid among them.

Between the neutral deck and opfem's problem, which knows only such blocks.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from .cards import DeckError, Place
from .deck import Deck, Elements, Face, Instance, Part

# Corners of the faces S1 to S6 of a hexahedron, as Abaqus and CalculiX number them.
FACES = np.array([(0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)])
HEXAHEDRA = ("C3D8", "C3D8R", "C3D8H", "C3D8RH", "C3D8I", "C3D8IH")
# Positions that differ by less, over the body's size, are the same: decks print 6 or 7 digits.
SAME = 1e-5
# How far a grid's steps may be from equal, of a step.
_UNEVEN = 1e-3
_MOST_BODIES = 100


@dataclass(frozen=True, eq=False)
class Body:
    """Connected elements of an instance.

    Attributes:
        name: Of the instance; in a deck without instances that of the element set that it fills.
        instance: Its name.
        numbers: Of its nodes, rising `(n,)`.
        X: Their positions [mm] `(n, 3)`.
        kinds: Types of its elements.
        elements: Numbers of its elements, rising `(m,)`.
        corners: Nodes of hexahedra by index `(m, 8)`; None where it has other elements.
        material: Of each element, by name; "" without.
        place: Where its first elements are listed.
    """

    name: str
    instance: str
    numbers: np.ndarray
    X: np.ndarray
    kinds: tuple[str, ...]
    elements: np.ndarray
    corners: np.ndarray | None
    material: np.ndarray
    place: Place

    def index(self, numbers: np.ndarray) -> np.ndarray:
        """Find nodes by number; those of other bodies are left out."""
        at = np.minimum(np.searchsorted(self.numbers, numbers), self.numbers.size - 1)
        return at[self.numbers[at] == numbers]

    def face_nodes(self, faces: tuple[Face, ...]) -> np.ndarray:
        """Find the quadrilaterals of a surface that are this body's `(k, 4)`."""
        found = [np.zeros((0, 4), np.int64)]
        for members, side in faces:
            chosen = np.isin(self.elements, members.get(self.instance, ()))
            if not chosen.any():
                continue
            if self.corners is None:
                raise self.place.refuse(f"contact of {self.name}, of {', '.join(self.kinds)}, is not supported.")
            found.append(self.corners[chosen][:, FACES[side - 1]])
        return np.concatenate(found)

    def section(self, y: float) -> np.ndarray:
        """Cut the body: corners x, z [mm] of the hexahedra that a plane at y goes through, `(k, 4, 2)`."""
        if self.corners is None:
            return np.zeros((0, 4, 2))
        X = self.X[self.corners]  # element, corner, component
        cut = X[(X[..., 1].min(axis=1) <= y) & (X[..., 1].max(axis=1) > y)]
        near = np.argsort(cut[..., 1], axis=1, kind="stable")[:, :4]
        flat = np.take_along_axis(cut, near[..., None], axis=1)[..., [0, 2]]
        around = flat - flat.mean(axis=1, keepdims=True)
        turn = np.argsort(np.arctan2(around[..., 1], around[..., 0]), axis=1)
        return np.take_along_axis(flat, turn[..., None], axis=1)

    @cached_property
    def block(self) -> "Block":
        """The body as a block of hexahedra on a regular grid.

        Raises:
            DeckError: If it is none.
        """
        return _block(self)


class Plane(NamedTuple):
    """A regular grid of nodes seen along z: rising x and y [mm], and which nodes stand there `(my, mx)`."""

    x: np.ndarray
    y: np.ndarray
    nodes: np.ndarray


@dataclass(frozen=True, eq=False)
class Block:
    """A body cut into hexahedra by a regular grid in x and y and upright columns of nodes.

    Attributes:
        body: The body.
        x: Of the columns, rising [mm].
        y: Of the columns, rising [mm].
        nodes: Index of every node `(nz+1, ny+1, nx+1)`, z rising.
        cells: Index of every element `(nz, ny, nx)`.
    """

    body: Body
    x: np.ndarray
    y: np.ndarray
    nodes: np.ndarray
    cells: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Heights of the nodes `(nz+1, ny+1, nx+1)` [mm]."""
        return self.body.X[self.nodes, 2]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Elements along x, y and z."""
        nz, ny, nx = self.cells.shape
        return nx, ny, nz

    def flipped(self) -> "Block":
        """Count the same block from above."""
        return Block(self.body, self.x, self.y, self.nodes[::-1], self.cells[::-1])


def find_bodies(deck: Deck) -> list[Body]:
    """Put parts in their places and take them apart into connected bodies.

    Raises:
        DeckError: If elements use nodes that are not there.
    """
    return [body for instance in deck.instances.values() for body in _of_instance(deck.parts[instance.part], instance)]


def _of_instance(part: Part, instance: Instance) -> list[Body]:
    order = np.argsort(part.numbers)
    numbers, X = part.numbers[order], instance.placed(part.positions[order])
    blocks = [block for block in part.elements if block.nodes.shape[1] > 1]  # springs join nothing
    where = []
    for block in blocks:
        at = np.minimum(np.searchsorted(numbers, block.nodes), max(numbers.size - 1, 0))
        missing = block.nodes[numbers[at] != block.nodes] if numbers.size else block.nodes
        if missing.size:
            raise block.place.refuse(f"*ELEMENT: there is no node {missing.flat[0]}.")
        where.append(at)
    if not blocks:
        return []
    first = np.concatenate([np.repeat(at[:, 0], at.shape[1] - 1) for at in where])
    other = np.concatenate([at[:, 1:].ravel() for at in where])
    joined = scipy.sparse.coo_array((np.ones(first.size, bool), (first, other)), shape=(numbers.size,) * 2)
    _, label = connected_components(joined, directed=False)
    firsts = np.concatenate([label[at[:, 0]] for at in where])
    found, order = np.unique(firsts, return_index=True)
    if found.size > _MOST_BODIES:
        raise blocks[0].place.refuse(f"*ELEMENT: the elements fall into {found.size} bodies that share no nodes.")
    own = [np.flatnonzero(label == one) for one in found[np.argsort(order)]]
    return [_body(part, instance, blocks, where, nodes, numbers, X) for nodes in own]


def _body(
    part: Part,
    instance: Instance,
    blocks: list[Elements],
    where: list[np.ndarray],
    own: np.ndarray,
    numbers: np.ndarray,
    X: np.ndarray,
) -> Body:
    """Collect the elements of one body; `own` are its nodes among those of the instance."""
    inside = np.zeros(numbers.size, bool)
    inside[own] = True
    chosen = [inside[at[:, 0]] for at in where]
    taken = [(block, at[take], take) for block, at, take in zip(blocks, where, chosen, strict=True) if take.any()]
    elements = np.concatenate([block.numbers[take] for block, _, take in taken])
    order = np.argsort(elements)
    kinds = tuple(dict.fromkeys(block.kind for block, _, _ in taken))
    corners = None
    if set(kinds) <= set(HEXAHEDRA):
        corners = np.searchsorted(own, np.concatenate([at for _, at, _ in taken]))[order]
    elements = elements[order]
    laws = np.full(elements.size, "", dtype=object)
    for section in part.sections:
        laws[np.isin(elements, section.elements)] = section.material
    name = instance.name
    if not name:
        sets = part.element_sets.items()
        name = next((key for key, members in sets if np.array_equal(np.sort(members), elements)), "the body")
    return Body(name, instance.name, numbers[own], X[own], kinds, elements, corners, laws, taken[0][0].place)


def _steps(values: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Tell apart the different values among positions; returns them, rising, and which one each is."""
    order = np.argsort(values, kind="stable")
    rises = np.diff(values[order], prepend=-np.inf) > SAME * size
    which = np.empty(values.size, np.int64)
    which[order] = np.cumsum(rises) - 1
    return values[order][rises], which


def _is_even(values: np.ndarray) -> bool:
    even = np.linspace(values[0], values[-1], values.size)
    return bool(np.abs(values - even).max() <= _UNEVEN * (even[1] - even[0]))


def _no_block(body: Body, why: str) -> DeckError:
    return body.place.refuse(
        f"{body.name} is no block of hexahedra on a regular grid in x and y: {why}. opfem solves such blocks only."
    )


def plane_of(body: Body, quads: np.ndarray) -> Plane:
    """Arrange the nodes of a surface as a regular grid.

    Raises:
        DeckError: If they are none.
    """
    own = np.unique(quads)
    if not own.size:
        raise body.place.refuse(f"the surface of {body.name} in contact has no faces.")
    X = body.X[own]
    size = float(np.ptp(X[:, :2], axis=0).max())
    (x, column), (y, row) = (_steps(X[:, k], size) for k in range(2))
    if min(x.size, y.size) < 2 or own.size != x.size * y.size:
        raise _no_block(body, f"the {own.size} nodes of its surface in contact fill no grid of {x.size} × {y.size}")
    if not (_is_even(x) and _is_even(y)):
        raise _no_block(body, "the nodes of its surface in contact stand in unequal steps")
    if len(quads) != (x.size - 1) * (y.size - 1):
        raise _no_block(body, f"its surface in contact has {len(quads)} faces on a grid of {x.size} × {y.size} nodes")
    nodes = np.empty((y.size, x.size), np.int64)
    nodes[row, column] = own
    return Plane(x, y, nodes)


def _block(body: Body) -> Block:
    if body.corners is None:
        raise _no_block(body, f"its elements are {', '.join(body.kinds)}")
    X = body.X
    size = float(np.ptp(X, axis=0).max())
    (x, column), (y, row) = (_steps(X[:, k], size) for k in range(2))
    layers, rest = divmod(len(X), x.size * y.size)
    if min(x.size, y.size, layers) < 2 or rest:
        raise _no_block(body, f"{len(X)} nodes in {x.size} × {y.size} columns")
    order = np.lexsort((X[:, 2], column, row))
    nodes = order.reshape(y.size, x.size, layers)
    rows, columns = np.arange(y.size)[:, None, None], np.arange(x.size)[:, None]
    if np.any(column[nodes] != columns) or np.any(row[nodes] != rows):
        raise _no_block(body, "its columns have different numbers of nodes")
    if not (_is_even(x) and _is_even(y)):
        raise _no_block(body, "columns of nodes stand in unequal steps")
    nodes = np.moveaxis(nodes, -1, 0)
    place = np.empty((len(X), 3), np.int64)
    place[nodes] = np.moveaxis(np.indices(nodes.shape), 0, -1)
    corners = place[body.corners]
    low = corners.min(axis=1)
    shape = tuple(n - 1 for n in nodes.shape)
    corner_ids = np.sort(((corners - low[:, None]) * (4, 2, 1)).sum(axis=-1), axis=1)
    wrong = np.any(corners.max(axis=1) - low != 1, axis=1) | np.any(corner_ids != np.arange(8), axis=1)
    if wrong.any():
        raise _no_block(body, f"element {body.elements[wrong][0]} has its corners elsewhere")
    cells = np.full(shape, -1)
    cells[tuple(low.T)] = np.arange(len(low))
    if len(low) != cells.size or np.any(cells < 0):
        raise _no_block(body, f"{len(low)} elements in {cells.size} places")
    return Block(body, x, y, nodes, cells)
