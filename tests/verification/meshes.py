"""Meshes of the verification problems: points `(3, nodes)` and cells `(elements, nodes per cell)`, NumPy only.

Hexahedra run x fastest, then y, then z; quadratic tetrahedra follow Abaqus. Every function returns
`(points, cells)`; node sets are found from positions.
"""

import itertools

import numpy as np

CORNERS = np.array([(x, y, z) for z, y, x in itertools.product((0, 1), repeat=3)])
# Corners of the faces of a hexahedron, right-handed about the outward normal: x0, x1, y0, y1, z0, z1.
FACES = np.array([(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)])
# Six tetrahedra of a unit cube, from (0, 0, 0) to (1, 1, 1) along its edges; odd orders of the axes are turned.
KUHN = [
    np.array([v[k] for k in ((0, 1, 2, 3) if np.linalg.det(np.diff(v, axis=0)) > 0 else (0, 2, 1, 3))])
    for v in (
        np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        for order in itertools.permutations(range(3))
    )
]
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def merged(points, cells, decimals=9):
    """Join nodes at the same place; points are rounded relative to the size of the mesh."""
    scale = np.abs(points).max()
    places = np.round(points / scale, decimals) + 0.0
    _, first, inverse = np.unique(places, axis=1, return_index=True, return_inverse=True)
    return points[:, first], inverse.reshape(-1)[cells]


def grid(x, y, z):
    """A box between the given planes."""
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    points = np.stack([xx, yy, zz]).reshape(3, -1)
    nx, ny, nz = len(x) - 1, len(y) - 1, len(z) - 1
    numbers = np.arange(points.shape[1]).reshape(nz + 1, ny + 1, nx + 1)
    cells = np.stack([numbers[c : c + nz, b : b + ny, a : a + nx].ravel() for a, b, c in CORNERS], axis=1)
    return points, cells


def unit_cube(n):
    """A unit cube of n³ hexahedra."""
    planes = np.linspace(0, 1, n + 1)
    return grid(planes, planes, planes)


def patch_cube():
    """Seven distorted hexahedra filling the unit cube; nodes 0 to 7 are its corners.

    Source: MacNeal & Harder, Finite Elements in Analysis and Design 1 (1985) 3, figure 2.
    """
    inner = [
        (0.249, 0.342, 0.192),
        (0.826, 0.288, 0.288),
        (0.273, 0.750, 0.230),
        (0.850, 0.649, 0.263),
        (0.320, 0.186, 0.643),
        (0.677, 0.305, 0.683),
        (0.165, 0.745, 0.702),
        (0.788, 0.693, 0.644),
    ]
    points = np.concatenate([CORNERS, inner]).T.astype(float)
    cells = [np.arange(8, 16)]
    for axis, end in itertools.product(range(3), (0, 1)):
        # The cell between a face of the cube and the same face of the inner hexahedron.
        cell = CORNERS.copy()
        inside = cell[:, axis] != end
        cell[:, axis] = end
        cells.append(cell @ (1, 2, 4) + 8 * inside)
    return points, np.array(cells)


def layered(plane, quads, z):
    """Hexahedra over quadrilaterals `(cells, 4)`, x fastest, in the plane."""
    count = plane.shape[1]
    points = np.concatenate([np.concatenate([plane, np.full((1, count), height)]) for height in z], axis=1)
    cells = [np.concatenate([quads + count * k, quads + count * (k + 1)], axis=1) for k in range(len(z) - 1)]
    return points, np.concatenate(cells)


def cook(n):
    """Cook's membrane of n × n × 1 hexahedra, 1 mm thick: corners (0, 0), (48, 44), (48, 60), (0, 44)."""
    points, cells = grid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), [0.0, 1.0])
    s, t, z = points
    return np.stack([48 * s, 44 * s + t * (44 - 28 * s), z]), cells


def polygon_radius(core):
    """Distance of the corners of a polygon with the area of the unit circle, 2 × core corners to a quarter."""
    step = np.pi / (4 * core)
    return np.sqrt(step / np.sin(step))


