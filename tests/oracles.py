"""NumPy oracles that tests of several stages share: tensors point by point, elements in loops. No code of opfem."""

import itertools

import numpy as np

# Corners of a cell, x fastest: the node order that element matrices are documented to have.
CELL = [(x, y, z) for z, y, x in itertools.product((0, 1), repeat=3)]
FACE = [(x, y) for y, x in itertools.product((0, 1), repeat=2)]


def random_rotation(rng):
    """A proper rotation, uniformly distributed."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def cauchy_stress(F, c10, c01, bulk, J=None):
    """Mooney–Rivlin Cauchy stress of one F, from modified b and its inverse; U' of another J if given."""
    volume = np.linalg.det(F)
    b = volume ** (-2 / 3) * F @ F.T
    inverse = np.linalg.inv(b)
    eye = np.eye(3)
    deviator = c10 * (b - np.trace(b) / 3 * eye) - c01 * (inverse - np.trace(inverse) / 3 * eye)
    return 2 / volume * deviator + bulk * ((volume if J is None else J) - 1) * eye


def first_piola(F, c10, c01, bulk, J=None):
    """First Piola–Kirchhoff stress of one F, pulled back from Cauchy stress."""
    return np.linalg.det(F) * cauchy_stress(F, c10, c01, bulk, J) @ np.linalg.inv(F).T


def warped_thickness(ny, nx, extent, mean=0.5, share=0.15):
    """Nodal thickness `(ny+1, nx+1)` of a layer whose interface is neither flat nor symmetric."""
    y, x = np.meshgrid(np.linspace(0, extent[1], ny + 1), np.linspace(0, extent[0], nx + 1), indexing="ij")
    return mean * (1 + share * np.sin(2.1 * x + 0.3) * np.cos(1.7 * y - 0.4) + 0.5 * share * x / extent[0])


def nodal_index(shape, component, z, y, x):
    """Place of an unknown in a flattened nodal field `(3, *shape)`."""
    return np.ravel_multi_index((component, z, y, x), (3, *shape))


def assemble_dense(K):
    """Add element matrices `(nz, 8, 8, 3, 3, ny, nx)` into a dense matrix, entry by entry."""
    nz, *_, ny, nx = K.shape
    shape = (nz + 1, ny + 1, nx + 1)
    size = 3 * int(np.prod(shape))
    dense = np.zeros((size, size), K.dtype)
    for k, j, i in itertools.product(range(nz), range(ny), range(nx)):
        places = [[nodal_index(shape, c, k + z, j + y, i + x) for c in range(3)] for x, y, z in CELL]
        for a, b in itertools.product(range(8), repeat=2):
            dense[np.ix_(places[a], places[b])] += K[k, a, b, :, :, j, i]
    return dense


def assemble_dense_face(K):
    """Add face matrices `(4, 4, 3, 3, ny, nx)` into a dense matrix of a face field `(3, ny+1, nx+1)`."""
    *_, ny, nx = K.shape
    shape = (3, ny + 1, nx + 1)
    dense = np.zeros((int(np.prod(shape)),) * 2)
    for j, i in itertools.product(range(ny), range(nx)):
        places = [[np.ravel_multi_index((c, j + y, i + x), shape) for c in range(3)] for x, y in FACE]
        for a, b in itertools.product(range(4), repeat=2):
            dense[np.ix_(places[a], places[b])] += K[a, b, :, :, j, i]
    return dense


def linear_interpolation(fine):
    """Matrix from the nodes of every second cell to all `fine` nodes; a missing last node is left out."""
    coarse = fine // 2 + 1
    P = np.zeros((fine, coarse))
    for node in range(fine):
        P[node, node // 2] += 1.0 if node % 2 == 0 else 0.5
        if node % 2:
            P[node, node // 2 + 1] += 0.5
    return P
