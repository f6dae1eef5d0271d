"""Where the layer touches rigid bodies: two faces, and the sides that may roll onto them.

A compressed layer bulges at its free sides, and a bulge folds onto the window or the sample: the
lower half of the sides can touch the window, the upper half the sample. The sides are one strip of
faces around the layer, seen from outside: south, east, north, west, its first node repeated last.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .face import CORNERS as FACE_CORNERS
from .hex8 import CORNERS
from .kinematics import contract

Place = Literal["window", "sample", "window_sides", "sample_sides"]
Face = Float[Array, "3 rows columns"]
Nodal = Float[Array, "3 mz my mx"]


class Parts(NamedTuple):
    """One thing for each part of the boundary that may touch a body; None where it cannot."""

    window: Any = None
    sample: Any = None
    window_sides: Any = None
    sample_sides: Any = None

    def map(self, function: Callable, *others: "Parts") -> "Parts":
        """Apply a function to every part that is there, with its place first."""
        return Parts(
            *(
                None if mine is None else function(place, mine, *rest)
                for place, mine, *rest in zip(self._fields, self, *others, strict=True)
            )
        )


def take(u: Nodal, place: str) -> Face:
    """Take the nodal values of one part of the boundary."""
    if place in ("window", "sample"):
        return u[:, 0 if place == "window" else -1]
    sides = [u[:, :, 0, :-1], u[:, :, :-1, -1], u[:, :, -1, :0:-1], u[:, :, :0:-1, 0], u[:, :, 0, :1]]
    return jnp.concatenate(sides, axis=-1)[:, _layers(u.shape[1] - 1, place, nodes=True)]


def put(f: Face, place: str, shape: tuple[int, ...]) -> Nodal:
    """Add the nodal values of one part into a zero nodal field: the transpose of `take`."""
    mz, my, mx = shape[1:]
    if place in ("window", "sample"):
        return _placed(f[:, None], shape, z=0 if place == "window" else mz - 1)
    layers = _layers(mz - 1, place, nodes=True)
    f = jnp.concatenate([f[..., :1] + f[..., -1:], f[..., 1:-1]], axis=-1)
    south, east, north, west = jnp.split(f, np.cumsum([mx - 1, my - 1, mx - 1]), axis=-1)
    return (
        _placed(south[:, :, None, :], shape, layers.start)
        + _placed(east[:, :, :, None], shape, layers.start, x=mx - 1)
        + _placed(north[:, :, None, ::-1], shape, layers.start, y=my - 1, x=1)
        + _placed(west[:, :, ::-1, None], shape, layers.start, y=1)
    )


def add_matrices(K: Array, face: Float[Array, "4 4 3 3 rows columns"], place: str) -> Array:
    """Add face matrices to element matrices `(nz, 8, 8, 3, 3, ny, nx)`."""
    nz, ny, nx = K.shape[0], *K.shape[-2:]
    if place in ("window", "sample"):
        corners = [(x, y, int(place == "sample")) for x, y in FACE_CORNERS]
        return _add(K, face[None], corners, z=0 if place == "window" else nz - 1)
    face = jnp.moveaxis(face, 4, 0)  # layers first
    south, east, north, west = jnp.split(face, np.cumsum([nx, ny, nx]), axis=-1)
    first = _layers(nz, place, nodes=False).start
    K = _add(K, south[..., None, :], [(s, 0, z) for s, z in FACE_CORNERS], first)
    K = _add(K, east[..., :, None], [(1, s, z) for s, z in FACE_CORNERS], first, x=nx - 1)
    K = _add(K, north[..., None, ::-1], [(1 - s, 1, z) for s, z in FACE_CORNERS], first, y=ny - 1)
    return _add(K, west[..., ::-1, None], [(0, 1 - s, z) for s, z in FACE_CORNERS], first)


def _layers(nz: int, place: str, nodes: bool) -> slice:
    """Rows of the strip of sides that belong to a body: its own half of the layer."""
    half = (nz + 1) // 2
    first = 0 if place == "window_sides" else nz - half
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
