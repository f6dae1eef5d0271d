"""Internal force and tangent against felupe, whose elements, materials and assembly share no code with opfem.

felupe (a development dependency, never imported by the package) states `mean_dilatation` as three fields,
displacement, pressure and volume ratio; both of the latter are eliminated here element by element.
"""

import itertools

import equinox as eqx
import felupe as fem
import jax.numpy as jnp
import numpy as np
import pytest
from felupe.constitution.tensortrax import Hyperelastic
from felupe.constitution.tensortrax.models.hyperelastic import mooney_rivlin

import opfem as op
from opfem.mechanics.internal import layer_body
from opfem.model import LayerMesh
from tests.oracles import assemble_dense, warped_thickness

EXTENT = (0.9, 0.8)
C10, C01, BULK = 2.2e-3, 7.03e-4, 0.11612
# Corners in VTK's order.
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
MATERIALS = {
    "neo-hooke": (op.NeoHooke(C10, BULK), fem.NeoHooke(mu=2 * C10, bulk=BULK)),
    "mooney-rivlin": (
        op.MooneyRivlin(C10, C01, BULK),
        fem.CompositeMaterial(Hyperelastic(mooney_rivlin, C10=C10, C01=C01), fem.Volumetric(bulk=BULK)),
    ),
}
_force = eqx.filter_jit(lambda body, u: body.internal_force(u)[0])
_stiffness = eqx.filter_jit(lambda body, u: body.cell_stiffness(u))


def felupe_mesh(X):
    """The same mesh; its points run as opfem's nodes, x fastest."""
    nz, ny, nx = (n - 1 for n in X.shape[1:])
    numbers = np.arange(X[0].size).reshape(X.shape[1:])
    cells = [
        [numbers[k + z, j + y, i + x] for x, y, z in CORNERS]
        for k, j, i in itertools.product(range(nz), range(ny), range(nx))
    ]
    return fem.Mesh(X.reshape(3, -1).T, np.array(cells), "hexahedron")


def by_felupe(mesh, law, u, form):
    """Force `(3 nodes,)` and tangent, unknowns point by point."""
    nodal = u.reshape(3, -1).T
    if form == "full":
        field = fem.FieldContainer([fem.Field(fem.RegionHexahedron(mesh), dim=3, values=nodal)])
        solid = fem.SolidBody(law, field)
        return solid.assemble.vector().toarray().ravel(), solid.assemble.matrix().toarray()
    field = fem.FieldsMixed(fem.RegionHexahedron(mesh), n=3)
    field[0].values[:] = nodal
    volumes = field[0].region.dV
    J = np.linalg.det(np.moveaxis(field[0].grad(), (0, 1), (-2, -1)) + np.eye(3))
    mean = ((J * volumes).sum(axis=0) / volumes.sum(axis=0))[:, None]
    field[1].values[:] = np.repeat(BULK * (mean - 1), len(field[1].values) // len(mean), axis=0)
    field[2].values[:] = np.repeat(mean, len(field[2].values) // len(mean), axis=0)
    solid = fem.SolidBody(fem.ThreeFieldVariation(law), field)
    force, K = solid.assemble.vector().toarray().ravel(), solid.assemble.matrix().toarray()
    n = nodal.size
    assert np.abs(force[n:]).max() < 1e-12 * np.abs(force[:n]).max()
    return force[:n], K[:n, :n] - K[:n, n:] @ np.linalg.solve(K[n:, n:], K[n:, :n])


@pytest.mark.parametrize("form", ["full", "mean_dilatation"])
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("elements", [(1, 1, 1), (4, 4, 2)])
def test_force_and_tangent(elements, name, form):
    material, law = MATERIALS[name]
    nx, ny, nz = elements
    mesh = LayerMesh(jnp.array(warped_thickness(ny, nx, EXTENT)), jnp.array(EXTENT), nz)
    X = np.asarray(mesh.positions())
    u = 0.03 * np.random.default_rng(0).standard_normal(X.shape)
    body = layer_body(mesh, material, form)
    force, tangent = by_felupe(felupe_mesh(X), law, u, form)
    order = np.arange(u.size).reshape(3, -1).T.ravel()  # from component by component to point by point
    got = np.asarray(_force(body, jnp.asarray(u))).ravel()[order]
    np.testing.assert_allclose(got, force, rtol=0, atol=1e-10 * np.abs(force).max())
    K = assemble_dense(np.asarray(_stiffness(body, jnp.asarray(u))))[np.ix_(order, order)]
    np.testing.assert_allclose(K, tangent, rtol=0, atol=1e-10 * np.abs(tangent).max())