def quarter_disc(core, inward, radii, z):
    """A quarter disc about z: a square core, blends out to the first radius, circles beyond.

    Circles are polygons of the same area, so their nodes lie a little outside.

    Args:
        core: Cells along a side of the core; there are twice as many along an arc.
        inward: Positions between core (0) and the first radius (1), ascending, without the ends.
        radii: Radii of the circles, ascending.
        z: Heights of the planes.
    """
    angles = np.linspace(0, np.pi / 2, 2 * core + 1)
    circle = polygon_radius(core) * np.stack([np.cos(angles), np.sin(angles)])
    side, corner = 0.5 * radii[0], 0.4 * radii[0]
    s = np.linspace(0, 1, core + 1)
    t, s = np.meshgrid(s, s, indexing="ij")
    x, y = side * s + (corner - side) * s * t, side * t + (corner - side) * s * t
    points, cells = _quads(np.stack([x, y]))
    right, top = np.stack([x[:, -1], y[:, -1]]), np.stack([x[-1, -2::-1], y[-1, -2::-1]])
    edge = np.concatenate([right, top], axis=1)
    curves = [edge, *(edge + p * (radii[0] * circle - edge) for p in inward), *(r * circle for r in radii)]
    more, ring_cells = _quads(np.stack(curves, axis=-1))
    plane, quads = merged(np.concatenate([points, more], axis=1), np.concatenate([cells, ring_cells + points.shape[1]]))
    plane[np.abs(plane) < 1e-12 * radii[-1]] = 0.0
    return layered(plane, quads, z)


def cylinder_sector(arc, radii, thickness):
    """A quarter of a hollow cylinder, one cell thick along z."""
    angles = np.linspace(0, np.pi / 2, arc + 1)
    r, angle = np.meshgrid(radii, angles)
    plane, quads = _quads(np.stack([r * np.cos(angle), r * np.sin(angle)]))
    plane[np.abs(plane) < 1e-12 * radii[-1]] = 0.0
    return layered(plane, quads, [0.0, thickness])


def sphere_octant(n, radii):
    """An octant of a hollow sphere: three patches of n × n cells over the angles."""
    axes = np.eye(3)
    middle = np.ones(3) / np.sqrt(3)
    s = np.linspace(0, 1, n + 1)
    points, cells, count = [], [], 0
    for k in range(3):
        a, b, c = axes[k], axes[(k + 1) % 3], axes[(k + 2) % 3]
        corners = np.array([[a, (a + b) / np.sqrt(2)], [(a + c) / np.sqrt(2), middle]])  # [t][s]
        weights = np.stack([1 - s, s])
        surface = np.einsum("ti,sj,tsk->jik", weights, weights, corners)  # (s, t, xyz)
        surface = surface / np.linalg.norm(surface, axis=-1, keepdims=True)
        block = np.asarray(radii)[:, None, None, None] * surface  # (r, s, t, xyz)
        _, index = grid(s, s, radii)
        points.append(np.moveaxis(np.swapaxes(block, 1, 2), -1, 0).reshape(3, -1))
        cells.append(index + count)
        count += points[-1].shape[1]
    joined, cells = merged(np.concatenate(points, axis=1), np.concatenate(cells))
    joined[np.abs(joined) < 1e-12 * radii[-1]] = 0.0
    return joined, cells


def tetrahedra(points, cells):
    """Split every hexahedron in 24 about its centre and the centres of its faces; any mesh stays conforming."""
    count = points.shape[1]
    centres = points[:, cells].mean(axis=2)
    faces = cells[:, FACES]  # (e, 6, 4)
    middles = points[:, faces].mean(axis=3).reshape(3, -1)
    centre = count + np.arange(len(cells))
    middle = (count + len(cells) + np.arange(6 * len(cells))).reshape(-1, 6)
    tets = [
        np.stack([faces[:, f, k], faces[:, f, (k + 1) % 4], middle[:, f], centre], axis=1)
        for f, k in itertools.product(range(6), range(4))
    ]
    # From outside the face turns left, so the centre lies behind it: swap two vertices.
    tets = np.concatenate(tets)[:, [1, 0, 2, 3]]
    return merged(np.concatenate([points, centres, middles], axis=1), tets)


def divided(cells):
    """Split every hexahedron of a grid in six along its diagonal; the nodes stay."""
    return np.concatenate([cells[:, vertices @ (1, 2, 4)] for vertices in KUHN])


def quadratic(points, tets):
    """Add the middles of the edges of linear tetrahedra."""
    pairs = np.sort(np.concatenate([tets[:, edge] for edge in EDGES]), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middles = points[:, edges].mean(axis=2)
    numbers = points.shape[1] + inverse.reshape(6, -1).T
    return np.concatenate([points, middles], axis=1), np.concatenate([tets, numbers], axis=1)


def boundary_faces(cells, points, where):
    """Faces `(faces, 4)` of hexahedra whose four nodes all lie where `where(points)` is true, outward normals."""
    faces = cells[:, FACES].reshape(-1, 4)
    return faces[where(points)[faces].all(axis=1)]


def _quads(positions):
    """Nodes and quadrilaterals of a mapped grid, positions `(2, rows, columns)`; columns are x."""
    _, rows, columns = positions.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=-1)
    return positions.reshape(2, -1), quads.reshape(-1, 4)
