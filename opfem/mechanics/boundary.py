"""Contact boundary of the layer: two faces, and the sides that may fold onto the rigid bodies.

A compressed layer bulges at its free sides, and a bulge folds onto window or sample: contact includes the lower half of
the sides with the window, the upper half with the sample. The sides are one strip of faces around the layer, seen from
outside: south, east, north, west, its first node repeated last.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .face import CORNERS as FACE_CORNERS, assemble_face, gather_face
from .hex8 import CORNERS
from .kinematics import contract

Body = Literal["window", "sample"]
Nodal = Float[Array, "3 mz my mx"]
Corners = Float[Array, "4 c faces"]


class Bodies(NamedTuple):
    """One value per rigid body; None for a body without contact."""

    window: Any = None
    sample: Any = None

    def map(self, function: Callable, *others: "Bodies") -> "Bodies":
        """Apply a function to every body with contact, its name first."""
        return Bodies(
            *(
                None if mine is None else function(body, mine, *rest)
                for body, mine, *rest in zip(self._fields, self, *others, strict=True)
            )
        )


class Touching(NamedTuple):
    """Nodal values of all faces in contact with one body: the face, and its half of the sides or None."""

    face: Float[Array, "c my mx"]
    sides: Float[Array, "c rows columns"] | None

    @property
    def total(self) -> Float[Array, " c"]:
        """The sum over all nodes."""
        face = jnp.sum(self.face, axis=(1, 2))
        return face if self.sides is None else face + jnp.sum(self.sides, axis=(1, 2))


def take(u: Nodal, body: str, with_sides: bool) -> Corners:
    """Gather nodal values at the corners of all faces in contact with a body, those of the sides last."""
    nodes = touched(u, body, with_sides)
    corners = gather_face(nodes.face).reshape(4, 3, -1)
    if nodes.sides is None:
        return corners
    return jnp.concatenate([corners, gather_face(nodes.sides).reshape(4, 3, -1)], axis=-1)


def touched(u: Nodal, body: str, with_sides: bool) -> Touching:
    """Extract the nodal values of all faces in contact with a body."""
    face = u[:, _level(u.shape[1], body)]
    if not with_sides:
        return Touching(face, None)
    rows = u[:, _layers(u.shape[1] - 1, body, nodes=True)]
    strip = [rows[:, :, 0, :-1], rows[:, :, :-1, -1], rows[:, :, -1, :0:-1], rows[:, :, :0:-1, 0], rows[:, :, 0, :1]]
    return Touching(face, jnp.concatenate(strip, axis=-1))


def to_touching(corners: Corners, elements: tuple[int, int, int]) -> Touching:
    """Assemble corner values at nodes.

    Args:
        corners: Corner values, ordered as `take` does.
        elements: Elements (nz, ny, nx).
    """
    face, sides = _split(corners, elements)
    return Touching(assemble_face(face), None if sides is None else assemble_face(sides))


def put(values: Touching, body: str, shape: tuple[int, ...]) -> Nodal:
    """Return a nodal field that is zero except for the nodal values of a body's faces."""
    mz, my, mx = shape[1:]
    whole = _placed(values.face[:, None], shape, z=_level(mz, body))
    if values.sides is None:
        return whole
    z = _layers(mz - 1, body, nodes=True).start
    sides = jnp.concatenate([values.sides[..., :1] + values.sides[..., -1:], values.sides[..., 1:-1]], axis=-1)
    south, east, north, west = jnp.split(sides, np.cumsum([mx - 1, my - 1, mx - 1]), axis=-1)
    return (
        whole
        + _placed(south[:, :, None, :], shape, z)
        + _placed(east[:, :, :, None], shape, z, x=mx - 1)
        + _placed(north[:, :, None, ::-1], shape, z, y=my - 1, x=1)
        + _placed(west[:, :, ::-1, None], shape, z, y=1)
    )


def add_matrices(K: Array, matrices: Float[Array, "4 4 3 3 faces"], body: str) -> Array:
    """Add face matrices, ordered as `take` does, to element matrices `(nz, 8, 8, 3, 3, ny, nx)`."""
    nz, ny, nx = K.shape[0], *K.shape[-2:]
    face, sides = _split(matrices, (nz, ny, nx))
    corners = [(x, y, int(body == "sample")) for x, y in FACE_CORNERS]
    K = _add(K, face[None], corners, z=_level(nz, body))
    if sides is None:
        return K
    sides = jnp.moveaxis(sides, 4, 0)  # layers first
    south, east, north, west = jnp.split(sides, np.cumsum([nx, ny, nx]), axis=-1)
    first = _layers(nz, body, nodes=False).start
    K = _add(K, south[..., None, :], [(s, 0, z) for s, z in FACE_CORNERS], first)
    K = _add(K, east[..., :, None], [(1, s, z) for s, z in FACE_CORNERS], first, x=nx - 1)
    K = _add(K, north[..., None, ::-1], [(1 - s, 1, z) for s, z in FACE_CORNERS], first, y=ny - 1)
    return _add(K, west[..., ::-1, None], [(0, 1 - s, z) for s, z in FACE_CORNERS], first)


def is_side(elements: tuple[int, int, int]) -> np.ndarray:
    """Return which faces of `take` are sides, `(faces,)`."""
    nz, ny, nx = elements
    return np.arange(ny * nx + (nz + 1) // 2 * 2 * (nx + ny)) >= ny * nx


def _split(values: Array, elements: tuple[int, int, int]) -> tuple[Array, Array | None]:
    """Split values of all faces in contact with a body into those of its face and of the sides, as grids."""
    nz, ny, nx = elements
    face = values[..., : ny * nx].reshape(*values.shape[:-1], ny, nx)
    if values.shape[-1] == ny * nx:
        return face, None
    return face, values[..., ny * nx :].reshape(*values.shape[:-1], (nz + 1) // 2, 2 * (nx + ny))


def _level(n: int, body: str) -> int:
    return 0 if body == "window" else n - 1


def _layers(nz: int, body: str, nodes: bool) -> slice:
    """Rows of the strip of sides in contact with a body: the half of the layer next to it."""
    half = (nz + 1) // 2
    first = 0 if body == "window" else nz - half
    return slice(first, first + half + nodes)


def _placed(values: Array, shape: tuple[int, ...], z: int, y: int = 0, x: int = 0) -> Array:
    start = (0, z, y, x)
    widths = [(at, n - at - m) for at, n, m in zip(start, shape, values.shape, strict=True)]
    return jnp.pad(values, widths)


def _add(K: Array, face: Array, corners: list[tuple[int, int, int]], z: int, y: int = 0, x: int = 0) -> Array:
    """Add `(nz', 4, 4, 3, 3, ny', nx')` to the elements that start at z, y, x."""
    to_element = np.zeros((8, 4))
    to_element[[CORNERS.index(corner) for corner in corners], range(4)] = 1.0
    pairs = np.einsum("aA,bB->abAB", to_element, to_element).reshape(8, 8, 16)
    face = jnp.moveaxis(face, 0, 2)
    whole = jnp.moveaxis(contract(pairs, face.reshape(16, *face.shape[2:])), 2, 0)
    at = (z, 0, 0, 0, 0, y, x)
    block = jax.lax.dynamic_slice(K, at, whole.shape)
    return jax.lax.dynamic_update_slice(K, block + whole, at)
