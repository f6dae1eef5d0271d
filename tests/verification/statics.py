"""What the verification problems share: bodies on meshes of any kind, and nodes by their position."""

import numpy as np

from opfem.mechanics.internal import SolidBody
from opfem.mechanics.unstructured import unstructured_cells
from tests.verification import meshes

FORMS = [
    ("hex8", "full"),
    ("hex8", "mean_dilatation"),
    ("hex8", "reduced"),
    ("hex8", "hybrid"),
    ("tet4", "full"),
    ("tet10", "full"),
]


def tetrahedral(points, hexahedra, kind):
    """Points and cells of the kind in place of hexahedra of any mesh."""
    if kind == "hex8":
        return points, hexahedra
    points, cells = meshes.tetrahedra(points, hexahedra)
    return (points, cells) if kind == "tet4" else meshes.quadratic(points, cells)


def body(points, cells, material, form="mean_dilatation"):
    """A body on cells whose kind shows in their number of nodes."""
    kind = {8: "hex8", 4: "tet4", 10: "tet10"}[cells.shape[1]]
    return SolidBody(material, unstructured_cells(points, cells, kind), form)


def at(coordinate, value):
    """Nodes of a plane."""
    return np.isclose(coordinate, value, rtol=0, atol=1e-9 * max(1.0, np.abs(coordinate).max()))


def nearest(points, *position):
    """Number of the node at a position."""
    distance = np.linalg.norm(points - np.array(position, float)[:, None], axis=0)
    node = int(np.argmin(distance))
    assert distance[node] < 1e-9 * np.abs(points).max()
    return node


def nodal_areas(points, faces):
    """Reference area that each node carries of quadrilaterals in a plane, `(nodes,)`."""
    corners = points[:, faces]  # (3, faces, 4)
    gauss = 0.5 - 0.5 / np.sqrt(3)
    areas = np.zeros(points.shape[1])
    for s, t in [(gauss, gauss), (1 - gauss, gauss), (gauss, 1 - gauss), (1 - gauss, 1 - gauss)]:
        N = np.array([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
        along_s, along_t = np.array([t - 1, 1 - t, t, -t]), np.array([s - 1, -s, s, 1 - s])
        area = 0.25 * np.linalg.norm(np.cross((corners @ along_s).T, (corners @ along_t).T), axis=1)
        areas += np.bincount(faces.ravel(), (area[:, None] * N).ravel(), minlength=points.shape[1])
    return areas


def held(points, **planes):
    """Components that are prescribed: `held(points, x=nodes, z=nodes)`."""
    fixed = np.zeros(points.shape, bool)
    for axis, nodes in planes.items():
        fixed["xyz".index(axis)] |= nodes
    return fixed
