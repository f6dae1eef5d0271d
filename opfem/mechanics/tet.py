"""The tetrahedra of a box: six to a hexahedral cell, all sharing its body diagonal.

Kuhn's subdivision: each goes from the cell's first corner to its last along three edges, one per axis, in one of the
six orders of the axes. It is the same in every cell, so neighbours conform.
"""

import itertools

import numpy as np

# Symmetric four-point rule of degree 2 on the unit tetrahedron, barycentric coordinates.
_FAR, _NEAR = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0, (5.0 - np.sqrt(5.0)) / 20.0
FOUR_POINTS = np.full((4, 4), _NEAR) + (_FAR - _NEAR) * np.eye(4)
# Pairs of vertices whose middles are nodes 5 to 10 of a quadratic tetrahedron, in Abaqus' order.
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def linear_gradients(vertices: np.ndarray) -> np.ndarray:
    """Compute the gradients of the four barycentric coordinates, `(4, 3)`, from the vertices `(4, 3)`."""
    return np.linalg.inv(np.column_stack([np.ones(4), vertices]))[1:].T


def quadratic_gradients(vertices: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Compute the gradients of the ten quadratic shape functions `(10, 3)` at a point in barycentric coordinates."""
    d = linear_gradients(vertices)
    corners = [(4.0 * point[a] - 1.0) * d[a] for a in range(4)]
    middles = [4.0 * (point[a] * d[b] + point[b] * d[a]) for a, b in EDGES]
    return np.array(corners + middles)


def kuhn_tetrahedra() -> np.ndarray:
    """List the vertices of the six tetrahedra of the unit cube, `(6, 4, 3)`, all of positive volume."""
    tetrahedra = []
    for order in itertools.permutations(range(3)):
        steps = np.eye(3, dtype=int)[list(order)]
        vertices = np.concatenate([np.zeros((1, 3), int), np.cumsum(steps, axis=0)])
        if np.linalg.det(steps) < 0:
            vertices[[1, 2]] = vertices[[2, 1]]
        tetrahedra.append(vertices)
    return np.array(tetrahedra)
